"""Taking the views of a calibration: a plan run step by step. No ROS here.

Stage, projector and camera are behind `CalibrationDevices`; everything that can be wrong with them,
or with what they see, ends the run with a refusal that says what was found and what was expected.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from sl_calibration.data.observations import View
from sl_calibration.target.plate import Plate
from sl_common.errors import CalibrationError, SlError
from sl_projector.sequence.stack import Stack

#: Fewer heights leave nothing to check the solution with (leave one out).
MIN_HEIGHTS = 3
#: Heights nearer to each other than this are one height, metres.
MIN_STEP_M = 20e-6
#: A plate that moved shows it by more than this, camera pixels; detection noise is 0.02 px.
MIN_MOTION_PX = 0.1

TARGETS = ("camera", "projector", "both")

#: Position of the stage: x, y, z, metres.
Place = tuple[float, float, float]
_SeenT = TypeVar("_SeenT")


class RunCancelled(SlError):
    """Whoever asked for the calibration does not want it any more."""


@dataclass(frozen=True)
class CalibrationRequest:
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
    travel_m : float
        Distance of two further views, moved in x and in y, at the middle height: they tell a plate
        that leans from a stage that is not square. 0 for none.
    patterns : bool
        Whether the projector's coordinates are wanted, or the plate's holes only.
    least : int
        Number of different heights that are needed.
    """

    target: str
    heights_m: tuple[float, ...]
    plate: Plate
    sequence: str
    travel_m: float = 0.0
    patterns: bool = True
    least: int = MIN_HEIGHTS

    def __post_init__(self) -> None:
        if self.target not in TARGETS:
            raise CalibrationError(f"target={self.target!r}; expected one of {TARGETS}")
        if not all(map(math.isfinite, self.heights_m)):
            raise CalibrationError(f"heights_m={self.heights_m}; expected finite numbers")
        if len(self.distinct) < self.least:
            raise CalibrationError(
                f"{len(self.distinct)} different heights (of {list(self.heights_m)} m); expected "
                f"at least {self.least}, {MIN_STEP_M * 1e6:g} um or more apart: from one height "
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

    @property
    def places(self) -> list[Place]:
        """Where views are taken, in order: x and y from where the stage stands, z absolute."""
        heights, travel_m = self.distinct, self.travel_m
        found = [(0.0, 0.0, height_m) for height_m in heights]
        if travel_m:
            middle = len(heights) // 2
            aside = [(travel_m, 0.0, heights[middle]), (0.0, travel_m, heights[middle])]
            found[middle + 1 : middle + 1] = aside
        return found


@dataclass(frozen=True)
class CalibrationProgress:
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


Tell = Callable[[CalibrationProgress], None]

#: Where in a view's share of the time each stage begins.
_BEGINS = {"home": 0.0, "planes": 0.2, "plate": 0.8}
#: Part of a run that taking the views makes up.
_TAKING = 0.85


class CalibrationDevices(Protocol):
    """What a session needs of stage, projector and camera.

    Every method raises an `SlError` with the reason when it cannot, and `RunCancelled` as soon as
    the run is cancelled.
    """

    def where(self) -> Place:
        """Return where the stage stands now."""
        ...

    def check(self, place: Place) -> None:
        """Refuse a place outside the stage's travel; nothing moves."""
        ...

    def move(self, place: Place) -> Place:
        """Move to a place, wait, and return where the stage says it stands."""
        ...

    def take(self, sequence: str) -> Stack:
        """Project a sequence and return the images."""
        ...

    def halt(self) -> None:
        """Stop stage and projector at once; never raises."""
        ...


class Session(Generic[_SeenT]):
    """Takes the views of one run.

    Parameters
    ----------
    devices : CalibrationDevices
        Stage, projector and camera.
    request : CalibrationRequest
        What is asked for.
    observe : callable
        Makes what is wanted of what was taken, or raises why it cannot.
    tell : callable
        Called with each change of progress.
    stage_tolerance_m : float
        The stage stands where it was sent within this.
    compare : callable
        Called with each view and the one before; raises when they cannot both be right.
    """

    def __init__(
        self,
        devices: CalibrationDevices,
        request: CalibrationRequest,
        observe: Callable[[Stack, CalibrationRequest], _SeenT],
        tell: Tell,
        stage_tolerance_m: float = 5e-6,
        compare: Callable[[_SeenT, _SeenT], None] = lambda _before, _after: None,
    ) -> None:
        self._devices, self._request = devices, request
        self._observe, self._compare, self._tell = observe, compare, tell
        self._tolerance_m = stage_tolerance_m

    def views(self) -> tuple[_SeenT, ...]:
        """Take all views; afterwards the stage stands where it stood before.

        After a cancelled run it stands where it was stopped.

        Raises
        ------
        RunCancelled
            Stage and projector were stopped.
        CalibrationError, DeviceError
            With the place at which it happened.
        """
        start = self._devices.where()
        places = [(start[0] + x, start[1] + y, z) for x, y, z in self._request.places]
        for place in places:
            self._devices.check(place)
        try:
            views = self._take_all(places)
        except RunCancelled:
            self._devices.halt()
            raise
        except SlError:
            with suppress(SlError):  # the first error is the one that counts
                self._devices.move(start)
            raise
        self._devices.move(start)
        return views

    def _take_all(self, places: list[Place]) -> tuple[_SeenT, ...]:
        """Look at each view in a thread beside, while the stage moves on and the next is taken."""
        views: list[_SeenT] = []
        looked: list[Future[_SeenT]] = []
        with ThreadPoolExecutor(1, "look") as beside:
            for i, place in enumerate(places):
                with _naming(i, places):
                    taken = self._take(i, place)
                looked.append(beside.submit(self._observe, taken, self._request))
                del taken  # a stack is large: two at a time
                if i:
                    self._accept(i - 1, places, looked, views)
            self._accept(len(places) - 1, places, looked, views)
        return tuple(views)

    def _accept(
        self, i: int, places: list[Place], looked: list[Future[_SeenT]], views: list[_SeenT]
    ) -> None:
        """Wait for what was seen in a view, and compare it with the one before."""
        with _naming(i, places):
            view = looked[i].result()
            if views:
                self._compare(views[-1], view)
        views.append(view)

    def _take(self, i: int, place: Place) -> Stack:
        self._report("home", i)
        self._check_place(self._devices.move(place), place)
        self._report("planes", i)
        taken = self._devices.take(self._request.sequence)
        self._check_place(taken.place, place)
        self._report("plate", i)
        return taken

    def _check_place(self, found: Place, asked: Place) -> None:
        if not all(abs(f - a) <= self._tolerance_m for f, a in zip(found, asked, strict=True)):
            raise CalibrationError(
                f"the stage stands at {in_words(found)} but was sent to {in_words(asked)}; "
                f"expected it within {self._tolerance_m * 1e6:g} um: it does not move as told"
            )

    def _report(self, stage: str, i: int) -> None:
        views = len(self._request.places)
        fraction = _TAKING * (i + _BEGINS[stage]) / views
        self._tell(CalibrationProgress(stage, i + 1, views, fraction))


@contextmanager
def _naming(i: int, places: list[Place]) -> Iterator[None]:
    """Say in which view it was that something was wrong."""
    try:
        yield
    except CalibrationError as error:
        raise CalibrationError(
            f"view {i + 1} of {len(places)}, stage at {in_words(places[i])}: {error}"
        ) from error


def in_words(place: Place) -> str:
    """Height of a place; x and y as well where they are not zero."""
    x, y, z = (f"{axis * 1e3:.4f}" for axis in place)
    return f"{z} mm" if max(map(abs, place[:2])) < MIN_STEP_M else f"({x}, {y}, {z}) mm"


def check_motion(before: View, after: View) -> None:
    """Refuse two views at different places that show the plate in the same one.

    Parameters
    ----------
    before, after : View
        Taken one after the other.

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
    moved_m = float(np.linalg.norm(np.subtract(after.place, before.place)))
    moved_px = np.linalg.norm(after.centres_px[b] - before.centres_px[a], axis=1)
    if float(np.median(moved_px)) < MIN_MOTION_PX:
        raise CalibrationError(
            f"the stage says that it moved by {moved_m * 1e3:.4f} mm but "
            f"the holes' images moved by {float(np.median(moved_px)):.3f} px; expected at "
            f"least {MIN_MOTION_PX} px: the stage, or the plate on it, does not move"
        )
