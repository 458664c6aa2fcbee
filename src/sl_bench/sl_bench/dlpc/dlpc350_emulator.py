"""A DLPC350 at the byte level, with flash images in it: reports in, reports out, trigger edges.

Written from TI's programmer's guide (DLPU010) and API apart from the driver. Flash images are
files as TI's tool takes them (24-bit BMP).
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_bench.dlpc.dlpc900_faults import Dlpc900Faults
from sl_bench.dlpc.dlpc900_sequencer import Mirrors, OnExposure, Program, Sequencer, Slot
from sl_common.clock import Clock, SystemClock
from sl_projector.dlpc.dmd import dmd_model
from sl_projector.hid.usb_socket import UsbIdentity

REPORT = 64
IDENTITY = UsbIdentity(0x0451, 0x6401, "EMU0350")
MAX_ENTRIES, MAX_IMAGES = 1824, 256
#: Shortest difference of exposure and period, other than none, microseconds.
MIN_DARK_US = 230
#: The validation says so often that it is busy.
BUSY_POLLS = 2
#: One count of the trigger input's delay.
DELAY_COUNT_US = 0.1072
_STORED = {0x1A1D: bytes([0, 0xBB, 0xBB]), 0x1A1E: bytes([0, 0xBB]), 0x1A35: bytes(4)}


class _Refused(Exception):
    """The controller's NACK; it gives no reason."""


