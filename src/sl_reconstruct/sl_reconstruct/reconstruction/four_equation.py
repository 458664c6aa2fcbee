"""Both DMD coordinates: the row of every point, and all four of Eqs. (3) and (4).

Row boundaries are found along camera columns, like column boundaries along camera rows. Between
them the DMD row is interpolated, so that every point has a whole pair of image points. Four
equations for three unknowns leave a residual: how far the two rays miss each other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sl_common.kernel_cache import kernel
from sl_reconstruct.cloud.refusals import Reason
from sl_reconstruct.decode.edges import PRESENT
from sl_reconstruct.decode.types import Floats, Lines
from sl_reconstruct.model.geometry import (
    DEPTH,
    DIVISION,
    Array,
    Geometry,
    Optics,
    brown_undistort,
    camera_rays,
    solve_points,
    solve_slopes,
)
from sl_reconstruct.reconstruction.triangulate import (
    GEOMETRY,
    Around,
    Output,
    Scratch,
    Screen,
    Triangulation,
    find_steps,
    screen_row,
)

ROW = int(Reason.ROW)

#: Row boundaries further apart than this are not interpolated between.
MAX_GAP = 4


class RowMap(NamedTuple):
    """What a stack's row patterns say.

    Parameters
    ----------
    v_map : ndarray, (W, H)
        DMD row at every pixel, NaN where it is not known.
    sigma_v : float
        Its 1-sigma, DMD pixels: that of a typical row boundary.
    max_gap_px : float
        Points whose rays miss each other by more are refused.
    """

    v_map: Floats
    sigma_v: float
    max_gap_px: float


class Crossed(NamedTuple):
    """What rows add to a cloud, each (H, K): DMD row, miss of the rays, residual; NaN: none."""

    v_px: Floats
    gap_m: Floats
    gap_px: Floats


class Sight(NamedTuple):
    """Where the two devices see a point: ideal slopes in camera and projector, and 1-sigma, px."""

    x: float
    y: float
    px: float
    py: float
    sigma_u: float
    sigma_v: float


@kernel()
def map_rows(
    first: int, last: int, lines: Lines, screen: Screen, v_map: Floats, around: Around
) -> None:
    """Interpolate the DMD row at the pixels of camera columns.

    Parameters
    ----------
    first, last : int
        Camera columns ``first:last``.
    lines : Lines
        Row boundaries along all camera columns.
    screen : Screen
        When a boundary is refused.
    v_map : ndarray, (W, H)
        Written to, NaN where the row is not known.
    around : Around
        Scratch.
    """
    for x in range(first, last):
        find_steps(lines.u_px, x, screen, around)
        out, at = v_map[x], lines.u_px[x]
        out[:] = np.nan
        last_j, last_y = -1, 0.0
        for j in range(at.size):
            y = np.float64(at[j])
            if around.bad[j] or np.isnan(y):
                continue
            if last_j >= 0 and j - last_j <= MAX_GAP and y != last_y:
                low, high = min(y, last_y), max(y, last_y)
                slope = (j - last_j) / (y - last_y)
                for i in range(int(np.ceil(low)), min(int(np.floor(high)), out.size - 1) + 1):
                    out[i] = j - 0.5 + (i - y) * slope
            last_j, last_y = j, y


@kernel()
def _row_at(v_map: Floats, u: float, y: int) -> float:
    """DMD row at camera column u, linear between the columns beside it; NaN where unknown."""
    x = int(np.floor(u))
    if not 0 <= x < v_map.shape[0] - 1:
        return np.nan
    w = u - x
    between: float = (1 - w) * v_map[x, y] + w * v_map[x + 1, y]
    return between


@kernel()
def _undistorted(o: Optics, u: float, v: float) -> tuple[float, float]:
    """Ideal slopes of an observed image point."""
    x, y = (u - o.cu) / o.fx, (v - o.cv) / o.fy
    if o.model == DIVISION:
        h = 1 + o.lens[0] * ((u - o.cu) ** 2 + (v - o.cv) ** 2)
        return x * h, y * h
    return brown_undistort(o.lens, x, y)


@kernel()
def solve_four(g: Geometry, at: Sight, out: Array) -> bool:
    """Least squares over Eqs. (3) and (4), each weighted to pixels.

    Parameters
    ----------
    g : Geometry
        The rig.
    at : Sight
        Where it sees the point.
    out : ndarray, (6,)
        Written to: world point, sigma of z, distance of the rays (metres), root sum of squared
        residuals (pixels).

    Returns
    -------
    bool
        False where the rays do not meet in front of both devices; then only the distance is
        written.
    """
    x, y, px, py = at.x, at.y, at.px, at.py
    a, b = g.a, g.b
    bx = b[0, 0] * x + b[0, 1] * y + b[0, 2]
    bz = b[2, 0] * x + b[2, 1] * y + b[2, 2]
    out[4] = miss_m(a, b @ np.array([x, y, 1.0]), np.array([px, py, 1.0]))
    depth = (px * a[2] - a[0]) / (bx - px * bz)
    far = a[2] + depth * bz
    if not (depth > 0 and far > 0):
        return False
    j = np.zeros((4, 3))
    c = np.zeros(4)
    j[0, 0], j[0, 2] = g.camera.fx / depth, -x * g.camera.fx / depth
    j[1, 1], j[1, 2] = g.camera.fy / depth, -y * g.camera.fy / depth
    for i in range(3):
        j[2, i] = (b[0, i] - px * b[2, i]) * g.projector.fx / far
        j[3, i] = (b[1, i] - py * b[2, i]) * g.projector.fy / far
    c[2] = (a[0] - px * a[2]) * g.projector.fx / far
    c[3] = (a[1] - py * a[2]) * g.projector.fy / far
    inverse = np.linalg.inv(j.T @ j) @ j.T
    p = -(inverse @ c)
    r = j @ p + c
    to_z = g.world[2] @ inverse
    out[:3] = g.origin + g.world @ p
    out[3] = np.sqrt((to_z[0] * at.sigma_u) ** 2 + (to_z[3] * at.sigma_v) ** 2)
    out[5] = np.sqrt(np.sum(r * r))
    return bool(p[2] > 0)


@kernel()
def miss_m(between: Array, ray: Array, other: Array) -> float:
    """Shortest distance of two lines.

    Parameters
    ----------
    between : ndarray, (3,)
        From the origin of one to that of the other, metres.
    ray, other : ndarray, (3,)
        Their directions, of any length.
    """
    n = np.cross(ray, other)
    distance: float = abs(np.dot(between, n)) / np.sqrt(np.dot(n, n))
    return distance


@kernel()
def _meets(g: Geometry, u: Floats, v: float, column: Array, r: Array) -> bool:
    """Whether a camera ray meets a DMD column, one of each, in front of both devices."""
    camera_rays(g, u, v, r)
    solve_slopes(g, column, r)
    solve_points(g, 1, r)
    return bool(r[DEPTH] > 0)


@kernel()
def cross_rows(
    job: Triangulation, rows: RowMap, first: int, last: int, out: Output, add: Crossed, s: Scratch
) -> None:
    """Screen rows and triangulate them from columns and DMD rows, by all four equations.

    Points without a DMD row are refused: three equations may leave depth all but free, as where
    the devices lie above each other. Of a point's sigma, the column's part is widened by bends and
    uneven light; the row's part is that of a typical row boundary by noise (docs/measure.md).

    Parameters
    ----------
    job, first, last, out, s
        As in `triangulate_rows`.
    rows : RowMap
        Has the DMD rows.
    add : Crossed
        Written to.
    """
    g, columns, u_px, reason, answer = job.geometry, job.columns, out.u_px, out.reason, np.zeros(6)
    for y in range(first, last):
        screen_row(job, y, out, s)
        out.values[y] = np.nan
        add.v_px[y], add.gap_m[y], add.gap_px[y] = np.nan, np.nan, np.nan
        for k in range(columns.size):
            if reason[y, k] != PRESENT:
                continue
            v = _row_at(rows.v_map, u_px[y, k], y)
            if np.isnan(v):
                if _meets(g, u_px[y, k : k + 1], float(y), columns[k : k + 1], s.rays):
                    reason[y, k] = ROW
                else:
                    reason[y, k], u_px[y, k] = GEOMETRY, np.nan
                continue
            seen = _undistorted(g.camera, u_px[y, k], float(y))
            lit = _undistorted(g.projector, columns[k], v)
            answer[5] = np.nan
            sight = Sight(seen[0], seen[1], lit[0], lit[1], s.sigma_px[k], rows.sigma_v)
            met = solve_four(g, sight, answer)
            add.v_px[y, k], add.gap_m[y, k], add.gap_px[y, k] = v, answer[4], answer[5]
            if met and answer[5] <= rows.max_gap_px:
                for i in range(3):
                    out.values[y, k, i] = answer[i]
                out.values[y, k, 3] = job.lines.level_dn[y, k]
                out.values[y, k, 4] = answer[3]
            else:
                reason[y, k], u_px[y, k] = GEOMETRY, np.nan
