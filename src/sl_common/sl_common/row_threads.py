"""Threads that share a stack's rows. The kernels release the interpreter, so plain threads do."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

#: Parts per thread: enough to even out uneven rows.
PARTS = 3


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(len(os.sched_getaffinity(0)), "sl-rows")


def share_rows(work: Callable[[int, int], None], rows: int) -> None:
    """Call ``work(first, last)`` for consecutive parts of ``range(rows)``, on every core.

    Returns when all are done; raises what any of them raised. Rows must not depend on each
    other, then the result does not depend on the number of cores.

    Parameters
    ----------
    work : callable
        Takes the first row of a part and the one behind its last.
    rows : int
        Number of rows.
    """
    parts = max(1, min(rows, PARTS * len(os.sched_getaffinity(0))))
    bounds = [rows * i // parts for i in range(parts + 1)]
    for done in [_pool().submit(work, a, b) for a, b in pairwise(bounds)]:
        done.result()
