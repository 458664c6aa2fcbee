"""Straight motion with a trapezoidal speed profile, as GRBL's planner makes it.

Every block starts and ends at rest: a stage is sent from place to place, so the corner speeds of
GRBL's look-ahead do not matter here. Lengths in millimetres, times in seconds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Ramp:
    """From rest to rest over a length: accelerate, cruise, decelerate."""

    length: float
    speed: float
    acceleration: float

    @property
    def peak(self) -> float:
        """Highest speed reached; short moves never cruise."""
        return min(self.speed, math.sqrt(self.length * self.acceleration))

    @property
    def duration(self) -> float:
        """Length over peak speed, plus one time of acceleration."""
        if self.length == 0.0:
            return 0.0
        return self.length / self.peak + self.peak / self.acceleration

    def at(self, t: float) -> tuple[float, float]:
        """Distance and speed at time ``t`` after the start, clamped to both ends."""
        if t >= self.duration:
            return self.length, 0.0
        t = max(t, 0.0)
        ramp_s = self.peak / self.acceleration
        left = self.duration - t
        if t < ramp_s:
            return 0.5 * self.acceleration * t * t, self.acceleration * t
        if left < ramp_s:
            return self.length - 0.5 * self.acceleration * left * left, self.acceleration * left
        return self.peak * (t - 0.5 * ramp_s), self.peak


@dataclass(frozen=True)
class Braking:
    """From a speed to rest."""

    speed: float
    acceleration: float

    @property
    def duration(self) -> float:
        """Time to rest."""
        return self.speed / self.acceleration

    def at(self, t: float) -> tuple[float, float]:
        """Distance and speed at time ``t`` after the braking began, clamped to rest."""
        t = min(max(t, 0.0), self.duration)
        return (self.speed - 0.5 * self.acceleration * t) * t, self.speed - self.acceleration * t


@dataclass(frozen=True)
class Block:
    """A line in the planner."""

    #: Machine position, mm.
    start: Triple
    target: Triple
    #: Programmed speed, mm/s; infinite for a rapid move.
    speed: float
    #: It came from ``$J=``.
    is_jog: bool

    @property
    def length(self) -> float:
        """Length of the line, mm."""
        return math.dist(self.start, self.target)

    def ramp(self, done: float, rates: Triple, accelerations: Triple) -> Ramp:
        """Profile of what is left of the line, within what each axis can do.

        Parameters
        ----------
        done : float
            Length behind, mm.
        rates, accelerations : tuple of float
            Of the axes, mm/s and mm/s^2.
        """
        shares = [abs(b - a) / self.length for a, b in zip(self.start, self.target, strict=True)]
        speed = min(r / s for r, s in zip(rates, shares, strict=True) if s > 0)
        acceleration = min(a / s for a, s in zip(accelerations, shares, strict=True) if s > 0)
        return Ramp(self.length - done, min(speed, self.speed), acceleration)

    def point(self, done: float) -> Triple:
        """Position after ``done`` mm."""
        share = done / self.length
        x, y, z = (a + share * (b - a) for a, b in zip(self.start, self.target, strict=True))
        return x, y, z


@dataclass(frozen=True)
class HomingLeg:
    """One leg of a homing cycle: every axis at its own constant rate, or a pause."""

    #: Place of the carriage, mm.
    start: Triple
    target: Triple
    #: mm/s of each axis that moves.
    rate: float
    #: Debounce time after the leg.
    pause_s: float
    #: Alarm that the leg ends in; 0 for none.
    alarm: int = 0

    @property
    def duration(self) -> float:
        """Time of the leg with its pause."""
        longest = max(abs(b - a) for a, b in zip(self.start, self.target, strict=True))
        return longest / self.rate + self.pause_s

    def at(self, t: float) -> Triple:
        """Place at time ``t`` after the leg began."""
        run = self.rate * max(t, 0.0)
        x, y, z = (
            a + math.copysign(min(run, abs(b - a)), b - a)
            for a, b in zip(self.start, self.target, strict=True)
        )
        return x, y, z


def homing_legs(
    place: Triple, settings: dict[int, float], dead_switches: frozenset[int]
) -> list[HomingLeg]:
    """Legs of ``$H`` from where the carriage stands: Z, then X and Y together.

    Seek the switch at ``$25``, pull off by ``$27``, locate it at ``$24``, pull off; ``$26`` after
    each. Switches are at 0, or at -travel for the axes in ``$23``.

    Parameters
    ----------
    place : tuple of float
        Where the carriage stands, mm.
    settings : dict
        GRBL's ``$n``.
    dead_switches : frozenset of int
        Axes whose switch never closes: the cycle ends with alarm 9 after 1.5 times their travel.
    """
    seek, locate = settings[25] / 60.0, settings[24] / 60.0
    legs: list[HomingLeg] = []
    for axes in ((2,), (0, 1)):
        dead = dead_switches.intersection(axes)
        if dead:
            beyond = {i: place[i] + 1.5 * _towards(i, settings) * settings[130 + i] for i in dead}
            return [*legs, HomingLeg(place, _with(place, beyond), seek, 0.0, alarm=9)]
        at_switch = _with(place, {i: _switch(i, settings) for i in axes})
        pulled = _with(place, {i: _pulled_off(i, settings) for i in axes})
        stops = (at_switch, pulled, at_switch, pulled)
        for target, rate in zip(stops, (seek, seek, locate, seek), strict=True):
            legs.append(HomingLeg(place, target, rate, settings[26] * 1e-3))
            place = target
    return legs


def homed_position(settings: dict[int, float]) -> Triple:
    """Machine position after homing: the pull-off away from the switch."""
    return _with((0.0, 0.0, 0.0), {i: _pulled_off(i, settings) for i in range(3)})


def _towards(axis: int, settings: dict[int, float]) -> float:
    return -1.0 if int(settings[23]) >> axis & 1 else 1.0


def _switch(axis: int, settings: dict[int, float]) -> float:
    return -settings[130 + axis] if _towards(axis, settings) < 0 else 0.0


def _pulled_off(axis: int, settings: dict[int, float]) -> float:
    return _switch(axis, settings) - _towards(axis, settings) * settings[27]


def _with(place: Triple, changed: Mapping[int, float]) -> Triple:
    x, y, z = (changed.get(axis, value) for axis, value in enumerate(place))
    return x, y, z
