"""A stage without a motor: the operator moves it by hand and confirms.

The node shows ``state().text`` to the operator and calls ``confirm`` or ``give_up`` from its
services; to everybody else it is a stage like any other.
"""

from __future__ import annotations

import threading

from sl_camera.stage.stage import AXES, Position, StageLimits, StageState, StateKind
from sl_common.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout


class ManualStage:
    """Asks the operator for every move. Implements ``StageDriver``.

    Parameters
    ----------
    low_m, high_m : tuple of float
        Reach, metres.
    """

    def __init__(
        self, low_m: Position = (-0.025, -0.025, -0.01), high_m: Position = (0.025, 0.025, 0.01)
    ) -> None:
        self._limits = StageLimits(low_m, high_m)
        self._cv = threading.Condition()
        self._is_open = False
        self._position: Position = (0.0, 0.0, 0.0)
        self._referenced = False
        self._request: Position | None = None
        self._is_reference = False
        self._held = False
        self._is_unlocked = False
        self._alarm = ""
        self._outcome = ""

    def open(self) -> None:
        """Begin: nothing is asked for, and where the stage stands is not known yet."""
        with self._cv:
            self._is_open, self._referenced, self._held = True, False, False
            self._request, self._alarm, self._is_unlocked = None, "", False

    def close(self) -> None:
        """Withdraw what is asked for."""
        with self._cv:
            self._end("the stage was closed")
            self._is_open = False

    # -- the operator's side --------------------------------------------------------------------

    def confirm(self, position_m: Position | None = None) -> None:
        """The operator has done what was asked.

        Parameters
        ----------
        position_m : tuple of float, optional
            What the scales say, where it is not exactly what was asked for.

        Raises
        ------
        DeviceRefused
            Nothing is asked for, the stage is held, or the position is out of reach.
        """
        with self._cv:
            if self._request is None or self._held:
                raise DeviceRefused(f"nothing to confirm: the stage is {self._kind()}")
            place = self._request if position_m is None else position_m
            self._limits.require_inside(place)
            self._position = place
            self._referenced = self._referenced or self._is_reference
            self._request, self._outcome = None, ""
            self._cv.notify_all()

    def give_up(self, reason: str) -> None:
        """The operator cannot or must not go on: alarm until ``clear()``."""
        with self._cv:
            self._end(reason)
            self._alarm, self._referenced, self._is_unlocked = reason, False, False

    # -- StageDriver ----------------------------------------------------------------------------

    def home(self, *, timeout_s: float = 120.0) -> None:
        """Ask the operator to set the stage to zero on its scales."""
        with self._cv:
            self._require("idle", "not_homed")
            self._ask((0.0, 0.0, 0.0), timeout_s, is_reference=True)

    def move_to(
        self, x_m: float, y_m: float, z_m: float, *, timeout_s: float | None = None
    ) -> None:
        """See `StageDriver`; asks the operator to move, and waits for the confirmation."""
        with self._cv:
            self._require("idle")
            self._limits.require_inside((x_m, y_m, z_m))
            self._ask((x_m, y_m, z_m), timeout_s, is_reference=False)

    def position_m(self) -> Position:
        """What was last confirmed, metres."""
        with self._cv:
            self._require_open()
            return self._position

    def state(self) -> StageState:
        """What is asked of the operator, in words."""
        with self._cv:
            return StageState(self._kind(), self._text(), self._referenced)

    def limits_m(self) -> StageLimits:
        """The reach given at the start."""
        self._require_open()
        return self._limits

    def hold(self) -> None:
        """Ask the operator to wait; a confirmation is refused meanwhile."""
        with self._cv:
            self._require("idle", "moving", "hold")
            self._held = True

    def resume(self) -> None:
        """Let the operator go on."""
        with self._cv:
            self._require("hold")
            self._held = False
            self._cv.notify_all()

    def stop(self) -> None:
        """Withdraw what is asked for; homing withdrawn ends in alarm."""
        with self._cv:
            self._require_open()
            if self._request is not None and self._is_reference:
                self._alarm, self._referenced = "homing was withdrawn", False
            self._end("the stage was stopped before the operator confirmed")

    def clear(self) -> None:
        """End an alarm; before the first homing, take the place where it stands for zero."""
        with self._cv:
            self._require_open()
            if self._kind() in ("alarm", "not_homed"):
                self._alarm, self._is_unlocked = "", True

    # -- inside, with the lock held ---------------------------------------------------------------

    def _kind(self) -> StateKind:
        if not self._is_open:
            return "lost"
        if self._alarm:
            return "alarm"
        if self._held:
            return "hold"
        if self._request is not None:
            return "homing" if self._is_reference else "moving"
        return "idle" if self._referenced or self._is_unlocked else "not_homed"

    def _text(self) -> str:
        if self._alarm or not self._is_open:
            return self._alarm or "not open"
        if self._request is None:
            return "" if self._referenced else "set the stage to zero and confirm (home)"
        place = ", ".join(
            f"{axis} = {value * 1e3:.3f}" for axis, value in zip(AXES, self._request, strict=True)
        )
        return f"move the stage to {place} mm and confirm"

    def _require_open(self) -> None:
        if not self._is_open:
            raise DeviceLost("the manual stage is not open")

    def _require(self, *kinds: str) -> None:
        self._require_open()
        if self._kind() not in kinds:
            raise DeviceRefused(
                f"stage is {self._kind()} ({self._text()}), expected {' or '.join(kinds)}"
            )

    def _ask(self, target: Position, timeout_s: float | None, *, is_reference: bool) -> None:
        """Wait for the operator; the time in hold does not count."""
        self._request, self._is_reference, self._outcome = target, is_reference, ""
        while not self._cv.wait_for(lambda: self._request is None, timeout_s):
            if not self._held:
                self._request = None
                raise DeviceTimeout(f"the operator has not confirmed within {timeout_s:g} s")
        if self._outcome:
            raise DeviceError(self._outcome)

    def _end(self, reason: str) -> None:
        self._held = False
        if self._request is not None:
            self._request, self._outcome = None, reason
            self._cv.notify_all()
