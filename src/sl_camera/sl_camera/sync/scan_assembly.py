"""One scan while it is being received: its triggers, its images, and what went wrong so far."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from statistics import median
from typing import Any

import numpy as np

from sl_camera.sync.match_events import (
    FrameDecision,
    ImageEvent,
    MatcherSettings,
    Status,
    TriggerEvent,
)
from sl_common.errors import SequenceError
from sl_projector.sequence.pattern_sequence import NAMED, PatternSequence, named
from sl_projector.sequence.stack import PIXEL_TYPES, Pixels, Stack, StagePose

Allocate = Callable[[tuple[int, int, int], np.dtype[Any]], Pixels]

#: Longest exposure of one pattern that is believed, seconds.
MAX_EXPOSURE_S = 60.0


class ScanRecord:
    """What is known of one scan between its first trigger and its verdict.

    It never forgets a problem: `problems` empty at the verdict is the only way to a stack.
    ``start_ns`` and ``last_ns`` are the first and last starts of exposures known.

    Parameters
    ----------
    first : TriggerEvent
        The trigger that it is opened for; take it with `add_trigger` as well.
    settings : MatcherSettings
        How strictly is matched.
    allocate : callable
        Gives the memory of the stack: ``allocate((N, H, W), dtype)``.
    """

    def __init__(self, first: TriggerEvent, settings: MatcherSettings, allocate: Allocate) -> None:
        self.first = first
        self.count = first.count
        self.problems: list[str] = []
        self.triggers: dict[int, TriggerEvent] = {}
        self.image_stamps: dict[int, int] = {}
        self.data: Pixels | None = None
        self.hopeless = False
        self.first_arrival = -1
        self.last_arrival = -1
        self.last_image_ns = 0
        self.progress_ns = 0
        self._settings = settings
        self._allocate = allocate
        self.start_ns = self.last_ns = first.stamp_ns
        self._period_ns = 0
        self._next_trigger = 0
        self._next_image = 0

    # -- triggers ---------------------------------------------------------------------------

    def add_trigger(self, event: TriggerEvent, now_ns: int) -> FrameDecision | None:
        """Take a trigger of this scan; the decision tells of a fault, None of none.

        Parameters
        ----------
        event : TriggerEvent
            What was announced.
        now_ns : int
            Monotonic clock, nanoseconds.
        """
        fault, status = self._trigger_fault(event), Status.REORDERED
        if not fault and event.index in self.triggers:
            fault, status = f"trigger {self.of(event.index)} came twice", Status.DUPLICATE
        elif not fault:
            fault = self._order_fault(event)
            self.triggers[event.index] = event
            self._update_times()
            self._next_trigger = max(self._next_trigger, event.index + 1)
            self.progress_ns = now_ns
        if not fault:
            return None
        self.blame(fault)
        if self.hopeless:  # the verdict follows at once
            return None
        return self.decide(status, event.index, fault, trigger_ns=event.stamp_ns)

    def _trigger_fault(self, event: TriggerEvent) -> str:
        """Why this trigger cannot be one of the scan's; such a scan is given up at once."""
        first = self.first
        fault = _plausible(event, self._settings)
        found = (event.sequence_name, event.dmd_size, event.count, event.exposure_s)
        expected = (first.sequence_name, first.dmd_size, first.count, first.exposure_s)
        if not fault and found != expected:
            fault = (
                f"trigger {self.of(event.index)} says sequence, DMD size, count, exposure = "
                f"{found}, the scan began with {expected}"
            )
        fault = fault or _as_named(event)
        self.hopeless = self.hopeless or bool(fault)
        return fault

    def _order_fault(self, event: TriggerEvent) -> str:
        if event.index < self._next_trigger:
            return f"trigger {self.of(event.index)} came after {self.of(self._next_trigger - 1)}"
        if event.index > self._next_trigger:
            return (
                f"trigger {self.of(self._next_trigger)} is missing: "
                f"{self.of(event.index)} came in its place"
            )
        if not self.triggers:
            return ""
        gap_ns = event.stamp_ns - self.triggers[event.index - 1].stamp_ns
        least_ns = 2 * self.gate_ns() if len(self.triggers) > 1 else 1
        if gap_ns < least_ns:
            return (
                f"trigger {self.of(event.index)} is stamped {gap_ns * 1e-6:.3f} ms after the one "
                f"before, expected at least {least_ns * 1e-6:.3f} ms"
            )
        return ""

    # -- time -------------------------------------------------------------------------------

    def _update_times(self) -> None:
        """Work out once per trigger what is asked for with every image."""
        known = sorted(self.triggers)
        stamps_ns = [self.triggers[index].stamp_ns for index in known]
        self.start_ns, self.last_ns = min(stamps_ns), max(stamps_ns)
        if self.count == 1:
            self._period_ns = int(self.first.exposure_s * 1e9)
        elif len(known) > 1:
            self._period_ns = max(0, (stamps_ns[1] - stamps_ns[0]) // (known[1] - known[0]))

    def period_ns(self) -> int:
        """Distance of the first two triggers; 0 as long as it is unknown."""
        return self._period_ns

    def gate_ns(self) -> int:
        """Half width of the window around a trigger in which its image lies."""
        return int(self._settings.tolerance_fraction * self.period_ns())

    def index_of(self, stamp_ns: int) -> int | None:
        """Trigger that an image of this stamp belongs to, None when (so far) there is none."""
        shifted = stamp_ns - int(self._settings.clock_offset_s * 1e9)
        gate_ns = self.gate_ns()
        if not gate_ns or not self.start_ns - gate_ns <= shifted <= self.last_ns + gate_ns:
            return None
        near = min(self.triggers.values(), key=lambda t: abs(t.stamp_ns - shifted))
        return near.index if abs(near.stamp_ns - shifted) <= gate_ns else None

    def covers(self, stamp_ns: int) -> bool:
        """Tell whether a stamp lies between the triggers known so far."""
        shifted = stamp_ns - int(self._settings.clock_offset_s * 1e9)
        return bool(self.triggers) and self.start_ns <= shifted <= self.last_ns

    def follows(self, stamp_ns: int) -> bool:
        """Tell whether a stamp lies where a trigger after the last one would be."""
        shifted = stamp_ns - int(self._settings.clock_offset_s * 1e9)
        return 0 < shifted - self.last_ns <= self.period_ns() + self.gate_ns()

    @property
    def newest_ns(self) -> int:
        """Latest trigger stamp known, that of the first trigger included where it was refused."""
        return max(self.first.stamp_ns, self.last_ns)

    @property
    def end_ns(self) -> int:
        """End of the last exposure known."""
        return self.last_ns + int(self.first.exposure_s * 1e9)

    # -- images -----------------------------------------------------------------------------

    def add_image(
        self, event: ImageEvent, index: int, arrival: int, now_ns: int
    ) -> tuple[Status, str]:
        """Take the image of trigger `index`; copied at once when nothing is wrong so far.

        The status is that of the image; MATCHED with a reason is an image that is right itself but
        shows that another one is missing.

        Parameters
        ----------
        event : ImageEvent
            What arrived.
        index, arrival : int
            Number of its trigger; how many images came before it.
        now_ns : int
            Monotonic clock, nanoseconds.
        """
        if self.first_arrival < 0:
            self.first_arrival = arrival
        status, fault = self._image_fault(event, index, arrival)
        self.last_arrival = max(self.last_arrival, arrival)
        if index not in self.image_stamps:
            self.image_stamps[index] = event.stamp_ns
            self._next_image = max(self._next_image, index + 1)
            self.progress_ns = self.last_image_ns = now_ns
        if fault:
            self.blame(fault)
        elif not self.problems and self.data is not None:
            self.data[index] = event.pixels()
        return status, fault

    def _image_fault(self, event: ImageEvent, index: int, arrival: int) -> tuple[Status, str]:
        if index in self.image_stamps:
            return Status.DUPLICATE, f"image {self.of(index)} came twice"
        fault = event.fault() or self._misfit(event)
        if fault:
            return Status.BAD_IMAGE, f"image {self.of(index)} is unusable: {fault}"
        if index > self._next_image:
            missing = self.of(self._next_image)
            return Status.MATCHED, f"image {missing} did not come before {self.of(index)}"
        if index < self._next_image or arrival < self.last_arrival:
            return Status.REORDERED, f"image {self.of(index)} came out of order"
        return Status.MATCHED, ""

    def _misfit(self, event: ImageEvent) -> str:
        """Why an image does not fit the stack; the first one makes it."""
        shape = (self.count, event.height, event.width)
        dtype = PIXEL_TYPES[event.encoding]
        if self.data is None:
            size = math.prod(shape) * dtype.itemsize
            if size > self._settings.max_stack_bytes:
                return (
                    f"{self.count} of {event.width} x {event.height} pixels are {size} bytes, "
                    f"expected at most {self._settings.max_stack_bytes}"
                )
            self.data = self._allocate(shape, dtype)
        if (shape, dtype) != (self.data.shape, self.data.dtype):
            return (
                f"it is {event.width} x {event.height} {event.encoding}, the scan began with "
                f"{self.data.shape[2]} x {self.data.shape[1]} {self.data.dtype}"
            )
        return ""

    # -- verdict ----------------------------------------------------------------------------

    def blame(self, problem: str) -> None:
        """Note a problem; the scan is lost from here on."""
        if len(self.problems) < 2 * self.count + 8:
            self.problems.append(problem)

    @property
    def received(self) -> bool:
        """Nothing more is expected: the last trigger and the image of the last one are here."""
        last = self.count - 1
        return last in self.triggers and last in self.image_stamps

    def timeout_at_ns(self) -> int:
        """When the scan is given up if nothing more comes."""
        wait_ns = max(self.first.exposure_s * 1e9, float(self.period_ns()))
        return self.progress_ns + int(wait_ns + self._settings.timeout_s * 1e9)

    def missing(self) -> Iterator[FrameDecision]:
        """One decision for every trigger without an image; each is a problem of the scan."""
        for index, trigger in sorted(self.triggers.items()):
            if index not in self.image_stamps:
                reason = f"image {self.of(index)} did not come"
                self.blame(reason)
                yield self.decide(
                    Status.TRIGGER_WITHOUT_IMAGE, index, reason, trigger_ns=trigger.stamp_ns
                )

    def check_complete(self) -> None:
        """Note what is wrong with the scan as a whole: triggers missing, images off their beat."""
        absent = self.count - len(self.triggers)
        if absent and not self.hopeless:
            self.blame(f"{absent} of {self.count} triggers did not come")
        if self.problems:
            return
        errors = [self.image_stamps[i] - self.triggers[i].stamp_ns for i in range(self.count)]
        middle = median(errors)
        worst = max(range(self.count), key=lambda i: abs(errors[i] - middle))
        off_ns, allowed_ns = (
            abs(errors[worst] - middle),
            self._settings.jitter_fraction * self.period_ns(),
        )
        if off_ns > allowed_ns:
            self.blame(
                f"image {self.of(worst)} is {off_ns * 1e-6:.3f} ms off the beat of the others, "
                f"expected at most {allowed_ns * 1e-6:.3f} ms"
            )

    def stack(self, pose: StagePose | None) -> Stack:
        """Return the stack of a scan without problems."""
        assert self.data is not None
        order = range(self.count)
        patterns = tuple(self.triggers[i].pattern for i in order)
        return Stack(
            self.data,
            PatternSequence(self.first.sequence_name, self.first.dmd_size, patterns),
            self.first.scan_id,
            tuple(self.image_stamps[i] for i in order),
            self.first.exposure_s,
            pose,
        )

    def reason(self) -> str:
        """All that went wrong in one sentence; the first causes matter most."""
        told = list(dict.fromkeys(self.problems))
        more = f"; and {len(told) - 3} more" if len(told) > 3 else ""
        return "; ".join(told[:3]) + more

    def of(self, index: int) -> str:
        """Name a position for a person, counted from 1."""
        return f"{index + 1} of {self.count}"

    def decide(
        self,
        status: Status,
        index: int,
        reason: str = "",
        trigger_ns: int | None = None,
        image_ns: int = 0,
        pose: StagePose | None = None,
    ) -> FrameDecision:
        """Make a decision of this scan; the trigger's stamp is looked up where not given.

        Parameters
        ----------
        status : Status
            The verdict.
        index : int
            Number of the pattern.
        reason : str
            Why, in words.
        trigger_ns, image_ns : int
            Stamps, nanoseconds; 0 for none.
        pose : StagePose, optional
            Where the part stood.
        """
        if trigger_ns is None:
            trigger_ns = self.triggers[index].stamp_ns if index in self.triggers else 0
        count = min(self.count, 0xFFFF)
        return FrameDecision(
            status, self.first.scan_id, index, count, reason, trigger_ns, image_ns, pose
        )


def _plausible(event: TriggerEvent, settings: MatcherSettings) -> str:
    if not 1 <= event.count <= settings.max_patterns or not 0 <= event.index < event.count:
        return (
            f"a trigger has index {event.index} and count {event.count}, expected "
            f"0 <= index < count <= {settings.max_patterns}"
        )
    if not 0.0 < event.exposure_s <= MAX_EXPOSURE_S:
        return (
            f"a trigger has exposure {event.exposure_s} s, expected more than 0 and at most "
            f"{MAX_EXPOSURE_S:g} s"
        )
    if event.stamp_ns <= 0:
        return f"a trigger has stamp {event.stamp_ns} ns, expected a time"
    try:
        PatternSequence(event.sequence_name, event.dmd_size, (event.pattern,))
    except SequenceError as error:
        return str(error)
    return ""


def _as_named(event: TriggerEvent) -> str:
    """Why a trigger of a built-in sequence is not what that sequence has there."""
    if event.sequence_name not in NAMED:
        return ""
    sequence = named(event.sequence_name, event.dmd_size)
    if event.count != len(sequence):
        return (
            f"a trigger says that sequence {sequence.name!r} has {event.count} patterns, "
            f"expected {len(sequence)}"
        )
    if event.pattern != sequence.patterns[event.index]:
        return (
            f"trigger {event.index + 1} of {event.count} shows {event.pattern}, sequence "
            f"{sequence.name!r} has {sequence.patterns[event.index]} there"
        )
    return ""
