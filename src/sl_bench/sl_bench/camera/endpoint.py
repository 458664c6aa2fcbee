"""What the camera's endpoints share: serving in a thread, and being unplugged for a while."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from sl_camera.drivers import socket_protocol as wire

Execute = Callable[[dict[str, Any]], dict[str, Any] | None]


class Endpoint(ABC):
    """Carries commands to the camera and frames from it.

    Parameters
    ----------
    execute : callable
        ``execute(command) -> reply``, both dictionaries (`sl_camera.drivers.socket_protocol`);
        None where the command has no reply. An `SlError` is a refusal.
    name : str
        Of the thread.
    """

    def __init__(self, execute: Execute, name: str) -> None:
        self._execute = execute
        self._stop = threading.Event()
        self._gone_until = 0.0
        self._thread = threading.Thread(target=self._loop, name=name, daemon=True)

    def start(self) -> None:
        """Serve from here on; raises OSError when the address is taken."""
        self._open()
        self._thread.start()

    def close(self) -> None:
        """Drop the host and serve no more."""
        self._stop.set()
        self._drop_host()
        if self._thread.ident is not None:  # started
            self._thread.join()
            self._shut()

    def disconnect(self, seconds: float) -> None:
        """Be gone for a while, as if unplugged."""
        self._gone_until = time.monotonic() + seconds
        self._drop_host()

    @property
    def _gone(self) -> bool:
        return time.monotonic() < self._gone_until

    @abstractmethod
    def send(self, header: wire.Header, pixels: NDArray[Any]) -> None:
        """Deliver one frame to the host, if there is one.

        Parameters
        ----------
        header : Header
            What it is; a payload below the full one is an incomplete frame.
        pixels : ndarray, (H, W) uint8 or uint16
            The whole image.
        """

    @abstractmethod
    def _open(self) -> None:
        """Open the sockets."""

    @abstractmethod
    def _loop(self) -> None:
        """Serve until `_stop` is set."""

    @abstractmethod
    def _drop_host(self) -> None:
        """Disconnect the host, if there is one."""

    @abstractmethod
    def _shut(self) -> None:
        """Close the sockets."""
