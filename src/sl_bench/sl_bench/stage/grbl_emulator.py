"""A GRBL stage on a pseudo-terminal: the real driver opens it as it would a USB cable.

``position_m()`` is where the carriage really stands; the bench's world reads it. Faults happen
on request. Knows the firmware model and the terminal, no driver and no ROS.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from sl_bench.stage.grbl_firmware import STAGE_SETTINGS, GrblFirmware
from sl_bench.stage.grbl_motion import Triple
from sl_bench.stage.pty_port import PtyPort

#: Places of the carriage that are remembered; in motion one every 2 ms.
REMEMBERED = 2000


def _between(a: Triple, b: Triple, part: float) -> Triple:
    x, y, z = (p + min(max(part, 0.0), 1.0) * (q - p) for p, q in zip(a, b, strict=True))
    return x, y, z


class GrblEmulator:
    """The stage of the bench.

    Parameters
    ----------
    settings : dict, optional
        GRBL settings (``$n``) that differ from ``STAGE_SETTINGS``: 50 x 50 x 20 mm, homing, soft
        and hard limits on.
    homed : bool
        Start homed and idle; otherwise locked, as after power-up.
    start_m : tuple of float
        Where the carriage stands at the start, stage metres.
    origin_mm : tuple of float, optional
        MPos at stage zero, as the driver has it; by default the middle of the travel.
    signs : tuple of int
        Direction of the stage's axes in machine coordinates, as the driver has them.
    clock : callable
        Seconds, increasing. A faster clock makes a faster stage.
    seed : int
        Of the serial noise.
    """

    def __init__(
        self,
        settings: dict[int, float] | None = None,
        *,
        homed: bool = False,
        start_m: Triple = (0.0, 0.0, 0.0),
        origin_mm: Triple | None = None,
        signs: tuple[int, int, int] = (1, 1, 1),
        clock: Callable[[], float] = time.monotonic,
        seed: int = 0,
    ) -> None:
        travel = [(STAGE_SETTINGS | (settings or {}))[130 + i] for i in range(3)]
        self._origin_mm = origin_mm or (-travel[0] / 2, -travel[1] / 2, -travel[2] / 2)
        self._signs, self._clock = signs, clock
        self._lock = threading.Lock()
        x, y, z = (o + s * p * 1e3 for o, s, p in zip(self._origin_mm, signs, start_m, strict=True))
        self.firmware = GrblFirmware(settings, carriage_mm=(x, y, z), homed=homed, now=clock())
        self._port = PtyPort(self._exchange, seed)
        self._track: deque[tuple[int, Triple]] = deque(maxlen=REMEMBERED)
        self._late: list[tuple[float, bytes]] = []
        self._lose_replies = 0
        self._delay_replies = 0
        self._delay_s = 0.0
        self._silent = False

    # -- life ---------------------------------------------------------------------------------

    def start(self) -> GrblEmulator:
        """Open the terminal and run; from now on ``port`` can be opened."""
        self._port.start()
        return self

    def close(self) -> None:
        """Stop, and remove the links."""
        self._port.close()

    def __enter__(self) -> GrblEmulator:
        return self.start()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def port(self) -> str:
        """The terminal's path."""
        return self._port.name

    def link(self, path: str | Path) -> None:
        """Keep a symbolic link to the terminal, whatever the terminal is called."""
        self._port.link(path)

    def position_m(self) -> Triple:
        """Where the carriage stands now, stage metres; thread-safe."""
        with self._lock:
            place = self.firmware.carriage_mm(self._clock())
        x, y, z = (
            s * (p - o) * 1e-3 for s, p, o in zip(self._signs, place, self._origin_mm, strict=True)
        )
        return x, y, z

    def position_at(self, time_ns: int) -> Triple:
        """Where the carriage stood at a time of the host's clock, stage metres; thread-safe.

        Of times that are longer past than it remembers it tells the oldest place, of times to
        come the present one.
        """
        now_ns, now_m = time.time_ns(), self.position_m()
        after_ns, after_m = now_ns, now_m
        for before_ns, before_m in reversed(list(self._track)):
            if before_ns <= time_ns:
                part = (time_ns - before_ns) / max(after_ns - before_ns, 1)
                return _between(before_m, after_m, part)
            after_ns, after_m = before_ns, before_m
        return now_m if time_ns >= now_ns else after_m

    def _remember(self) -> None:
        """Note where the carriage stands; where it rests, only since when and until when."""
        place, time_ns = self.position_m(), time.time_ns()
        if len(self._track) > 1 and self._track[-1][1] == self._track[-2][1] == place:
            self._track.pop()
        self._track.append((time_ns, place))

    # -- faults on request ------------------------------------------------------------------------

    def noise(self, count: int = 8) -> None:
        """Random bytes in front of the next answer."""
        self._port.noise(count)

    def lose_replies(self, count: int = 1) -> None:
        """The next so many ``ok`` and ``error`` lines never arrive."""
        self._lose_replies = count

    def delay_replies(self, count: int, delay_s: float) -> None:
        """The next so many ``ok`` and ``error`` lines arrive late (real seconds)."""
        self._delay_replies, self._delay_s = count, delay_s

    def fall_silent(self, silent: bool = True) -> None:
        """The controller hangs: it takes everything and answers nothing."""
        self._silent = silent

    def alarm(self, code: int) -> None:
        """Raise an alarm now; motion stops dead."""
        with self._lock:
            self.firmware.advance(self._clock())
            self.firmware.alarm(code)

    def close_switch(self, axis: int) -> None:
        """A limit switch (0 x, 1 y, 2 z) closes: alarm 1."""
        with self._lock:
            self.firmware.advance(self._clock())
            self.firmware.close_switch(axis)

    def open_switches(self) -> None:
        """All limit switches open again."""
        with self._lock:
            self.firmware.axes.closed_switches.clear()

    def remove_switches(self, *axes: int) -> None:
        """Home switches that never close: homing ends in alarm 9."""
        with self._lock:
            self.firmware.axes.dead_switches = frozenset(axes)

    def jam(self, stuck: bool = True) -> None:
        """Lines are answered ``ok`` but nothing moves, and the counter shows it."""
        with self._lock:
            self.firmware.axes.stuck = stuck

    def lose_steps(self, share: float) -> None:
        """The carriage falls short of every move by this share; the controller cannot know."""
        with self._lock:
            self.firmware.axes.lost_step_share = share

    def power_cycle(self) -> None:
        """Power gone and back: banner, lock, position forgotten; the carriage stays."""
        with self._lock:
            self.firmware.advance(self._clock())
            self.firmware.power_cycle()

    def disconnect(self) -> None:
        """Pull the cable; the stage stays powered."""
        self._port.unplug()

    def reconnect(self) -> None:
        """Plug the cable in again; ``port`` has changed, links lead to the new one."""
        self._port.plug()

    # -- the wire -----------------------------------------------------------------------------

    def _exchange(self, received: bytes) -> bytes:
        self._remember()
        with self._lock:
            now = self._clock()
            if received and not self._silent:
                self.firmware.receive(received, now)
            else:
                self.firmware.advance(now)
            sent = self.firmware.take_output()
        if self._silent:
            return b""
        return self._due() + (self._faulted(sent) if sent else b"")

    def _due(self) -> bytes:
        """Late replies whose time has come."""
        now = time.monotonic()
        due = b"".join(data for when, data in self._late if when <= now)
        self._late = [(when, data) for when, data in self._late if when > now]
        return due

    def _faulted(self, sent: bytes) -> bytes:
        lines = sent.splitlines(keepends=True)
        return b"".join(line for line in lines if self._passes(line))

    def _passes(self, line: bytes) -> bool:
        if not line.startswith((b"ok", b"error")):
            return True
        if self._lose_replies:
            self._lose_replies -= 1
            return False
        if self._delay_replies:
            self._delay_replies -= 1
            self._late.append((time.monotonic() + self._delay_s, line))
            return False
        return True
