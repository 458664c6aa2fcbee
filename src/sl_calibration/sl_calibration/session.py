"""Taking the views of a calibration: a plan run step by step. No ROS here.

Stage, projector and camera are behind `Gear`; everything that can be wrong with them, or with
what they see, ends the run with a refusal that says what was found and what was expected.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sl_calibration.plate import Plate
from sl_calibration.views import View
from sl_projector.errors import CalibrationError, SlError
from sl_projector.sequence import PatternSequence

#: Fewer heights leave nothing to check the solution with (leave one out).
MIN_HEIGHTS = 3
#: Heights nearer to each other than this are one height, metres.
MIN_STEP_M = 20e-6
#: A plate that moved shows it by more than this, camera pixels; detection noise is 0.02 px.
MIN_MOTION_PX = 0.1

TARGETS = ("camera", "projector", "both")


class RunCancelled(SlError):
    """Whoever asked for the calibration does not want it any more."""


@dataclass(frozen=True)
class Order:
    """What is asked for.

    Parameters
    ----------
    target : {"both", "camera", "projector"}
        What is calibrated.
    heights_m : tuple of float
        Stage heights of the views, metres.
    plate : Plate
        The hole plate on the stage.
    sequence : str
        Patterns, both axes.
    """

    target: str
    heights_m: tuple[float, ...]
    plate: Plate
    sequence: str

    def __post_init__(self) -> None:
        if self.target not in TARGETS:
            raise CalibrationError(f"target={self.target!r}; expected one of {TARGETS}")
        if not all(map(math.isfinite, self.heights_m)):
            raise CalibrationError(f"heights_m={self.heights_m}; expected finite numbers")
        if len(self.distinct) < MIN_HEIGHTS:
            raise CalibrationError(
                f"{len(self.distinct)} different heights (of {list(self.heights_m)} m); expected "
                f"at least {MIN_HEIGHTS}, {MIN_STEP_M * 1e6:g} um or more apart: from one height "
                "neither focal length and distance nor the stage can be told apart"
            )

    @property
    def distinct(self) -> list[float]:
        """Heights in ascending order, so that the stage always comes from below."""
        found: list[float] = []
        for height_m in sorted(self.heights_m):
            if not found or height_m - found[-1] >= MIN_STEP_M:
                found.append(height_m)
        return found


@dataclass(frozen=True)
class Taken:
    """A complete stack and where the stage stood.

    Parameters
    ----------
    images : ndarray, (N, H, W), uint8 or uint16
        In pattern order.
    sequence : PatternSequence
        What was projected.
    height_m : float
        Stage z of the stack's pose, metres.
    """

    images: NDArray[Any]
    sequence: PatternSequence
    height_m: float


@dataclass(frozen=True)
class Progress:
    """How far a run is.

    Parameters
    ----------
    stage : {"home", "planes", "plate", "solve", "check", "store"}
        What is being done: move, project and expose, find holes, solve, check, store.
    view, views : int
        Height being worked on (1 is the first), and heights in all.
    fraction : float
        0 .. 1.
    """

    stage: str
    view: int
    views: int
    fraction: float


Tell = Callable[[Progress], None]

#: Where in a view's share of the time each stage begins.
_BEGINS = {"home": 0.0, "planes": 0.2, "plate": 0.8}
#: Part of a run that taking the views makes up.
_TAKING = 0.85


class Gear(Protocol):
    """What a session needs of stage, projector and camera.

    Every method raises an `SlError` with the reason when it cannot, and `RunCancelled` as soon as
    the run is cancelled.
    """

    def where(self) -> float:
        """Return the stage's height now, metres."""
        ...

    def check(self, height_m: float) -> None:
        """Refuse a height outside the stage's travel; nothing moves."""
        ...

    def move(self, height_m: float) -> float:
        """Move to a height, wait, and return where the stage says it stands."""
        ...

    def take(self, sequence: str) -> Taken:
        """Project a sequence and return the images."""
        ...

    def halt(self) -> None:
        """Stop stage and projector at once; never raises."""
        ...


