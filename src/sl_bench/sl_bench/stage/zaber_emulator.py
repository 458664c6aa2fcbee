"""Three Zaber devices in a daisy chain on a pseudo-terminal.

Written from the protocol's description (``hardware.md`` section 4.3); shares no code with the
driver. Faults happen on request.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable

from sl_bench.stage.grbl_motion import Braking, Ramp, Triple
from sl_bench.stage.serial_emulator import SerialEmulator

MICROSTEP_M = 0.047625e-6
_COMMAND = re.compile(r"/(\d*) ?(\d?) ?(\d\d)? ?([a-z][^:]*)?(?::([0-9A-F]{2}))?")


class ZaberDevice:
    """One axis of a device; positions in microsteps.

    Parameters
    ----------
    address, axis : int
        The device's place in the chain, and which of its axes this is.
    limit_max, position : int
        Reach, from 0 on, and where the carriage stands at the start.
    referenced : bool
        Whether the axis knows its position.
    """

    def __init__(
        self, address: int, axis: int, limit_max: int, position: int, referenced: bool
    ) -> None:
        self.address, self.axis, self.limit_max = address, axis, limit_max
        self.carriage = float(position)
        self.offset = 0.0 if referenced else self.carriage  # it believes carriage - offset
        self.flags = set() if referenced else {"WR"}
        self.stuck_flags: set[str] = set()  # come back however often they are cleared
        self.speed, self.acceleration = 500_000.0, 5_000_000.0
        self._ramp: Ramp | Braking | None = None
        self._since = self._start = self._direction = 0.0
        self._homing = False

    @property
    def busy(self) -> bool:
        """Whether it moves."""
        return self._ramp is not None

    @property
    def position(self) -> int:
        """Where it believes that it stands."""
        return round(self.carriage - self.offset)

    def flag(self) -> str:
        """The most important flag: faults before warnings before notes."""
        flags = self.flags | self.stuck_flags
        return min(flags, key=lambda name: ("FWN".index(name[0]), name)) if flags else "--"

    def advance(self, now: float) -> None:
        """Let the axis move until ``now``."""
        if self._ramp is None:
            return
        travelled, _ = self._ramp.at(now - self._since)
        self.carriage = self._start + self._direction * travelled
        if now - self._since >= self._ramp.duration:
            self._ramp = None
            if self._homing:
                self._homing, self.offset = False, 0.0
                self.flags -= {"WR", "WH"}

    def go(self, target: float, now: float, *, homing: bool = False) -> None:
        """Start a motion of the carriage.

        Parameters
        ----------
        target : float
            Where to, microsteps.
        now : float
            Time, seconds.
        homing : bool
            The axis knows its position afterwards.
        """
        self._start, self._since, self._homing = self.carriage, now, homing
        self._direction = 1.0 if target >= self.carriage else -1.0
        self._ramp = Ramp(abs(target - self.carriage), self.speed, self.acceleration)
        self.flags.discard("NI")

    def stop(self, now: float, *, dead: bool = False) -> None:
        """Stop.

        Parameters
        ----------
        now : float
            Time, seconds.
        dead : bool
            At once; otherwise decelerate.
        """
        self.advance(now)
        if self._ramp is None:
            return
        self.flags.add("NI")
        self._homing = False
        _, speed = self._ramp.at(now - self._since)
        self._start, self._since = self.carriage, now
        self._ramp = None if dead or speed == 0.0 else Braking(speed, self.acceleration)

    def obey(self, data: str, now: float) -> tuple[bool, str]:
        """Carry out a command; whether it is accepted, and the answer.

        Parameters
        ----------
        data : str
            The command without address and number.
        now : float
            Time, seconds.
        """
        self.advance(now)
        verb, _, rest = data.partition(" ")
        if verb == "get":
            values = {"pos": self.position, "limit.min": 0, "limit.max": self.limit_max}
            values |= {"system.serial": 10_000 + self.address, "resolution": 64}
            return (True, str(values[rest])) if rest in values else (False, "BADCOMMAND")
        if data == "stop":
            self.stop(now)
        elif data in ("warnings clear", "driver enable"):
            self.flags = {flag for flag in self.flags if flag.startswith("W")}
        elif data in ("", "estop"):
            if data:
                self.stop(now, dead=True)
        elif any(flag.startswith("F") for flag in self.flags | self.stuck_flags):
            return False, "DRIVERDISABLED"
        elif data == "home":
            self.go(0.0, now, homing=True)
        elif verb == "move":
            return self._move(rest, now)
        elif re.fullmatch(r"set pos \d+", data):
            self.offset = self.carriage - int(data.split()[-1])
            self.flags -= {"WR", "WH"}
        else:
            return False, "BADCOMMAND"
        return True, "0"

    def _move(self, data: str, now: float) -> tuple[bool, str]:
        kind, _, value = data.partition(" ")
        if kind not in ("abs", "rel"):
            return False, "BADCOMMAND"
        if not re.fullmatch(r"-?\d+", value):
            return False, "BADDATA"
        target = int(value) + (self.position if kind == "rel" else 0)
        if "WR" in self.flags or not 0 <= target <= self.limit_max:
            return False, "BADDATA"
        self.go(target + self.offset, now)
        return True, "0"


class ZaberEmulator(SerialEmulator):
    """The chain on its cable; addresses 1, 2, 3 are x, y, z, or the axes of one controller.

    Parameters
    ----------
    travel_m : tuple of float
        Reach of the axes; the stage's zero is their middle.
    homed : bool
        Start referenced.
    one_controller : bool
        One device of three axes instead of three devices.
    clock : callable
        Seconds, increasing. A faster clock makes a faster stage.
    seed : int
        Of the serial noise.
    """

    def __init__(
        self,
        *,
        travel_m: Triple = (0.05, 0.05, 0.02),
        homed: bool = False,
        one_controller: bool = False,
        clock: Callable[[], float] = time.monotonic,
        seed: int = 0,
    ) -> None:
        super().__init__(seed)
        self._clock = clock
        limits = [round(travel / MICROSTEP_M) for travel in travel_m]
        self.devices = [
            ZaberDevice(*((1, i) if one_controller else (i, 1)), limit, limit // 2, homed)
            for i, limit in enumerate(limits, 1)
        ]
        self._lock = threading.Lock()
        self._pending = b""

    def position_m(self) -> Triple:
        """Where the carriages stand now, stage metres; thread-safe."""
        with self._lock:
            for device in self.devices:
                device.advance(self._clock())
            x, y, z = (
                (device.carriage - device.limit_max // 2) * MICROSTEP_M for device in self.devices
            )
        return x, y, z

    # -- faults on request ------------------------------------------------------------------------

    def fault(self, axis: int, flag: str = "FS", *, stays: bool = False) -> None:
        """Stop an axis dead with a fault; the others go on.

        Parameters
        ----------
        axis : {0, 1, 2}
            x, y, z.
        flag : str
            Two letters, as in replies.
        stays : bool
            The flag comes back however often it is cleared, until `release`.
        """
        with self._lock:
            device = self.devices[axis]
            device.stop(self._clock(), dead=True)
            (device.stuck_flags if stays else device.flags).add(flag)

    def release(self) -> None:
        """Remove the causes of lasting faults."""
        with self._lock:
            for device in self.devices:
                device.stuck_flags.clear()

    def power_cycle(self) -> None:
        """Let all devices forget where they are; no banner says so."""
        with self._lock:
            for device in self.devices:
                device.stop(self._clock(), dead=True)
                device.flags, device.offset = {"WR"}, device.carriage

    # -- the wire -----------------------------------------------------------------------------

    def _exchange(self, received: bytes) -> bytes:
        with self._lock:
            now = self._clock()
            for device in self.devices:
                device.advance(now)
            *lines, self._pending = (self._pending + received).split(b"\n")
            return b"".join(self._answer(line.decode("latin-1").strip(), now) for line in lines)

    def _answer(self, line: str, now: float) -> bytes:
        match = _COMMAND.fullmatch(line)
        if match is None:
            return b""
        address, axis, number, data, lrc = match.groups()
        if lrc is not None and (sum(line[1:-3].encode()) + int(lrc, 16)) % 256:
            return b""  # a damaged command is for nobody
        called = [d for d in self.devices if int(address or 0) in (0, d.address)]
        # A controller speaks once: as the axis that is called, else as its first.
        speakers = {d.address: d for d in reversed(called)}
        speakers |= {d.address: d for d in called if d.axis == int(axis or 0)}
        return b"".join(
            self._reply(d, int(axis or 0), number, (data or "").strip(), lrc is not None, now)
            for d in speakers.values()
        )

    def _reply(
        self, device: ZaberDevice, axis: int, number: str | None, data: str, lrc: bool, now: float
    ) -> bytes:
        accepted, answer = (
            device.obey(data, now) if axis in (0, device.axis) else (False, "BADAXIS")
        )
        words = [f"{device.address:02d}", str(axis), *([number] if number else [])]
        words += ["OK" if accepted else "RJ", "BUSY" if device.busy else "IDLE", device.flag()]
        text = " ".join([*words, answer])
        if self._loses_reply():
            return b""
        return f"@{text}{f':{-sum(text.encode()) & 0xFF:02X}' if lrc else ''}\r\n".encode()
