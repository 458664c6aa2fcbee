"""Three stepper axes under GRBL: planner, motion in real time, homing, limit switches.

The carriage is apart from the step counter, as in a real stage: homing, power cycles and lost
steps move one against the other. Knows nothing of lines and bytes.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from sl_bench.stage.grbl_motion import (
    Block,
    Braking,
    HomingLeg,
    Ramp,
    Triple,
    homed_position,
    homing_legs,
)

OVERRUN_MM = 1.0  # from the limit switch to the hard stop

Event = Literal["", "started", "done", "braked", "empty", "homing", "homed", "no switch", "limit"]


class GrblAxes:
    """The mechanics and their motion.

    Parameters
    ----------
    settings : dict
        GRBL's ``$n``, shared with the firmware.
    carriage_mm : tuple of float
        Where the axes stand, mm from the home switches.
    counter_mm : tuple of float
        Where the controller believes they stand.
    now : float
        Time of the start, seconds.

    Attributes
    ----------
    dead_switches, closed_switches : set of int
        Faults: home switches that never close; limit switches that are closed anyway.
    stuck : bool
        Fault: blocks are taken and never move anything.
    lost_step_share : float
        Fault: share of every motion that the carriage does not follow.
    """

    def __init__(
        self, settings: dict[int, float], carriage_mm: Triple, counter_mm: Triple, now: float
    ) -> None:
        self._settings = settings
        self.carriage, self.counter, self.now = carriage_mm, counter_mm, now
        self.planner: deque[Block] = deque()
        self._profile: Ramp | Braking | None = None
        self._legs: deque[HomingLeg] = deque()
        self._since, self._done = now, 0.0
        self.dead_switches: frozenset[int] = frozenset()
        self.closed_switches: set[int] = set()
        self.stuck = False
        self.lost_step_share = 0.0

    @property
    def is_moving(self) -> bool:
        """Whether a block or a braking is under way; homing does not count."""
        return self._profile is not None

    @property
    def is_homing(self) -> bool:
        """Whether a homing cycle is under way."""
        return bool(self._legs)

    def speed_mm_s(self) -> float:
        """Speed along the path now."""
        return self._profile.at(self.now - self._since)[1] if self._profile else 0.0

    def on_steps(self, place: Sequence[float]) -> Triple:
        """Return the nearest position that is a whole number of steps from machine zero."""
        x, y, z = (
            round(value * self._settings[100 + i]) / self._settings[100 + i]
            for i, value in enumerate(place)
        )
        return x, y, z

    def shows_pin(self, axis: int) -> bool:
        """Whether the axis' limit switch is closed."""
        return self._pressed(axis) or axis in self.closed_switches

    def _pressed(self, axis: int) -> bool:
        """Whether the carriage is at a switch: just beyond either end of the travel."""
        p, margin = self.carriage[axis], 1e-6
        return p > margin or p < -self._settings[130 + axis] - margin

    # -- orders -------------------------------------------------------------------------------

    def stop_dead(self) -> None:
        """Stop at once and forget everything planned."""
        self.planner.clear()
        self._legs.clear()
        self._profile, self._done = None, 0.0

    def brake(self) -> None:
        """Decelerate on the path and stay on it."""
        if not isinstance(self._profile, Ramp):
            return
        travelled, speed = self._profile.at(self.now - self._since)
        self._done += travelled
        self._since = self.now
        self._profile = Braking(speed, self._profile.acceleration)

    def home(self) -> None:
        """Begin the homing cycle."""
        self._since = self.now
        self._legs = deque(homing_legs(self.carriage, self._settings, self.dead_switches))

    def start_block(self, feed_share: float) -> bool:
        """Begin the next block, or what a hold left of it; False where there is none.

        The feed override leaves jogs and rapid moves alone.
        """
        if not self.planner or self._profile is not None:
            return False
        block, settings = self.planner[0], self._settings
        if not block.is_jog:
            block = replace(block, speed=block.speed * feed_share)
        x, y, z = (settings[110 + i] / 60.0 for i in range(3))
        accelerations = settings[120], settings[121], settings[122]
        self._profile = block.ramp(self._done, (x, y, z), accelerations)
        self._since = self.now
        return True

    # -- time ---------------------------------------------------------------------------------

    def advance(self, now: float) -> Event:
        """Move on to the next event, or to ``now`` where there is none (empty string)."""
        if self._legs:
            return self._advance_homing(now)
        if self._profile is None:
            self.now = max(self.now, now)
            return ""
        elapsed = now - self._since
        travelled, _ = self._profile.at(elapsed)
        if self._place(self.planner[0].point(self._done + travelled)):
            return "limit"
        if elapsed < self._profile.duration:
            self.now = max(self.now, now)
            return ""
        return self._end_profile()

    def _end_profile(self) -> Event:
        assert self._profile is not None
        self.now = max(self.now, self._since + self._profile.duration)
        braked = isinstance(self._profile, Braking)
        self._done += self._profile.at(math.inf)[0]
        self._profile = None
        if not braked or self._done >= self.planner[0].length - 1e-9:
            self.planner.popleft()
            self._done = 0.0
        return "braked" if braked else "done"

    def _place(self, counter: Triple) -> bool:
        """Move the counter, and the carriage as far as it follows; True at a hard limit."""
        if self.stuck:
            return False
        step = [b - a for a, b in zip(self.counter, counter, strict=True)]
        self.counter = counter
        followed = 1.0 - self.lost_step_share
        x, y, z = (
            min(max(p + followed * d, -self._settings[130 + i] - OVERRUN_MM), OVERRUN_MM)
            for i, (p, d) in enumerate(zip(self.carriage, step, strict=True))
        )
        self.carriage = x, y, z
        return bool(self._settings[21]) and any(self._pressed(axis) for axis in range(3))

    def _advance_homing(self, now: float) -> Event:
        leg = self._legs[0]
        elapsed = now - self._since
        self.carriage = leg.at(elapsed)
        if elapsed < leg.duration:
            self.now = max(self.now, now)
            return ""
        self._since += leg.duration
        self.now = max(self.now, self._since)
        self._legs.popleft()
        if leg.alarm:
            return "no switch"
        if self._legs:
            return "homing"
        self.counter = homed_position(self._settings)
        return "homed"
