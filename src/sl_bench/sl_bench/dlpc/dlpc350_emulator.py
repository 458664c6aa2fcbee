"""A DLPC350 at the byte level, with images in its flash.

Flash images are files as TI's tool takes them (24-bit BMP).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_bench.dlpc.dlpc_emulator import DlpcEmulator, Error, Refusal, invalid
from sl_bench.dlpc.sequencer import Mirrors, OnExposure, Program, Slot
from sl_common.clock import Clock
from sl_projector.dlpc.dmd import dmd_model
from sl_projector.hid.usb_socket import UsbIdentity

IDENTITY = UsbIdentity(0x0451, 0x6401, "EMU0350")
MAX_ENTRIES, MAX_IMAGES = 1824, 256
#: Shortest difference of exposure and period, other than none, microseconds.
MIN_DARK_US = 230
#: The validation answers this often that it is busy.
BUSY_POLLS = 2
#: One count of the trigger input's delay.
DELAY_COUNT_US = 0.1072


class Dlpc350Emulator(DlpcEmulator):
    """The controller with its DMD (912 x 1140) and flash.

    Parameters
    ----------
    flash : sequence of path
        Its images, 24-bit BMP files of the DMD's size.
    clock, on_exposure
        See `DlpcEmulator`.
    """

    STORED: ClassVar[Mapping[int, bytes]] = {
        0x1A1D: bytes([0, 0xBB, 0xBB]),
        0x1A1E: bytes([0, 0xBB]),
        0x1A35: bytes(4),
    }

    def __init__(
        self,
        flash: Sequence[Path],
        clock: Clock | None = None,
        on_exposure: OnExposure | None = None,
    ) -> None:
        model = dmd_model("DLP4500")
        self._flash = [_flash_image(path, (model.rows, model.columns, 3)) for path in flash]
        super().__init__(model, clock, on_exposure)

    def _reset(self) -> None:
        self._power, self._mode, self._source, self._trigger_mode = 0, 0, 0, 0
        self._mailbox, self._address = 0, 0
        self._images: dict[int, int] = {}
        self._entries: dict[int, tuple[int, int, int]] = {}
        self._config = (0, 0, False)
        self._valid, self._busy, self._verdict = False, 0, 0

    # -- commands -----------------------------------------------------------------------------

    def _readers(self) -> Mapping[int, Callable[[], bytes]]:
        return {
            0x0200: lambda: bytes([self._power]),
            0x0205: lambda: struct.pack("<HBB", 1, 2, 3) * 4,
            0x1A0A: lambda: bytes([1 | self.aborted << 6]),
            0x1A0B: lambda: b"\x01",
            0x1A0C: lambda: bytes([(self._power == 1) | self.running << 1]),
            0x1A1A: self._validation,
            0x1A1B: lambda: bytes([self._mode]),
            0x1A22: lambda: bytes([self._source]),
            0x1A23: lambda: bytes([self._trigger_mode]),
            0x1A42: lambda: bytes([len(self._flash)]),
        }

    def _writers(self) -> Mapping[int, Callable[[bytes], None]]:
        idle_only = {
            0x1A1A: self._validate,
            0x1A1B: self._set_mode,
            0x1A22: self._set_source,
            0x1A23: self._set_trigger_mode,
            0x1A33: self._open_mailbox,
            0x1A34: self._take_images,
            0x1A3E: self._take_entry,
            0x1A3F: self._set_address,
            0x1A40: self._configure,
        }
        always = {0x0200: self._set_power, 0x1A24: self._start_stop}
        if not self.running:
            return idle_only | always
        return dict.fromkeys(idle_only, lambda _: self._refuse_while_running()) | always

    def _set_power(self, data: bytes) -> None:
        self.halt()
        if data[0] == 2:
            self.power_cycle()
        self._power = data[0] & 1

    def _set_mode(self, data: bytes) -> None:
        self._mode, self._valid = data[0], False

    def _set_source(self, data: bytes) -> None:
        if data[0] not in (0, 3):
            raise invalid("source")
        self._source, self._valid = data[0], False

    def _set_trigger_mode(self, data: bytes) -> None:
        if data[0] > 4:
            raise invalid("trigger mode")
        self._trigger_mode, self._valid = data[0], False

    def _open_mailbox(self, data: bytes) -> None:
        self._mailbox, self._address, self._valid = data[0], 0, False

    def _set_address(self, data: bytes) -> None:
        (self._address,) = struct.unpack_from("<H", data)
        if self._address >= MAX_ENTRIES:
            raise Refusal(Error.BAD_INDEX, "address")

    def _take_images(self, data: bytes) -> None:
        if self._mailbox != 1 or len(data) > MAX_IMAGES:
            raise Refusal(Error.WRONG_MODE, "the image table's mailbox is not open")
        # The controller has exactly two entries the other way round.
        self._images = dict(enumerate(data[::-1] if len(data) == 2 else data))

    def _take_entry(self, data: bytes) -> None:
        if self._mailbox != 3:
            raise Refusal(Error.WRONG_MODE, "the variable exposure mailbox is not open")
        self._entries[self._address] = struct.unpack_from("<III", data)

    def _configure(self, data: bytes) -> None:
        entries, _, images, repeat = struct.unpack_from("<HHBB", data)
        self._config, self._valid = (entries + 1, images + 1, bool(repeat)), False

    # -- validation and run -------------------------------------------------------------------

    def _validation(self) -> bytes:
        self._busy -= self._busy > 0
        return bytes([0x80 if self._busy else self._verdict])

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
            self.halt()
            self.aborted = False
            return
        if not (self._valid and self._mode == 1 and self._source == 3) or self._power:
            raise Refusal(Error.NOT_PRESENT, "nothing valid to show")
        count, _, endless = self._config
        (delay,) = struct.unpack("<I", self._registers[0x1A35])
        self.start(
            Program(
                slots=self._slots(count),
                exposures=0 if endless else count,
                first=0,
                mirrors_of=self._mirrors_of,
                camera_output=2,
                edge_delay_us=0,
                trigger_in_delay_us=round(delay * DELAY_COUNT_US),
            )
        )

    def _slots(self, count: int) -> tuple[Slot, ...]:
        slots, swaps = [], 0
        for word, exposure_us, period_us in (self._entries[i] for i in range(count)):
            swaps += word >> 18 & 1
            image = self._images[swaps - 1]
            dark_us = period_us - exposure_us
            waits = word & 3 in (1, 2)
            slots.append(Slot(image, word >> 2 & 0x3F, 1, exposure_us, dark_us, waits))
        return tuple(slots)

    def _mirrors_of(self, slot: Slot) -> Mirrors:
        """Planes 0-7 are green, 8-15 red, 16-23 blue; OpenCV's pixels are blue, green, red."""
        channel = {0: 1, 1: 2, 2: 0}[slot.bit // 8]
        mirrors: Mirrors = (self._flash[slot.image][:, :, channel] >> (slot.bit % 8) & 1) == 1
        mirrors.flags.writeable = False
        return mirrors


def _flash_image(path: Path, shape: tuple[int, int, int]) -> NDArray[np.uint8]:
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if pixels is None or pixels.shape != shape:
        raise ValueError(f"{path} is no image of {shape[1]} x {shape[0]}")
    return np.asarray(pixels, np.uint8)
