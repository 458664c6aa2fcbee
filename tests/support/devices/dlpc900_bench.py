"""An emulated DLPC900 behind pyusb, with the real driver in front; for tests."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field

import numpy as np
import usb.core

from sl_bench.dlpc.dlpc900_emulator import Dlpc900Emulator
from sl_bench.dlpc.usb_server import EmulatedUsb
from sl_projector.dlpc.dlpc900_driver import Dlpc900, Dlpc900Settings
from sl_projector.dlpc.dmd import Timing
from sl_projector.hid.usb_socket import LinkBackend

REPLY_TIMEOUT_S = 0.3
FAST = Timing(1e-3)
START = 0x1A24


class VirtualClock:
    """A clock that does not sleep: waiting moves its time on at once."""

    def __init__(self, start_ns: int = 1_700_000_000_000_000_000) -> None:
        self._now_ns = start_ns
        self._lock = threading.Lock()

    def now_ns(self) -> int:
        """Return the virtual time."""
        return self._now_ns

    def wait_until(self, deadline_ns: int, interrupt: threading.Event) -> bool:
        """Move the time to ``deadline_ns``, unless ``interrupt`` is set."""
        time.sleep(0)  # let other threads run: an endless sequence must not starve them
        if interrupt.is_set():
            return True
        with self._lock:
            self._now_ns = max(self._now_ns, deadline_ns)
        return False


@dataclass
class Recorder:
    """A device in front of the device: remembers every report that the host sends."""

    device: Dlpc900Emulator
    reports: list[bytes] = field(default_factory=list)

    def __getattr__(self, name):
        return getattr(self.device, name)

    def receive(self, report):
        self.reports.append(report)
        return self.device.receive(report)

    def messages(self):
        """Return (flags, command, data) of each message, put together from the reports."""
        found, at = [], 0
        while at < len(self.reports):
            length = int.from_bytes(self.reports[at][2:4], "little")
            count = -(-(4 + length) // 64)
            whole = b"".join(self.reports[at : at + count])[: 4 + length]
            found.append((whole[0], int.from_bytes(whole[4:6], "little"), whole[6:]))
            at += count
        return found


class Bench:
    """Emulator, bus and driver; exposures seen by the camera's trigger line in ``edges``."""

    def __init__(self, model="DLP5500", clock=None, **settings):
        self.clock = clock or VirtualClock()
        self.emulator = Dlpc900Emulator(model, self.clock, self._edge, strict=True)
        self.recorder = Recorder(self.emulator)
        self.bus = EmulatedUsb(self.recorder)
        self.edges = []
        settings.setdefault("reply_timeout_s", REPLY_TIMEOUT_S)
        self.settings = Dlpc900Settings(**settings)
        self.driver = self.make_driver()

    @property
    def faults(self):
        return self.emulator.faults

    def make_driver(self, model=None, device="usb"):
        return Dlpc900(
            device,
            model or self.emulator.model,
            self.settings,
            backend=LinkBackend(self.bus.connect()),
            clock=self.clock,
        )

    def run_and_wait(self, sequence, timing=FAST, repeats=1):
        """Load and run a sequence to its end; exposures are in ``edges`` afterwards."""
        self.edges.clear()
        self.driver.load(sequence, timing)
        info = self.driver.run(timing, repeats)
        # Waiting moves the virtual clock, so it may be far ahead of an emulator that is busy.
        self.driver.wait(timeout_s=1e6)
        return info

    def assert_shown(self, sequence):
        """Each pattern was shown once, in order, mirror for mirror."""
        assert [index for _, index, _, _ in self.edges] == list(range(len(sequence)))
        for mirrors, index, _, _ in self.edges:
            np.testing.assert_array_equal(mirrors, sequence.frame(index) == 255)

    def _edge(self, mirrors, index, start_ns, exposure_s):
        self.edges.append((mirrors, index, start_ns, exposure_s))

    def find(self):
        """Return the device as a foreign host program finds it."""
        backend = LinkBackend(self.bus.connect())
        return usb.core.find(idVendor=0x0451, idProduct=0xC900, backend=backend)


def open_bench():
    """An emulated DLP5500 with its driver open."""
    made = Bench()
    made.driver.open()
    yield made
    made.driver.close()
