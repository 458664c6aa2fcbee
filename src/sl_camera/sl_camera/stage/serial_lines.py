"""Lines over a serial port: opens it, reads it in a thread, tells when it is gone.

Knows pyserial and nothing about any device's protocol.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable

import serial

from sl_common.errors import DeviceLost, DeviceTimeout

MAX_LINE_BYTES = 4096


class SerialLines:
    """A serial port (8N1) that delivers whole lines to a callback, from its own thread.

    Parameters
    ----------
    port : str
        Device path or any pyserial URL.
    baud : int
        Bits per second.
    on_line : callable
        Called with each line received, without its end and surrounding blanks; empty lines are
        left out, bytes that are not ASCII become U+FFFD.
    on_lost : callable
        Called once, with the reason, when the port vanishes while it is open.
    """

    def __init__(
        self, port: str, baud: int, on_line: Callable[[str], None], on_lost: Callable[[str], None]
    ) -> None:
        self.port = port
        self._on_line, self._on_lost = on_line, on_lost
        self._write_lock = threading.Lock()
        self._closing = False
        try:
            # exclusive: a second program that opens the same port would eat our replies
            self._serial = serial.serial_for_url(
                port, baud, timeout=0.2, write_timeout=2.0, exclusive=True
            )
        except (OSError, ValueError) as error:
            raise DeviceLost(f"cannot open the serial port {port}: {error}") from error
        self._thread = threading.Thread(target=self._read_loop, name=f"serial {port}", daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> None:
        """Send bytes as they are.

        Raises
        ------
        DeviceLost
            The port is gone.
        DeviceTimeout
            The port takes no bytes.
        """
        try:
            with self._write_lock:
                self._serial.write(data)
        except serial.SerialTimeoutException as error:
            raise DeviceTimeout(f"{self.port} takes no bytes") from error
        except (OSError, TypeError, ValueError) as error:
            raise DeviceLost(f"{self.port} is gone: {error}") from error

    def close(self) -> None:
        """Close the port and end the thread; never raises."""
        self._closing = True
        with contextlib.suppress(OSError, AttributeError):
            self._serial.cancel_read()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=2.0)
        with contextlib.suppress(OSError):
            self._serial.close()

    def _read_loop(self) -> None:
        pending = b""
        while not self._closing:
            try:
                chunk = self._serial.read(max(1, self._serial.in_waiting))
            except (OSError, TypeError, ValueError) as error:
                if not self._closing:
                    self._on_lost(f"{self.port} is gone: {error}")
                return
            *lines, pending = (pending + chunk).split(b"\n")
            pending = pending[-MAX_LINE_BYTES:]
            for line in lines:
                text = line.decode("ascii", "replace").strip()
                if text:
                    self._on_line(text)
