"""Stage driver for GRBL 1.1 and grblHAL over a serial port.

Moves are ``G53`` moves in machine coordinates, one line at a time, so neither work offsets nor
modal state matter. The end of a move is an answered ``G4`` dwell (it empties the planner), then
``Idle`` and the right position. GRBL's answers carry no number, so after a lost one the
conversation is set to zero by a soft reset, which keeps the position while the stage stands.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator

from sl_camera.grbl_protocol import (
    ALARMS_KEEPING_POSITION,
    HOLD,
    JOG_CANCEL,
    RESET,
    RESUME,
    STATUS,
    MachineFrame,
    Report,
    alarm_code,
    alarm_text,
    error_text,
    machine_frame,
    parse_report,
    parse_setting,
)
from sl_camera.serial_lines import SerialLines
from sl_camera.stage import Position, StageLimits, StageState
from sl_projector.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout

POLL_S = 0.1  # GRBL asks for at most 10 status requests a second
IDLE_WITHOUT_REPLY_S = 1.0  # idle for so long with a reply owing: the reply is lost
MAX_LINE = 79  # characters, of GRBL's 80 with the line end
INCH_MM = 25.4

Triple = tuple[float, float, float]


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
        self._link: SerialLines | None = None
        self._cv = threading.Condition()
        self._line_lock = threading.Lock()  # one line and its reply at a time
        self._motion_lock = threading.Lock()  # one mover at a time
        self._query_lock = threading.Lock()  # one status request at a time
        self._forget()

    def _forget(self) -> None:
        """Know nothing about the controller, as before the first ``open``."""
        self._settings: dict[int, float] = {}
        self._frame: MachineFrame | None = None
        self._replies: list[str] = []
        self._report: Report | None = None
        self._report_time = -math.inf
        self._reports = 0
        self._machine_mm: Triple | None = None
        self._offset_mm: Triple = (0.0, 0.0, 0.0)
        self._offset_known = False
        self._message = ""
        self._version = ""
        self._banners = 0
        self._banner_wanted = True
        self._break = 0  # counts alarms and banners: whoever waits for a reply stops waiting
        self._alarm: str | None = None
        self._alarm_critical = False
        self._lost: str | None = "not open"
        self._activity = ""
        self._referenced = False
        self._resync = False
        self.noise_lines = 0

    # -- connecting ---------------------------------------------------------------------------

    def open(self) -> None:
        """Connect, end a motion left over, read the settings (see ``StageDriver.open``)."""
        self.close()
        self._forget()
        self._link = SerialLines(self.port, self.baud, self._on_line, self._on_lost)
        self._lost = None
        try:
            self._greet()
            self._read_settings()
            self._banner_wanted = False
        except DeviceError:
            self.close()
            raise

    def close(self) -> None:
        """Let go of the port; a running motion is stopped first. Never raises."""
        link, self._link = self._link, None
        if link is None:
            return
        if self._activity:
            with contextlib.suppress(DeviceError):
                link.write(HOLD)
        link.close()
        self._on_lost("closed")

    def _greet(self) -> None:
        """Get a banner from a controller that stands still.

        An Arduino restarts when its port is opened and sends the banner by itself; others are
        asked for their state first, because a soft reset in motion would lose the position.
        """
        deadline = time.monotonic() + self._reply_timeout_s
        while not self._banners and self._report is None and time.monotonic() < deadline:
            self._write(STATUS)
            self._wait(lambda: self._banners > 0 or self._report is not None, 0.25)
        if self._report is not None and self._report.state in ("Run", "Jog", "Hold", "Door"):
            self._halt()
        if not self._banners:
            self._soft_reset()
        if not self._version.lower().startswith(("grbl 1.1", "grblhal 1.1")):
            raise DeviceError(
                f"{self.port} answers {self._version!r}, expected GRBL or grblHAL 1.1"
            )

    def _read_settings(self) -> None:
        self._alarm = None  # what was printed before we connected; the state says what still holds
        self.command("$$")
        missing = [
            n for n in (110, 111, 112, 120, 121, 122, 130, 131, 132) if n not in self._settings
        ]
        if missing:
            raise DeviceError(f"GRBL's settings lack {missing}; expected $110 to $132 for x, y, z")
        self._frame = machine_frame(self._settings, self._origin_mm, self._signs)
        self._refresh(fresh=True)

    # -- what the reader thread hears -----------------------------------------------------------

    def _on_lost(self, reason: str) -> None:
        with self._cv:
            self._lost, self._referenced = reason, False
            self._cv.notify_all()

    def _on_line(self, line: str) -> None:
        with self._cv:
            if line == "ok" or line.startswith("error:"):
                self._replies.append(line)
            elif line.startswith("<"):
                self._on_report(line)
            elif line.startswith("ALARM:"):
                self._on_alarm(alarm_code(line))
            elif line.lower().startswith("grbl"):
                self._on_banner(line)
            elif line.startswith("[MSG:"):
                self._message = line[5:-1]
            elif (setting := parse_setting(line)) is not None:
                self._settings[setting[0]] = setting[1]
            elif not line.startswith(("[", "$", ">")):
                self.noise_lines += 1
            self._cv.notify_all()

    def _on_report(self, line: str) -> None:
        try:
            report = parse_report(line)
        except ValueError:
            self.noise_lines += 1
            return
        if report.offset is not None:
            self._offset_mm, self._offset_known = report.offset, True
        self._report, self._report_time = report, time.monotonic()
        self._reports += 1
        if report.is_machine or self._offset_known:
            self._machine_mm = self._in_machine_mm(report)

    def _in_machine_mm(self, report: Report) -> Triple:
        unit = INCH_MM if self._settings.get(13) else 1.0
        offset = (0.0, 0.0, 0.0) if report.is_machine else self._offset_mm
        x, y, z = (unit * (a + b) for a, b in zip(report.position, offset, strict=True))
        return x, y, z

    def _on_alarm(self, code: int) -> None:
        self._alarm, self._alarm_critical = alarm_text(code), code in (1, 2)
        if code not in ALARMS_KEEPING_POSITION:
            self._referenced = False
        self._break += 1

    def _on_banner(self, line: str) -> None:
        self._version = line
        self._banners += 1
        self._replies.clear()
        if not self._banner_wanted and self._alarm is None:  # it counts from somewhere else now
            self._alarm = "the controller restarted by itself (power cycle?); the position is lost"
            self._referenced = False
        self._break += 1

    # -- talking ------------------------------------------------------------------------------

    def command(self, line: str, *, timeout_s: float | None = None) -> None:
        """Send one line and wait for its ``ok``. For diagnosis; moves go through ``move_to``.

        Raises
        ------
        DeviceRefused
            ``error:N``, in words.
        DeviceError
            Alarm or reset before the answer came.
        DeviceTimeout, DeviceLost
            No answer; no port.
        """
        self._exchange(line, timeout_s or self._reply_timeout_s)

    def _write(self, data: bytes) -> None:
        link = self._link
        if link is None or self._lost is not None:
            raise DeviceLost(f"stage on {self.port}: {self._lost or 'not open'}")
        link.write(data)

    def _wait(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until ``done``; raises where the port vanishes meanwhile."""
        with self._cv:
            reached = self._cv.wait_for(lambda: done() or self._lost is not None, timeout_s)
            if self._lost is not None:
                raise DeviceLost(f"stage on {self.port}: {self._lost}")
            return reached

    def _exchange(self, line: str, timeout_s: float) -> None:
        """One line, one reply. Time in hold does not count towards the time-out."""
        if len(line) > MAX_LINE or not line.isascii():
            raise DeviceRefused(
                f"line of {len(line)} characters, expected at most {MAX_LINE} ASCII"
            )
        with self._line_lock:
            self._settle_conversation()
            with self._cv:
                self._replies.clear()
                started = self._break
            self._write(line.encode("ascii") + b"\n")
            self._await_reply(line, started, timeout_s)
            reply = self._replies[0]
        if reply != "ok":
            raise DeviceRefused(f"GRBL refuses {line!r}: {error_text(reply)}")

    def _await_reply(self, line: str, started: int, timeout_s: float) -> None:
        """Wait for the reply, asking for the status meanwhile to see holds and lost replies."""
        left_s, idle_s, last = timeout_s, 0.0, time.monotonic()
        while not self._wait(lambda: bool(self._replies) or self._break != started, POLL_S):
            now = time.monotonic()
            spent, last = now - last, now
            state = self._state_word()
            left_s -= 0.0 if state in ("Hold", "Door") else spent
            idle_s = idle_s + spent if state == "Idle" else 0.0
            if left_s <= 0.0:
                self._resync = True
                raise DeviceTimeout(f"no reply to {line!r} within {timeout_s:g} s")
            if self._activity == "dwell" and idle_s > IDLE_WITHOUT_REPLY_S:
                self._resync = True  # it stands and the reply is lost: the position will tell
                self._replies.append("ok")
                return
            if self._activity != "homing":  # an AVR answers no status while it homes
                self._write(STATUS)
        if self._break != started:
            raise DeviceError(self._alarm or f"the controller was stopped before {line!r} was done")

    def _state_word(self) -> str:
        return self._report.state if self._report is not None else ""

    def _settle_conversation(self) -> None:
        """After a lost reply: start the conversation anew, standing, so that none is stale."""
        if self._resync:
            self._soft_reset()

    def _soft_reset(self) -> None:
        """0x18 and the banner. Keeps the position where nothing moves."""
        seen = self._banners
        self._banner_wanted = True
        with self._cv:
            self._break += 1  # a line cut short by the reset is answered "ok": not to be believed
            self._cv.notify_all()
        try:
            self._write(RESET)
            if not self._wait(lambda: self._banners > seen, self._reply_timeout_s):
                raise DeviceTimeout(
                    f"no GRBL banner from {self.port} within {self._reply_timeout_s:g} s of a reset"
                )
        finally:
            self._banner_wanted = False
        self._resync = False

    def _refresh(self, *, fresh: bool = False) -> Report:
        """Latest status report, asked for where the last is older than the polling interval."""
        with self._query_lock:
            report = self._report
            if report is not None and not fresh and time.monotonic() - self._report_time < POLL_S:
                return report
            seen = self._reports
            deadline = time.monotonic() + self._reply_timeout_s
            while time.monotonic() < deadline:
                self._write(STATUS)
                if self._wait(lambda: self._reports > seen, 0.5):
                    assert self._report is not None
                    return self._report
            raise DeviceTimeout(f"no status from {self.port} within {self._reply_timeout_s:g} s")

    def _wait_state(self, wanted: Callable[[Report], bool], timeout_s: float, what: str) -> None:
        deadline = time.monotonic() + timeout_s
        while not wanted(report := self._refresh(fresh=True)):
            if time.monotonic() > deadline:
                raise DeviceTimeout(
                    f"stage not {what} within {timeout_s:g} s, state {report.state}"
                )
            if self._alarm is not None:
                raise DeviceError(self._alarm)
            time.sleep(POLL_S)

    # -- state --------------------------------------------------------------------------------

    def state(self) -> StageState:
        """What the stage is doing; asks the controller at most ten times a second."""
        if self._lost is not None:
            return StageState("lost", self._lost)
        if self._activity == "homing" and self._alarm is None:
            return StageState("homing", "searching the home switches")
        if self._alarm is not None:
            return StageState("alarm", self._alarm, self._referenced)
        try:
            report = self._refresh()
        except DeviceError as error:
            return StageState("lost", str(error))
        return self._interpret(report)

    def _interpret(self, report: Report) -> StageState:
        if self._alarm is not None:
            return StageState("alarm", self._alarm, self._referenced)
        if report.state == "Alarm":
            return StageState("not_homed", self._message or "locked until home or clear")
        if report.state in ("Hold", "Door"):
            text = "halted; resume or stop" if report.state == "Hold" else "safety door open"
            return StageState("hold", text, self._referenced)
        if report.state in ("Run", "Jog") or (report.state == "Idle" and self._activity):
            return StageState("moving", "moving", self._referenced)
        if report.state == "Home":
            return StageState("homing", "searching the home switches")
        if report.state == "Idle":
            text = "" if self._referenced else "position counts from no home switch"
            return StageState("idle", text, self._referenced)
        return StageState("alarm", f"controller state {report.state}; clear to leave it")

    def position_m(self) -> Position:
        """Where the stage stands, metres, as the controller counts it."""
        frame = self._opened()
        if self._activity != "homing" and not self._alarm_critical:
            self._refresh()
        if self._machine_mm is None:
            raise DeviceTimeout("GRBL reports work positions and has not sent its offset (WCO) yet")
        return frame.stage_m(self._machine_mm)

    def limits_m(self) -> StageLimits:
        """Reach as the controller's settings have it (``$130`` to ``$132``)."""
        return self._opened().limits()

    def _opened(self) -> MachineFrame:
        if self._frame is None or self._lost is not None:
            raise DeviceLost(f"stage on {self.port}: {self._lost or 'not open'}")
        return self._frame

    def _require(self, *kinds: str) -> None:
        state = self.state()
        if state.kind == "lost":
            raise DeviceLost(f"stage on {self.port}: {state.text}")
        if state.kind not in kinds:
            raise DeviceRefused(
                f"stage is {state.kind} ({state.text}), expected {' or '.join(kinds)}"
            )

    @contextlib.contextmanager
    def _moving(self, activity: str, *kinds: str) -> Iterator[None]:
        """Own the motion; what goes wrong inside leaves the stage standing."""
        if not self._motion_lock.acquire(blocking=False):
            raise DeviceRefused("stage is moving for another caller, expected idle")
        try:
            self._require(*kinds)
            self._activity = activity
            yield
        except DeviceTimeout:
            with contextlib.suppress(DeviceError):
                self.stop()
            raise
        finally:
            self._activity = ""
            self._motion_lock.release()

    # -- motion -------------------------------------------------------------------------------

    def home(self, *, timeout_s: float = 120.0) -> None:
        """``$H``; blocks until the switches are found."""
        with self._moving("homing", "idle", "not_homed"):
            self._exchange("$H", timeout_s)
            self._activity = "homed"
            self._wait_state(lambda report: report.state == "Idle", 2.0, "idle after homing")
            self._referenced = True

    def move_to(
        self, x_m: float, y_m: float, z_m: float, *, timeout_s: float | None = None
    ) -> None:
        """Move in a straight line to an absolute position and wait until the stage stands there."""
        frame = self._opened()
        frame.limits().require_inside((x_m, y_m, z_m))
        target_mm = frame.machine_mm((x_m, y_m, z_m))
        with self._moving("line", "idle"):
            timeout_s = timeout_s or self._patience_s(target_mm)
            self._exchange(self._move_line(target_mm), min(timeout_s, self._reply_timeout_s))
            self._activity = "dwell"
            self._exchange("G4P0.01", timeout_s)
            self._wait_state(lambda report: report.state == "Idle", timeout_s, "idle")
            self._verify(target_mm)

    def _move_line(self, target_mm: Triple) -> str:
        x, y, z = target_mm
        rate = "G0" if self._speed_m_s is None else f"G1F{self._speed_m_s * 6e4:.0f}"
        return f"G21G90G94G53{rate}X{x:.4f}Y{y:.4f}Z{z:.4f}"

    def _patience_s(self, target_mm: Triple) -> float:
        """Twice the time the move should take, and five seconds."""
        here = self._machine_mm or target_mm
        longest = max(abs(a - b) for a, b in zip(here, target_mm, strict=True))
        slowest = min(self._settings[n] for n in (110, 111, 112)) / 60.0
        gentlest = min(self._settings[n] for n in (120, 121, 122))
        speed = min(slowest, (self._speed_m_s or math.inf) * 1e3)
        return 2.0 * (longest / speed + speed / gentlest) + 5.0

    def _verify(self, target_mm: Triple) -> None:
        """The controller must stand where it was sent, to a step and the report's rounding."""
        here = self._machine_mm
        if here is None:
            return
        for i, (found, wanted) in enumerate(zip(here, target_mm, strict=True)):
            if abs(found - wanted) > 0.002 + 1.0 / self._settings.get(100 + i, 1000.0):
                raise DeviceError(
                    f"the stage says that it has moved but stands at MPos {here}, "
                    f"expected {tuple(round(value, 4) for value in target_mm)}"
                )

    def jog_by(self, dx_m: float, dy_m: float, dz_m: float, *, speed_m_s: float) -> None:
        """Start a relative motion and return; ``stop()`` ends it at any time.

        Unlike a move it cannot be held: ``hold`` ends a jog.

        Raises
        ------
        DeviceRefused
            Beyond the limits (nothing was sent), or not idle.
        """
        frame = self._opened()
        with self._moving("line", "idle"):
            here = self.position_m()
            target = (here[0] + dx_m, here[1] + dy_m, here[2] + dz_m)
            frame.limits().require_inside(target)
            x, y, z = frame.machine_mm(target)
            line = f"$J=G21G90G53X{x:.4f}Y{y:.4f}Z{z:.4f}F{speed_m_s * 6e4:.1f}"
            self._exchange(line, self._reply_timeout_s)
        self._report_time = -math.inf  # the report at hand is from before the jog

    def hold(self) -> None:
        """``!``: halt smoothly; ``resume`` goes on. Refused while homing and in alarm."""
        self._require("idle", "moving", "hold")
        self._halt()

    def _halt(self) -> None:
        jogging = self._state_word() == "Jog"
        self._write(JOG_CANCEL if jogging else HOLD)
        resting = ("Idle",) if jogging else ("Hold", "Door")
        self._wait_state(
            lambda report: report.state in resting and (jogging or report.substate == 0),
            self._patience_s(self._machine_mm or (0.0, 0.0, 0.0)),
            "halted",
        )

    def resume(self) -> None:
        """``~``: go on with what ``hold`` interrupted."""
        self._require("hold")
        self._write(RESUME)
        self._wait_state(
            lambda report: report.state not in ("Hold", "Door"), self._reply_timeout_s, "resumed"
        )

    def stop(self) -> None:
        """Halt and drop what is left: jog cancel, or hold and a reset while standing."""
        self._opened()
        if self._activity == "homing":
            self._soft_reset()
            return
        if self._alarm is not None:
            return
        report = self._refresh(fresh=True)
        if report.state == "Alarm" or (report.state == "Idle" and not self._activity):
            return
        self._halt()
        if self._refresh(fresh=True).state != "Idle":
            self._soft_reset()
            self._refresh(fresh=True)

    def clear(self) -> None:
        """Reset and ``$X``: the operator says that it is safe to move again."""
        self._opened()
        if self.state().kind not in ("alarm", "not_homed"):
            return
        self._soft_reset()
        if self._refresh(fresh=True).state == "Alarm":
            self._exchange("$X", self._reply_timeout_s)
        report = self._refresh(fresh=True)
        if report.state != "Idle":
            raise DeviceRefused(f"still {report.state} after the unlock: {self._message}")
        self._alarm, self._alarm_critical, self._message = None, False, ""
