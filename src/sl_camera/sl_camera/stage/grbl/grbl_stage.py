"""Stage driver for GRBL 1.1 and grblHAL over a serial port.

Moves are ``G53`` moves in machine coordinates, one line at a time, so neither work offsets nor
modal state matter. The end of a move is an answered ``G4`` dwell (it empties the planner), then
``Idle``, then the right position.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

from sl_camera.stage.grbl.grbl_conversation import GrblConversation, Triple
from sl_camera.stage.grbl.grbl_protocol import HOLD, RESUME, MachineFrame, Report, machine_frame
from sl_camera.stage.grbl.grbl_standstill import halt, verify, wait_begin, wait_idle
from sl_camera.stage.stage import Position, StageLimits, StageState
from sl_common.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout

HOMING_POLL_S = 0.5  # an AVR answers no status while it homes, and need not be pestered
PATIENCE_AT_START = 5  # a simulator on a busy machine may need ten seconds for its first answer
NEEDED_SETTINGS = (130, 131, 132)


class GrblStage:
    """A three-axis stage on a GRBL 1.1 controller. Implements ``StageDriver``.

    Parameters
    ----------
    port : str
        Serial device, for instance ``/dev/ttyUSB0``.
    baud : int
        115200 for GRBL 1.1.
    origin_mm : tuple of float, optional
        MPos where the stage reads zero; by default the middle of the travel, or machine zero
        where the controller has no homing (see ``machine_frame``).
    signs : tuple of int
        +1 or -1 per axis: the direction of the stage's axes in machine coordinates. +z of the
        stage is towards the devices.
    speed_m_s : float, optional
        Speed of moves; by default the controller's own limits (``G0``).
    reply_timeout_s : float
        Longest wait for an answer that involves no motion. grblHAL may need a second.
    """

    def __init__(
        self,
        port: str,
        *,
        baud: int = 115200,
        origin_mm: Triple | None = None,
        signs: tuple[int, int, int] = (1, 1, 1),
        speed_m_s: float | None = None,
        reply_timeout_s: float = 3.0,
    ) -> None:
        self.port, self.baud = port, baud
        self._origin_mm, self._signs = origin_mm, signs
        self._speed_m_s, self._reply_timeout_s = speed_m_s, reply_timeout_s
        self._talk: GrblConversation | None = None
        self._frame: MachineFrame | None = None
        self._motion_lock = threading.Lock()  # one mover at a time
        self._activity = ""  # "homing", "moving" or nothing, whatever a stale report says

    # -- connecting ---------------------------------------------------------------------------

    def open(self) -> None:
        """Connect, end a motion left over, read the settings (see ``StageDriver.open``)."""
        self.close()
        talk = GrblConversation(self.port, self.baud, self._reply_timeout_s)
        try:
            first = talk.greet()
            if first is not None and first.state in ("Run", "Jog", "Hold", "Door"):
                halt(talk)
            talk.know_banner()
            talk.exchange("$$", PATIENCE_AT_START * self._reply_timeout_s)
            missing = [n for n in NEEDED_SETTINGS if n not in talk.settings]
            if missing:
                raise DeviceError(f"{self.port} has no settings {missing}, expected $130 to $132")
            talk.know_position()
        except DeviceError:
            talk.close()
            raise
        self._frame = machine_frame(talk.settings, self._origin_mm, self._signs)
        self._talk = talk

    def close(self) -> None:
        """Let go of the port; a running motion is stopped first. Never raises."""
        talk, self._talk = self._talk, None
        if talk is not None:
            talk.close(HOLD if self._activity == "moving" else b"")

    def _open_talk(self) -> GrblConversation:
        talk = self._talk
        if talk is None or talk.lost is not None:
            reason = "not open" if talk is None else talk.lost
            raise DeviceLost(f"stage on {self.port}: {reason}")
        return talk

    def _open_frame(self) -> MachineFrame:
        self._open_talk()
        if self._frame is None:
            raise DeviceLost(f"stage on {self.port}: not open")
        return self._frame

    def command(self, line: str) -> None:
        """Send one line and wait for its ``ok``; for diagnosis, moves go through ``move_to``.

        Raises
        ------
        DeviceRefused, DeviceError, DeviceTimeout, DeviceLost
            As ``GrblConversation.exchange``.
        """
        talk = self._open_talk()
        talk.exchange(line, self._reply_timeout_s)
        talk.expire_report()

    # -- state --------------------------------------------------------------------------------

    def state(self) -> StageState:
        """What the stage is doing; asks the controller at most ten times a second."""
        talk = self._talk
        if talk is None or talk.lost is not None:
            return StageState("lost", "not open" if talk is None else talk.lost or "")
        if talk.alarm is not None:
            return StageState("alarm", talk.alarm, talk.referenced)
        if self._activity == "homing":
            return StageState("homing", "searching the home switches")
        try:
            report = talk.report()
        except DeviceError as error:
            return StageState("lost", str(error))
        return self._interpret(talk, report)

    def _interpret(self, talk: GrblConversation, report: Report) -> StageState:
        if talk.alarm is not None:
            return StageState("alarm", talk.alarm, talk.referenced)
        if report.state == "Alarm":
            return StageState("not_homed", "locked until home or clear")
        if report.state in ("Hold", "Door"):
            text = "halted; resume or stop" if report.state == "Hold" else "safety door open"
            return StageState("hold", text, talk.referenced)
        if report.state in ("Run", "Jog") or (report.state == "Idle" and self._activity):
            return StageState("moving", "moving", talk.referenced)
        if report.state == "Home":
            return StageState("homing", "searching the home switches")
        if report.state == "Idle":
            text = "" if talk.referenced else "position counts from no home switch"
            return StageState("idle", text, talk.referenced)
        return StageState("alarm", f"controller state {report.state}; clear to leave it")

    def position_m(self) -> Position:
        """Where the stage stands, metres, as the controller counts it."""
        frame, talk = self._open_frame(), self._open_talk()
        if self._activity != "homing" and not talk.is_deaf:
            talk.report()
        if talk.machine_mm is None:
            raise DeviceTimeout("GRBL reports work positions and has not sent its offset (WCO) yet")
        return frame.stage_m(talk.machine_mm)

    @property
    def measured_ns(self) -> int:
        """When the position that ``position_m`` told last was asked for, host clock."""
        talk = self._talk
        return talk.measured_ns if talk is not None else 0

    def limits_m(self) -> StageLimits:
        """Reach as the controller's settings have it (``$130`` to ``$132``)."""
        return self._open_frame().limits()

    def _require(self, *kinds: str) -> None:
        state = self.state()
        if state.kind == "lost":
            raise DeviceLost(f"stage on {self.port}: {state.text}")
        if state.kind not in kinds:
            wanted = " or ".join(kinds)
            raise DeviceRefused(f"stage is {state.kind} ({state.text}), expected {wanted}")

    @contextlib.contextmanager
    def _owning_motion(self, activity: str, *kinds: str) -> Iterator[GrblConversation]:
        """Be the one who moves; a time-out inside leaves the stage standing."""
        if not self._motion_lock.acquire(blocking=False):
            raise DeviceRefused("stage is moving for another caller, expected idle")
        try:
            self._require(*kinds)
            self._activity = activity
            yield self._open_talk()
        except DeviceTimeout:
            with contextlib.suppress(DeviceError):
                self._stop()
            raise
        finally:
            self._activity = ""
            self._motion_lock.release()

    # -- motion -------------------------------------------------------------------------------

    def home(self, *, timeout_s: float = 120.0) -> None:
        """``$H``; blocks until the switches are found."""
        with self._owning_motion("homing", "idle", "not_homed") as talk:
            talk.exchange("$H", timeout_s, poll_s=HOMING_POLL_S)
            wait_idle(talk, "idle after homing")
            talk.referenced = True

    def move_to(
        self, x_m: float, y_m: float, z_m: float, *, timeout_s: float | None = None
    ) -> None:
        """See `StageDriver`; moves in a straight line.

        Without ``timeout_s`` it waits for as long as the position changes.
        """
        frame = self._open_frame()
        frame.limits().require_inside((x_m, y_m, z_m))
        target_mm = frame.machine_mm((x_m, y_m, z_m))
        with self._owning_motion("moving", "idle") as talk:
            talk.exchange(self._move_line(target_mm), self._reply_timeout_s)
            breaks = talk.breaks
            talk.exchange("G4 P0.01", timeout_s, may_be_lost=True)
            talk.wait_state(lambda report: report.state == "Idle", "idle")
            verify(talk, target_mm, breaks)

    def _move_line(self, target_mm: Triple) -> str:
        x, y, z = target_mm
        speed = self._speed_m_s
        line = f"{'G1' if speed else 'G0'} G53 G21 G90 G94 X{x:.4f} Y{y:.4f} Z{z:.4f}"
        return f"{line} F{speed * 6e4:.1f}" if speed else line

    def jog_by(self, dx_m: float, dy_m: float, dz_m: float, *, speed_m_s: float) -> None:
        """Start a relative motion and return; ``stop()`` ends it at any time.

        Unlike a move it cannot be held: ``hold`` ends a jog.

        Parameters
        ----------
        dx_m, dy_m, dz_m : float
            Distance in stage axes, metres.
        speed_m_s : float
            Along the path, metres per second.

        Raises
        ------
        DeviceRefused
            Beyond the limits (nothing was sent), or not idle.
        """
        frame = self._open_frame()
        with self._owning_motion("moving", "idle") as talk:
            x, y, z = (a + b for a, b in zip(self.position_m(), (dx_m, dy_m, dz_m), strict=True))
            frame.limits().require_inside((x, y, z))
            x, y, z = (1e3 * s * d for s, d in zip(self._signs, (dx_m, dy_m, dz_m), strict=True))
            # relative, as in GRBL's own examples: there are controllers that jog no other way
            line = f"$J=G91 G21 X{x:.4f} Y{y:.4f} Z{z:.4f} F{speed_m_s * 6e4:.1f}"
            talk.exchange(line, self._reply_timeout_s)
            wait_begin(talk)

    def hold(self) -> None:
        """``!``: halt smoothly; ``resume`` goes on. Refused while homing and in alarm."""
        self._require("idle", "moving", "hold")
        halt(self._open_talk())

    def resume(self) -> None:
        """``~``: go on with what ``hold`` interrupted."""
        self._require("hold")
        talk = self._open_talk()
        talk.write(RESUME)
        talk.wait_state(lambda report: report.state not in ("Hold", "Door"), "resumed")

    def stop(self) -> None:
        """Halt and drop what is left: jog cancel, or hold and a reset while standing.

        A controller that takes no notice of either is reset in motion: that costs the position.

        Raises
        ------
        DeviceError
            It took a reset, or an alarm came instead; nothing moves until ``clear``.
        """
        self._stop()
        if self._motion_lock.acquire(timeout=self._reply_timeout_s):  # the mover has noticed
            self._motion_lock.release()

    def _stop(self) -> None:
        talk = self._open_talk()
        if self._activity == "homing":
            talk.reset()
            return
        if talk.alarm is not None:
            return
        report = talk.report(fresh=True)
        if report.state == "Alarm" or (report.state == "Idle" and not self._activity):
            return
        try:
            halt(talk)
        except DeviceLost:
            raise
        except DeviceError as error:
            if talk.alarm is None:
                talk.reset()
                talk.lose_position(f"stopped by a reset, the position is lost: {error}")
            raise DeviceError(talk.alarm) from error
        if talk.report(fresh=True).state != "Idle" or self._activity:
            talk.reset()
            talk.report(fresh=True)

    def clear(self) -> None:
        """Reset and ``$X``: the operator says that it is safe to move again."""
        talk = self._open_talk()
        if self.state().kind not in ("alarm", "not_homed"):
            return
        talk.reset()
        if talk.alarm is None and talk.state_word != "Check":
            talk.referenced = False  # locked for a reason that was not told, or asleep
        if talk.report(fresh=True).state == "Alarm":
            talk.exchange("$X", self._reply_timeout_s)
        report = talk.report(fresh=True)
        if report.state != "Idle":
            raise DeviceRefused(f"still {report.state} after the unlock: {talk.message}")
        talk.alarm = None
