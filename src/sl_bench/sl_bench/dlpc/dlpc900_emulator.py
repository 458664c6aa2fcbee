"""A DLPC900 at the byte level: reports in, reports out, and mirrors that move by the clock.

Written from TI's programmer's guide (DLPU018J) apart from the driver; only the table of DMD
models is shared. What the guide leaves open is settled leniently, so that foreign host programs
are understood, except where ``strict`` is said.
"""

from __future__ import annotations

import struct
import threading
from collections import OrderedDict
from collections.abc import Callable

import numpy as np

from sl_bench.dlpc.dlpc900_faults import Dlpc900Faults
from sl_bench.dlpc.dlpc900_memory import MAX_FLY_IMAGES, ImageMemory
from sl_bench.dlpc.dlpc900_refusal import (
    BAD_BIT,
    BAD_DARK,
    BAD_DEFINITION,
    BAD_DELAY,
    BAD_EXPOSURE,
    BAD_INDEX,
    INVALID_COMMAND,
    INVALID_PARAMETER,
    NO_ERROR,
    NOT_PRESENT,
    WRONG_MODE,
    Refusal,
)
from sl_bench.dlpc.dlpc900_registers import ACTIVE_BLOCKS, INVERT_DATA, STORED
from sl_bench.dlpc.dlpc900_sequencer import Mirrors, OnExposure, Program, Sequencer, Slot
from sl_common.clock import Clock, SystemClock
from sl_projector.dlpc.dmd import DmdModel, dmd_model

REPORT = 64
BUFFER = 512
NACK = 0x20  # flag of a reply

_MAX_CACHED_PATTERNS = 64
_MODE_PATTERNS = (1, 2, 3)
_ON_THE_FLY = 3
_LAST_PLANE = 23


