"""Whether processes that a test did not start itself have ended."""

from __future__ import annotations

import time
from pathlib import Path


def wait_until_ended(pid: int, patience_s: float = 15.0) -> None:
    """Wait for a process that may be nobody's child: signals and init's reaping take a moment.

    One that has ended and waits to be reaped (state Z) has ended; in a container that may last.
    """
    end_s = time.monotonic() + patience_s
    while not _ended(pid):
        assert time.monotonic() < end_s, f"process {pid} still runs"
        time.sleep(0.01)


def _ended(pid: int) -> bool:
    try:
        # pid (name) state ...; the name may hold anything (proc(5))
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return True
    return state in "ZX"
