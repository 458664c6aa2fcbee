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

#: A boundary may move from row to row by so many times the jump that makes a step.
ROW_JUMP = 2.0
#: Boundaries over which a neighbour may be looked for.
NEIGHBOURS = 8


class Output(NamedTuple):
    """Where a cloud is written: (H, K, 5) values, (H, K) columns and reasons."""

    values: NDArray[np.float32]
    u_px: NDArray[np.float32]
    reason: NDArray[np.uint8]


class Screen(NamedTuple):
    """When neighbours say that a depth step lies under an edge.

    ``jump_px``: an edge may lie so far from where two neighbours lead, camera pixels.
    ``near_px``: signed least distance to the next boundary, ``wide_px`` of those on both sides.
    """

    jump_px: float
    near_px: float
    wide_px: float


@njit(cache=True, nogil=True, error_model="numpy")
def _off(u: Any, before: Any, after: Any, limit: Any, bad: Any) -> None:
    """Mark where ``u`` is not where two neighbours lead; before, after: (near, far)."""
    for k in range(u.size):
        d = u[k] - (2 * before[0][k] - before[1][k])
        e = u[k] - (2 * after[0][k] - after[1][k])
        bad[k] |= np.uint8(abs(d) > limit) | np.uint8(abs(e) > limit)


@njit(cache=True, nogil=True, error_model="numpy")
def _squeezed(u: Any, left: Any, right: Any, s: Screen, bad: Any) -> None:
    """Mark where boundaries crowd: a wall that the camera does not see, blurred.

    Mirrored images are compared with their signs exchanged.
    """
    sign = np.float32(1 if s.near_px > 0 else -1)
    near, wide = np.float32(abs(s.near_px)), np.float32(abs(s.wide_px))
    for k in range(u.size):
        a, b = sign * (u[k] - left[k]), sign * (right[k] - u[k])
        bad[k] |= np.uint8(a < near) | np.uint8(b < near) | np.uint8(a + b < wide)


@njit(cache=True, nogil=True, error_model="numpy")
def _apart(u: Any, other: Any, limit: float, bad: Any) -> None:
    """Mark where another row has the boundary elsewhere."""
    far = np.float32(limit)
    for k in range(u.size):
        bad[k] |= np.uint8(abs(other[k] - u[k]) > far)


@njit(cache=True, nogil=True, error_model="numpy")
def _borders(u: Any, next_row: Any, limit: float, bad: Any) -> None:
    """Mark where the next row holds nothing nearby, or another surface.

    Such a row runs along a wall or a shadow: which side of it a pixel sees is not certain.
    """
    far = np.float32(limit)
    for k in range(1, u.size - 1):
        a, b, c = next_row[k - 1], next_row[k], next_row[k + 1]
        nothing = (a != a) & (b != b) & (c != c)
        bad[k] |= np.uint8(nothing) | np.uint8(abs(b - u[k]) > far)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _side(u: Any, k: int, step: int) -> tuple[float, float, int]:
    """Where the next two present boundaries on a side lead, distance per boundary, their number."""
    first = -1
    pace = 0.0
    for i in range(1, NEIGHBOURS + 1):
        j = k + step * i
        if j < 0 or j >= u.size:
            break
        if u[j] == u[j]:
            if first >= 0:
                return u[first] + (u[first] - u[j]) / (first - j) * (k - first), pace, 2
            first = j
            pace = (u[j] - u[k]) / (j - k)
    return 0.0, pace, 1 if first >= 0 else 0


@njit(cache=True, nogil=True, error_model="numpy")
def _lonely(u: Any, s: Screen, bad: Any) -> None:
    """Check boundaries without near neighbours against farther ones; alone, they are refused."""
    n = u.size
    sign, near = 1.0 if s.near_px > 0 else -1.0, abs(s.near_px)
    for k in range(n):
        if bad[k] or np.isnan(u[k]):
            continue
        left = k >= 2 and u[k - 1] + u[k - 2] == u[k - 1] + u[k - 2]
        right = k < n - 2 and u[k + 1] + u[k + 2] == u[k + 1] + u[k + 2]
        if left and right:
            continue
        a, pace_a, has_a = _side(u, k, -1)
        b, pace_b, has_b = _side(u, k, 1)
        off = (has_a == 2 and abs(u[k] - a) > s.jump_px) or (
            has_b == 2 and abs(u[k] - b) > s.jump_px
        )
        crowd = (has_a and sign * pace_a < near) or (has_b and sign * pace_b < near)
        near_by = 0
        for j in range(max(0, k - 2), min(n, k + 3)):
            near_by += u[j] == u[j]
        if off or crowd or has_a + has_b < 2 or near_by < 2:
            bad[k] = 1


@njit(cache=True, nogil=True, error_model="numpy")
def find_steps(u_px: Any, y: int, s: Screen, bad: Any) -> None:
    """Mark boundaries of row y that are not where their neighbours in row and column lead."""
    u = u_px[y]
    n, rows = u.size, u_px.shape[0]
    limit = np.float32(s.jump_px)
    bad[:] = 0
    _squeezed(u[1 : n - 1], u[: n - 2], u[2:], s, bad[1 : n - 1])
    mid = u[2 : n - 2]
    _off(mid, (u[1 : n - 3], u[: n - 4]), (u[3 : n - 1], u[4:]), limit, bad[2 : n - 2])
    if 2 <= y < rows - 2:
        _off(u, (u_px[y - 1], u_px[y - 2]), (u_px[y + 1], u_px[y + 2]), limit, bad)
    for step in (-1, 1):
        if 0 <= y + step < rows:
            _borders(u, u_px[y + step], ROW_JUMP * s.jump_px, bad)
        if 0 <= y + 2 * step < rows:
            _apart(u, u_px[y + 2 * step], 2 * ROW_JUMP * s.jump_px, bad)
    _lonely(u, s, bad)


@njit(cache=True, nogil=True, error_model="numpy")
def _row(g: Geometry, y: int, columns: Any, lines: Any, bad: Any, r: Rays, out: Output) -> None:
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
    first: int, last: int, g: Geometry, columns: Any, lines: Any, screen: Screen, out: Output,
    r: Rays, bad: Any,
) -> None:  # fmt: skip
    """Screen and triangulate rows first to last. columns: observed DMD column of each boundary."""
    for y in range(first, last):
        find_steps(lines.u_px, y, screen, bad)
        _row(g, y, columns, lines, bad, r, out)
