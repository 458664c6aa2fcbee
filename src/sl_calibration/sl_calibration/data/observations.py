"""What a calibration is solved from, kept so that it can be solved again.

Nothing here is a result: plate coordinates that were given, pixels that were measured, heights
that the stage reported.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from zipfile import BadZipFile
from zlib import error as ZlibError  # noqa: N812

import numpy as np
from numpy.typing import NDArray

from sl_common.documents import written_atomically
from sl_common.errors import CalibrationError

Array = NDArray[np.float64]

FORMAT = 1
#: Views are aside of each other when their x or y differ by this, metres.
SAME_XY_M = 20e-6


@dataclass(frozen=True)
class View:
    """The plate at one height of the stage, seen by the camera and lit by the projector.

    Parameters
    ----------
    height_m : float
        Stage z, as the stage reports it, metres.
    hole_ids : ndarray, (N, 2), int
        Column and row of each hole on the plate.
    plate_xy_m : ndarray, (N, 2)
        Where the holes are on the plate, metres.
    centres_px : ndarray, (N, 2)
        Images of their centres, camera pixels.
    centres_sigma_px : ndarray, (N,)
        1-sigma of each coordinate.
    camera_px : ndarray, (M, 2)
        Camera pixels on the plate at which the projector's coordinates were decoded.
    dmd_px : ndarray, (M, 2)
        DMD column and row that light them.
    dmd_sigma_px : ndarray, (M, 2)
        Their 1-sigma, the camera's noise included.
    edge_sigma_px : float
        1-sigma of a single edge on this plate in this light, camera pixels.
    xy_m : tuple of float
        Stage x and y, as the stage reports them, metres.

    Raises
    ------
    CalibrationError
        When shapes do not fit, or a number is not finite (``edge_sigma_px`` may be NaN).
    """

    height_m: float
    hole_ids: NDArray[np.int64]
    plate_xy_m: Array
    centres_px: Array
    centres_sigma_px: Array
    camera_px: Array
    dmd_px: Array
    dmd_sigma_px: Array
    edge_sigma_px: float = float("nan")
    xy_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        holes, targets = len(self.centres_px), len(self.camera_px)
        shapes = {"height_m": (), "hole_ids": (holes, 2), "xy_m": (2,)}
        shapes |= {"plate_xy_m": (holes, 2), "centres_px": (holes, 2), "centres_sigma_px": (holes,)}
        shapes |= dict.fromkeys(("camera_px", "dmd_px", "dmd_sigma_px"), (targets, 2))
        for name, shape in shapes.items():
            value = np.asarray(getattr(self, name))
            if value.shape != shape:
                raise CalibrationError(f"{name}.shape={value.shape}; expected {shape}")
            if not np.all(np.isfinite(value)):
                raise CalibrationError(f"{name} holds a number that is not finite")
            if "sigma" in name and not np.all(value > 0):
                raise CalibrationError(f"{name} holds numbers that are not positive")

    @property
    def place(self) -> tuple[float, float, float]:
        """Where the stage stood, metres."""
        return (*self.xy_m, self.height_m)


def stage_positions(views: Sequence[View]) -> Array:
    """Stage position (V, 3) of each view: z as it reads, x and y from where most views stood.

    A stage whose x and y only tremble has not moved in them.
    """
    places = np.array([view.place for view in views]).reshape(-1, 3)
    if len(places):
        places[:, :2] -= np.median(places[:, :2], axis=0)
    places[:, :2][np.abs(places[:, :2]) < SAME_XY_M] = 0.0
    return places


@dataclass(frozen=True)
class Observations:
    """All views of a run, and what has to be known beside them.

    Parameters
    ----------
    views : tuple of View
        In the order in which they were taken.
    camera_size, dmd_size : tuple of int
        (width, height), pixels.
    camera_pitch_m, dmd_pitch_m : float
        Pixel pitch on the chips, metres; for reports in millimetres only.
    made_from : mapping
        Where, when and with what they were taken; plain values.
    """

    views: tuple[View, ...]
    camera_size: tuple[int, int]
    dmd_size: tuple[int, int]
    camera_pitch_m: float
    dmd_pitch_m: float
    made_from: Mapping[str, Any] = field(default_factory=dict)

    @property
    def stage_m(self) -> Array:
        """Stage position (V, 3) of each view."""
        return stage_positions(self.views)

    @property
    def has_targets(self) -> bool:
        """Whether the projector was seen in any view."""
        return any(len(view.camera_px) for view in self.views)


def save_observations(path: Path, observations: Observations) -> None:
    """Write observations in one step.

    Parameters
    ----------
    path : Path
        A ``.npz``: arrays ``NAME_i`` of view i, and the rest as JSON ``about``.
    observations : Observations
        What is written.
    """
    about = {
        "format": FORMAT,
        "views": len(observations.views),
        **{k: v for k, v in vars(observations).items() if k != "views"},
    }
    arrays = {
        f"{name}_{i}": np.asarray(value)
        for i, view in enumerate(observations.views)
        for name, value in asdict(view).items()
    }
    arrays["about"] = np.array(json.dumps(about))
    with written_atomically(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def load_observations(path: Path) -> Observations:
    """Read what `save_observations` wrote.

    Raises
    ------
    CalibrationError
        When the file is not one, or incomplete.
    """
    try:
        with path.open("rb") as whole, np.load(whole, allow_pickle=False) as file:
            about = json.loads(str(file["about"]))
            if about.get("format") != FORMAT:
                raise CalibrationError(
                    f"{path} is of format {about.get('format')}; expected format {FORMAT}"
                )
            views = tuple(_view(file, i) for i in range(int(about["views"])))
        camera_size, dmd_size = _size(about["camera_size"]), _size(about["dmd_size"])
        pitches = float(about["camera_pitch_m"]), float(about["dmd_pitch_m"])
        return Observations(views, camera_size, dmd_size, *pitches, about["made_from"])
    except CalibrationError:
        raise
    except (OSError, KeyError, ValueError, TypeError, EOFError, BadZipFile, ZlibError) as error:
        raise CalibrationError(
            f"{path} holds no observations ({error}); expected the observations.npz of a run"
        ) from error


def _view(file: Mapping[str, Any], i: int) -> View:
    """View i of a file; older files have no x and y."""
    names = [name for name in View.__dataclass_fields__ if name != "xy_m" or f"{name}_{i}" in file]
    values = {name: file[f"{name}_{i}"] for name in names}
    x, y = values.get("xy_m", (0.0, 0.0))
    numbers = {name: float(values[name]) for name in ("height_m", "edge_sigma_px")}
    return View(**{**values, **numbers, "xy_m": (float(x), float(y))})


def _size(value: Any) -> tuple[int, int]:
    width, height = map(int, value)
    return width, height
