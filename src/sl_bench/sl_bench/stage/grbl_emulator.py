"""A GRBL stage on a pseudo-terminal: the real driver opens it like a USB cable.

``position_m()`` is where the carriage really stands; the bench's world reads it. Faults happen
on request.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from sl_bench.stage.grbl_firmware import GrblFirmware
from sl_bench.stage.grbl_motion import Triple
from sl_bench.stage.serial_emulator import SerialEmulator

#: Positions of the carriage that are remembered; in motion one every 2 ms.
REMEMBERED = 2000


def _between(a: Triple, b: Triple, part: float) -> Triple:
    x, y, z = (p + min(max(part, 0.0), 1.0) * (q - p) for p, q in zip(a, b, strict=True))
    return x, y, z


class GrblEmulator(SerialEmulator):
    """The stage of the bench; its zero is the middle of the travel.

    Parameters
    ----------
    settings : dict, optional
        GRBL settings (``$n``) that differ from `grbl_firmware.STAGE_SETTINGS`: 50 x 50 x 20 mm,
        homing, soft and hard limits on.
    homed : bool
        Start homed and idle; otherwise locked, as after power-up.
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
        clock: Callable[[], float] = time.monotonic,
        seed: int = 0,
    ) -> None:
        super().__init__(seed)
        self._clock = clock
        self._lock = threading.Lock()
        self.firmware = GrblFirmware(settings, homed=homed, now=clock())
        self._origin_mm = self.firmware.axes.carriage
        self._track: deque[tuple[int, Triple]] = deque(maxlen=REMEMBERED)
        self._late: list[tuple[float, bytes]] = []
        self._replies_to_delay, self._delay_s = 0, 0.0
        self._silent = False

    def position_m(self) -> Triple:
        """Where the carriage stands now, stage metres; thread-safe."""
        with self._lock:
            place = self.firmware.carriage_mm(self._clock())
        x, y, z = ((p - o) * 1e-3 for p, o in zip(place, self._origin_mm, strict=True))
        return x, y, z

    def position_at(self, time_ns: int) -> Triple:
        """Where the carriage stood at a time of the host's clock, stage metres; thread-safe.

        Before the remembered time it is the oldest position, in the future the present one.
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
        """Note where the carriage stands; at rest, only since when and until when."""
        place, time_ns = self.position_m(), time.time_ns()
        if len(self._track) > 1 and self._track[-1][1] == self._track[-2][1] == place:
            self._track.pop()
        self._track.append((time_ns, place))

    # -- faults on request --------------------------------------------------------------------

    def delay_replies(self, count: int, delay_s: float) -> None:
        """Let the next ``ok`` and ``error`` lines arrive late.

        Parameters
        ----------
        count : int
            Lines that are late.
        delay_s : float
            Real seconds, whatever the clock says.
        """
        self._replies_to_delay, self._delay_s = count, delay_s

    def fall_silent(self, silent: bool = True) -> None:
        """Hang: the controller takes everything and answers nothing."""
        self._silent = silent

    def alarm(self, code: int) -> None:
        """Raise an alarm now; motion stops dead."""
        with self._lock:
            self.firmware.advance(self._clock())
            self.firmware.alarm(code)

    def close_switch(self, axis: int) -> None:
        """Close a limit switch (0 x, 1 y, 2 z): alarm 1."""
        with self._lock:
            self.firmware.advance(self._clock())
            self.firmware.close_switch(axis)

    def open_switches(self) -> None:
        """Open all limit switches again."""
        with self._lock:
            self.firmware.axes.closed_switches.clear()

    def remove_switches(self, *axes: int) -> None:
        """Let these home switches never close: homing ends in alarm 9."""
        with self._lock:
            self.firmware.axes.dead_switches = frozenset(axes)

    def jam(self, stuck: bool = True) -> None:
        """Answer lines with ``ok`` but move nothing; the counter shows it."""
        with self._lock:
            self.firmware.axes.stuck = stuck

    def lose_steps(self, share: float) -> None:
        """Let the carriage fall short of every move by this share; the controller cannot know."""
        with self._lock:
            self.firmware.axes.lost_step_share = share

    def power_cycle(self) -> None:
        """Switch off and on: banner, lock, position forgotten; the carriage stays."""
        with self._lock:
            self.firmware.advance(self._clock())
            self.firmware.power_cycle()

    # -- the wire -----------------------------------------------------------------------------

    def _exchange(self, received: bytes) -> bytes:
        self._remember()
        with self._lock:
            now = self._clock()
            if received and not self._silent:
                self.firmware.receive(received, now)
            else:
                self.firmware.advance(now)
            lines = self.firmware.take_output().splitlines(keepends=True)
        if self._silent:
            return b""
        return self._due() + b"".join(line for line in lines if self._passes(line))

    def _due(self) -> bytes:
        """Late replies whose time has come."""
        now = time.monotonic()
        due = b"".join(data for when, data in self._late if when <= now)
        self._late = [(when, data) for when, data in self._late if when > now]
        return due

    def _passes(self, line: bytes) -> bool:
        """Whether a line is sent at once: only ``ok`` and ``error`` get lost or late."""
        if not line.startswith((b"ok", b"error")):
            return True
        if self._loses_reply():
            return False
        if self._replies_to_delay:
            self._replies_to_delay -= 1
            self._late.append((time.monotonic() + self._delay_s, line))
            return False
        return True
