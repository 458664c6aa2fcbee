"""What a stage is to this project: a small protocol, the states it can be in, and its limits.

Metres and the stage's own axes at this edge (``sl_stage``: +z towards the devices); what a
controller calls its coordinates stays inside the driver. A driver knows no ROS.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol, get_args

from sl_common.errors import DeviceRefused

Position = tuple[float, float, float]
"""x, y, z of the stage in metres."""

StateKind = Literal["idle", "moving", "hold", "alarm", "homing", "not_homed", "lost"]

STATE_KINDS: tuple[StateKind, ...] = get_args(StateKind)

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class StageState:
    """What the stage is doing, in one word and one sentence.

    Parameters
    ----------
    kind : str
        ``idle`` stands and takes moves; ``moving``; ``hold`` halted, a move may be unfinished;
        ``alarm`` nothing moves until ``clear()``; ``homing``; ``not_homed`` powered up and locked
        until ``home()`` (or ``clear()``, which gives up the reference); ``lost`` the device is
        gone or silent until ``open()``.
    text : str
        The reason in words, for an operator.
    referenced : bool
        The position counts from a home switch, found since this driver was opened.
    """

    kind: StateKind
    text: str = ""
    referenced: bool = False


@dataclass(frozen=True)
class StageLimits:
    """Where the stage may be sent, metres, both ends included."""

    low_m: Position
    high_m: Position

    def require_inside(self, target_m: Position, slack_m: float = 1e-7) -> None:
        """Refuse a target that is not a finite point between the limits.

        Parameters
        ----------
        target_m : tuple of float
            x, y, z in metres.
        slack_m : float
            Rounding that is forgiven, metres.

        Raises
        ------
        DeviceRefused
            With the axis, the value and the range that was expected.
        """
        for axis, value, low, high in zip(AXES, target_m, self.low_m, self.high_m, strict=True):
            if not (math.isfinite(value) and low - slack_m <= value <= high + slack_m):
                raise DeviceRefused(
                    f"stage target {axis} = {value * 1e3:g} mm, expected "
                    f"{low * 1e3:g} to {high * 1e3:g} mm (soft limit); nothing was sent"
                )


class StageDriver(Protocol):
    """A three-axis stage. One thread moves it; any number may ask for state and position.

    ``hold``, ``stop``, ``state`` and ``position_m`` may be called while another thread is inside
    ``move_to`` or ``home``. Every method but ``state`` and ``close`` raises ``DeviceLost`` once
    the device is gone; ``open`` then tries anew.
    """

    def open(self) -> None:
        """Connect. Called by the node at activation and again after ``lost``.

        Afterwards the stage stands still (a motion left over from before is stopped) and
        ``state()`` is ``idle``, ``not_homed`` or ``alarm``.

        Raises
        ------
        DeviceLost
            No such port, or another program has it.
        DeviceTimeout
            The port is there, the device does not answer.
        DeviceError
            Something else answers, or a version that is not understood.
        """
        ...

    def close(self) -> None:
        """Let go of the device; never raises, may be called twice. A running move is stopped."""
        ...

    def home(self, *, timeout_s: float = 120.0) -> None:
        """Find the reference. Blocks; afterwards ``idle`` and ``referenced``.

        Raises
        ------
        DeviceRefused
            In alarm, held, moving, or without home switches.
        DeviceTimeout
            Not home in time; the motion has been stopped.
        DeviceError
            The search failed (no switch found); the state is ``alarm``.
        """
        ...

    def move_to(
        self, x_m: float, y_m: float, z_m: float, *, timeout_s: float | None = None
    ) -> None:
        """Move to an absolute position and wait. Afterwards the stage stands there, ``idle``.

        Parameters
        ----------
        x_m, y_m, z_m : float
            Target, metres, within ``limits_m()``.
        timeout_s : float, optional
            Longest time to wait, without the time spent in ``hold``; by default generous for the
            distance. On time-out the motion is stopped before the error is raised.

        Raises
        ------
        DeviceRefused
            Outside the limits (nothing was sent), or the state is not ``idle``.
        DeviceTimeout
            Not there in time.
        DeviceError
            Alarm, reset or ``stop()`` on the way, or it stands elsewhere although it says done.
        """
        ...

    def position_m(self) -> Position:
        """Where the stage stands, metres; while moving, where it was at most 0.2 s ago.

        A driver that does not ask for it anew in each call has an attribute ``measured_ns``: when
        it asked for the position that it told last, host clock. Poses are stamped with it.
        """
        ...

    def state(self) -> StageState:
        """What it is doing. Never raises: a silent or vanished device is ``lost``."""
        ...

    def hold(self) -> None:
        """Halt smoothly, keep the rest of the move. Afterwards ``hold``, standing still."""
        ...

    def resume(self) -> None:
        """Go on after ``hold``. Afterwards ``moving``, or ``idle`` where nothing was left."""
        ...

    def stop(self) -> None:
        """Halt and drop the rest of the move. Afterwards ``idle``, the position known.

        A waiting ``move_to`` raises. Homing cannot be stopped smoothly: it ends in ``alarm``.
        """
        ...

    def clear(self) -> None:
        """Acknowledge an alarm: the operator says that it is safe. Afterwards ``idle``.

        Nothing moves by itself. Where the alarm lost the position, ``referenced`` is False until
        ``home()``. Does nothing where there is no alarm.

        Raises
        ------
        DeviceRefused
            The cause is still there (emergency stop pressed, switch closed).
        """
        ...

    def limits_m(self) -> StageLimits:
        """Reach of the axes, as the device itself holds them. Valid after ``open``."""
        ...
