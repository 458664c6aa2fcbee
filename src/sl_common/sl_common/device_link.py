"""Keep one device open: connect, notice its loss, try again with back-off. No ROS here."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from sl_common.errors import DeviceLost, SlError

FIRST_RETRY_S = 0.5
LONGEST_RETRY_S = 8.0


class Closable(Protocol):
    """A device that can be given back."""

    def close(self) -> None:
        """Give the device back; called once, also after it was lost."""
        ...


DeviceT = TypeVar("DeviceT", bound=Closable)


class DeviceLink(Generic[DeviceT]):
    """A device that may come and go.

    Parameters
    ----------
    name : str
        What messages call the device.
    connect : callable
        Opens the device and makes it ready; raises `SlError`, `OSError` or `ValueError` when it
        cannot.
    on_change : callable
        Called from the link's thread with one line whenever the state changes.
    """

    def __init__(
        self, name: str, connect: Callable[[], DeviceT], on_change: Callable[[str], None]
    ) -> None:
        self.name = name
        self.reason = "not connected yet"
        self.losses = 0
        self._connect = connect
        self._on_change = on_change
        self._device: DeviceT | None = None
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{name} link", daemon=True)

    def start(self) -> None:
        """Begin to connect; returns at once."""
        self._thread.start()

    @property
    def connected(self) -> bool:
        """Whether the device is open."""
        return self._device is not None

    @property
    def current(self) -> DeviceT | None:
        """The open device, or None: for threads that go on without one."""
        return self._device

    def device(self) -> DeviceT:
        """Return the open device.

        Raises
        ------
        DeviceLost
            When it is not connected, with the reason of the last attempt.
        """
        device = self._device
        if device is None:
            raise DeviceLost(f"the {self.name} is not connected: {self.reason}")
        return device

    def lost(self, device: DeviceT, error: Exception) -> None:
        """Say that the device failed; it is closed and opened again. Repeats are harmless.

        Parameters
        ----------
        device : object
            The device that failed; another one is left alone.
        error : Exception
            What it raised.
        """
        with self._lock:
            if self._device is not device:
                return
            self._device = None
            self.losses += 1
            self.reason = str(error)
        self._on_change(f"{self.name} lost: {error}")
        _close(device)
        self._wake.set()

    def close(self) -> None:
        """Stop trying and give the device back."""
        self._stop.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)
        with self._lock:
            device, self._device = self._device, None
        if device is not None:
            _close(device)

    def _run(self) -> None:
        delay_s = FIRST_RETRY_S
        while not self._stop.is_set():
            self._wake.clear()
            if self._device is None and not self._try():
                self._wake.wait(delay_s)
                delay_s = min(2 * delay_s, LONGEST_RETRY_S)
                continue
            delay_s = FIRST_RETRY_S
            self._wake.wait(1.0)

    def _try(self) -> bool:
        try:
            device = self._connect()
        except (SlError, OSError, ValueError) as error:
            if str(error) != self.reason:
                self._on_change(f"{self.name} not connected: {error}")
            self.reason = str(error)
            return False
        with self._lock:
            self._device, self.reason = device, ""
        self._on_change(f"{self.name} connected")
        return True


def _close(device: Closable) -> None:
    """Close a device that may be gone already; what it says about that is of no use to anyone."""
    try:
        device.close()
    except (SlError, OSError):
        return
