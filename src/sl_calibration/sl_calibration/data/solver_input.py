"""Observations as the solver wants them: one row per hole or target, all views joined.

The world is the plate as it lies when the stage reads zero: x and y in the plate, z along its
normal towards the devices. `stage_m` is where the stage says it stands, relative to that zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sl_calibration.data.observations import Observations
from sl_common.errors import CalibrationError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HoleView:
    """Holes of the plate, as a camera sees them at one stage position.

    Parameters
    ----------
    stage_m : ndarray, (3,)
        Stage position, metres; z up.
    plate_xy_m : ndarray, (N, 2)
        Where the holes are on the plate, metres.
    pixels : ndarray, (N, 2)
        Observed images (u, v) of the holes' centres, pixels.
    sigma_px : float or ndarray, (N,) or (N, 2)
        1-sigma of the coordinates, pixels.

    Raises
    ------
    CalibrationError
        When shapes do not fit or a number is not finite.
    """

    stage_m: Array
    plate_xy_m: Array
    pixels: Array
    sigma_px: Array

    def __post_init__(self) -> None:
        _set(self, "stage_m", (3,))
        _set(self, "plate_xy_m", (-1, 2))
        _set(self, "pixels", (len(self.plate_xy_m), 2))
        object.__setattr__(self, "sigma_px", _sigma(self.sigma_px, len(self.pixels)))


@dataclass(frozen=True)
class TargetView:
    """Points of a flat, as camera and projector name them at one stage position.

    Parameters
    ----------
    stage_m : ndarray, (3,)
        Stage position, metres; z up.
    camera_px : ndarray, (N, 2)
        Camera pixels (u, v).
    projector_px : ndarray, (N, 2)
        DMD coordinates (column, row) decoded there, pixels.
    sigma_px : float or ndarray, (N,) or (N, 2)
        1-sigma of the DMD coordinates, DMD pixels; the camera's noise is to be included.

    Raises
    ------
    CalibrationError
        When shapes do not fit or a number is not finite.
    """

    stage_m: Array
    camera_px: Array
    projector_px: Array
    sigma_px: Array

    def __post_init__(self) -> None:
        _set(self, "stage_m", (3,))
        _set(self, "camera_px", (-1, 2))
        _set(self, "projector_px", (len(self.camera_px), 2))
        object.__setattr__(self, "sigma_px", _sigma(self.sigma_px, len(self.camera_px)))


def _set(view: HoleView | TargetView, name: str, shape: tuple[int, ...]) -> None:
    array = np.asarray(getattr(view, name), dtype=np.float64)
    fits = array.ndim == len(shape) and all(
        want in (-1, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = tuple("N" if n == -1 else n for n in shape)
        raise CalibrationError(f"{name}.shape={array.shape}; expected {wanted}")
    if not np.all(np.isfinite(array)):
        raise CalibrationError(f"{name} holds a number that is not finite; expected measured ones")
    object.__setattr__(view, name, array)


def _sigma(value: ArrayLike, count: int) -> Array:
    sigma = np.asarray(value, dtype=np.float64)
    if sigma.shape == (count,):
        sigma = sigma[:, np.newaxis]
    if sigma.shape not in ((), (count, 1), (count, 2)):
        raise CalibrationError(f"sigma_px.shape={sigma.shape}; expected () or ({count},) or x 2")
    if not np.all((sigma > 0) & np.isfinite(sigma)):
        raise CalibrationError("sigma_px holds numbers that are not positive; expected pixels")
    return np.array(np.broadcast_to(sigma, (count, 2)))


@dataclass(frozen=True)
class Holes:
    """All views of the plate, one row per hole.

    ``points_m`` (N, 3) on the plate, ``stage_m`` (N, 3), ``view`` (N,) indices, ``pixels`` (N, 2),
    ``sigma_px`` (N, 2).
    """

    points_m: Array
    stage_m: Array
    view: NDArray[np.intp]
    pixels: Array
    sigma_px: Array

    @property
    def nominal_m(self) -> Array:
        """World points (N, 3) as a faultless stage would have them."""
        return np.asarray(self.points_m + self.stage_m)

    def part(self, rows: NDArray[np.bool_]) -> Holes:
        """Only some rows."""
        return Holes(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @classmethod
    def of(cls, views: Sequence[HoleView]) -> Holes:
        """Join views."""
        flat = [np.pad(view.plate_xy_m, ((0, 0), (0, 1))) for view in views]
        return cls(
            _join(flat, 3), *_stage(views),
            _join([view.pixels for view in views], 2), _join([view.sigma_px for view in views], 2),
        )  # fmt: skip


@dataclass(frozen=True)
class Targets:
    """All projected targets, one row each.

    ``camera_px`` (N, 2), ``stage_m`` (N, 3), ``view`` (N,) indices, ``pixels`` (N, 2) on the DMD,
    ``sigma_px`` (N, 2).
    """

    camera_px: Array
    stage_m: Array
    view: NDArray[np.intp]
    pixels: Array
    sigma_px: Array

    def part(self, rows: NDArray[np.bool_]) -> Targets:
        """Only some rows."""
        return Targets(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @classmethod
    def of(cls, views: Sequence[TargetView]) -> Targets:
        """Join views."""
        return cls(
            _join([view.camera_px for view in views], 2), *_stage(views),
            _join([view.projector_px for view in views], 2),
            _join([view.sigma_px for view in views], 2),
        )  # fmt: skip


def _join(parts: Sequence[Array], width: int) -> Array:
    return np.concatenate([np.empty((0, width)), *parts])


def _stage(views: Sequence[HoleView] | Sequence[TargetView]) -> tuple[Array, NDArray[np.intp]]:
    """Stage position (N, 3) and view index (N,) of every row."""
    counts = [len(view.sigma_px) for view in views]
    stage = np.array([view.stage_m for view in views]).reshape(-1, 3)
    return np.repeat(stage, counts, axis=0), np.repeat(np.arange(len(views)), counts)


def hole_views(observations: Observations) -> list[HoleView]:
    """Holes as the solver wants them."""
    return [
        HoleView(stage_m, v.plate_xy_m, v.centres_px, v.centres_sigma_px)
        for stage_m, v in zip(observations.stage_m, observations.views, strict=True)
    ]


def target_views(observations: Observations) -> list[TargetView]:
    """Targets as the solver wants them."""
    return [
        TargetView(stage_m, v.camera_px, v.dmd_px, v.dmd_sigma_px)
        for stage_m, v in zip(observations.stage_m, observations.views, strict=True)
    ]
