"""A pyusb backend for a HID device in another process, reached over a Unix socket.

The driver then runs unchanged, through the real pyusb, against an emulator (`sl_bench`) or any
other process that serves this format. One connection is one opened device. Integers are little
endian.

===========  ==================================================================================
request      u32 length of what follows, u8 operation, u8 endpoint, u32 timeout in ms, payload
answer       u32 length of what follows, i32 errno (0: done), payload
===========  ==================================================================================

=========  ====================  ========================================================
operation  meaning               payload
=========  ====================  ========================================================
0          describe              answer: u16 vendor, u16 product, serial number in ASCII
1          claim interface 0     none
2          release interface 0   none
3          interrupt OUT         request: the report
4          interrupt IN          request: u16 size; answer: the report
5          clear halt            none
6          kernel driver active  answer: u8 0 or 1
7          detach kernel driver  none
8          attach kernel driver  none
=========  ====================  ========================================================
"""

from __future__ import annotations

import array
import contextlib
import errno
import os
import socket
import struct
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import NoReturn, Protocol

import usb.backend
import usb.core

DESCRIBE, CLAIM, RELEASE, WRITE, READ, CLEAR_HALT = range(6)
KERNEL_DRIVER, DETACH, ATTACH = 6, 7, 8
REQUEST = struct.Struct("<BBI")
ANSWER = struct.Struct("<i")
LENGTH = struct.Struct("<I")
SIZE = struct.Struct("<H")
IDENTITY = struct.Struct("<HH")
MAX_FRAME_BYTES = 4096
ANSWER_MARGIN_S = 5.0  # beyond a transfer's own timeout the other process is taken for dead
RELEASE_TIMEOUT_S = 1.0

ENDPOINT_OUT, ENDPOINT_IN = 0x01, 0x81


@dataclass(frozen=True)
class UsbIdentity:
    """What a device tells of itself when it is found."""

    vendor: int
    product: int
    serial: str


class UsbLink(Protocol):
    """One HID device with a report endpoint each way, as a host sees it.

    Every method raises OSError with the errno that libusb gives: ENODEV gone, EBUSY taken, EPIPE
    stalled, ETIMEDOUT no data in time.
    """

    def describe(self) -> UsbIdentity:
        """Return who the device is."""
        ...

    def claim(self) -> None:
        """Take the interface: afterwards transfers are allowed."""
        ...

    def release(self) -> None:
        """Give the interface back. Never fails."""
        ...

    def write(self, endpoint: int, report: bytes, timeout_ms: int) -> int:
        """Send a report, return the bytes taken.

        Parameters
        ----------
        endpoint : int
            Address of the OUT endpoint.
        report : bytes
            At most 64 bytes.
        timeout_ms : int
            Longest wait, milliseconds.
        """
        ...

    def read(self, endpoint: int, size: int, timeout_ms: int) -> bytes:
        """Wait for a report, at most ``size`` bytes.

        Parameters
        ----------
        endpoint, size : int
            Address of the IN endpoint; most bytes to take.
        timeout_ms : int
            Longest wait, milliseconds.
        """
        ...

    def clear_halt(self, endpoint: int) -> None:
        """End a stall."""
        ...

    def kernel_driver_active(self) -> bool:
        """Tell whether the kernel's own driver holds the interface."""
        ...

    def detach_kernel_driver(self) -> None:
        """Take the interface from the kernel's driver."""
        ...

    def attach_kernel_driver(self) -> None:
        """Give the interface back to the kernel's driver."""
        ...


def _receive_exactly(connection: socket.socket, count: int) -> bytes:
    """Read ``count`` bytes; ConnectionError when the other side has gone."""
    parts = bytearray()
    while len(parts) < count:
        part = connection.recv(count - len(parts))
        if not part:
            raise ConnectionResetError(errno.ECONNRESET, "the other side closed the socket")
        parts += part
    return bytes(parts)


def receive_frame(connection: socket.socket) -> bytes:
    """Read one length-prefixed frame; ConnectionError when it cannot be one."""
    (length,) = LENGTH.unpack(_receive_exactly(connection, LENGTH.size))
    if length > MAX_FRAME_BYTES:
        raise ConnectionAbortedError(
            errno.ECONNABORTED, f"frame of {length} bytes; expected at most {MAX_FRAME_BYTES}"
        )
    return _receive_exactly(connection, length)


def send_frame(connection: socket.socket, frame: bytes) -> None:
    """Send one length-prefixed frame.

    Parameters
    ----------
    connection : socket
        Connected stream socket.
    frame : bytes
        At most `MAX_FRAME_BYTES`.
    """
    connection.sendall(LENGTH.pack(len(frame)) + frame)


