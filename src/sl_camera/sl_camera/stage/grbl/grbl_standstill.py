"""Whether a GRBL stage rests: halting it, and waiting for the end of motions.

The word in a report is not enough. There are controllers that say ``Idle`` for a moment before a
motion begins, ``Hold`` while it goes on, and some that do not know a real-time command. So the
stage rests where its word and its position say so, more than once.
"""

from __future__ import annotations

import math
import time

from sl_camera.stage.grbl.grbl_conversation import POLL_S, GrblConversation, Patience, Triple
from sl_camera.stage.grbl.grbl_protocol import HOLD, JOG_CANCEL, UNTOLD_ALARM, Report
from sl_common.errors import DeviceError, DeviceTimeout

IDLE_REPORTS = 3  # in a row, at one place
DEAF_REPORTS = 10  # that show no halt: the command was not heard. GRBL's second report shows it
UNKNOWN_BRAKING_MM = 100.0


class _Watch:
    """Reports one after the other, and what they say together."""

    def __init__(self, talk: GrblConversation) -> None:
        self._talk = talk
        self._patience = Patience(None)
        self._place: Triple | None = None
        self._idle_reports = 0
        self.travelled_mm = 0.0

    def look(self, what: str) -> Report:
        """Take the next report; raises in an alarm, and where nothing changes for long."""
        if self._place is not None:
            time.sleep(POLL_S)
        report = self._talk.report(fresh=True)
        place = self._talk.machine_mm or (0.0, 0.0, 0.0)
        step_mm = math.inf if self._place is None else math.dist(place, self._place)
        if self._talk.alarm is not None or report.state == "Alarm":
            raise DeviceError(self._talk.alarm or UNTOLD_ALARM)
        self._is_still, self._place = step_mm == 0.0, place
        self.travelled_mm += step_mm if math.isfinite(step_mm) else 0.0
        idle = self._is_still and report.state in ("Idle", "Sleep", "Check")
        self._idle_reports = self._idle_reports + 1 if idle else 0
        self._patience.spend("", place)
        if self._patience.is_over:
            raise DeviceTimeout(f"stage not {what} {self._patience.text}, state {report.state}")
        return report

    def is_resting(self, report: Report) -> bool:
        """Halted, or idle for a while."""
        return self._idle_reports >= IDLE_REPORTS or (self._is_still and report.is_halted)


def halt(talk: GrblConversation) -> None:
    """Bring motion to rest: a jog is cancelled, anything else is held.

    Raises
    ------
    DeviceError
        The controller takes no notice, or an alarm came instead.
    DeviceTimeout, DeviceLost
        It stands still and is not halted; it is gone.
    """
    jogging = talk.state_word == "Jog"
    talk.write(JOG_CANCEL if jogging else HOLD)
    watch, braking_mm, in_vain = _Watch(talk), _braking_mm(talk.settings), 0
    while not watch.is_resting(report := watch.look("halted")):
        # a jog that is cancelled is called so until it rests, and not all know of Hold:1
        near = watch.travelled_mm < 2.0 * braking_mm + 1.0
        may_brake = near and report.state in ("Jog", "Hold", "Door")
        in_vain += not (may_brake or report.is_braking or report.state == "Idle")
        if in_vain < DEAF_REPORTS:
            continue
        if not jogging:
            raise DeviceError(
                f"told to halt, the controller has moved on by {watch.travelled_mm:.1f} mm "
                f"and says {report.state}"
            )
        jogging, in_vain = False, 0
        talk.write(HOLD)  # ends a jog too, also where 0x85 is not known


def _braking_mm(settings: dict[int, float]) -> float:
    """Longest way to stand still from full speed, ``v^2 / 2a``, by ``$110`` and ``$120``."""
    ways = []
    for axis in range(3):
        speed_mm_s, acceleration = settings.get(110 + axis, 0.0) / 60.0, settings.get(120 + axis)
        ways.append(speed_mm_s**2 / (2.0 * acceleration) if acceleration else UNKNOWN_BRAKING_MM)
    return max(ways)


def wait_begin(talk: GrblConversation) -> None:
    """Give an accepted motion a few reports to be seen; a short one may be over by then."""
    watch = _Watch(talk)
    for _ in range(IDLE_REPORTS):
        if watch.look("seen to move").state != "Idle" or watch.travelled_mm > 0.0:
            return


def wait_idle(talk: GrblConversation, what: str) -> None:
    """Wait until the stage is idle and rests.

    Parameters
    ----------
    talk : GrblConversation
        The open controller.
    what : str
        What is waited for, for the message.

    Raises
    ------
    DeviceError
        An alarm came instead.
    DeviceTimeout
        It stands still in a state that does not end.
    """
    watch = _Watch(talk)
    while True:
        report = watch.look(what)
        if watch.is_resting(report):
            if report.state != "Idle":
                raise DeviceError(f"stage not {what}, state {report.state}")
            return


def verify(talk: GrblConversation, target_mm: Triple, breaks: int) -> None:
    """The controller must stand where it was sent; there are some that are idle too early.

    Parameters
    ----------
    talk : GrblConversation
        The open controller.
    target_mm : tuple of float
        Machine position that was commanded, millimetres.
    breaks : int
        `GrblConversation.breaks` before the motion.

    Raises
    ------
    DeviceError
        It does not come any nearer, or there was an alarm or a reset since ``breaks`` was read.
    """
    nearest_mm, in_vain = math.inf, 0
    while not _is_at(talk, target_mm):
        talk.require_unbroken(breaks, "the stage was there")
        place = talk.machine_mm or target_mm
        away_mm = math.dist(place, target_mm)
        in_vain = 0 if away_mm < nearest_mm else in_vain + 1
        nearest_mm = min(away_mm, nearest_mm)
        if in_vain >= IDLE_REPORTS:
            talk.distrust()  # its planner counts from elsewhere than its position
            raise DeviceError(
                f"the stage says that it has moved but stands at MPos {place} mm, "
                f"expected {tuple(round(value, 4) for value in target_mm)}"
            )
        time.sleep(POLL_S)
        talk.report(fresh=True)


def _is_at(talk: GrblConversation, target_mm: Triple) -> bool:
    """To a step and the report's rounding."""
    found = zip(talk.machine_mm or target_mm, target_mm, strict=True)
    return all(
        abs(value - wanted) <= 0.002 + 1.0 / (talk.settings.get(100 + i) or 1000.0)
        for i, (value, wanted) in enumerate(found)
    )
