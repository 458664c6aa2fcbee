"""The clock that runs are timed by; tests give another one, which does not sleep. Scan numbers."""

from __future__ import annotations

import threading
import time
from typing import Protocol


class Clock(Protocol):
    """Tells the time and waits for it."""

    def now_ns(self) -> int:
        """Time since the epoch, nanoseconds."""
        ...

    def wait_until(self, deadline_ns: int, interrupt: threading.Event) -> bool:
        """Wait for a moment; True when ``interrupt`` was set before it.

        Parameters
        ----------
        deadline_ns : int
            Moment, nanoseconds since the epoch.
        interrupt : threading.Event
            Ends the wait early.
        """
        ...


class SystemClock:
    """The host's clock, `time.time_ns`."""

    def now_ns(self) -> int:
        """See `Clock`."""
        return time.time_ns()

    def wait_until(self, deadline_ns: int, interrupt: threading.Event) -> bool:
        """See `Clock`."""
        while (left_ns := deadline_ns - time.time_ns()) > 0:
            if interrupt.wait(left_ns * 1e-9):
                return True
        return interrupt.is_set()


def next_scan_id(last: int) -> int:
    """Return a scan number that no scan had, not even before a restart: seconds since 1970 or more.

    It fits the messages' 32 bits until 2106.
    """
    return max(last + 1, int(time.time()))
