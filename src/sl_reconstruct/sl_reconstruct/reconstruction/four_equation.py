"""Both DMD coordinates: the row of every point, and all four of Eqs. (3) and (4).

Row boundaries are found along camera columns, like column boundaries along camera rows. Between
them the DMD row is interpolated, so that every point has a whole pair of image points. Four
equations for three unknowns leave a residual: how far the two rays miss each other.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_common.kernel_cache import kernel
from sl_reconstruct.cloud.refusals import Reason
from sl_reconstruct.decode.edges import PRESENT
from sl_reconstruct.decode.types import Lines
from sl_reconstruct.model.geometry import DIVISION, Geometry, Optics, brown_undistort
from sl_reconstruct.reconstruction.triangulate import GEOMETRY, Around, Output, Screen, find_steps

ROW = int(Reason.ROW)

#: Row boundaries further apart than this are not interpolated between.
MAX_GAP = 4


class Crossed(NamedTuple):
    """What rows add to a cloud: (H, K) DMD row, miss distances; ``v_map`` is (W, H) scratch."""

    v_map: NDArray[np.float32]
    v_px: NDArray[np.float32]
    gap_m: NDArray[np.float32]
    gap_px: NDArray[np.float32]


@kernel()
def map_rows(
    first: int, last: int, lines: Lines, screen: Screen, v_map: Any, around: Around
) -> None:
    """Fill the DMD row at the pixels of camera columns first to last; NaN where unknown.

    lines: row boundaries along camera columns, shape (W, DMD rows).
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
def row_at(v_map: Any, u: float, y: int) -> Any:
    """DMD row at camera column u, linear between the columns beside it; NaN where unknown."""
    x = int(np.floor(u))
    if not 0 <= x < v_map.shape[0] - 1:
        return np.nan
    w = u - x
    return (1 - w) * v_map[x, y] + w * v_map[x + 1, y]


@kernel()
def undistorted(o: Optics, u: float, v: float) -> Any:
    """Ideal slopes of an observed image point."""
    x, y = (u - o.cu) / o.fx, (v - o.cv) / o.fy
    if o.model == DIVISION:
        h = 1 + o.lens[0] * ((u - o.cu) ** 2 + (v - o.cv) ** 2)
        return x * h, y * h
    return brown_undistort(o.lens, x, y)


@kernel()
def solve_four(
    g: Geometry, x: float, y: float, px: float, py: float, sigma_u: float, sigma_v: float, out: Any
) -> Any:
    """Least squares over Eqs. (3) and (4), each weighted to pixels.

    x, y and px, py are ideal slopes in camera and projector. Writes to ``out``: world point,
    sigma of z, miss distance in metres, root sum of squared residuals in pixels. False where
    the rays do not meet in front of both devices.
    """
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
    out[3] = np.sqrt((to_z[0] * sigma_u) ** 2 + (to_z[3] * sigma_v) ** 2)
    out[5] = np.sqrt(np.sum(r * r))
    return p[2] > 0


@kernel()
def miss_m(between: Any, ray: Any, other: Any) -> Any:
    """Shortest distance of two lines, given the vector between their origins."""
    n = np.cross(ray, other)
    return abs(np.dot(between, n)) / np.sqrt(np.dot(n, n))


@kernel()
def cross_rows(
    first: int, last: int, g: Geometry, columns: Any, lines: Lines, sigma_v: float,
    max_gap_px: float, out: Output, add: Crossed,
) -> None:  # fmt: skip
    """Solve all four equations where a point of rows first to last has a DMD row.

    Points without one are refused: three equations may leave depth all but free, as where the
    devices lie above each other.
    """
    answer = np.zeros(6)
    for y in range(first, last):
        add.gap_m[y], add.gap_px[y] = np.nan, np.nan
        for k in range(columns.size):
            v, u = np.nan, lines.u_px[y, k]
            if out.reason[y, k] == PRESENT or out.reason[y, k] == GEOMETRY:
                v = row_at(add.v_map, u, y)
            add.v_px[y, k] = v
            if np.isnan(v):
                if out.reason[y, k] == PRESENT:
                    out.values[y, k], out.reason[y, k] = np.nan, ROW
                continue
            cx, cy = undistorted(g.camera, u, float(y))
            px, py = undistorted(g.projector, columns[k], v)
            answer[5] = np.nan
            met = solve_four(g, cx, cy, px, py, lines.sigma_px[y, k], sigma_v, answer)
            add.gap_m[y, k], add.gap_px[y, k] = answer[4], answer[5]
            if met and answer[5] <= max_gap_px:
                for i in range(3):
                    out.values[y, k, i] = answer[i]
                out.values[y, k, 3] = lines.level_dn[y, k]
                out.values[y, k, 4] = answer[3]
                out.u_px[y, k] = u
                out.reason[y, k] = PRESENT
            else:
                out.values[y, k] = np.nan
                out.reason[y, k] = GEOMETRY
                out.u_px[y, k] = np.nan
