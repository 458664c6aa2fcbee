"""USB's side of an emulated HID device.

Reports queued for the host, faults of the bus, and a server through which another process
uses the device over a Unix socket (`sl_projector.hid.usb_socket`).
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import socketserver
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn, Protocol

from sl_bench.dlpc.dlpc_faults import DlpcFaults
from sl_projector.hid import usb_socket as wire
from sl_projector.hid.usb_socket import UsbIdentity, UsbLink

MAX_QUEUED_REPORTS = 64  # as many as Linux keeps for a hidraw reader
SHORT_REPORT_BYTES = 3
_POLL_S = 0.1
DLPC900_IDENTITY = UsbIdentity(0x0451, 0xC900, "EMU0001")


class HidDevice(Protocol):
    """A device behind the bus: takes reports, returns reports."""

    faults: DlpcFaults

    def receive(self, report: bytes) -> list[bytes]:
        """Take a report, return what is answered."""
        ...

    def forget_message(self) -> None:
        """Drop an incomplete message."""
        ...

    def power_cycle(self) -> None:
        """Lose all state."""
        ...


def _fail(number: int) -> NoReturn:
    raise OSError(number, os.strerror(number))


class EmulatedUsb:
    """The bus with one device on it.

    Parameters
    ----------
    device : HidDevice
        What receives the reports, e.g. a `Dlpc900Emulator`.
    identity : UsbIdentity
        Vendor, product and serial number.

    Attributes
    ----------
    present : bool
        Whether the device is on the bus.
    unplugged : int
        How often it was taken out.
    owner : EmulatedLink or None
        The host that has claimed the interface.
    replies : deque
        Reports for the host, each with the time from which it can be read.
    ready : Condition
        Guards owner and replies, and announces replies.
    """

    def __init__(self, device: HidDevice, identity: UsbIdentity = DLPC900_IDENTITY) -> None:
        self.device = device
        self.identity = identity
        self.present = True
        self.unplugged = 0
        self.owner: EmulatedLink | None = None
        self.replies: deque[tuple[float, bytes]] = deque(maxlen=MAX_QUEUED_REPORTS)
        self.ready = threading.Condition()

    @property
    def claimed(self) -> bool:
        """Whether a host has the interface."""
        return self.owner is not None

    def connect(self) -> EmulatedLink:
        """Return a host's view of the device."""
        return EmulatedLink(self)

    def unplug(self) -> None:
        """Take the device from the bus; it keeps its power and its state."""
        with self.ready:
            self.present = False
            self.unplugged += 1
            self.owner = None
            self.ready.notify_all()

    def plug_in(self) -> None:
        """Put it back; hosts must open it again."""
        with self.ready:
            self.device.forget_message()
            self.replies.clear()
            self.present = True

    def power_cycle(self) -> None:
        """Switch the device off and on: it leaves the bus and comes back without memory."""
        self.unplug()
        self.device.power_cycle()
        self.plug_in()

    def queue(self, reply: bytes) -> None:
        """Make a reply readable, as its faults allow."""
        faults = self.device.faults
        if faults.take("lose_replies"):
            return
        ready_s = time.monotonic()
        if faults.take("late_replies"):
            ready_s += faults.late_s
        with self.ready:
            if faults.take("stale_replies"):
                old = bytes([reply[0], (reply[1] - 1) & 0xFF])
                self.replies.append((ready_s, (old + reply[2:4] + b"\xff" * 60)))
            if faults.take("empty_replies"):
                reply = reply[:2] + bytes(len(reply) - 2)
            if faults.take("short_replies"):
                reply = reply[:SHORT_REPORT_BYTES]
            self.replies.append((ready_s, reply))
            self.ready.notify_all()


