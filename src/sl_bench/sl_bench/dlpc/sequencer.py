"""An emulated DLPC's sequencer: shows patterns by the clock and raises trigger edges."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sl_bench.dlpc.dlpc_faults import DlpcFaults
from sl_common.clock import Clock

Mirrors = NDArray[np.bool_]
OnExposure = Callable[[Mirrors, int, int, float], None]


@dataclass(frozen=True)
class Slot:
    """One pattern of the sequence as the pattern table defines it."""

    image: int
    #: First bit plane of the image that is shown, and how many.
    bit: int
    depth: int
    exposure_us: int
    dark_us: int
    #: Begin at an edge of TRIG_IN_1.
    wait_trigger: bool
    #: Raise an edge of the second trigger output.
    trigger_out_2: bool = True


@dataclass(frozen=True)
class Program:
    """What a start command starts."""

    slots: tuple[Slot, ...]
    #: Patterns to show; 0 repeats the table until it is stopped.
    exposures: int
    #: Exposure to begin with, after a pause.
    first: int
    #: Renders a slot.
    mirrors_of: Callable[[Slot], Mirrors]
    #: The trigger output that the camera is wired to: 1 is high through each exposure, and so
    #: stays high between patterns without dark time; 2 marks the start of each pattern.
    camera_output: int
    #: Delay of that output's rising edge.
    edge_delay_us: int
    #: From the edge on TRIG_IN_1 to the exposure.
    trigger_in_delay_us: int
    #: Ends the program when it is set.
    halt: threading.Event = field(default_factory=threading.Event)


class Sequencer:
    """Runs one program at a time on a thread of its own.

    Parameters
    ----------
    clock : Clock
        What exposures are scheduled by, from absolute deadlines.
    faults : DlpcFaults
        What goes wrong on request.
    dark : ndarray of bool, (rows, columns)
        The mirrors when nothing is shown.
    on_exposure : callable, optional
        Called on the sequencer's thread at each trigger edge: mirrors (bool, (rows, columns),
        read-only), number of the exposure in the run, time of the edge (host clock, ns), exposure
        in seconds.

    Attributes
    ----------
    start_ns : list of int
        Start of each exposure of the last run, host clock, ns.
    exposure : int
        Number of the exposure shown now or last.
    aborted : bool
        Whether the last run was aborted.
    """

    def __init__(
        self, clock: Clock, faults: DlpcFaults, dark: Mirrors, on_exposure: OnExposure | None = None
    ) -> None:
        self.on_exposure = on_exposure
        self.exposure = 0
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

    @property
    def running(self) -> bool:
        """True from start until the last dark time is over."""
        return self._thread is not None and self._thread.is_alive()

    def mirrors_now(self) -> Mirrors:
        """Return the mirrors as they stand, shape (rows, columns), True is bright."""
        return self._shown

    def start(self, program: Program) -> None:
        """Begin to show a program; returns when it is running."""
        self.halt()
        self._halt, self.aborted = program.halt, False
        self._edge.clear()
        self.start_ns = []
        began_ns = self._clock.now_ns()
        self._thread = threading.Thread(
            target=self._show, args=(program, began_ns), name="sequencer", daemon=True
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

    def _show(self, program: Program, begin_ns: int) -> None:
        exposure, halt = program.first, program.halt
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
            self.exposure, self._shown = exposure, mirrors
            self._expose(program, slot, begin_ns)
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

    def _expose(self, program: Program, slot: Slot, begin_ns: int) -> None:
        self.start_ns.append(begin_ns)
        if self.on_exposure is not None and self._raises_edge(program, slot):
            edge_ns = begin_ns + program.edge_delay_us * 1000
            for _ in range(self._faults.edges(self.exposure)):
                self.on_exposure(self._shown, self.exposure, edge_ns, slot.exposure_us * 1e-6)
        exposed_ns = begin_ns + slot.exposure_us * 1000
        if slot.dark_us and not self._clock.wait_until(exposed_ns, program.halt):
            self._shown = self._dark

    def _raises_edge(self, program: Program, slot: Slot) -> bool:
        if program.camera_output == 2:
            return slot.trigger_out_2
        before = program.slots[(self.exposure - 1) % len(program.slots)]
        return self.exposure == program.first or before.dark_us > 0 or slot.wait_trigger
