"""Commands and replies of a DLPC900 over a HID transport.

Knows how to ask, how long to wait, which reply belongs to which command, and what a refusal
means; knows nothing of patterns.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping

from sl_common.clock import Clock, SystemClock
from sl_common.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout
from sl_projector.dlpc import dlpc900_protocol as protocol
from sl_projector.hid.usb_transport import HidTransport

REPLY_TIMEOUT_S = 2.0  # TI's own software waits so long
_DRAIN_TIMEOUT_S = 0.002
_MAX_DRAINED = 256
# Public drivers meet answers without data from devices that were asked too soon, and ask again.
_EMPTY_PAUSE_S, _MAX_EMPTY = 0.05, 5


class Dlpc900Port:
    """One open controller; methods may be called from several threads.

    Parameters
    ----------
    transport : HidTransport
        Reports to and from the device; closed by `close`.
    reply_timeout_s : float
        How long to wait for the reply to a command.
    clock : Clock
        What `write_once` tells the time by.
    """

    #: What messages call the controller, and its commands.
    chip = "DLPC900"
    names: Mapping[int, str] = protocol.NAMES

    def __init__(
        self,
        transport: HidTransport,
        reply_timeout_s: float = REPLY_TIMEOUT_S,
        clock: Clock | None = None,
    ) -> None:
        self._transport = transport
        self._reply_timeout_s = reply_timeout_s
        self._clock: Clock = clock or SystemClock()
        self._lock = threading.RLock()
        self._closed = False
        self._sequence = 0
        self.messages = 0
        self.reports_out = 0
        self.reports_in = 0
        self.stale_replies = 0

    def drain(self) -> None:
        """Throw away replies to an earlier owner's commands."""
        with self._lock, contextlib.suppress(DeviceTimeout):
            for _ in range(_MAX_DRAINED):
                self._transport.read(_DRAIN_TIMEOUT_S)

    def close(self) -> None:
        """Release the device; whoever still uses the port is told that it is lost."""
        with self._lock:
            self._closed = True
            self._transport.close()

    def read(self, command: int, size: int = 1) -> bytes:
        """Ask for data, at least ``size`` bytes; asked twice when the answer is lost.

        Parameters
        ----------
        command : int
            Number of the command.
        size : int
            Least number of bytes.

        Returns
        -------
        bytes
            All that the device sent, at most 60.

        Raises
        ------
        DeviceRefused
            When the device says no, with its reason.
        DeviceTimeout
            When it does not answer.
        DeviceError
            When the answer is shorter than expected.
        """
        with self._lock:
            reply = self._ask(command)
            for _ in range(_MAX_EMPTY):
                if reply.data or reply.refused or not size:
                    break
                pause_until_ns = self._clock.now_ns() + int(_EMPTY_PAUSE_S * 1e9)
                self._clock.wait_until(pause_until_ns, threading.Event())
                reply = self._ask(command)
            self._refuse(command, reply)
        if len(reply.data) < size:
            raise DeviceError(
                f"{self.chip} answered 0x{command:04X} ({self.names.get(command)}) with "
                f"{len(reply.data)} bytes; expected at least {size}"
            )
        return reply.data

    def write(self, command: int, data: bytes) -> None:
        """Set something, confirmed by the device; repeated when the confirmation is lost.

        Only for commands of which a repetition changes nothing. Raises as `read`.

        Parameters
        ----------
        command : int
            Number of the command.
        data : bytes
            Its parameters.
        """
        with self._lock:
            self._refuse(command, self._twice(lambda: self._exchange(command, data, read=False)))

    def write_once(self, command: int, data: bytes) -> tuple[int, int]:
        """Set something that must not happen twice; return the host time of its transfer.

        Parameters
        ----------
        command : int
            Number of the command.
        data : bytes
            Its parameters.

        Returns
        -------
        began_ns, ended_ns : int
            The clock around the outgoing transfer. Raises as `read`.
        """
        with self._lock:
            reply = self._exchange(command, data, read=False)
            times = self._sent_ns
            self._refuse(command, reply)
        return times

    def send(self, command: int, data: bytes, step: str) -> None:
        """Send data without asking for a reply (image data must be sent so), then for its error.

        Nothing comes between the two, also not of another thread: the next command without an
        error would hide this one's.

        Parameters
        ----------
        command : int
            Number of the command.
        data : bytes
            Its parameters.
        step : str
            What is being done, for the message.

        Raises
        ------
        DeviceRefused
            When the device has an error latched; names the step.
        """
        with self._lock:
            self._send(command, data, read=False, reply=False)
            code = self.read(protocol.ERROR_CODE)[0]
            if code:
                raise DeviceRefused(
                    f"{self.chip} reports error {code}, "
                    f"{protocol.ERRORS.get(code, 'undefined error')}{self._error_text()}, "
                    f"after {step}"
                )

    def _ask(self, command: int) -> protocol.Reply:
        return self._twice(lambda: self._exchange(command, b"", read=True))

    def _twice(self, exchange: Callable[[], protocol.Reply]) -> protocol.Reply:
        try:
            return exchange()
        except DeviceTimeout:
            return exchange()

    def _send(self, command: int, data: bytes, *, read: bool, reply: bool) -> int:
        if self._closed:  # pyusb would open the device again, behind everybody's back
            raise DeviceLost(f"the connection to the {self.chip} was closed")
        self._sequence = self._sequence % 255 + 1  # never 0: padding would look like an answer
        packet = protocol.message(command, data, read=read, reply=reply, sequence=self._sequence)
        began_ns = self._clock.now_ns()
        for report in protocol.reports(packet):
            self._transport.write(report, self._reply_timeout_s)
            self.reports_out += 1
        self._sent_ns = (began_ns, self._clock.now_ns())
        self.messages += 1
        return self._sequence

    def _exchange(self, command: int, data: bytes, *, read: bool) -> protocol.Reply:
        sequence = self._send(command, data, read=read, reply=True)
        deadline_s = time.monotonic() + self._reply_timeout_s
        while (left_s := deadline_s - time.monotonic()) > 0:
            reply = protocol.decode_reply(self._transport.read(left_s))
            self.reports_in += 1
            if reply is not None and reply.sequence == sequence:
                return reply
            self.stale_replies += 1  # late answer to an earlier command, or cut short
        raise DeviceTimeout(
            f"{self.chip} did not answer 0x{command:04X} ({self.names.get(command)}) "
            f"within {self._reply_timeout_s} s"
        )

    def _refuse(self, command: int, reply: protocol.Reply) -> None:
        if not reply.refused:
            return
        if command in (protocol.ERROR_CODE, protocol.ERROR_TEXT):
            raise protocol.refusal(command, 255)
        code = self.read(protocol.ERROR_CODE)[0]
        raise protocol.refusal(command, code, self._error_text().removeprefix(": "))

    def _error_text(self) -> str:
        """Return the device's own words, or nothing when it has none."""
        try:
            text = self.read(protocol.ERROR_TEXT, 0).split(b"\0")[0].decode("ascii", "replace")
            self.drain()  # the text's further reports, whose letters may look like an answer
        except DeviceError:
            return ""
        return f": {text}" if text else ""
