"""64-byte HID reports to and from a USB device, by pyusb.

The device string chooses the device: ``usb`` the only one, ``usb:SERIAL`` the one of that serial
number, ``socket:PATH`` the one that another process serves (`sl_projector.hid.usb_socket`).
"""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Callable
from typing import Any, NoReturn, Protocol

import usb.core
import usb.util

from sl_common.errors import ConfigError, DeviceError, DeviceLost, DeviceTimeout
from sl_projector.hid.usb_socket import ENDPOINT_IN, ENDPOINT_OUT, LinkBackend, SocketLink

REPORT_BYTES = 64
_GONE = {errno.ENODEV, errno.ENXIO, errno.ENOENT, errno.ESHUTDOWN, errno.EIO}


class HidTransport(Protocol):
    """Reports of 64 bytes each way; the driver is its only user."""

    def write(self, report: bytes, timeout_s: float) -> None:
        """Send one report. Raises DeviceTimeout, DeviceLost, DeviceError.

        Parameters
        ----------
        report : bytes
            At most 64 bytes.
        timeout_s : float
            Longest wait, seconds.
        """
        ...

    def read(self, timeout_s: float) -> bytes:
        """Wait for one report, which a faulty device may cut short. Raises as `write`."""
        ...

    def close(self) -> None:
        """Release the device; never fails."""
        ...


def _translate(error: usb.core.USBError, doing: str) -> NoReturn:
    """Turn pyusb's error into ours."""
    if isinstance(error, usb.core.USBTimeoutError) or error.errno == errno.ETIMEDOUT:
        raise DeviceTimeout(f"USB {doing}: no answer in time") from error
    if error.errno == errno.EPIPE:
        raise DeviceLost(
            f"USB {doing}: the endpoint stalled again; open the device anew"
        ) from error
    if error.errno == errno.EBUSY:
        raise DeviceLost(
            f"USB {doing}: another program or kernel driver has the device; close it first"
        ) from error
    if error.errno in (errno.EACCES, errno.EPERM):
        raise DeviceError(
            f"USB {doing}: no permission; install 60-sl-projector.rules (its head says how)"
        ) from error
    if error.errno in _GONE:
        raise DeviceLost(f"USB {doing}: the device is gone ({error})") from error
    raise DeviceError(f"USB {doing}: {error}") from error


class UsbHid:
    """A HID device through pyusb, its interface 0 claimed until `close`."""

    def __init__(self, device: Any) -> None:
        self._device = device
        self._kernel_driver_detached = False
        try:
            self._claim()
        except usb.core.USBError as error:
            self.close()
            _translate(error, "open")

    def _claim(self) -> None:
        # Backends of other systems have no kernel driver to detach.
        with contextlib.suppress(NotImplementedError):
            if self._device.is_kernel_driver_active(0):
                self._device.detach_kernel_driver(0)
                self._kernel_driver_detached = True
        self._device.set_configuration()
        usb.util.claim_interface(self._device, 0)

    def write(self, report: bytes, timeout_s: float) -> None:
        """See `HidTransport`."""
        timeout_ms = max(1, round(timeout_s * 1000))
        self._transfer(lambda: self._device.write(ENDPOINT_OUT, report, timeout_ms), ENDPOINT_OUT)

    def read(self, timeout_s: float) -> bytes:
        """See `HidTransport`."""
        timeout_ms = max(1, round(timeout_s * 1000))
        return bytes(
            self._transfer(
                lambda: self._device.read(ENDPOINT_IN, REPORT_BYTES, timeout_ms), ENDPOINT_IN
            )
        )

    def _transfer(self, transfer: Callable[[], Any], endpoint: int) -> Any:
        """Do a transfer; one that stalled carried nothing, so it is done again, once."""
        doing = "write" if endpoint == ENDPOINT_OUT else "read"
        try:
            return transfer()
        except usb.core.USBError as error:
            if error.errno != errno.EPIPE:
                _translate(error, doing)
        try:
            self._device.clear_halt(endpoint)
            return transfer()
        except usb.core.USBError as error:
            _translate(error, doing)

    def close(self) -> None:
        """See `HidTransport`."""
        with contextlib.suppress(usb.core.USBError, NotImplementedError):
            usb.util.release_interface(self._device, 0)
        if self._kernel_driver_detached:
            with contextlib.suppress(usb.core.USBError, NotImplementedError):
                self._device.attach_kernel_driver(0)
        usb.util.dispose_resources(self._device)


def serial_number(device: Any) -> str:
    """Return a USB device's serial number; empty when it has none or may not be opened."""
    try:
        return usb.util.get_string(device, device.iSerialNumber) or ""
    except (usb.core.USBError, ValueError):
        return ""


def open_usb(device: str, vendor: int, product: int, backend: Any = None) -> UsbHid:
    """Find and open a HID device.

    Parameters
    ----------
    device : str
        ``usb``, ``usb:SERIAL`` or ``socket:PATH``.
    vendor, product : int
        USB ids.
    backend : optional
        pyusb backend to use in place of libusb (tests, other systems).

    Raises
    ------
    ConfigError
        When the device string has another form.
    DeviceLost
        When there is no such device, or somebody else has it.
    DeviceError
        When it cannot be opened for another reason.
    """
    kind, _, name = device.partition(":")
    if kind not in ("usb", "socket") or (kind == "socket" and not name):
        raise ConfigError(f"device {device!r}; expected 'usb', 'usb:SERIAL' or 'socket:PATH'")
    if kind == "socket":
        backend = LinkBackend(SocketLink(name))
    wanted = name if kind == "usb" else ""
    match = {"custom_match": lambda one: serial_number(one) == wanted} if wanted else {}
    try:
        found = usb.core.find(idVendor=vendor, idProduct=product, backend=backend, **match)
    except usb.core.NoBackendError as error:
        raise DeviceError("pyusb finds no libusb-1.0; install it (libusb-1.0-0)") from error
    except usb.core.USBError as error:
        _translate(error, "search")
    if found is None:
        raise DeviceLost(f"no USB device {vendor:04x}:{product:04x} found at {device!r}")
    return UsbHid(found)