class EmulatedLink:
    """One host's view of the emulated bus; a `UsbLink`.

    Parameters
    ----------
    bus : EmulatedUsb
        The bus.
    """

    def __init__(self, bus: EmulatedUsb) -> None:
        self._bus = bus
        self._unplugged = bus.unplugged

    def _check_present(self) -> None:
        """ENODEV when the device is gone, or was plugged in again since it was opened."""
        if not self._bus.present or self._unplugged != self._bus.unplugged:
            _fail(errno.ENODEV)

    def _check_transfer(self) -> None:
        self._check_present()
        if self._bus.owner is not self:
            _fail(errno.ENODEV)
        if self._bus.device.faults.take("stalls"):
            _fail(errno.EPIPE)

    def describe(self) -> UsbIdentity:
        """See `UsbLink`."""
        if not self._bus.present:
            _fail(errno.ENODEV)
        return self._bus.identity

    def claim(self) -> None:
        """See `UsbLink`."""
        bus, faults = self._bus, self._bus.device.faults
        with bus.ready:
            self._unplugged = bus.unplugged
            self._check_present()
            if faults.kernel_driver or faults.taken or bus.owner not in (None, self):
                _fail(errno.EBUSY)
            bus.owner = self
            bus.device.forget_message()

    def release(self) -> None:
        """See `UsbLink`."""
        with self._bus.ready:
            if self._bus.owner is self:
                self._bus.owner = None

    def write(self, endpoint: int, report: bytes, timeout_ms: int) -> int:
        """See `UsbLink`."""
        self._check_transfer()
        bus = self._bus
        replies = bus.device.receive(report)
        if replies:  # the controller has one buffer for answers: what was not read is gone
            now_s = time.monotonic()
            with bus.ready:
                late = [entry for entry in bus.replies if entry[0] > now_s]
                bus.replies.clear()
                bus.replies.extend(late)
        for reply in replies:
            bus.queue(reply)
        return len(report)

    def read(self, endpoint: int, size: int, timeout_ms: int) -> bytes:
        """See `UsbLink`."""
        self._check_transfer()
        bus, deadline_s = self._bus, time.monotonic() + timeout_ms / 1000
        with bus.ready:
            while True:
                if bus.owner is not self:
                    _fail(errno.ENODEV)
                now_s = time.monotonic()
                report = next((r for r in bus.replies if r[0] <= now_s), None)
                if report is not None:
                    bus.replies.remove(report)
                    return report[1][:size]
                if now_s >= deadline_s:
                    _fail(errno.ETIMEDOUT)
                wake_s = min([deadline_s, *(r[0] for r in bus.replies)])
                bus.ready.wait(max(wake_s - now_s, 1e-4))

    def clear_halt(self, endpoint: int) -> None:
        """See `UsbLink`."""
        self._check_present()

    def kernel_driver_active(self) -> bool:
        """See `UsbLink`."""
        return self._bus.device.faults.kernel_driver

    def detach_kernel_driver(self) -> None:
        """See `UsbLink`."""
        self._bus.device.faults.kernel_driver = False

    def attach_kernel_driver(self) -> None:
        """See `UsbLink`."""


def _perform(link: UsbLink, request: bytes) -> bytes:
    """Do what a request asks, return the answer's payload."""
    operation, endpoint, timeout_ms = wire.REQUEST.unpack_from(request)
    payload = request[wire.REQUEST.size :]
    if operation == wire.DESCRIBE:
        identity = link.describe()
        return wire.IDENTITY.pack(identity.vendor, identity.product) + identity.serial.encode()
    if operation == wire.READ:
        return link.read(endpoint, wire.SIZE.unpack(payload)[0], timeout_ms)
    if operation == wire.KERNEL_DRIVER:
        return bytes([link.kernel_driver_active()])
    silent: dict[int, Callable[[], object]] = {
        wire.WRITE: lambda: link.write(endpoint, payload, timeout_ms),
        wire.CLAIM: link.claim,
        wire.RELEASE: link.release,
        wire.CLEAR_HALT: lambda: link.clear_halt(endpoint),
        wire.DETACH: link.detach_kernel_driver,
        wire.ATTACH: link.attach_kernel_driver,
    }
    if operation not in silent:
        _fail(errno.ENOSYS)
    silent[operation]()
    return b""


class _Connection(socketserver.BaseRequestHandler):
    """One connection: one opened device."""

    server: UsbSocketServer

    def handle(self) -> None:
        link = self.server.bus.connect()
        self.server.connections.add(self.request)
        try:
            with contextlib.suppress(OSError):
                while True:
                    wire.send_frame(self.request, self._respond(link))
        finally:
            link.release()
            self.server.connections.discard(self.request)

    def _respond(self, link: UsbLink) -> bytes:
        request = wire.receive_frame(self.request)
        try:
            return wire.ANSWER.pack(0) + _perform(link, request)
        except OSError as error:
            return wire.ANSWER.pack(error.errno or errno.EIO)
        except struct.error:
            return wire.ANSWER.pack(errno.EINVAL)


class UsbSocketServer(socketserver.ThreadingUnixStreamServer):
    """Lends an emulated device to other processes, one connection an opened device.

    Parameters
    ----------
    path : str
        The Unix socket; removed at `close`. Only its owner may connect.
    bus : EmulatedUsb
        The device.
    """

    daemon_threads = True

    def __init__(self, path: str, bus: EmulatedUsb) -> None:
        self.bus = bus
        self.connections: set[socket.socket] = set()
        self._path = Path(path)
        self._path.unlink(missing_ok=True)
        super().__init__(path, _Connection)
        self._path.chmod(0o600)
        threading.Thread(
            target=self.serve_forever, args=(_POLL_S,), name="usb server", daemon=True
        ).start()

    def close(self) -> None:
        """Drop all connections and remove the socket."""
        self.shutdown()
        self.server_close()
        for connection in list(self.connections):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        self._path.unlink(missing_ok=True)
