"""What a run is made from; published, so that a recording of it is solved to the same bits."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from typing import Any

from sl_calibration.bundle.parameters import FixedLens
from sl_calibration.data.observations import Observations, View
from sl_calibration.data.session import CalibrationRequest
from sl_calibration.solve.acceptance import Limits
from sl_calibration.target.plate import Plate

_NO_SIDE = "not checked: no mark of this plate tells its face from its back"


@dataclass(frozen=True)
class Pitches:
    """Pixel pitches of the chips, metres; they only turn pixels into millimetres in reports."""

    camera_m: float
    projector_m: float


@dataclass(frozen=True)
class RunRecord:
    """A calibration run, in plain values.

    Parameters
    ----------
    scan_ids : tuple of int
        Its stacks in order; empty where all that fit are meant.
    made_from : mapping
        See `made_from_request`.
    pitches : Pitches
        Of the chips.
    limits : Limits
        Acceptance gate.
    accepted : bool
        Whether the calibration passed.
    hash : str
        Of the calibration; empty where there is none.
    message : str
        The run's outcome.
    """

    scan_ids: tuple[int, ...]
    made_from: Mapping[str, Any]
    pitches: Pitches
    limits: Limits
    accepted: bool = False
    hash: str = ""
    message: str = ""

    @property
    def plain(self) -> dict[str, Any]:
        """Everything as plain values, for JSON."""
        return {"format": 1, **asdict(self), "scan_ids": list(self.scan_ids)}

    @classmethod
    def of_plain(cls, values: Mapping[str, Any]) -> RunRecord:
        """Return what `plain` made of one; KeyError, TypeError or ValueError where it did not."""
        return cls(
            tuple(int(number) for number in values["scan_ids"]),
            values["made_from"],
            Pitches(**values["pitches"]),
            Limits(**values["limits"]),
            hash=str(values["hash"]),
        )

    @property
    def request(self) -> CalibrationRequest:
        """What its views were taken for."""
        made_from = self.made_from
        plate = Plate(**{**made_from["plate"], "origin_id": tuple(made_from["plate"]["origin_id"])})
        target = str(made_from.get("target", "both"))
        patterns = target != "camera" or "kept" in made_from
        sequence = str(made_from["sequence"])
        return CalibrationRequest(target, (0.0,), plate, sequence, patterns=patterns, least=1)

    def observations(
        self, views: Sequence[View], camera_size: tuple[int, int], dmd_size: tuple[int, int]
    ) -> Observations:
        """Put views together with what has to be known beside them.

        Parameters
        ----------
        views : sequence of View
            In the order in which they were taken.
        camera_size, dmd_size : tuple of int
            (width, height), pixels.
        """
        pitches = self.pitches.camera_m, self.pitches.projector_m
        return Observations(tuple(views), camera_size, dmd_size, *pitches, self.made_from)


def made_from_request(
    request: CalibrationRequest, fixed: FixedLens | None = None
) -> dict[str, Any]:
    """Everything that a calibration is made from, plain values.

    Parameters
    ----------
    request : CalibrationRequest
        What is asked for.
    fixed : FixedLens or None
        The lens that stays.
    """
    return {
        "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "target": request.target,
        "heights_m": request.distinct,
        "travel_m": request.travel_m,
        "plate": asdict(request.plate),
        "sequence": request.sequence,
        "software": _versions(),
        **({"kept": fixed.plain} if fixed else {}),
        **({} if request.plate.tells_its_back else {"plate_side": _NO_SIDE}),
    }


def _versions() -> dict[str, str]:
    """Versions of what computes a calibration."""
    found = {}
    for name in ("slrig", "numpy", "scipy", "opencv-python-headless", "numba"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "unknown"
    return found
