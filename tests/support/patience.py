"""How long tests wait: upper limits that grow with how busy this machine is.

A limit matters to a test that fails; one that passes goes on as soon as what it waits for is
there. So limits are generous, and never decide a verdict on a machine that is merely slow.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

PATIENCE_S = 30.0


def slowness() -> float:
    """How much longer work takes than on an idle machine: at least 1.

    Twice the tasks that want a core now, or wanted one in the last minute, over the cores
    (proc_loadavg(5)); twice, as this process may be the one that waits longest.
    """
    minute, _, _, tasks, _ = Path("/proc/loadavg").read_text().split()
    wanting = max(float(minute), float(tasks.partition("/")[0]))
    return max(1.0, 2.0 * wanting / (os.cpu_count() or 1))


def patience(seconds: float) -> float:
    """Longest wait, in seconds, for what takes less than ``seconds`` on an idle machine."""
    return seconds * slowness()


class Deadline:
    """A limit that is extended while the machine is busy."""

    def __init__(self, seconds: float = PATIENCE_S) -> None:
        self._began_s, self._seconds = time.monotonic(), seconds

    @property
    def is_over(self) -> bool:
        waited_s = time.monotonic() - self._began_s
        return waited_s > self._seconds and waited_s > patience(self._seconds)


def wait(predicate: Callable[[], Any], what: str, seconds: float = PATIENCE_S) -> Any:
    """Return what the predicate gives as soon as it is true; fail when it never is."""
    deadline = Deadline(seconds)
    while not (found := predicate()):
        if deadline.is_over:
            pytest.fail(f"waited {seconds:g} s, and longer as the machine is busy, for {what}")
        time.sleep(0.005)
    return found