class Session:
    """Takes the views of one run.

    Parameters
    ----------
    gear : Gear
        The devices.
    order : Order
        What is asked for.
    observe : callable
        Makes a `View` of what was taken, or raises why it cannot.
    tell : callable
        Called with each change of progress.
    stage_tolerance_m : float
        The stage stands where it was sent within this.
    """

    def __init__(
        self,
        gear: Gear,
        order: Order,
        observe: Callable[[Taken, Order], View],
        tell: Tell,
        stage_tolerance_m: float = 5e-6,
    ) -> None:
        self._gear, self._order = gear, order
        self._observe, self._tell = observe, tell
        self._tolerance_m = stage_tolerance_m

    def views(self) -> tuple[View, ...]:
        """Take all views; afterwards the stage stands where it stood before.

        After a cancelled run it stands where it was stopped.

        Raises
        ------
        RunCancelled
            Stage and projector were stopped.
        CalibrationError, DeviceError
            With the height at which it happened.
        """
        start_m = self._gear.where()
        for height_m in self._order.distinct:
            self._gear.check(height_m)
        try:
            views = self._take_all()
        except RunCancelled:
            self._gear.halt()
            raise
        except SlError:
            with suppress(SlError):  # the first error is the one to be told
                self._gear.move(start_m)
            raise
        self._gear.move(start_m)
        return views

    def _take_all(self) -> tuple[View, ...]:
        views: list[View] = []
        heights = self._order.distinct
        for i, height_m in enumerate(heights):
            try:
                view = self._take(i, height_m)
                if views:
                    check_motion(views[-1], view)
            except CalibrationError as error:
                raise CalibrationError(
                    f"view {i + 1} of {len(heights)}, stage at {height_m * 1e3:.4f} mm: {error}"
                ) from error
            views.append(view)
        return tuple(views)

    def _take(self, i: int, height_m: float) -> View:
        self._report("home", i)
        self._check_height(self._gear.move(height_m), height_m)
        self._report("planes", i)
        taken = self._gear.take(self._order.sequence)
        self._check_height(taken.height_m, height_m)
        self._report("plate", i)
        return self._observe(taken, self._order)

    def _check_height(self, found_m: float, asked_m: float) -> None:
        if not abs(found_m - asked_m) <= self._tolerance_m:
            raise CalibrationError(
                f"the stage stands at {found_m * 1e3:.4f} mm but was sent to {asked_m * 1e3:.4f} "
                f"mm; expected it within {self._tolerance_m * 1e6:g} um: it does not move as told"
            )

    def _report(self, stage: str, i: int) -> None:
        views = len(self._order.distinct)
        fraction = _TAKING * (i + _BEGINS[stage]) / views
        self._tell(Progress(stage, i + 1, views, fraction))


def check_motion(before: View, after: View) -> None:
    """Refuse two views at different heights that show the plate in the same place.

    Raises
    ------
    CalibrationError
        When the plate did not move although the stage says so, or shows other holes.
    """
    here = {tuple(hole): i for i, hole in enumerate(before.hole_ids)}
    pairs = [(here[tuple(h)], j) for j, h in enumerate(after.hole_ids) if tuple(h) in here]
    if not pairs:
        raise CalibrationError(
            "no hole of the view before is seen any more; expected the same plate at every height"
        )
    a, b = np.array(pairs).T
    moved_px = np.linalg.norm(after.centres_px[b] - before.centres_px[a], axis=1)
    if float(np.median(moved_px)) < MIN_MOTION_PX:
        raise CalibrationError(
            f"the stage says that it moved by {(after.height_m - before.height_m) * 1e3:.4f} mm "
            f"but the holes' images moved by {float(np.median(moved_px)):.3f} px; expected at "
            f"least {MIN_MOTION_PX} px: the stage, or the plate on it, does not move"
        )
