"""From decoded lines to the organised cloud: depth-step screening and triangulation."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sl_reconstruct.edges import PRESENT
from sl_reconstruct.geometry import Geometry, Rays, camera_rays, solve_points, solve_slopes
from sl_reconstruct.reasons import Reason

STEP = int(Reason.STEP)
GEOMETRY = int(Reason.GEOMETRY)

#: Boundaries over which a neighbour may be looked for.
NEIGHBOURS = 8


class Output(NamedTuple):
    """Where a cloud is written: (H, K, 5) values, (H, K) columns and reasons."""

    values: NDArray[np.float32]
    u_px: NDArray[np.float32]
    reason: NDArray[np.uint8]


@njit(cache=True, nogil=True, error_model="numpy")
def _off(u: Any, before: Any, after: Any, limit: Any, bad: Any) -> None:
    """Mark where ``u`` is not where two neighbours lead; before, after: (near, far)."""
    for k in range(u.size):
        d = u[k] - (2 * before[0][k] - before[1][k])
        e = u[k] - (2 * after[0][k] - after[1][k])
        bad[k] |= np.uint8(abs(d) > limit) | np.uint8(abs(e) > limit)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _side(u: Any, k: int, step: int) -> tuple[float, bool]:
    """Where the next two present boundaries on a side lead, and whether there are two."""
    first = -1
    for i in range(1, NEIGHBOURS + 1):
        j = k + step * i
        if j < 0 or j >= u.size:
            break
        if u[j] == u[j]:
            if first < 0:
                first = j
            else:
                return u[first] + (u[first] - u[j]) / (first - j) * (k - first), True
    return 0.0, False


@njit(cache=True, nogil=True, error_model="numpy")
def _lonely(u: Any, limit: float, bad: Any) -> None:
    """Check boundaries without near neighbours against farther ones; alone, they are refused."""
    n = u.size
    for k in range(n):
        if bad[k] or not u[k] == u[k]:
            continue
        left = k >= 2 and u[k - 1] + u[k - 2] == u[k - 1] + u[k - 2]
        right = k < n - 2 and u[k + 1] + u[k + 2] == u[k + 1] + u[k + 2]
        if left and right:
            continue
        a, has_a = _side(u, k, -1)
        b, has_b = _side(u, k, 1)
        off = (has_a and abs(u[k] - a) > limit) or (has_b and abs(u[k] - b) > limit)
        if off or not (has_a or has_b):
            bad[k] = 1


@njit(cache=True, nogil=True, error_model="numpy")
def find_steps(u_px: Any, y: int, limit: float, bad: Any) -> None:
    """Mark boundaries of row y that are not where their neighbours in row and column lead."""
    u = u_px[y]
    n, rows = u.size, u_px.shape[0]
    limit32 = np.float32(limit)
    for k in range(n):
        bad[k] = 0
    if n > 4:
        mid = u[2 : n - 2]
        _off(mid, (u[1 : n - 3], u[: n - 4]), (u[3 : n - 1], u[4:]), limit32, bad[2 : n - 2])
    if 2 <= y < rows - 2:
        _off(u, (u_px[y - 1], u_px[y - 2]), (u_px[y + 1], u_px[y + 2]), limit32, bad)
    _lonely(u, limit, bad)


@njit(cache=True, nogil=True, error_model="numpy")
def _row(
    g: Geometry, y: int, columns: Any, lines: Any, bad: Any, r: Rays, out: Output
) -> None:
    u, reason, values = out.u_px[y], out.reason[y], out.values[y]
    found, sigma_px, level = lines.reason[y], lines.sigma_px[y], lines.level_dn[y]
    for k in range(u.size):
        u[k] = np.float32(np.nan) if bad[k] else lines.u_px[y, k]
        reason[k] = np.uint8(STEP) if bad[k] and found[k] == PRESENT else found[k]
    camera_rays(g, u, float(y), r)
    solve_slopes(g, columns, r)
    solve_points(g, r)
    nan = np.float32(np.nan)
    for k in range(u.size):
        if reason[k] == PRESENT and r.depth[k] > 0:
            values[k, 0] = r.px[k]
            values[k, 1] = r.py[k]
            values[k, 2] = r.pz[k]
            values[k, 3] = level[k]
            values[k, 4] = abs(r.dz[k]) * sigma_px[k]
            continue
        if reason[k] == PRESENT:
            reason[k] = GEOMETRY
            u[k] = nan
        for i in range(5):
            values[k, i] = nan


@njit(cache=True, nogil=True, error_model="numpy")
def triangulate_rows(
    first: int, last: int, g: Geometry, columns: Any, lines: Any, limit: float, out: Output,
    r: Rays, bad: Any,
) -> None:  # fmt: skip
    """Screen and triangulate rows first to last. columns: observed DMD column of each boundary."""
    for y in range(first, last):
        find_steps(lines.u_px, y, limit, bad)
        _row(g, y, columns, lines, bad, r, out)
