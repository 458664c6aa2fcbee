"""A pseudo-terminal that stands in for a serial cable: unplug it, plug it in, make it noisy.

Knows no protocol. The emulators of serial devices share it.
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
from collections.abc import Callable
from pathlib import Path

TICK_S = 0.002


class PtyPort:
    """Runs a device behind a pseudo-terminal, in its own thread.

    Parameters
    ----------
    exchange : callable
        ``exchange(received) -> to_send``, both bytes; called at least every 2 ms and whenever
        bytes arrive. It is the device.
    seed : int
        Of the noise.
    """

    def __init__(self, exchange: Callable[[bytes], bytes], seed: int = 0) -> None:
        self._exchange = exchange
        self._random = random.Random(seed)
        self._lock = threading.Lock()
        self._master = self._slave = -1
        self._links: list[Path] = []
        self._noise_bytes = 0
        self._running = False
        self._thread = threading.Thread(target=self._loop, name="pty device", daemon=True)

    @property
    def name(self) -> str:
        """Path of the terminal that a driver opens; changes when the cable is plugged anew."""
        return os.ttyname(self._slave)

    def start(self) -> None:
        """Plug in and run."""
        self.plug()
        self._running = True
        self._thread.start()

    def close(self) -> None:
        """Stop the device and take the links away."""
        self._running = False
        if self._thread.is_alive():
            self._thread.join()
        self.unplug()

    def link(self, path: str | Path) -> None:
        """Keep a symbolic link to the terminal: a name that outlives unplugging."""
        self._links.append(Path(path))
        self._relink()

    def plug(self) -> None:
        """Connect the cable: a new terminal, and the links lead to it."""
        with self._lock:
            if self._master >= 0:
                return
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave, termios.TCSANOW)
            os.set_blocking(self._master, False)
        self._relink()

    def unplug(self) -> None:
        """Pull the cable: whoever has the port open gets an error, the links are gone."""
        with self._lock:
            if self._master < 0:
                return
            for link in self._links:
                link.unlink(missing_ok=True)
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1

    def noise(self, count: int) -> None:
        """Put so many random bytes in front of the device's next answer."""
        self._noise_bytes += count

    def _relink(self) -> None:
        if self._slave < 0:
            return
        for link in self._links:
            beside = link.with_name(link.name + ".new")
            beside.unlink(missing_ok=True)
            beside.symlink_to(self.name)
            beside.replace(link)

    def _loop(self) -> None:
        while self._running:
            self._send(self._exchange(self._receive()))

    def _receive(self) -> bytes:
        with self._lock:
            master = self._master
            if master >= 0:
                # the lock keeps the descriptor ours: a closed one may be somebody else's by now
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
            # no line ends and no ASCII: noise, not another answer
            noise = bytes(self._random.randrange(0x80, 0x100) for _ in range(self._noise_bytes))
            data, self._noise_bytes = noise + data, 0
        with self._lock, contextlib.suppress(OSError):
            if self._master >= 0:
                os.write(self._master, data)