class Dlpc900Emulator:
    """The controller with its DMD.

    Parameters
    ----------
    model : str or DmdModel
        The DMD.
    clock : Clock, optional
        `SystemClock` for real time, `VirtualClock` for tests that do not sleep.
    on_exposure : callable, optional
        Called on the sequencer's thread at each trigger edge: mirrors (bool, shape (rows,
        columns), read-only), number of the exposure in the run, time of the edge (host clock,
        ns), exposure in seconds. May be set later.
    camera_output : {2, 1}
        The trigger output that the camera is wired to: its rising-edge delay applies.
    strict : bool
        Forget the images when the pattern table's images or count change, and refuse a compressed
        image whose header miscounts its bytes, as the guide says (host programs that do neither
        are in use).
    """

    def __init__(
        self,
        model: str | DmdModel = "DLP5500",
        clock: Clock | None = None,
        on_exposure: OnExposure | None = None,
        *,
        camera_output: int = 2,
        strict: bool = False,
    ) -> None:
        self.model = dmd_model(model) if isinstance(model, str) else model
        self.faults = Dlpc900Faults()
        self.strict = strict
        self._camera_output = camera_output
        dark = np.zeros((self.model.rows, self.model.columns), np.bool_)
        dark.flags.writeable = False
        self._sequencer = Sequencer(clock or SystemClock(), self.faults, dark)
        self._sequencer.on_exposure = on_exposure
        self._lock = threading.RLock()
        self.messages = 0
        self.errors: list[str] = []
        self.power_cycle()

    # -- what the bench sees -------------------------------------------------------------------

    @property
    def on_exposure(self) -> OnExposure | None:
        """Who is told of trigger edges."""
        return self._sequencer.on_exposure

    @on_exposure.setter
    def on_exposure(self, listener: OnExposure | None) -> None:
        self._sequencer.on_exposure = listener

    @property
    def running(self) -> bool:
        """True while a sequence is shown."""
        return self._sequencer.running

    @property
    def start_ns(self) -> list[int]:
        """Start of each exposure of the last run so far, host clock, ns."""
        return list(self._sequencer.start_ns)

    @property
    def mode(self) -> int:
        """Display mode: 3 is pattern on the fly."""
        return self._mode

    def mirrors_now(self) -> Mirrors:
        """Return the mirrors as they stand, shape (rows, columns), True is bright."""
        return self._sequencer.mirrors_now()

    def pattern(self, index: int) -> Mirrors:
        """Return the mirrors of a pattern table entry as it would be shown."""
        return self._mirrors_of(self._table[index])

    def trigger_in(self, edge_ns: int | None = None) -> bool:
        """Raise an edge on TRIG_IN_1; False when no pattern waits for it."""
        return self._sequencer.trigger_in(edge_ns)

    def power_cycle(self) -> None:
        """Forget everything, as when power fails."""
        with self._lock:
            self._sequencer.halt()
            self._sequencer.aborted = False
            self._registers = dict(STORED)
            self._power, self._idle, self._mode = 0, 0, 1
            self._error, self._error_text = NO_ERROR, ""
            self._memory = ImageMemory(self.model, strict=self.strict)
            self._definitions: dict[int, Slot] = {}
            self._table: tuple[Slot, ...] = ()
            self._exposures = 0
            self._paused_at = 0
            self._cache: OrderedDict[tuple[int, int], Mirrors] = OrderedDict()
            self._pending = bytearray()

    # -- reports -------------------------------------------------------------------------------

    def forget_message(self) -> None:
        """Drop a message that is incomplete: the bus was reset."""
        with self._lock:
            self._pending.clear()

    def receive(self, report: bytes) -> list[bytes]:
        """Take one report from the host; return the reply's reports, mostly none or one.

        A report may lack its padding, or have the report id in front (65 bytes), as it is handed
        to HID libraries.
        """
        if len(report) == REPORT + 1 and report[0] == 0:
            report = report[1:]
        with self._lock:
            self._pending += report.ljust(REPORT, b"\0")
            flags, sequence, length = struct.unpack_from("<BBH", self._pending)
            needed = 4 + length
            if not 2 <= length <= BUFFER - 4:
                self._pending.clear()
                self._fail(INVALID_PARAMETER, f"message of {length} bytes")
                return self._reply(flags, sequence, b"", NACK)
            if len(self._pending) < needed:
                return []
            message = bytes(self._pending[:needed])
            self._pending.clear()
            return self._answer(message)

    def _answer(self, message: bytes) -> list[bytes]:
        flags, sequence, _, command = struct.unpack_from("<BBHH", message)
        self.messages += 1
        read = bool(flags & 0x80)
        data, nack = b"", 0
        try:
            data = self._execute(command, message[6:], read)
        except Refusal as refusal:
            nack = NACK
            self._fail(refusal.code, f"0x{command:04X}: {refusal.reason}")
        else:
            if command not in (0x0100, 0x0101):
                self._error, self._error_text = NO_ERROR, ""
        return self._reply(flags, sequence, data, nack)

    def _reply(self, flags: int, sequence: int, data: bytes, nack: int) -> list[bytes]:
        """Reports of a reply; none when the host wants none."""
        if not flags & 0x40:
            return []
        reply = struct.pack("<BBH", flags & 0xC7 | nack, sequence, len(data)) + data
        return [reply[i : i + REPORT].ljust(REPORT, b"\0") for i in range(0, len(reply), REPORT)]

    def _fail(self, code: int, reason: str) -> None:
        self._error, self._error_text = code, reason
        self.errors.append(f"error {code}: {reason}")

    def _execute(self, command: int, data: bytes, read: bool) -> bytes:
        if command not in (0x0100, 0x0101) and self.faults.take("refuse"):
            raise Refusal(self.faults.refuse_code, "refused on request")
        if read:
            return self._read(command)
        self._write(command, data)
        return b""

    # -- reading -------------------------------------------------------------------------------

    def _read(self, command: int) -> bytes:
        if command in self._registers:
            return self._registers[command]
        readers: dict[int, Callable[[], bytes]] = {
            0x0100: lambda: bytes([self._error]),
            0x0101: lambda: self._error_text.encode()[:127].ljust(128, b"\0"),
            0x0200: lambda: bytes([self._power]),
            0x0201: lambda: bytes([self._idle]),
            0x0205: lambda: struct.pack("<HBB", 0, 1, 6) * 4,
            0x0206: lambda: bytes([self.model.hardware_code]) + b"EMULATOR".ljust(32, b"\0"),
            0x1A0A: lambda: bytes([self._hardware_status()]),
            0x1A0B: lambda: b"\x01",
            0x1A0C: lambda: bytes([self._main_status()]),
            0x1A1B: lambda: bytes([self._mode]),
            0x1A31: lambda: struct.pack("<HI", len(self._table), self._exposures),
            0x1A42: lambda: struct.pack("<8H", *self.model.min_exposure_us),
        }
        if command not in readers:
            raise Refusal(INVALID_COMMAND)
        return readers[command]()

    def _hardware_status(self) -> int:
        return 1 | self.model.dual << 4 | self._sequencer.aborted << 6

    def _main_status(self) -> int:
        return (self._power == 1) | self.running << 1

    # -- writing -------------------------------------------------------------------------------

    def _write(self, command: int, data: bytes) -> None:
        writers: dict[int, tuple[int, Callable[[bytes], None]]] = {
            0x0200: (1, self._set_power),
            0x0201: (1, self._set_idle),
            0x0802: (1, lambda _: self.power_cycle()),
            0x1A1B: (1, self._set_mode),
            0x1A24: (1, self._start_stop),
            0x1A2A: (6, lambda d: self._begin_image(0, d)),
            0x1A2B: (2, lambda d: self._memory.take(0, d)),
            0x1A2C: (6, lambda d: self._begin_image(1, d)),
            0x1A2D: (2, lambda d: self._memory.take(1, d)),
            0x1A31: (6, self._configure),
            0x1A32: (2, self._reorder),
            0x1A34: (12, self._define),
        }
        if command in self._registers:
            self._store(command, data)
        elif command not in writers:
            raise Refusal(INVALID_COMMAND)
        else:
            least, writer = writers[command]
            if len(data) < least:
                raise Refusal(INVALID_PARAMETER, f"{len(data)} data bytes; expected {least}")
            writer(data)

    def _store(self, command: int, data: bytes) -> None:
        size = len(self._registers[command])
        if len(data) < size:
            raise Refusal(INVALID_PARAMETER, f"{len(data)} data bytes; expected {size}")
        if command in (0x1A1D, 0x1A1E):
            inverted, rising, falling = struct.unpack_from("<Bhh", data)
            if not (-20 <= rising <= 20000 and -20 <= falling <= 20000):
                raise Refusal(BAD_DELAY)
            if inverted & 1 and rising < falling:
                raise Refusal(BAD_DELAY, "inverted: rising delay below falling delay")
        if command == 0x1A35 and struct.unpack_from("<H", data)[0] < self.model.block_load_us[-1]:
            raise Refusal(BAD_DELAY)
        if 0x1A1D <= command <= 0x1A36:
            self._refuse_while_running()
        if command in (0x1008, 0x1009, INVERT_DATA):
            self._cache.clear()
        self._registers[command] = data[:size]

    def _refuse_while_running(self) -> None:
        if self.running:
            raise Refusal(WRONG_MODE, "a sequence is running")

    def _set_power(self, data: bytes) -> None:
        if data[0] == 2:
            self.power_cycle()
        elif data[0] > 2:
            raise Refusal(INVALID_PARAMETER)
        else:
            self._sequencer.halt()
            self._power = data[0]

    def _set_idle(self, data: bytes) -> None:
        if data[0] not in (0, 1, 3):
            raise Refusal(INVALID_PARAMETER)
        self._refuse_while_running()
        self._idle = int(data[0] == 1)

    def _set_mode(self, data: bytes) -> None:
        if data[0] > _ON_THE_FLY:
            raise Refusal(INVALID_PARAMETER)
        self._refuse_while_running()
        if data[0] != self._mode:
            self._definitions, self._table, self._paused_at = {}, (), 0
        self._mode = data[0]

    # -- pattern table -------------------------------------------------------------------------

    def _define(self, data: bytes) -> None:
        if self._mode not in _MODE_PATTERNS:
            raise Refusal(WRONG_MODE)
        self._refuse_while_running()
        (index,) = struct.unpack_from("<H", data)
        options = data[5]
        place = data[10] | data[11] << 8
        slot = Slot(
            image=place & 0x7FF,
            bit=place >> 11,
            depth=(options >> 1 & 7) + 1 + 8 * (data[9] >> 1 & 1),
            exposure_us=int.from_bytes(data[2:5], "little"),
            dark_us=int.from_bytes(data[6:9], "little"),
            wait_trigger=bool(options & 0x80),
            trigger_out_2=not data[9] & 1,
        )
        self._check_slot(index, slot)
        self._definitions[index] = slot

    def _check_slot(self, index: int, slot: Slot) -> None:
        if index >= self.model.max_patterns:
            raise Refusal(BAD_INDEX)
        if slot.bit > _LAST_PLANE:
            raise Refusal(BAD_BIT)
        if slot.bit + slot.depth > _LAST_PLANE + 1:
            raise Refusal(BAD_DEFINITION, "bit position and depth leave the image")
        if slot.exposure_us < self._least_exposure_us(slot.depth):
            raise Refusal(BAD_EXPOSURE)
        if 0 < slot.dark_us < self.model.min_dark_us:
            raise Refusal(BAD_DARK)
        if self._mode == _ON_THE_FLY and slot.image >= MAX_FLY_IMAGES:
            raise Refusal(INVALID_PARAMETER, f"image {slot.image} on the fly")

    def _least_exposure_us(self, depth: int) -> int:
        if depth > 1:
            return self.model.min_exposure_us[min(depth, 8) - 1]
        loads_us = self.model.block_load_us
        return loads_us[min(max(self._registers[ACTIVE_BLOCKS][1], 1), len(loads_us)) - 1]

    def _configure(self, data: bytes) -> None:
        if self._mode not in _MODE_PATTERNS:
            raise Refusal(WRONG_MODE)
        self._refuse_while_running()
        entries, exposures = struct.unpack_from("<HI", data)
        entries &= 0x7FF
        if not 1 <= entries <= self.model.max_patterns:
            raise Refusal(BAD_INDEX)
        if missing := [i for i in range(entries) if i not in self._definitions]:
            raise Refusal(BAD_DEFINITION, f"entry {missing[0]} is not defined")
        table = tuple(self._definitions[i] for i in range(entries))
        places = [(s.image, s.bit, s.depth) for s in table]
        if self.strict and places != [(s.image, s.bit, s.depth) for s in self._table]:
            self._memory.clear()
            self._cache.clear()
        self._table, self._exposures, self._paused_at = table, exposures, 0

    def _reorder(self, data: bytes) -> None:
        """Show defined patterns in another order, without defining or loading them again."""
        if len(data) < 8:  # the mailbox address of TI's older SDK, of no meaning since
            return
        self._refuse_while_running()
        count, exposures = struct.unpack_from("<HI", data)
        order = [int.from_bytes(data[at : at + 2], "little") for at in range(6, len(data) - 1, 2)]
        if not 1 <= count <= len(order):
            raise Refusal(INVALID_PARAMETER, f"{len(order)} indices; it says {count}")
        if any(index not in self._definitions for index in order[:count]):
            raise Refusal(BAD_INDEX)
        self._table = tuple(self._definitions[index] for index in order[:count])
        self._exposures, self._paused_at = exposures, 0

    # -- mirrors -------------------------------------------------------------------------------

    def _begin_image(self, controller: int, data: bytes) -> None:
        if self._mode != _ON_THE_FLY:
            raise Refusal(WRONG_MODE)
        self._refuse_while_running()
        self._cache.clear()
        self._memory.begin(controller, data)

    def _mirrors_of(self, slot: Slot) -> Mirrors:
        # Of more than one bit only the most significant plane is looked at: this bench shows
        # binary patterns.
        key = (slot.image, slot.bit + slot.depth - 1)
        if key not in self._cache:
            mirrors = self._memory.plane(*key)
            mirrors = mirrors[:, ::-1] if self._registers[0x1008][0] & 1 else mirrors
            mirrors = mirrors[::-1] if self._registers[0x1009][0] & 1 else mirrors
            mirrors = np.ascontiguousarray(mirrors ^ bool(self._registers[INVERT_DATA][0] & 1))
            mirrors.flags.writeable = False
            self._cache[key] = mirrors
            if len(self._cache) > _MAX_CACHED_PATTERNS:
                self._cache.popitem(last=False)
        return self._cache[key]

    # -- start and stop ------------------------------------------------------------------------

    def _start_stop(self, data: bytes) -> None:
        if data[0] == 2:
            self._start()
        elif data[0] == 1:
            if self.running:  # a pause before the first start, as some hosts send it, skips nothing
                self._sequencer.halt()
                self._paused_at = self._sequencer.exposure
        elif data[0] == 0:
            self._sequencer.halt()
            self._sequencer.aborted = False
            self._paused_at = 0
        else:
            raise Refusal(INVALID_PARAMETER)

    def _start(self) -> None:
        if self._mode not in _MODE_PATTERNS or self._power or self._idle:
            raise Refusal(WRONG_MODE)
        if not self._table:
            raise Refusal(NOT_PRESENT, "the pattern table is empty")
        used = {slot.image for slot in self._table}
        if missing := {image for image in used if not self._memory.holds(image)}:
            raise Refusal(NOT_PRESENT, f"image {min(missing)} is not loaded")
        output = self._registers[{1: 0x1A1D, 2: 0x1A1E}[self._camera_output]]
        self._sequencer.start(
            Program(
                slots=self._table,
                exposures=self._exposures,
                first=self._paused_at,
                mirrors_of=self._mirrors_of,
                camera_output=self._camera_output,
                edge_delay_us=struct.unpack_from("<h", output, 1)[0],
                trigger_in_delay_us=struct.unpack("<H", self._registers[0x1A35][:2])[0],
            )
        )
        self._paused_at = 0
