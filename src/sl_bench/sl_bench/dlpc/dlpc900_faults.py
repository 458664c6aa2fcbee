"""What the emulated DLPC900 does wrong on request."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field


@dataclass
class Dlpc900Faults:
    """Set a field to make it happen; counts run down to nothing as they happen.

    Unplugging, plugging in and power cycles are methods of `Dlpc900Usb`.

    Parameters
    ----------
    refuse : int
        So many next commands (other than reading the error) are refused.
    refuse_code : int
        The error code that these give.
    lose_replies : int
        So many next replies are never sent.
    late_replies : int
        So many next replies come ``late_s`` late.
    late_s : float
        How late, seconds.
    stale_replies : int
        So many next replies are preceded by one with an old sequence byte.
    short_replies : int
        So many next replies are cut to 3 bytes.
    empty_replies : int
        So many next replies come without their data.
    stalls : int
        So many next transfers stall (EPIPE).
    kernel_driver : bool
        The kernel's driver holds the interface (claiming gives EBUSY until it is detached).
    taken : bool
        Another program holds the interface (claiming gives EBUSY).
    abort_at : int or None
        The sequencer aborts in place of this exposure.
    lost_edges : set of int
        Exposures of the next run whose trigger edge is missing.
    doubled_edges : set of int
        Exposures of the next run with two trigger edges.
    """

    refuse: int = 0
    refuse_code: int = 2
    lose_replies: int = 0
    late_replies: int = 0
    late_s: float = 0.1
    stale_replies: int = 0
    short_replies: int = 0
    empty_replies: int = 0
    stalls: int = 0
    kernel_driver: bool = False
    taken: bool = False
    abort_at: int | None = None
    lost_edges: set[int] = field(default_factory=set)
    doubled_edges: set[int] = field(default_factory=set)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def take(self, name: str) -> bool:
        """Use up one of a counted fault; True when there was one."""
        with self._lock:
            left = int(getattr(self, name))
            if left > 0:
                setattr(self, name, left - 1)
            return left > 0

    def edges(self, exposure: int) -> int:
        """Return how many trigger edges an exposure gives: 1 when all is well."""
        if exposure in self.lost_edges:
            self.lost_edges.discard(exposure)
            return 0
        if exposure in self.doubled_edges:
            self.doubled_edges.discard(exposure)
            return 2
        return 1
