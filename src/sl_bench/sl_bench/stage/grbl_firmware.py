"""GRBL 1.1h as a machine without a port: bytes and a clock in, bytes and a position out.

Behaviour after gnea/grbl 1.1h (``interface.md``, ``commands.md``, ``jogging.md``, and what its
source does where the documents are silent).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from sl_bench.stage.grbl_axes import GrblAxes
from sl_bench.stage.grbl_gcode import GcodeCommand, GrblError, Modes, clean, parse
from sl_bench.stage.grbl_motion import Block, Triple

VERSION = "1.1h"
RX_BYTES = 128
LINE_CHARS = 79
PLANNER_BLOCKS = 15

STAGE_SETTINGS: dict[int, float] = {
    **{0: 10, 1: 255, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 1, 11: 0.01, 12: 0.002, 13: 0},
    **{20: 1, 21: 1, 22: 1, 23: 0, 24: 120.0, 25: 900.0, 26: 25, 27: 1.0, 30: 1000, 31: 0, 32: 0},
    **{100: 1000.0, 101: 1000.0, 102: 1000.0, 110: 1500.0, 111: 1500.0, 112: 900.0},
    **{120: 250.0, 121: 250.0, 122: 200.0, 130: 50.0, 131: 50.0, 132: 20.0},
}
"""A stage of 50 x 50 x 20 mm, 1 um steps; 1 mm in z takes 0.15 s."""

_WHOLE = frozenset({0, 1, 2, 3, 4, 5, 6, 10, 13, 20, 21, 22, 23, 26, 30, 31, 32})


class GrblFirmware:
    """The controller and the axes that it drives.

    Parameters
    ----------
    settings : dict, optional
        ``$n`` values that differ from ``STAGE_SETTINGS``.
    homed : bool
        Start as after homing, idle; otherwise as after power-up. The axes stand in the middle of
        their travel either way.
    now : float
        Time of the start, seconds.
    """

    def __init__(
        self, settings: dict[int, float] | None = None, *, homed: bool = False, now: float = 0.0
    ) -> None:
        self.settings = STAGE_SETTINGS | (settings or {})
        middle = (-self.settings[130] / 2, -self.settings[131] / 2, -self.settings[132] / 2)
        self.axes = GrblAxes(self.settings, middle, middle if homed else (0.0, 0.0, 0.0), now)
        self._modes = Modes()
        self._out = bytearray()
        #: ``Idle``, ``Run``, ``Hold``, ``Jog``, ``Alarm``, ``Home`` or ``Check``.
        self._state = "Idle"
        self._boot(locked=not homed and bool(self.settings[22]))

    def _boot(self, *, locked: bool) -> None:
        """Come up after power-on or reset, with the banner."""
        self._rx = bytearray()
        self._line = bytearray()
        self._pending: Callable[[], bool] | None = None
        self._critical = self._alarm_when_halted = False
        self._owes_ok = False
        self._status_wanted = False
        self._wco_in = self._ov_in = 0
        self._feed_percent = 100
        self._target = list(self.axes.counter)
        self._modes.reset()
        self._say("", f"Grbl {VERSION} ['$' for help]")
        self._state = "Alarm" if locked else "Idle"
        if locked:
            self._say("[MSG:'$H'|'$X' to unlock]")

    # -- what the world sees ------------------------------------------------------------------

    def carriage_mm(self, now: float) -> Triple:
        """Where the axes really stand at ``now``, mm from the home switches."""
        self.advance(now)
        return self.axes.carriage

    def take_output(self) -> bytes:
        """Bytes for the host since the last call."""
        data = bytes(self._out)
        self._out.clear()
        return data

    def _say(self, *lines: str) -> None:
        for line in lines:
            self._out += line.encode("ascii") + b"\r\n"

    # -- faults -------------------------------------------------------------------------------

    def power_cycle(self) -> None:
        """Switch off and on: the counter starts at zero wherever the carriage is."""
        self.axes.stop_dead()
        self.axes.counter = (0.0, 0.0, 0.0)
        self._modes = Modes()
        self._out.clear()
        self._boot(locked=bool(self.settings[22]))

    def alarm(self, code: int) -> None:
        """Stop dead and raise an alarm; 1 and 2 then wait for a reset."""
        self._stop_dead()
        self._state = "Alarm"
        self._say(f"ALARM:{code}")
        if code in (1, 2):
            self._say("[MSG:Reset to continue]")
            self._critical = True

    def close_switch(self, axis: int) -> None:
        """Close a limit switch, wherever the carriage is; with hard limits on that is alarm 1."""
        self.axes.closed_switches.add(axis)
        if self.settings[21] and self._state not in ("Alarm", "Home") and not self._critical:
            self.alarm(1)

    def _stop_dead(self) -> None:
        self.axes.stop_dead()
        self._target = list(self.axes.counter)

    # -- time ---------------------------------------------------------------------------------

    def advance(self, now: float) -> None:
        """Let time pass until ``now``: motion, reports, lines that can be answered."""
        while self._step_motion(now):
            pass
        if self._status_wanted and not self._critical and self._state != "Home":
            self._status_wanted = False
            self._report_status()
        self._read_lines()

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes of the host: real-time commands act at once, others go to the buffer.

        Parameters
        ----------
        data : bytes
            As received; what does not fit into the buffer is lost.
        now : float
            Time, seconds.
        """
        self.advance(now)
        for byte in data:
            if not self._realtime(byte) and len(self._rx) < RX_BYTES:
                self._rx.append(byte)
        self.advance(now)

    # -- motion -------------------------------------------------------------------------------

    def _step_motion(self, now: float) -> bool:
        """Let the axes pass one event; False where they have reached ``now``."""
        event = self.axes.advance(now)
        if event == "limit":
            self.alarm(1)
        elif event == "no switch":
            self.alarm(9)
            self._reset()  # a failed cycle resets the controller by itself
        elif event == "homed":
            self._target = list(self.axes.counter)
            self._state = "Idle"
        elif event == "braked" and self._alarm_when_halted:
            self.alarm(2)
        elif event == "braked" and self._state == "Jog":
            self._stop_dead()
            self._state = "Idle"
        return self._start_block() or bool(event)

    def _start_block(self) -> bool:
        if self._state not in ("Idle", "Run", "Jog") or self.axes.is_moving:
            return False
        if self.axes.start_block(self._feed_percent / 100.0):
            self._state = "Jog" if self.axes.planner[0].is_jog else "Run"
            return True
        self._state = "Idle"
        return False

    # -- real-time commands ---------------------------------------------------------------------

    def _realtime(self, byte: int) -> bool:
        """Act on a real-time byte; False for one that belongs to a line."""
        actions: dict[int, Callable[[], None]] = {
            0x3F: self._want_status,
            0x21: self._feed_hold,
            0x7E: self._cycle_start,
            0x18: self._reset,
            0x85: self._jog_cancel,
        }
        if byte in actions:
            actions[byte]()
        elif 0x90 <= byte <= 0x94:
            self._override_feed(byte)
        return byte in actions or byte >= 0x80

    def _want_status(self) -> None:
        self._status_wanted = True
        self.advance(self.axes.now)

    def _feed_hold(self) -> None:
        if self._state == "Jog":
            self.axes.brake()
        elif self._state in ("Idle", "Run") and not self._critical:
            self.axes.brake()
            self._state = "Hold"

    def _jog_cancel(self) -> None:
        if self._state == "Jog":
            self.axes.brake()

    def _cycle_start(self) -> None:
        if self._state == "Hold" and not self.axes.is_moving:
            self._state = "Idle"

    def _override_feed(self, byte: int) -> None:
        change = (100 - self._feed_percent, 10, -10, 1, -1)[byte - 0x90]
        self._feed_percent = min(max(self._feed_percent + change, 10), 200)
        self._ov_in = 0

    def _reset(self) -> None:
        """0x18. In motion it costs the position; a line that waited is answered on the way out."""
        if self.axes.is_homing:
            self.alarm(6)
        elif self.axes.is_moving:
            self.alarm(3)
        if self._owes_ok:
            self._say("ok")
        self._stop_dead()
        self._boot(locked=self._state == "Alarm")

    # -- reports ------------------------------------------------------------------------------

    def _report_status(self) -> None:
        busy = self._state in ("Run", "Jog", "Hold", "Home")
        state = self._state
        if state == "Hold":
            state = "Hold:0" if not self.axes.is_moving else "Hold:1"
        machine = self.axes.on_steps(self.axes.counter)
        offset = self._modes.work_offset()
        in_work = not int(self.settings[10]) & 1
        shown = [m - o for m, o in zip(machine, offset, strict=True)] if in_work else list(machine)
        fields = [state, f"{'W' if in_work else 'M'}Pos:{self._numbers(shown)}"]
        if int(self.settings[10]) & 2:
            fields.append(
                f"Bf:{PLANNER_BLOCKS - len(self.axes.planner)},{RX_BYTES - len(self._rx)}"
            )
        fields.append(f"FS:{self.axes.speed_mm_s() * 60.0:.0f},0")
        pins = "".join(axis for i, axis in enumerate("XYZ") if self.axes.shows_pin(i))
        fields += [f"Pn:{pins}"] if pins else []
        self._say("<" + "|".join(fields + list(self._slow_fields(busy, offset))) + ">")

    def _slow_fields(self, busy: bool, offset: list[float]) -> Iterator[str]:
        """WCO at first and every 10 (30 when busy) reports, Ov one later, every 10 (20)."""
        if self._wco_in > 0:
            self._wco_in -= 1
        else:
            self._wco_in = 29 if busy else 9
            self._ov_in = self._ov_in or 1
            yield f"WCO:{self._numbers(offset)}"
        if self._ov_in > 0:
            self._ov_in -= 1
        else:
            self._ov_in = 19 if busy else 9
            yield f"Ov:{self._feed_percent},100,100"

    def _numbers(self, values: list[float]) -> str:
        if self.settings[13]:
            return ",".join(f"{value / 25.4:.4f}" for value in values)
        return ",".join(f"{value + 0.0:.3f}" for value in values)

    # -- lines --------------------------------------------------------------------------------

    def _read_lines(self) -> None:
        """Take lines from the buffer until something holds the reader up."""
        while not self._critical and self._state not in ("Hold", "Home"):
            if self._pending is not None:
                if not self._pending():
                    return
                self._pending = None
            if self._owes_ok:
                self._owes_ok = False
                self._say("ok")
            if not self._rx:
                return
            self._take_byte(self._rx.pop(0))

    def _take_byte(self, byte: int) -> None:
        if byte not in (0x0A, 0x0D):
            self._line.append(byte)
            return
        line = clean(self._line.decode("latin-1"))
        self._line.clear()
        self._owes_ok = True
        try:
            if len(line) > LINE_CHARS:
                raise GrblError(11)
            self._obey(line)
        except GrblError as error:
            self._owes_ok = False
            self._say(f"error:{error.code}")

    def _obey(self, line: str) -> None:
        if not line:
            return
        if line.startswith("$"):
            self._system(line)
        elif self._state in ("Alarm", "Jog"):
            raise GrblError(9)
        else:
            self._execute(parse(line, self._modes, self._target), is_jog=False)

    def _execute(self, command: GcodeCommand, *, is_jog: bool) -> None:
        if command.dwell_s is not None:
            self._dwell(command.dwell_s)
        elif command.target is not None:
            self._line_to(command.target, command.feed, is_jog=is_jog)

    def _dwell(self, seconds: float) -> None:
        """``G4`` waits for the planner to run empty, then for its own time."""
        over: list[float] = []

        def waited() -> bool:
            if self.axes.planner:
                return False
            if not over:
                over.append(self.axes.now + seconds)
            return self.axes.now >= over[0]

        self._pending = waited

    def _line_to(self, target: list[float], feed: float, *, is_jog: bool) -> None:
        if self._outside(target):
            if is_jog:
                raise GrblError(15)
            self._soft_limit()
            return
        if self._state == "Check":
            self._target = target
            return
        start, goal = self.axes.on_steps(self._target), self.axes.on_steps(target)
        if goal != start:
            self.axes.planner.append(Block(start, goal, feed / 60.0 if feed else math.inf, is_jog))
            self._target = target
            self._pending = lambda: len(self.axes.planner) <= PLANNER_BLOCKS
            self._step_motion(self.axes.now)

    def _outside(self, target: list[float]) -> bool:
        return bool(self.settings[20]) and any(
            not -self.settings[130 + i] - 1e-9 <= value <= 1e-9 for i, value in enumerate(target)
        )

    def _soft_limit(self) -> None:
        """Halt smoothly first, so that the position is kept; then alarm 2."""
        if self.axes.is_moving:
            self.axes.brake()
            self._state, self._alarm_when_halted = "Hold", True
        else:
            self.alarm(2)

    # -- system commands ------------------------------------------------------------------------

    def _system(self, line: str) -> None:
        if line.startswith("$J="):
            self._jog(line[3:])
        elif line.startswith("$J"):
            raise GrblError(16)
        elif line in ("$$", "$G", "$", "$C", "$X"):
            self._query(line)
        elif self._state not in ("Idle", "Alarm"):
            raise GrblError(8)
        elif line == "$H":
            self._home()
        else:
            self._write_setting(line)

    def _jog(self, line: str) -> None:
        if self._state not in ("Idle", "Jog"):
            raise GrblError(8)
        self._execute(parse(line, self._modes, self._target, jog=True), is_jog=True)

    def _query(self, line: str) -> None:
        if line == "$":
            self._say("[HLP:$$ $G $x=val $J=line $C $X $H ~ ! ? ctrl-x]")
        elif line == "$X":
            if self._state == "Alarm":
                self._say("[MSG:Caution: Unlocked]")
                self._state = "Idle"
        elif line == "$G":
            m = self._modes
            self._say(
                f"[GC:{m.motion} {m.coordinates} G17 {m.units} {m.distance} G94 M5 M9 T0 "
                f"F{m.feed:g} S0]"
            )
        elif self._state == "Run":
            raise GrblError(8)
        elif line == "$$":
            self._say(*(f"${n}={self._setting_text(n)}" for n in sorted(self.settings)))
        else:
            self._check_mode()

    def _check_mode(self) -> None:
        if self._state == "Check":
            self._say("[MSG:Disabled]")
            self._reset()
        elif self._state == "Idle":
            self._say("[MSG:Enabled]")
            self._state = "Check"
        else:
            raise GrblError(8)

    def _home(self) -> None:
        if not self.settings[22]:
            raise GrblError(5)
        self._state = "Home"
        self.axes.home()

    def _write_setting(self, line: str) -> None:
        name, equals, text = line[1:].partition("=")
        if not equals or not name.isdigit() or int(name) not in self.settings:
            raise GrblError(3)
        try:
            value = float(text)
        except ValueError:
            raise GrblError(2) from None
        number = int(name)
        if value < 0:
            raise GrblError(4)
        if number == 0 and value < 3:
            raise GrblError(6)
        if number == 20 and value and not self.settings[22]:
            raise GrblError(10)
        self.settings[number] = value
        if number == 22 and not value:
            self.settings[20] = 0.0
        self._wco_in = 0

    def _setting_text(self, number: int) -> str:
        value = self.settings[number]
        return f"{value:.0f}" if number in _WHOLE else f"{value:.3f}"
