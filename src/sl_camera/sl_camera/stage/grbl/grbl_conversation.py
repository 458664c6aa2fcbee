"""The conversation with a GRBL controller: one line and its answer, reports, alarms, resets.

GRBL's answers carry no number. So one line is out at a time, and after a lost answer the
conversation starts anew with a soft reset, which keeps the position while nothing moves.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable

from sl_camera.stage.grbl.grbl_protocol import (
    ALARMS_KEEPING_POSITION,
    ECHO,
    RESET,
    RESUME,
    STATUS,
    UNTOLD_ALARM,
    Report,
    alarm_code,
    alarm_text,
    error_text,
    is_supported,
    parse_report,
    parse_setting,
)
from sl_camera.stage.serial_lines import SerialLines
from sl_common.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout

POLL_S = 0.1  # GRBL asks for at most 10 status requests a second
NUDGE_S = 0.25
STILL_S = 5.0  # without a time-out a wait ends after standing still for so long
RESET_ATTEMPTS = 8
REPORTS_TO_OFFSET = 31
IDLE_WITHOUT_REPLY_S = 1.0  # idle for so long with the answer to a dwell owing: it is lost
MAX_LINE = 79  # characters, of GRBL's 80 with the line end
INCH_MM = 25.4

Triple = tuple[float, float, float]


class Patience:
    """How long an answer may still take: a total, or for as long as the stage moves.

    Time in hold does not count.
    """

    def __init__(self, timeout_s: float | None) -> None:
        self.text = f"within {timeout_s or STILL_S:g} s"
        if timeout_s is None:
            self.text += " of standing still"
        self._is_total = timeout_s is not None
        self._left_s = self._full_s = timeout_s or STILL_S
        self._last = time.monotonic()
        self._place: Triple | None = None
        self.idle_s = 0.0

    def spend(self, state: str, place: Triple | None) -> None:
        """Count the time since the last call, by what the controller said meanwhile.

        Parameters
        ----------
        state : str
            State in the last report.
        place : tuple of float or None
            Machine position in it, millimetres.
        """
        now = time.monotonic()
        spent, self._last = now - self._last, now
        if state not in ("Hold", "Door"):
            self._left_s -= spent
        if place != self._place and not self._is_total:
            self._left_s = self._full_s
        self._place = place
        self.idle_s = self.idle_s + spent if state == "Idle" else 0.0

    @property
    def is_over(self) -> bool:
        """Nothing is left to wait for."""
        return self._left_s <= 0.0


class GrblConversation:
    """An open port with a controller behind it; thread-safe.

    Parameters
    ----------
    port, baud
        As pyserial has them.
    reply_timeout_s : float
        Longest wait for an answer that involves no motion.

    Attributes
    ----------
    settings : dict
        ``$n`` with a number, as last printed.
    machine_mm : tuple of float or None
        Last MPos.
    measured_ns : int
        When it was asked for, host clock: it is not older.
    alarm : str or None
        Why nothing may move until it is acknowledged; also a restart that nobody asked for.
    is_deaf : bool
        A limit alarm: the controller answers nothing before a reset.
    referenced : bool
        Set by the owner after homing; falls with everything that costs the position.
    lost : str or None
        Why there is no port any more.
    message : str
        The last ``[MSG:...]``.
    noise_lines : int
        Lines that made no sense.
    """

    def __init__(self, port: str, baud: int, reply_timeout_s: float) -> None:
        self.port, self.reply_timeout_s = port, reply_timeout_s
        self.settings: dict[int, float] = {}
        self.machine_mm: Triple | None = None
        self.alarm: str | None = None
        self.is_deaf = False
        self.referenced = False
        self.lost: str | None = None
        self.message = self.version = ""
        self.noise_lines = 0
        self._cv = threading.Condition()
        self._line_lock = threading.Lock()  # one line and its answer at a time
        self._query_lock = threading.Lock()  # one status request at a time
        self._replies: list[str] = []
        self._report: Report | None = None
        self._report_time = -math.inf
        self._asked_ns = 0  # of the oldest question for the status that has no answer yet
        self._last_asked_ns = self.measured_ns = 0
        self._offset_mm: Triple | None = None
        self._reports = self._banners = 0
        self._banner_wanted = True
        self._late_banners_until = -math.inf  # of resets that were repeated: no surprise either
        self._break = 0  # counts alarms and resets: whoever waits for an answer stops waiting
        self._resync = self._refused = False
        self._link = SerialLines(port, baud, self._on_line, self._on_lost)

    def close(self, last_bytes: bytes = b"") -> None:
        """Send the bytes if that is still possible and let go of the port; never raises."""
        if last_bytes and self.lost is None:
            with contextlib.suppress(DeviceError):
                self._link.write(last_bytes)
        self._link.close()
        self._on_lost("closed")

    # -- what the reader thread hears -----------------------------------------------------------

    def _on_lost(self, reason: str) -> None:
        with self._cv:
            self.lost, self.referenced = self.lost or reason, False
            self._cv.notify_all()

    def _on_line(self, line: str) -> None:
        line = line.lstrip(ECHO)
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
                self.message = line[5:-1]
            elif (setting := parse_setting(line)) is not None:
                self.settings[setting[0]] = setting[1]
            elif not line.startswith(("[", "$", ">")):
                self.noise_lines += 1
            self._cv.notify_all()

    def _on_report(self, line: str) -> None:
        try:
            report = parse_report(line)
        except ValueError:
            self.noise_lines += 1
            return
        self._offset_mm = report.offset or self._offset_mm
        if report.state == "Alarm" and self.state_word not in ("Alarm", "") and not self.alarm:
            self.lose_position(UNTOLD_ALARM)
            self._break += 1
        self._report, self._report_time = report, time.monotonic()
        self.measured_ns, self._asked_ns = self._asked_ns or self._last_asked_ns, 0
        self._reports += 1
        offset = (0.0, 0.0, 0.0) if report.is_machine else self._offset_mm
        if offset is not None:
            unit = INCH_MM if self.settings.get(13) else 1.0
            x, y, z = (unit * (a + b) for a, b in zip(report.position, offset, strict=True))
            self.machine_mm = x, y, z

    def _on_alarm(self, code: int) -> None:
        self.alarm, self.is_deaf = alarm_text(code), code in (1, 2)
        if code not in ALARMS_KEEPING_POSITION:
            self.referenced = False
        self._break += 1

    def _on_banner(self, line: str) -> None:
        self.version, self.is_deaf, self._asked_ns = line, False, 0
        self._report = None  # of before
        self._banners += 1
        self._replies.clear()
        if not self._banner_wanted and time.monotonic() > self._late_banners_until:
            self.lose_position(
                "the controller restarted by itself (power cycle?); the position is lost"
            )
        self._break += 1

    def lose_position(self, reason: str) -> None:
        """Nothing may move before this is acknowledged; an alarm that is known goes before it."""
        self.alarm, self.referenced = self.alarm or reason, False

    # -- talking ------------------------------------------------------------------------------

    def write(self, data: bytes) -> None:
        """Send bytes, real-time commands among them; DeviceLost where there is no port."""
        if self.lost is not None:
            raise DeviceLost(f"stage on {self.port}: {self.lost}")
        if data == STATUS:
            self._last_asked_ns = time.time_ns()
            self._asked_ns = self._asked_ns or self._last_asked_ns
        self._link.write(data)

    def _ask_in_turn(self) -> None:
        """Ask for the status, unless somebody waits for an answer already.

        GRBL may answer two questions with one report, and then nobody knows of when it is.
        """
        if not self._asked_ns or time.time_ns() - self._last_asked_ns > NUDGE_S * 1e9:
            self.write(STATUS)

    def _wait(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until ``done``; raises where the port vanishes meanwhile."""
        with self._cv:
            reached = self._cv.wait_for(lambda: done() or self.lost is not None, timeout_s)
            if self.lost is not None:
                raise DeviceLost(f"stage on {self.port}: {self.lost}")
            return reached

    def _asking(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until ``done``, asking for the status now and then.

        The questions do no harm, and there are controllers that send what they have to say
        only when the next byte arrives.
        """
        deadline = time.monotonic() + timeout_s
        while not self._wait(done, NUDGE_S):
            if time.monotonic() > deadline:
                return False
            self.write(STATUS)
        return True

    def greet(self) -> Report | None:
        """Wait for the first sign of life: a status report, or None for a fresh banner.

        An Arduino restarts when its port is opened and sends the banner by itself; others are
        asked for their state, because a reset in motion would cost the position.
        """
        self.write(STATUS)
        self._asking(lambda: self._banners > 0 or self._report is not None, self.reply_timeout_s)
        return None if self._banners else self._report

    def know_banner(self) -> None:
        """Make sure of a banner and of the version in it; from now on one is a surprise.

        Raises
        ------
        DeviceTimeout
            Nothing answers.
        DeviceError
            Something else than GRBL or grblHAL 1.1.
        """
        if not self._banners:
            self.reset()
        if not is_supported(self.version):
            raise DeviceError(f"{self.port} answers {self.version!r}, expected GRBL or grblHAL 1.1")
        self._banner_wanted = False
        self.alarm, self.is_deaf = None, False  # from before us; the state says what still holds

    def know_position(self) -> None:
        """Ask for the status until it tells a machine position.

        A controller that reports work positions (``$10``) sends their offset in every 30th report
        at the latest; one that never does has none.
        """
        for _ in range(REPORTS_TO_OFFSET):
            self.report(fresh=True)
            if self.machine_mm is not None:
                return
        self._offset_mm = (0.0, 0.0, 0.0)
        self.report(fresh=True)

    def exchange(
        self,
        line: str,
        timeout_s: float | None,
        *,
        poll_s: float = POLL_S,
        may_be_lost: bool = False,
    ) -> None:
        """Send one line and wait for its ``ok``.

        Parameters
        ----------
        line : str
            Without line end, at most 79 characters.
        timeout_s : float or None
            Longest wait; None for as long as the position changes.
        poll_s : float
            Status requests while waiting: they show holds and progress.
        may_be_lost : bool
            An idle controller that owes the answer is as good as the answer.

        Raises
        ------
        DeviceRefused
            ``error:N``, in words.
        DeviceError
            Alarm or reset before the answer came.
        DeviceTimeout, DeviceLost
            No answer; no port.
        """
        if len(line) > MAX_LINE or not line.isascii():
            raise DeviceRefused(
                f"line of {len(line)} characters, expected at most {MAX_LINE} ASCII"
            )
        with self._line_lock:
            if self._resync:
                self.reset()
            if self._refused and self.version.lower().startswith("grblhal"):
                self._send_line("$G", Patience(self.reply_timeout_s), poll_s, False)
            reply = self._send_line(line, Patience(timeout_s), poll_s, may_be_lost)
        # grblHAL refuses all G-code after a refusal, until a $ line that it accepts
        self._refused = reply != "ok"
        if self._refused:
            raise DeviceRefused(f"GRBL refuses {line!r}: {error_text(reply)}")

    def _send_line(self, line: str, patience: Patience, poll_s: float, may_be_lost: bool) -> str:
        with self._cv:
            self._replies.clear()
            started = self._break
        self.write(line.encode("ascii") + b"\n")
        pushed_at: Triple | None = None
        while not self._wait(lambda: bool(self._replies) or self._break != started, poll_s):
            patience.spend(self.state_word, self.machine_mm)
            if may_be_lost and patience.idle_s > IDLE_WITHOUT_REPLY_S:
                if pushed_at == self.machine_mm:
                    self._resync = True
                    return "ok"
                # grbl-sim on a busy machine runs out of steps: idle, with the rest still planned
                pushed_at, patience.idle_s = self.machine_mm, 0.0
                self.write(RESUME)
            if patience.is_over:
                self._resync = True
                raise DeviceTimeout(f"no answer to {line!r} {patience.text}")
            self._ask_in_turn()
        with self._cv:
            self.require_unbroken(started, f"{line!r} was done")
            return self._replies[0]

    @property
    def state_word(self) -> str:
        """State in the last report; empty before the first."""
        return self._report.state if self._report is not None else ""

    def reset(self) -> None:
        """0x18 and the banner. Keeps the position where nothing moves.

        GRBL drops a reset that comes while it still writes its alarm message, so it is repeated.

        Raises
        ------
        DeviceTimeout
            No banner.
        """
        seen = self._banners
        self._banner_wanted = True
        with self._cv:
            self._break += 1  # a line cut short by the reset is answered "ok": not to be believed
            self._cv.notify_all()
        try:
            for attempt in range(RESET_ATTEMPTS):
                self.write(RESET)
                if self._asking(lambda: self._banners > seen, self.reply_timeout_s / 3):
                    self._await_late_banners(seen, attempt)
                    break
            else:
                raise DeviceTimeout(f"no GRBL banner from {self.port} after a reset")
        finally:
            self._banner_wanted = False
        self._resync = False

    def _await_late_banners(self, seen: int, repeats: int) -> None:
        """Each reset may have been heard: a banner that is still to come is no power cycle."""
        if repeats:
            self._asking(lambda: self._banners > seen + repeats, 0.3 * repeats)
            self._late_banners_until = time.monotonic() + self.reply_timeout_s

    def report(self, *, fresh: bool = False) -> Report:
        """Latest status report, asked for where the last is older than the polling interval.

        Raises
        ------
        DeviceTimeout, DeviceLost
            No answer; no port.
        """
        with self._query_lock:
            report = self._report
            if report is not None and not fresh and time.monotonic() - self._report_time < POLL_S:
                return report
            self._wait(lambda: not self._asked_ns, NUDGE_S)
            seen = self._reports
            self.write(STATUS)
            answered = self._asking(lambda: self._reports > seen, self.reply_timeout_s)
            if not answered or self._report is None:
                raise DeviceTimeout(f"no status from {self.port} within {self.reply_timeout_s:g} s")
            return self._report

    def distrust(self) -> None:
        """Begin the next line with a reset: what the controller says does not fit together."""
        self._resync = True

    def expire_report(self) -> None:
        """The report at hand is from before a command: the next caller gets a new one."""
        self._report_time = -math.inf

    @property
    def breaks(self) -> int:
        """How many alarms and resets there have been."""
        return self._break

    def require_unbroken(self, breaks: int, what: str) -> None:
        """DeviceError where there was an alarm or a reset since ``breaks`` was read.

        Parameters
        ----------
        breaks : int
            `breaks` as it was when the motion began.
        what : str
            What was expected before an alarm, for the message.
        """
        if self._break != breaks:
            raise DeviceError(self.alarm or f"the controller was stopped before {what}")

    def wait_state(self, wanted: Callable[[Report], bool], what: str) -> None:
        """Ask for the status until it is as wanted.

        Parameters
        ----------
        wanted : callable
            Takes a `Report` and tells whether the wait is over.
        what : str
            The state in words, for the message.

        Raises
        ------
        DeviceTimeout
            Not so within 5 s, however long the stage went on moving before.
        DeviceError
            An alarm came instead.
        """
        patience = Patience(None)
        while not wanted(report := self.report(fresh=True)):
            patience.spend("", self.machine_mm)
            if patience.is_over:
                raise DeviceTimeout(f"stage not {what} {patience.text}, state {report.state}")
            if self.alarm is not None or report.state == "Alarm":
                raise DeviceError(self.alarm or UNTOLD_ALARM)
            time.sleep(POLL_S)
