"""A DLPC at the byte level: reports in, reports out, registers, faults.

What the DLPC900 and the DLPC350 share: the framing of TI's USB commands, the refusals, and a
sequencer behind them. Written from TI's programmer's guides (DLPU018J, DLPU010) apart from the
drivers; only the table of DMD models is shared.
"""

from __future__ import annotations

import struct
import threading
from abc import abstractmethod
from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import ClassVar

import numpy as np

from sl_bench.dlpc.dlpc_faults import DlpcFaults
from sl_bench.dlpc.sequencer import OnExposure, Sequencer
from sl_common.clock import Clock, SystemClock
from sl_projector.dlpc.dmd import DmdModel

REPORT = 64
BUFFER = 512
READ, REPLY_WANTED, NACK = 0x80, 0x40, 0x20
ERROR_CODE, ERROR_TEXT = 0x0100, 0x0101


class Error(IntEnum):
    """TI's error codes (command 0x0100) and their texts."""

    text: str

    NO_ERROR = 0, ""
    INVALID_COMMAND = 3, "Invalid command number"
    WRONG_MODE = 5, "Command not allowed in current mode"
    INVALID_PARAMETER = 6, "Invalid command parameter"
    NOT_PRESENT = 7, "Item referred by the parameter is not present"
    BAD_COMPRESSION = 9, "Device failure"
    BAD_BIT = 10, "Pattern bit number out of range"
    BAD_DARK = 12, "Pattern dark time out of range"
    BAD_DELAY = 13, "Signal delay out of range"
    BAD_EXPOSURE = 14, "Pattern exposure out of range"
    BAD_INDEX = 15, "Pattern number out of range"
    BAD_DEFINITION = 16, "Invalid pattern definition"

    def __new__(cls, code: int, text: str) -> Error:  # noqa: D102
        member = int.__new__(cls, code)
        member._value_, member.text = code, text
        return member


class Refusal(Exception):
    """A command that the controller answers with NACK, and its error code."""

    def __init__(self, code: int, reason: str = "") -> None:
        self.code = code
        self.reason = reason or getattr(code, "text", "Device failure")
        super().__init__(self.reason)


def invalid(reason: str) -> Refusal:
    """Return the refusal of an invalid parameter."""
    return Refusal(Error.INVALID_PARAMETER, reason)


class DlpcEmulator(Sequencer):
    """A controller with its DMD, spoken to by reports; a `HidDevice`.

    Parameters
    ----------
    model : DmdModel
        The DMD.
    clock : Clock, optional
        What exposures are timed by; `SystemClock` unless given.
    on_exposure : callable, optional
        See `Sequencer`. May be set later.
    """

    #: Registers that are only stored: command, bytes at power-up.
    STORED: ClassVar[Mapping[int, bytes]]

    def __init__(
        self, model: DmdModel, clock: Clock | None, on_exposure: OnExposure | None
    ) -> None:
        self.model = model
        self.faults = DlpcFaults()
        dark = np.zeros((model.rows, model.columns), np.bool_)
        dark.flags.writeable = False
        super().__init__(clock or SystemClock(), self.faults, dark, on_exposure)
        self._lock = threading.RLock()
        self.messages = 0
        self.errors: list[str] = []
        self.power_cycle()

    def power_cycle(self) -> None:
        """Forget everything, as when power fails."""
        with self._lock:
            self.halt()
            self.aborted = False
            self._registers = dict(self.STORED)
            self._pending = bytearray()
            self._error, self._error_text = int(Error.NO_ERROR), ""
            self._reset()

    @abstractmethod
    def _reset(self) -> None:
        """Bring the controller's own state to that after power-up."""

    @abstractmethod
    def _readers(self) -> Mapping[int, Callable[[], bytes]]:
        """Commands that can be read besides the registers."""

    @abstractmethod
    def _writers(self) -> Mapping[int, Callable[[bytes], None]]:
        """Commands that can be written besides the registers.

        They may raise `IndexError` or `struct.error` where data are missing.
        """

    def _store(self, command: int, data: bytes) -> None:
        """Write a register."""
        self._registers[command] = data[: len(self._registers[command])]

    def _refuse_while_running(self) -> None:
        if self.running:
            raise Refusal(Error.WRONG_MODE, "a sequence is running")

    # -- reports ------------------------------------------------------------------------------

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
            if 2 <= length <= BUFFER - 4 and len(self._pending) < 4 + length:
                return []
            message = bytes(self._pending[4 : 4 + length])
            self._pending.clear()
            data, nack = self._answer(message, bool(flags & READ))
            if not flags & REPLY_WANTED:
                return []
            reply = struct.pack("<BBH", flags & 0xC7 | nack, sequence, len(data)) + data
            parts = range(0, len(reply), REPORT)
            return [reply[i : i + REPORT].ljust(REPORT, b"\0") for i in parts]

    def _answer(self, message: bytes, read: bool) -> tuple[bytes, int]:
        """Data and NACK flag of the reply."""
        command = int.from_bytes(message[:2], "little")
        try:
            if not 2 <= len(message) <= BUFFER - 4:
                raise invalid(f"message of {len(message)} bytes")
            self.messages += 1
            data = self._execute(command, message[2:], read)
        except Refusal as refusal:
            self._fail(refusal.code, f"0x{command:04X}: {refusal.reason}")
            return b"", NACK
        except (IndexError, struct.error):
            self._fail(Error.INVALID_PARAMETER, f"0x{command:04X}: {len(message) - 2} data bytes")
            return b"", NACK
        if command not in (ERROR_CODE, ERROR_TEXT):
            self._error, self._error_text = int(Error.NO_ERROR), ""
        return data, 0

    def _fail(self, code: int, reason: str) -> None:
        self._error, self._error_text = code, reason
        self.errors.append(f"error {code}: {reason}")

    def _execute(self, command: int, data: bytes, read: bool) -> bytes:
        if command not in (ERROR_CODE, ERROR_TEXT) and self.faults.take("refuse"):
            raise Refusal(self.faults.refuse_code, "refused on request")
        if read:
            if command in self._registers:
                return self._registers[command]
            if (reader := self._readers().get(command)) is not None:
                return reader()
        elif command in self._registers:
            self._store(command, data)
            return b""
        elif (writer := self._writers().get(command)) is not None:
            writer(data)
            return b""
        raise Refusal(Error.INVALID_COMMAND)