class SocketLink:
    """The client's end: a `UsbLink` to the process that listens at ``path``."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._connection: socket.socket | None = None

    def _connected(self) -> socket.socket:
        if self._connection is None:
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                connection.connect(self._path)
            except OSError:
                connection.close()
                raise
            self._connection = connection
        return self._connection

    def _request(
        self, operation: int, endpoint: int = 0, timeout_ms: int = 0, payload: bytes = b""
    ) -> bytes:
        with self._lock:
            try:
                connection = self._connected()
                connection.settimeout(timeout_ms / 1000 + ANSWER_MARGIN_S)
                send_frame(connection, REQUEST.pack(operation, endpoint, timeout_ms) + payload)
                answer = receive_frame(connection)
                (status,) = ANSWER.unpack_from(answer)
            except (OSError, struct.error) as gone:
                self._drop()
                raise OSError(errno.ENODEV, f"no device at socket {self._path}: {gone}") from gone
        if status:
            raise OSError(status, os.strerror(status))
        return answer[ANSWER.size :]

    def _drop(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def describe(self) -> UsbIdentity:
        """See `UsbLink`."""
        payload = self._request(DESCRIBE)
        vendor, product = IDENTITY.unpack_from(payload)
        return UsbIdentity(vendor, product, payload[IDENTITY.size :].decode("ascii"))

    def claim(self) -> None:
        """See `UsbLink`."""
        self._request(CLAIM)

    def release(self) -> None:
        """See `UsbLink`; closes the connection."""
        with self._lock:
            if self._connection is not None:
                # Wait for the answer: the next to claim the device must find it free.
                with contextlib.suppress(OSError):
                    self._connection.settimeout(RELEASE_TIMEOUT_S)
                    send_frame(self._connection, REQUEST.pack(RELEASE, 0, 0))
                    receive_frame(self._connection)
            self._drop()

    def write(self, endpoint: int, report: bytes, timeout_ms: int) -> int:
        """See `UsbLink`."""
        self._request(WRITE, endpoint, timeout_ms, report)
        return len(report)

    def read(self, endpoint: int, size: int, timeout_ms: int) -> bytes:
        """See `UsbLink`."""
        return self._request(READ, endpoint, timeout_ms, SIZE.pack(size))

    def clear_halt(self, endpoint: int) -> None:
        """See `UsbLink`."""
        self._request(CLEAR_HALT, endpoint)

    def kernel_driver_active(self) -> bool:
        """See `UsbLink`."""
        return self._request(KERNEL_DRIVER) != b"\0"

    def detach_kernel_driver(self) -> None:
        """See `UsbLink`."""
        self._request(DETACH)

    def attach_kernel_driver(self) -> None:
        """See `UsbLink`."""
        self._request(ATTACH)


def _usb_error(error: OSError) -> usb.core.USBError:
    text = error.strerror or str(error)
    if error.errno == errno.ETIMEDOUT:
        return usb.core.USBTimeoutError(text, -7, errno.ETIMEDOUT)
    return usb.core.USBError(text, None, error.errno)


def _reraise(error: OSError) -> NoReturn:
    raise _usb_error(error) from error


_CONFIGURATION = SimpleNamespace(
    bLength=9, bDescriptorType=2, wTotalLength=41, bNumInterfaces=1, bConfigurationValue=1,
    iConfiguration=0, bmAttributes=0xC0, bMaxPower=50, extra_descriptors=[],
)  # fmt: skip
_INTERFACE = SimpleNamespace(
    bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0, bNumEndpoints=2,
    bInterfaceClass=3, bInterfaceSubClass=0, bInterfaceProtocol=0, iInterface=0,
    extra_descriptors=[],
)  # fmt: skip
_SERIAL_STRING = 3
_LANGUAGES = (4, 3, 0x09, 0x04)


def _string_descriptor(text: str) -> bytes:
    encoded = text.encode("utf-16-le")
    return bytes([2 + len(encoded), 3]) + encoded


class LinkBackend(usb.backend.IBackend):  # type: ignore[misc]
    """pyusb's side of one `UsbLink`: give it to ``usb.core.find(backend=...)``."""

    def __init__(self, link: UsbLink) -> None:
        self._link = link

    def enumerate_devices(self) -> Iterator[UsbLink]:
        """Yield the one device, or nothing when it is not there."""
        try:
            self._link.describe()
        except OSError:
            return
        yield self._link

    def get_device_descriptor(self, dev: UsbLink) -> SimpleNamespace:
        """Return the device descriptor: full speed, HID at interface level."""
        identity = dev.describe()
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x0110, bDeviceClass=0, bDeviceSubClass=0,
            bDeviceProtocol=0, bMaxPacketSize0=64, idVendor=identity.vendor,
            idProduct=identity.product, bcdDevice=0x0100, iManufacturer=0, iProduct=0,
            iSerialNumber=_SERIAL_STRING, bNumConfigurations=1, bus=1, address=1, port_number=1,
            port_numbers=(1,), speed=2,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: UsbLink, config: int) -> SimpleNamespace:
        """See `IBackend`: return the only configuration."""
        return (_CONFIGURATION,)[config]

    def get_interface_descriptor(
        self, dev: UsbLink, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """See `IBackend`: return the only interface."""
        return ((_INTERFACE,)[intf],)[alt]

    def get_endpoint_descriptor(
        self, dev: UsbLink, ep: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """See `IBackend`: return the report endpoint out (0) or in (1)."""
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=(ENDPOINT_OUT, ENDPOINT_IN)[ep],
            bmAttributes=3, wMaxPacketSize=64, bInterval=1, bRefresh=0, bSynchAddress=0,
            extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev: UsbLink) -> UsbLink:
        """Return the handle: the link itself."""
        return dev

    def close_device(self, dev_handle: UsbLink) -> None:
        """Let the link go."""
        dev_handle.release()

    def set_configuration(self, dev_handle: UsbLink, config_value: int) -> None:
        """See `IBackend`: nothing to do: there is one configuration."""

    def get_configuration(self, dev_handle: UsbLink) -> int:
        """Return the only configuration's number."""
        return int(_CONFIGURATION.bConfigurationValue)

    def claim_interface(self, dev_handle: UsbLink, intf: int) -> None:
        """See `IBackend`: take the interface."""
        try:
            dev_handle.claim()
        except OSError as error:
            _reraise(error)

    def release_interface(self, dev_handle: UsbLink, intf: int) -> None:
        """See `IBackend`: give the interface back."""
        dev_handle.release()

    def intr_write(
        self, dev_handle: UsbLink, ep: int, intf: int, data: array.array[int], timeout: int
    ) -> int:
        """See `IBackend`: send a report."""
        try:
            return dev_handle.write(ep, bytes(data), timeout)
        except OSError as error:
            _reraise(error)

    def intr_read(
        self, dev_handle: UsbLink, ep: int, intf: int, size: array.array[int], timeout: int
    ) -> int:
        """See `IBackend`: receive a report into ``size``, which is pyusb's buffer."""
        try:
            report = dev_handle.read(ep, len(size), timeout)
        except OSError as error:
            _reraise(error)
        size[: len(report)] = array.array("B", report)
        return len(report)

    def clear_halt(self, dev_handle: UsbLink, ep: int) -> None:
        """See `IBackend`: end a stall."""
        try:
            dev_handle.clear_halt(ep)
        except OSError as error:
            _reraise(error)

    def is_kernel_driver_active(self, dev_handle: UsbLink, intf: int) -> bool:
        """See `IBackend`: tell whether the kernel's driver holds the interface."""
        try:
            return dev_handle.kernel_driver_active()
        except OSError as error:
            _reraise(error)

    def detach_kernel_driver(self, dev_handle: UsbLink, intf: int) -> None:
        """See `IBackend`: take the interface from the kernel's driver."""
        try:
            dev_handle.detach_kernel_driver()
        except OSError as error:
            _reraise(error)

    def attach_kernel_driver(self, dev_handle: UsbLink, intf: int) -> None:
        """See `IBackend`: give the interface back to the kernel's driver."""
        try:
            dev_handle.attach_kernel_driver()
        except OSError as error:
            _reraise(error)

    def ctrl_transfer(
        self, dev_handle: UsbLink, bmRequestType: int, bRequest: int, wValue: int, wIndex: int,
        data: array.array[int], timeout: int,
    ) -> int:  # fmt: skip
        """See `IBackend`: answer the request for a string descriptor; stall on anything else."""
        strings = {0x0300: bytes(_LANGUAGES)}
        strings[0x0300 | _SERIAL_STRING] = _string_descriptor(dev_handle.describe().serial)
        if (bmRequestType, bRequest) != (0x80, 6) or wValue not in strings:
            raise usb.core.USBError(os.strerror(errno.EPIPE), -9, errno.EPIPE)
        answer = strings[wValue][: len(data)]
        data[: len(answer)] = array.array("B", answer)
        return len(answer)
