"""The emulated DLPC900's sequencer: shows patterns by the clock and raises trigger edges."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sl_bench.dlpc.dlpc900_faults import Dlpc900Faults
from sl_common.clock import Clock

Mirrors = NDArray[np.bool_]
OnExposure = Callable[[Mirrors, int, int, float], None]


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


@dataclass(frozen=True)
class Slot:
    """One pattern of the sequence as the pattern table defines it."""

    image: int
    bit: int
    depth: int
    exposure_us: int
    dark_us: int
    wait_trigger: bool
    trigger_out_2: bool


@dataclass(frozen=True)
class Program:
    """What a start command starts.

    Parameters
    ----------
    slots : tuple of Slot
        The pattern table.
    exposures : int
        Patterns to show; 0 repeats the table for ever.
    first : int
        Exposure to begin with (after a pause).
    mirrors_of : callable
        Renders a slot.
    camera_output : int
        The trigger output that the camera is wired to: 1 is high through each exposure, and so
        stays high between patterns without dark time; 2 marks the start of each pattern.
    edge_delay_us : int
        Delay of that output's rising edge.
    trigger_in_delay_us : int
        From the edge on TRIG_IN_1 to the exposure.
    """

    slots: tuple[Slot, ...]
    exposures: int
    first: int
    mirrors_of: Callable[[Slot], Mirrors]
    camera_output: int
    edge_delay_us: int
    trigger_in_delay_us: int


class Sequencer:
    """Runs one program at a time on a thread of its own.

    Parameters
    ----------
    clock : Clock
        What exposures are scheduled by, from absolute deadlines.
    faults : Dlpc900Faults
        What goes wrong on request.
    dark : ndarray of bool, shape (rows, columns)
        The mirrors when nothing is shown.
    """

    def __init__(self, clock: Clock, faults: Dlpc900Faults, dark: Mirrors) -> None:
        self.on_exposure: OnExposure | None = None
        self.start_ns: list[int] = []
        self.aborted = False
        self._clock = clock
        self._faults = faults
        self._dark = dark
        self._shown = dark
        self._halt = threading.Event()
        self._edge = threading.Event()
        self._edges_ns: deque[int] = deque(maxlen=1)
        self._waiting = False
        self._thread: threading.Thread | None = None
        self._exposure = 0

    @property
    def running(self) -> bool:
        """True from start until the last dark time is over."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def exposure(self) -> int:
        """Number of the exposure shown now or last."""
        return self._exposure

    def mirrors_now(self) -> Mirrors:
        """Return the mirrors as they stand, shape (rows, columns), True is bright."""
        return self._shown

    def start(self, program: Program) -> None:
        """Begin to show a program; returns when it is running."""
        self.halt()
        self._halt, self.aborted = threading.Event(), False
        self._edge.clear()
        self.start_ns = []
        began_ns = self._clock.now_ns()
        self._thread = threading.Thread(
            target=self._show, args=(program, began_ns, self._halt), name="dlpc900", daemon=True
        )
        self._thread.start()

    def halt(self) -> None:
        """Stop showing; returns when the mirrors are dark."""
        self._halt.set()
        self._edge.set()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join()
        self._shown = self._dark

    def trigger_in(self, edge_ns: int | None = None) -> bool:
        """Raise an edge on TRIG_IN_1; False when no pattern waits for it (the edge is lost)."""
        if not self._waiting:
            return False
        self._edges_ns.append(self._clock.now_ns() if edge_ns is None else edge_ns)
        self._edge.set()
        return True

    def _show(self, program: Program, begin_ns: int, halt: threading.Event) -> None:
        exposure = program.first
        while not halt.is_set() and (not program.exposures or exposure < program.exposures):
            slot = program.slots[exposure % len(program.slots)]
            mirrors = program.mirrors_of(slot)
            if slot.wait_trigger:
                begin_ns = self._wait_for_edge(halt, begin_ns) + program.trigger_in_delay_us * 1000
            if self._clock.wait_until(begin_ns, halt):
                break
            if self._faults.abort_at == exposure:
                self._faults.abort_at, self.aborted = None, True
                break
            self._expose(program, slot, mirrors, exposure, begin_ns, halt)
            begin_ns += (slot.exposure_us + slot.dark_us) * 1000
            exposure += 1
        self._clock.wait_until(begin_ns, halt)
        self._shown = self._dark

    def _wait_for_edge(self, halt: threading.Event, not_before_ns: int) -> int:
        self._clock.wait_until(not_before_ns, halt)
        self._edge.clear()
        self._waiting = not halt.is_set()
        if self._waiting:
            self._edge.wait()
        self._waiting = False
        return self._edges_ns.pop() if self._edges_ns else self._clock.now_ns()

    def _expose(
        self, program: Program, slot: Slot, mirrors: Mirrors, exposure: int, begin_ns: int,
        halt: threading.Event,
    ) -> None:  # fmt: skip
        self._exposure = exposure
        self._shown = mirrors
        self.start_ns.append(begin_ns)
        if self.on_exposure is not None and self._raises_edge(program, slot, exposure):
            edge_ns = begin_ns + program.edge_delay_us * 1000
            for _ in range(self._faults.edges(exposure)):
                self.on_exposure(mirrors, exposure, edge_ns, slot.exposure_us * 1e-6)
        if slot.dark_us and not self._clock.wait_until(begin_ns + slot.exposure_us * 1000, halt):
            self._shown = self._dark

    @staticmethod
    def _raises_edge(program: Program, slot: Slot, exposure: int) -> bool:
        if program.camera_output == 2:
            return slot.trigger_out_2
        before = program.slots[(exposure - 1) % len(program.slots)]
        return exposure == program.first or before.dark_us > 0 or slot.wait_trigger
