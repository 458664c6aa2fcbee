"""From decoded lines to the organised cloud: depth-step screening and triangulation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sl_common.kernel_cache import kernel
from sl_reconstruct.cloud.refusals import Reason
from sl_reconstruct.decode.edge_uncertainty import widen_edges
from sl_reconstruct.decode.edges import PRESENT, Tuning
from sl_reconstruct.decode.types import Bytes, Floats, Lines
from sl_reconstruct.model.geometry import (
    DEPTH,
    DZ,
    PX,
    PY,
    PZ,
    RAYS,
    Array,
    Geometry,
    camera_rays,
    ray_tile,
    solve_points,
    solve_slopes,
)

STEP = int(Reason.STEP)
GEOMETRY = int(Reason.GEOMETRY)

#: A boundary may move from row to row by this many times the jump that makes a step.
ROW_JUMP = 2.0
#: Boundaries over which a neighbour may be looked for.
NEIGHBOURS = 8


class Output(NamedTuple):
    """Where a cloud is written.

    Parameters
    ----------
    values : ndarray, (H, K, 5)
        World x, y, z, level and sigma; NaN where there is no point.
    u_px : ndarray, (H, K)
        Camera column of each boundary.
    reason : ndarray, (H, K)
        Why there is no point.
    """

    values: Floats
    u_px: Floats
    reason: Bytes


class Screen(NamedTuple):
    """When neighbours say that a depth step lies under an edge.

    Parameters
    ----------
    jump_px : float
        An edge may lie this far from where two neighbours lead, camera pixels.
    near_px, wide_px : float
        Least distance to the next boundary, and between those on both sides; signed.
    """

    jump_px: float
    near_px: float
    wide_px: float


class Around(NamedTuple):
    """Scratch for one row: it and two rows on either side, with two NaN at both ends; marks."""

    rows: Floats
    bad: Bytes


class Triangulation(NamedTuple):
    """What the rows of a cloud are made from.

    Parameters
    ----------
    geometry : Geometry
        The rig.
    columns : ndarray, (K,)
        Observed DMD column of each boundary.
    lines : Lines
        Boundaries along every camera row.
    screen : Screen
        When a boundary is refused.
    tuning : Tuning
        What ``lines`` were decoded with.
    """

    geometry: Geometry
    columns: Array
    lines: Lines
    screen: Screen
    tuning: Tuning


class Scratch(NamedTuple):
    """Scratch of one thread: solved rays, neighbours of a row, and its sigma, camera pixels."""

    rays: Array
    around: Around
    sigma_px: Floats


def around_row(n: int) -> Around:
    """Return scratch for rows of n boundaries."""
    return Around(np.full((5, n + 4), np.nan, np.float32), np.zeros(n, np.uint8))


def triangulation_scratch(n: int) -> Scratch:
    """Return scratch for rows of n boundaries."""
    return Scratch(ray_tile(), around_row(n), np.zeros(n, np.float32))


@kernel()
def _compare(rows: Floats, y: int, height: int, s: Screen, bad: Bytes) -> None:
    """Mark a row's boundaries that are not where others lead: 1 is bad, 2 has few neighbours.

    Bad is what lies off the line through two neighbours on a side, in the row or the column; what
    crowds its neighbours, as where a wall that the camera does not see is blurred (mirrored images
    have their signs exchanged); and what the next rows hold elsewhere, or do not hold at all:
    such a row runs along a wall or a shadow, and which side of it a pixel sees is not certain.
    """
    above, over, row, under, below = rows[0], rows[1], rows[2], rows[3], rows[4]
    two, sign = np.float32(2), np.float32(1 if s.near_px > 0 else -1)
    near, wide = np.float32(abs(s.near_px)), np.float32(abs(s.wide_px))
    jump, far = np.float32(s.jump_px), np.float32(ROW_JUMP * s.jump_px)
    farther, inside = np.float32(2 * ROW_JUMP * s.jump_px), 2 <= y < height - 2
    off_rows = jump if inside else np.float32(np.inf)
    first, last = y == 0, y == height - 1
    for k in range(bad.size):
        u, left, right = row[k + 2], row[k + 1], row[k + 3]
        up, down = over[k + 2], under[k + 2]
        off = abs(u - (two * left - row[k])) > jump
        off |= abs(u - (two * right - row[k + 4])) > jump
        off |= abs(u - (two * up - above[k + 2])) > off_rows
        off |= abs(u - (two * down - below[k + 2])) > off_rows
        a, b = sign * (u - left), sign * (right - u)
        off |= (a < near) | (b < near) | (a + b < wide)
        off |= (abs(up - u) > far) | (abs(down - u) > far)
        off |= (abs(above[k + 2] - u) > farther) | (abs(below[k + 2] - u) > farther)
        none_up = (over[k + 1] != over[k + 1]) & (up != up) & (over[k + 3] != over[k + 3])
        none_down = (under[k + 1] != under[k + 1]) & (down != down) & (under[k + 3] != under[k + 3])
        off |= (none_up & (not first)) | (none_down & (not last))
        pairs = (left + row[k]) + (right + row[k + 4])
        lonely = (pairs != pairs) & (u == u)
        bad[k] = np.uint8(1) if off else np.uint8(2 * lonely)


@kernel(forceinline=True)
def _side(u: Floats, k: int, step: int) -> tuple[float, float, int]:
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


@kernel()
def _lonely(u: Floats, s: Screen, bad: Bytes) -> None:
    """Check boundaries without near neighbours against farther ones; alone, they are refused."""
    n = u.size
    sign, near = 1.0 if s.near_px > 0 else -1.0, abs(s.near_px)
    for k in range(n):
        if bad[k] != 2:
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
        bad[k] = off or crowd or has_a + has_b < 2 or near_by < 2


@kernel(forceinline=True)
def find_steps(u_px: Floats, y: int, s: Screen, around: Around) -> None:
    """Mark boundaries of a row that are not where their neighbours in row and column lead.

    Parameters
    ----------
    u_px : ndarray, (H, K)
        Columns of all boundaries.
    y : int
        The row.
    s : Screen
        The limits.
    around : Around
        Its ``bad`` is written: 1 where a boundary is refused.
    """
    height, n = u_px.shape
    for i in range(5):
        row = around.rows[i, 2 : n + 2]
        if 0 <= y + i - 2 < height:
            source = u_px[y + i - 2]
            for k in range(n):
                row[k] = source[k]
        else:
            row[:] = np.float32(np.nan)
    _compare(around.rows, y, height, s, around.bad)
    _lonely(u_px[y], s, around.bad)


@kernel(forceinline=True)
def screen_row(job: Triangulation, y: int, out: Output, s: Scratch) -> None:
    """Write a row's columns, reasons and sigma as its neighbours leave them.

    Parameters
    ----------
    job : Triangulation
        The boundaries.
    y : int
        The row.
    out : Output
        Its ``u_px`` and ``reason`` are written.
    s : Scratch
        Its ``sigma_px`` is written: the lines' own says what noise does, to which comes what
        bends and uneven light do.
    """
    lines, bad, nan = job.lines, s.around.bad, np.float32(np.nan)
    u, reason, at, found = out.u_px[y], out.reason[y], lines.u_px[y], lines.reason[y]
    widen_edges(job.tuning, at, lines.level_dn[y], lines.sigma_px[y], s.sigma_px)
    find_steps(lines.u_px, y, job.screen, s.around)
    for k in range(u.size):
        u[k] = nan if bad[k] else at[k]
        reason[k] = np.uint8(STEP) if (bad[k] != 0) & (found[k] == PRESENT) else found[k]


@kernel(forceinline=True)
def _write(
    r: Array, sigma_px: Floats, level: Floats, values: Floats, u: Floats, reason: Bytes
) -> None:
    """Write the solved part of a row; NaN where there is no point."""
    nan = np.float32(np.nan)
    for k in range(u.size):
        if reason[k] == PRESENT and r[DEPTH + k] > 0:
            values[k, 0] = r[PX + k]
            values[k, 1] = r[PY + k]
            values[k, 2] = r[PZ + k]
            values[k, 3] = level[k]
            values[k, 4] = abs(r[DZ + k]) * sigma_px[k]
            continue
        if reason[k] == PRESENT:
            reason[k] = GEOMETRY
            u[k] = nan
        for i in range(5):
            values[k, i] = nan


@kernel()
def triangulate_rows(job: Triangulation, first: int, last: int, out: Output, s: Scratch) -> None:
    """Screen rows and triangulate them from their columns alone, by three equations.

    Parameters
    ----------
    job : Triangulation
        What they are made from.
    first, last : int
        Rows ``first:last``.
    out : Output
        The cloud, written to.
    s : Scratch
        Made by `triangulation_scratch`, one for each thread.
    """
    g, columns, level_dn = job.geometry, job.columns, job.lines.level_dn
    r, sigma_px = s.rays, s.sigma_px
    for y in range(first, last):
        screen_row(job, y, out, s)
        u, reason, values, level = out.u_px[y], out.reason[y], out.values[y], level_dn[y]
        for a in range(0, u.size, RAYS):
            b = min(a + RAYS, u.size)
            camera_rays(g, u[a:b], float(y), r)
            solve_slopes(g, columns[a:b], r)
            solve_points(g, b - a, r)
            _write(r, sigma_px[a:b], level[a:b], values[a:b], u[a:b], reason[a:b])
