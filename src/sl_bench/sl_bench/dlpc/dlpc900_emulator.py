"""A DLPC900 at the byte level, with images loaded on the fly.

What TI's guide leaves open is settled leniently, so that foreign host programs are understood,
except where ``strict`` is said.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import ClassVar

import numpy as np

from sl_bench.dlpc.dlpc900_memory import MAX_FLY_IMAGES, ImageMemory
from sl_bench.dlpc.dlpc900_registers import (
    ACTIVE_BLOCKS,
    FLIP_COLUMNS,
    FLIP_ROWS,
    INVERT_DATA,
    STORED,
    TRIGGER_IN_DELAY,
    TRIGGER_OUT,
)
from sl_bench.dlpc.dlpc_emulator import (
    ERROR_CODE,
    ERROR_TEXT,
    DlpcEmulator,
    Error,
    Refusal,
    invalid,
)
from sl_bench.dlpc.sequencer import Mirrors, OnExposure, Program, Slot
from sl_common.clock import Clock
from sl_projector.dlpc.dmd import DmdModel, dmd_model

_MAX_CACHED_PATTERNS = 64
_MODE_PATTERNS = (1, 2, 3)
_ON_THE_FLY = 3
_LAST_PLANE = 23


class Dlpc900Emulator(DlpcEmulator):
    """The controller with its DMD.

    Parameters
    ----------
    model : str or DmdModel
        The DMD.
    clock, on_exposure
        See `DlpcEmulator`.
    camera_output : {2, 1}
        The trigger output that the camera is wired to: its rising-edge delay applies.
    strict : bool
        Forget the images when the pattern table's images or count change, and refuse a compressed
        image whose header miscounts its bytes, as the guide says (host programs that do neither
        are in use).
    """

    STORED: ClassVar[Mapping[int, bytes]] = STORED

    def __init__(
        self,
        model: str | DmdModel = "DLP5500",
        clock: Clock | None = None,
        on_exposure: OnExposure | None = None,
        *,
        camera_output: int = 2,
        strict: bool = False,
    ) -> None:
        self.strict = strict
        self._camera_output = camera_output
        super().__init__(dmd_model(model) if isinstance(model, str) else model, clock, on_exposure)

    def pattern(self, index: int) -> Mirrors:
        """Return the mirrors of a pattern table entry as it would be shown."""
        return self._mirrors_of(self._table[index])

    def _reset(self) -> None:
        self._power, self._idle, self._mode = 0, 0, 1
        self._memory = ImageMemory(self.model, strict=self.strict)
        self._definitions: dict[int, Slot] = {}
        self._table: tuple[Slot, ...] = ()
        self._exposures = self._paused_at = 0
        self._cache: OrderedDict[tuple[int, int], Mirrors] = OrderedDict()

    # -- commands -----------------------------------------------------------------------------

    def _readers(self) -> Mapping[int, Callable[[], bytes]]:
        return {
            ERROR_CODE: lambda: bytes([self._error]),
            ERROR_TEXT: lambda: self._error_text.encode()[:127].ljust(128, b"\0"),
            0x0200: lambda: bytes([self._power]),
            0x0201: lambda: bytes([self._idle]),
            0x0205: lambda: struct.pack("<HBB", 0, 1, 6) * 4,
            0x0206: lambda: bytes([self.model.hardware_code]) + b"EMULATOR".ljust(32, b"\0"),
            0x1A0A: lambda: bytes([1 | self.model.dual << 4 | self.aborted << 6]),
            0x1A0B: lambda: b"\x01",
            0x1A0C: lambda: bytes([(self._power == 1) | self.running << 1]),
            0x1A1B: lambda: bytes([self._mode]),
            0x1A31: lambda: struct.pack("<HI", len(self._table), self._exposures),
            0x1A42: lambda: struct.pack("<8H", *self.model.min_exposure_us),
        }

    def _writers(self) -> Mapping[int, Callable[[bytes], None]]:
        return {
            0x0200: self._set_power,
            0x0201: self._set_idle,
            0x0802: lambda _: self.power_cycle(),
            0x1A1B: self._set_mode,
            0x1A24: self._start_stop,
            0x1A2A: lambda d: self._begin_image(0, d),
            0x1A2B: lambda d: self._memory.take(0, d),
            0x1A2C: lambda d: self._begin_image(1, d),
            0x1A2D: lambda d: self._memory.take(1, d),
            0x1A31: self._configure,
            0x1A32: self._reorder,
            0x1A34: self._define,
        }

    def _store(self, command: int, data: bytes) -> None:
        size = len(self._registers[command])
        if len(data) < size:
            raise invalid(f"{len(data)} data bytes; expected {size}")
        if command in TRIGGER_OUT.values():
            inverted, rising, falling = struct.unpack_from("<Bhh", data)
            if not (-20 <= rising <= 20000 and -20 <= falling <= 20000):
                raise Refusal(Error.BAD_DELAY)
            if inverted & 1 and rising < falling:
                raise Refusal(Error.BAD_DELAY, "inverted: rising delay below falling delay")
        value = int.from_bytes(data[:2], "little")
        if command == TRIGGER_IN_DELAY and value < self.model.block_load_us[-1]:
            raise Refusal(Error.BAD_DELAY)
        if 0x1A1D <= command <= 0x1A36:
            self._refuse_while_running()
        if command in (FLIP_COLUMNS, FLIP_ROWS, INVERT_DATA):
            self._cache.clear()
        super()._store(command, data)

    def _set_power(self, data: bytes) -> None:
        if data[0] == 2:
            self.power_cycle()
        elif data[0] > 2:
            raise Refusal(Error.INVALID_PARAMETER)
        else:
            self.halt()
            self._power = data[0]

    def _set_idle(self, data: bytes) -> None:
        if data[0] not in (0, 1, 3):
            raise Refusal(Error.INVALID_PARAMETER)
        self._refuse_while_running()
        self._idle = int(data[0] == 1)

    def _set_mode(self, data: bytes) -> None:
        if data[0] > _ON_THE_FLY:
            raise Refusal(Error.INVALID_PARAMETER)
        self._refuse_while_running()
        if data[0] != self._mode:
            self._definitions, self._table, self._paused_at = {}, (), 0
        self._mode = data[0]

    # -- pattern table -------------------------------------------------------------------------

    def _define(self, data: bytes) -> None:
        if self._mode not in _MODE_PATTERNS:
            raise Refusal(Error.WRONG_MODE)
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
            raise Refusal(Error.BAD_INDEX)
        if slot.bit > _LAST_PLANE:
            raise Refusal(Error.BAD_BIT)
        if slot.bit + slot.depth > _LAST_PLANE + 1:
            raise Refusal(Error.BAD_DEFINITION, "bit position and depth leave the image")
        if slot.exposure_us < self._least_exposure_us(slot.depth):
            raise Refusal(Error.BAD_EXPOSURE)
        if 0 < slot.dark_us < self.model.min_dark_us:
            raise Refusal(Error.BAD_DARK)
        if self._mode == _ON_THE_FLY and slot.image >= MAX_FLY_IMAGES:
            raise invalid(f"image {slot.image} on the fly")

    def _least_exposure_us(self, depth: int) -> int:
        if depth > 1:
            return self.model.min_exposure_us[min(depth, 8) - 1]
        loads_us = self.model.block_load_us
        return loads_us[min(max(self._registers[ACTIVE_BLOCKS][1], 1), len(loads_us)) - 1]

    def _configure(self, data: bytes) -> None:
        if self._mode not in _MODE_PATTERNS:
            raise Refusal(Error.WRONG_MODE)
        self._refuse_while_running()
        entries, exposures = struct.unpack_from("<HI", data)
        entries &= 0x7FF
        if not 1 <= entries <= self.model.max_patterns:
            raise Refusal(Error.BAD_INDEX)
        if missing := [i for i in range(entries) if i not in self._definitions]:
            raise Refusal(Error.BAD_DEFINITION, f"entry {missing[0]} is not defined")
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
            raise invalid(f"{len(order)} indices; it says {count}")
        if any(index not in self._definitions for index in order[:count]):
            raise Refusal(Error.BAD_INDEX)
        self._table = tuple(self._definitions[index] for index in order[:count])
        self._exposures, self._paused_at = exposures, 0

    # -- mirrors -------------------------------------------------------------------------------

    def _begin_image(self, controller: int, data: bytes) -> None:
        if self._mode != _ON_THE_FLY:
            raise Refusal(Error.WRONG_MODE)
        self._refuse_while_running()
        self._cache.clear()
        self._memory.begin(controller, data)

    def _mirrors_of(self, slot: Slot) -> Mirrors:
        # Of more than one bit only the most significant plane is looked at: this bench shows
        # binary patterns.
        key = (slot.image, slot.bit + slot.depth - 1)
        if key not in self._cache:
            mirrors = self._memory.plane(*key)
            mirrors = mirrors[:, ::-1] if self._registers[FLIP_COLUMNS][0] & 1 else mirrors
            mirrors = mirrors[::-1] if self._registers[FLIP_ROWS][0] & 1 else mirrors
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
                self.halt()
                self._paused_at = self.exposure
        elif data[0] == 0:
            self.halt()
            self.aborted = False
            self._paused_at = 0
        else:
            raise Refusal(Error.INVALID_PARAMETER)

    def _start(self) -> None:
        if self._mode not in _MODE_PATTERNS or self._power or self._idle:
            raise Refusal(Error.WRONG_MODE)
        if not self._table:
            raise Refusal(Error.NOT_PRESENT, "the pattern table is empty")
        used = {slot.image for slot in self._table}
        if missing := {image for image in used if not self._memory.holds(image)}:
            raise Refusal(Error.NOT_PRESENT, f"image {min(missing)} is not loaded")
        output = self._registers[TRIGGER_OUT[self._camera_output]]
        self.start(
            Program(
                slots=self._table,
                exposures=self._exposures,
                first=self._paused_at,
                mirrors_of=self._mirrors_of,
                camera_output=self._camera_output,
                edge_delay_us=struct.unpack_from("<h", output, 1)[0],
                trigger_in_delay_us=struct.unpack_from("<H", self._registers[TRIGGER_IN_DELAY])[0],
            )
        )
        self._paused_at = 0
