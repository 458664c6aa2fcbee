"""A device behind a pseudo-terminal that stands in for a serial cable.

Knows no protocol: what the GRBL and the Zaber emulator share, with the faults of cable and port.
"""

from __future__ import annotations

import contextlib
import os
import random
import select
import termios
import threading
import time
import tty
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Self

TICK_S = 0.002


class SerialEmulator(ABC):
    """Runs a device behind a pseudo-terminal, in a thread of its own; a context manager.

    Parameters
    ----------
    seed : int
        Of the noise on the line.
    """

    def __init__(self, seed: int = 0) -> None:
        self._random = random.Random(seed)
        self._cable = threading.Lock()
        self._master = self._slave = -1
        self._links: list[Path] = []
        self._noise_bytes = self._replies_to_lose = 0
        self._running = False
        self._thread = threading.Thread(target=self._loop, name="serial device", daemon=True)

    @abstractmethod
    def _exchange(self, received: bytes) -> bytes:
        """Take what the host sent, return what it is sent; called at least every 2 ms."""

    def start(self) -> Self:
        """Plug in and run; from now on ``port`` can be opened."""
        self.reconnect()
        self._running = True
        self._thread.start()
        return self

    def close(self) -> None:
        """Stop the device and remove the links."""
        self._running = False
        if self._thread.is_alive():
            self._thread.join()
        self.disconnect()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def port(self) -> str:
        """Path of the terminal that a driver opens; changes when the cable is plugged in again."""
        return os.ttyname(self._slave)

    def link(self, path: str | Path) -> None:
        """Keep a symbolic link to the terminal: a name that outlives unplugging."""
        self._links.append(Path(path))
        self._relink()

    # -- faults on request --------------------------------------------------------------------

    def reconnect(self) -> None:
        """Plug in the cable: a new terminal, and the links lead to it."""
        with self._cable:
            if self._master >= 0:
                return
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave, termios.TCSANOW)
            os.set_blocking(self._master, False)
        self._relink()

    def disconnect(self) -> None:
        """Pull the cable: a host with the port open gets an error, the links are gone."""
        with self._cable:
            if self._master < 0:
                return
            for link in self._links:
                link.unlink(missing_ok=True)
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1

    def noise(self, count: int = 8) -> None:
        """Put ``count`` random bytes in front of the next answer."""
        self._noise_bytes += count

    def lose_replies(self, count: int = 1) -> None:
        """Lose the next ``count`` replies."""
        self._replies_to_lose = count

    def _loses_reply(self) -> bool:
        """Whether this reply gets lost."""
        lost = self._replies_to_lose > 0
        self._replies_to_lose -= lost
        return lost

    # -- the cable ----------------------------------------------------------------------------

    def _relink(self) -> None:
        if self._slave < 0:
            return
        for link in self._links:
            beside = link.with_name(link.name + ".new")
            beside.unlink(missing_ok=True)
            beside.symlink_to(self.port)
            beside.replace(link)

    def _loop(self) -> None:
        while self._running:
            self._send(self._exchange(self._receive()))

    def _receive(self) -> bytes:
        with self._cable:
            master = self._master
            if master >= 0:
                # The lock keeps the descriptor ours: a closed one may belong to another by now.
                ready, _, _ = select.select([master], [], [], TICK_S)
                if not ready:
                    return b""
                with contextlib.suppress(OSError):
                    return os.read(master, 4096)
        time.sleep(TICK_S)
        return b""

    def _send(self, data: bytes) -> None:
        if not data:
            return
        if self._noise_bytes:
            # No line ends and no ASCII: noise, not another answer.
            noise = bytes(self._random.randrange(0x80, 0x100) for _ in range(self._noise_bytes))
            data, self._noise_bytes = noise + data, 0
        with self._cable, contextlib.suppress(OSError):
            if self._master >= 0:
                os.write(self._master, data)