class Dlpc350Emulator:
    """The controller with its DMD (912 x 1140) and flash; a `HidDevice`.

    Parameters
    ----------
    flash : sequence of path
        Its images, 24-bit BMP files of the DMD's size.
    clock : Clock, optional
        `SystemClock` for real time.
    on_exposure : callable, optional
        Told of each trigger edge, as by `Dlpc900Emulator`.
    """

    def __init__(
        self,
        flash: Sequence[Path],
        clock: Clock | None = None,
        on_exposure: OnExposure | None = None,
    ) -> None:
        self.model = dmd_model("DLP4500")
        self.faults = Dlpc900Faults()
        self.errors: list[str] = []
        self._flash = [self._image(path) for path in flash]
        dark = np.zeros((self.model.rows, self.model.columns), np.bool_)
        dark.flags.writeable = False
        self._sequencer = Sequencer(clock or SystemClock(), self.faults, dark)
        self._sequencer.on_exposure = on_exposure
        self._lock = threading.RLock()
        self.power_cycle()

    def _image(self, path: Path) -> NDArray[np.uint8]:
        pixels = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if pixels is None or pixels.shape != (self.model.rows, self.model.columns, 3):
            raise ValueError(f"{path} is no image of {self.model.columns} x {self.model.rows}")
        return np.asarray(pixels, np.uint8)

    @property
    def running(self) -> bool:
        """True while a sequence is shown."""
        return self._sequencer.running

    def mirrors_now(self) -> Mirrors:
        """Return the mirrors as they stand, shape (rows, columns), True is bright."""
        return self._sequencer.mirrors_now()

    def power_cycle(self) -> None:
        """Forget everything but the flash."""
        with self._lock:
            self._sequencer.halt()
            self._sequencer.aborted = False
            self._registers = dict(_STORED)
            self._power, self._mode, self._source, self._trigger_mode = 0, 0, 0, 0
            self._mailbox, self._address = 0, 0
            self._images: dict[int, int] = {}
            self._entries: dict[int, tuple[int, int, int]] = {}
            self._config = (0, 0, False)
            self._valid, self._busy, self._verdict = False, 0, 0
            self._pending = bytearray()

    # -- reports --------------------------------------------------------------------------------

    def forget_message(self) -> None:
        """Drop a message that is incomplete."""
        with self._lock:
            self._pending.clear()

    def receive(self, report: bytes) -> list[bytes]:
        """Take one report from the host; return the reply's reports, mostly none or one."""
        with self._lock:
            self._pending += report.ljust(REPORT, b"\0")
            flags, sequence, length = struct.unpack_from("<BBH", self._pending)
            if len(self._pending) < 4 + length:
                return []
            message = bytes(self._pending[4 : 4 + length])
            self._pending.clear()
            data, nack = self._answer(message, bool(flags & 0x80))
            if not flags & 0x40:
                return []
            reply = struct.pack("<BBH", flags & 0xC7 | nack, sequence, len(data)) + data
            return [reply[:REPORT].ljust(REPORT, b"\0")]

    def _answer(self, message: bytes, read: bool) -> tuple[bytes, int]:
        command = int.from_bytes(message[:2], "little")
        try:
            if self.faults.take("refuse"):
                raise _Refused("refused on request")
            if read:
                return self._read(command), 0
            self._write(command, message[2:])
        except (_Refused, IndexError, struct.error) as refusal:
            self.errors.append(f"0x{command:04X}: {refusal}")
            return b"", 0x20
        return b"", 0

    def _read(self, command: int) -> bytes:
        if command in self._registers:
            return self._registers[command]
        if command == 0x1A1A:
            self._busy -= self._busy > 0
            return bytes([0x80 if self._busy else self._verdict])
        values: dict[int, bytes] = {
            0x0200: bytes([self._power]),
            0x0205: struct.pack("<HBB", 1, 2, 3) * 4,
            0x1A0A: bytes([1 | self._sequencer.aborted << 6]),
            0x1A0B: b"\x01",
            0x1A0C: bytes([(self._power == 1) | self.running << 1]),
            0x1A1B: bytes([self._mode]),
            0x1A22: bytes([self._source]),
            0x1A23: bytes([self._trigger_mode]),
            0x1A42: bytes([len(self._flash)]),
        }
        if command not in values:
            raise _Refused("unknown")
        return values[command]

    # -- writing --------------------------------------------------------------------------------

    def _write(self, command: int, data: bytes) -> None:
        writers: dict[int, Callable[[bytes], None]] = {
            0x0200: self._set_power, 0x1A1A: self._validate, 0x1A1B: self._set_mode,
            0x1A22: self._set_source, 0x1A23: self._set_trigger_mode, 0x1A24: self._start_stop,
            0x1A33: self._open_mailbox, 0x1A34: self._take_images, 0x1A3E: self._take_entry,
            0x1A3F: self._set_address, 0x1A40: self._configure,
        }  # fmt: skip
        if command in self._registers:
            self._registers[command] = data[: len(self._registers[command])]
        elif command not in writers:
            raise _Refused("unknown")
        else:
            if self.running and command not in (0x1A24, 0x0200):
                raise _Refused("a sequence is running")
            writers[command](data)

    def _set_power(self, data: bytes) -> None:
        self._sequencer.halt()
        if data[0] == 2:
            self.power_cycle()
        self._power = data[0] & 1

    def _set_mode(self, data: bytes) -> None:
        self._mode, self._valid = data[0], False

    def _set_source(self, data: bytes) -> None:
        if data[0] not in (0, 3):
            raise _Refused("source")
        self._source, self._valid = data[0], False

    def _set_trigger_mode(self, data: bytes) -> None:
        if data[0] > 4:
            raise _Refused("trigger mode")
        self._trigger_mode, self._valid = data[0], False

    def _open_mailbox(self, data: bytes) -> None:
        self._mailbox, self._address, self._valid = data[0], 0, False

    def _set_address(self, data: bytes) -> None:
        (self._address,) = struct.unpack_from("<H", data)
        if self._address >= MAX_ENTRIES:
            raise _Refused("address")

    def _take_images(self, data: bytes) -> None:
        if self._mailbox != 1 or len(data) > MAX_IMAGES:
            raise _Refused("the image table's mailbox is not open")
        # The controller has exactly two entries the other way round.
        self._images = dict(enumerate(data[::-1] if len(data) == 2 else data))

    def _take_entry(self, data: bytes) -> None:
        if self._mailbox != 3:
            raise _Refused("the variable exposure mailbox is not open")
        self._entries[self._address] = struct.unpack_from("<III", data)

    def _configure(self, data: bytes) -> None:
        entries, _, images, repeat = struct.unpack_from("<HHBB", data)
        self._config, self._valid = (entries + 1, images + 1, bool(repeat)), False

    # -- validation and run ---------------------------------------------------------------------

    def _validate(self, _data: bytes) -> None:
        self._busy, self._verdict = BUSY_POLLS, self._judge()
        self._valid = self._verdict & 0b11 == 0

    def _judge(self) -> int:
        count, images, _ = self._config
        entries = [self._entries.get(i) for i in range(count)]
        if self._trigger_mode != 3 or any(e is None for e in entries):
            return 0b10
        verdict, swaps = 0, 0
        for word, exposure_us, period_us in filter(None, entries):
            plane, depth = word >> 2 & 0x3F, word >> 8 & 0xF
            swaps += word >> 18 & 1
            verdict |= exposure_us < self.model.min_exposure_us[0] or period_us < exposure_us
            verdict |= (plane > 23 or depth != 1) << 1
            verdict |= (0 < period_us - exposure_us <= MIN_DARK_US) << 4
        # Black (bit 17) must come before a pattern that waits; before the first, the last's.
        for i, (word, _, _) in enumerate(filter(None, entries)):
            before = entries[i - 1]
            if word & 3 in (1, 2) and before is not None:
                verdict |= (not before[0] >> 17 & 1) << 3
        known = all(self._images.get(i, len(self._flash)) < len(self._flash) for i in range(images))
        first = entries[0]
        if swaps != images or not known or first is None or first[0] & 3 == 3:
            verdict |= 0b10
        return int(verdict)

    def _start_stop(self, data: bytes) -> None:
        if data[0] != 2:
            self._sequencer.halt()
            self._sequencer.aborted = False
            return
        if not (self._valid and self._mode == 1 and self._source == 3) or self._power:
            raise _Refused("nothing valid to show")
        count, _, endless = self._config
        slots = self._slots(count)
        (delay,) = struct.unpack("<I", self._registers[0x1A35])
        self._sequencer.start(
            Program(
                slots, 0 if endless else count, 0, self._mirrors_of, 2, 0,
                trigger_in_delay_us=round(delay * DELAY_COUNT_US),
            )
        )  # fmt: skip

    def trigger_in(self, edge_ns: int | None = None) -> bool:
        """Raise an edge on TRIG_IN_1; False when no pattern waits for it."""
        return self._sequencer.trigger_in(edge_ns)

    def _slots(self, count: int) -> tuple[Slot, ...]:
        slots, swaps = [], 0
        for word, exposure_us, period_us in (self._entries[i] for i in range(count)):
            swaps += word >> 18 & 1
            image = self._images[swaps - 1]
            dark_us = period_us - exposure_us
            waits = word & 3 in (1, 2)
            slots.append(Slot(image, word >> 2 & 0x3F, 1, exposure_us, dark_us, waits, True))
        return tuple(slots)

    def _mirrors_of(self, slot: Slot) -> Mirrors:
        """Planes 0-7 are green, 8-15 red, 16-23 blue; OpenCV's pixels are blue, green, red."""
        channel = {0: 1, 1: 2, 2: 0}[slot.bit // 8]
        mirrors: Mirrors = (self._flash[slot.image][:, :, channel] >> (slot.bit % 8) & 1) == 1
        mirrors.flags.writeable = False
        return mirrors
