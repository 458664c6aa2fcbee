"""What an emulated DLPC does wrong on request."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field


@dataclass
class DlpcFaults:
    """Set a field to make it happen; counts run down to nothing as they happen.

    Unplugging, plugging in and power cycles are methods of `EmulatedUsb`.

    Parameters
    ----------
    refuse, refuse_code : int
        Number of next commands (other than reading the error) that are refused, and the error
        code that they give.
    lose_replies, late_replies, stale_replies, short_replies, empty_replies : int
        Number of next replies that are never sent, come ``late_s`` late, are preceded by one with
        an old sequence byte, are cut to 3 bytes, come without their data.
    late_s : float
        How late, seconds.
    stalls : int
        Number of next transfers that stall (EPIPE).
    kernel_driver : bool
        The kernel's driver holds the interface (claiming gives EBUSY until it is detached).
    taken : bool
        Another program holds the interface (claiming gives EBUSY).
    abort_at : int or None
        The sequencer aborts in place of this exposure.
    lost_edges, doubled_edges : set of int
        Exposures of the next run whose trigger edge is missing, or comes twice.
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
        for exposures, count in ((self.lost_edges, 0), (self.doubled_edges, 2)):
            if exposure in exposures:
                exposures.discard(exposure)
                return count
        return 1
