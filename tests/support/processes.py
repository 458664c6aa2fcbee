"""Whether processes that a test did not start itself have ended."""

from __future__ import annotations

from pathlib import Path

from support.patience import wait


def wait_until_ended(pid: int) -> None:
    """Wait for a process that may be nobody's child: signals and init's reaping take a moment.

    One that has ended and waits to be reaped (state Z) has ended; in a container that may last.
    """
    wait(lambda: _ended(pid), f"the end of process {pid}")


def _ended(pid: int) -> bool:
    try:
        # pid (name) state ...; the name may hold anything (proc(5))
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return True
    return state in "ZX"
