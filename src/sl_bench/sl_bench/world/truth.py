"""Ground truth of a scene, at any camera pixel, in double precision."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sl_bench.world import raycast
from sl_bench.world.raycast import Vector, View, inlined
from sl_common.kernel_cache import kernel

Array = NDArray[np.float64]

#: Step of numeric derivatives, camera pixels.
DIFFERENCE_PX = 0.05


@inlined
def _look(view: View, qu: float, qv: float) -> tuple[Vector, Vector, float]:
    """First hit ((x, y, z), (nx, ny, nz), depth) of a pixel's ray, part frame; inf for none."""
    o, d = view.camera.position_m, raycast.ray(view.camera, qu, qv)
    t, nx, ny, nz = raycast.first_hit(view.surface, (o[0], o[1], o[2]), d)
    return (o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]), (nx, ny, nz), t


@kernel()
def points(view: View, q_px: Array) -> Array:
    """First intersections of camera rays with the part.

    Parameters
    ----------
    view : View
        Part and devices.
    q_px : ndarray, (N, 2)
        Camera pixels.

    Returns
    -------
    ndarray, (N, 3)
        Part frame; NaN where a ray meets nothing.
    """
    out = np.full((q_px.shape[0], 3), np.nan)
    for i in range(q_px.shape[0]):
        p, _, t = _look(view, q_px[i, 0], q_px[i, 1])
        if t < np.inf:
            out[i, 0], out[i, 1], out[i, 2] = p
    return out


@kernel()
def lit(view: View, q_px: Array) -> NDArray[np.bool_]:
    """Whether the projector lights what pixels see: inside the DMD and not in shadow, (N,).

    Parameters
    ----------
    view : View
        Part and devices.
    q_px : ndarray, (N, 2)
        Camera pixels.
    """
    out = np.zeros(q_px.shape[0], dtype=np.bool_)
    o, size = view.projector.position_m, view.projector.size_px
    for i in range(q_px.shape[0]):
        p, n, t = _look(view, q_px[i, 0], q_px[i, 1])
        if not t < np.inf:
            continue
        u, v, _ = raycast.project(view.projector, p[0], p[1], p[2])
        inside = -0.5 <= u <= size[0] - 0.5 and -0.5 <= v <= size[1] - 0.5
        facing = n[0] * (o[0] - p[0]) + n[1] * (o[1] - p[1]) + n[2] * (o[2] - p[2]) > 0.0
        out[i] = inside and facing and not raycast.shadowed(view.surface, p, o)
    return out


@kernel()
def projector_map(view: View, q_px: Array) -> Array:
    """Where the projector sees what the camera sees, lit or not.

    Parameters
    ----------
    view : View
        Part and devices.
    q_px : ndarray, (N, 2)
        Camera pixels.

    Returns
    -------
    ndarray, (N, 4)
        u, v, projector depth, camera depth; NaN where a ray meets nothing.
    """
    out = np.full((q_px.shape[0], 4), np.nan)
    for i in range(q_px.shape[0]):
        p, _, t = _look(view, q_px[i, 0], q_px[i, 1])
        if t < np.inf:
            u, v, depth = raycast.project(view.projector, p[0], p[1], p[2])
            out[i, 0], out[i, 1], out[i, 2], out[i, 3] = u, v, depth, t
    return out


def crossings(view: View, axis: int, targets_px: Array, line_px: float, length_px: int) -> Array:
    """Camera coordinates at which a DMD coordinate takes given values along a camera line.

    Parameters
    ----------
    view : View
        Part and devices.
    axis : {0, 1}
        0: u along a camera row; 1: v along a camera column.
    targets_px : ndarray, (K,)
        DMD coordinates.
    line_px : float
        The camera row (or column), which need not be a whole number.
    length_px : int
        Pixels of that row (or column).

    Returns
    -------
    ndarray, (K,)
        Camera px; NaN where the coordinate is not reached or jumps across.
    """

    def at(position: Array) -> Array:
        q = np.full((position.size, 2), float(line_px))
        q[:, axis] = position
        return projector_map(view, q)[:, axis]

    grid = np.arange(-1.0, length_px + 1.0)
    values = at(grid)
    out = np.full(targets_px.size, np.nan)
    for k, target in enumerate(targets_px):
        left = values[:-1] - target
        cells = np.flatnonzero((left <= 0.0) != (values[1:] - target <= 0.0))
        if cells.size:
            out[k] = grid[cells[0]]
    low, high = out.copy(), out + 1.0
    rising = at(low) <= targets_px
    for _ in range(50):  # bisection to the last bit: a jump cannot be mistaken for a root
        middle = 0.5 * (low + high)
        below = (at(middle) <= targets_px) == rising
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    near = np.abs(at(low) - at(high)) < 1e-6
    return np.where(near, 0.5 * (low + high), np.nan)


def gradients(view: View, axis: int, q_px: Array) -> Array:
    """Gradient (N, 2) of a DMD coordinate over the camera's pixels, by central differences.

    Parameters
    ----------
    view : View
        Part and devices.
    axis : {0, 1}
        Of u, of v.
    q_px : ndarray, (N, 2)
        Camera pixels.
    """
    out = np.empty_like(q_px)
    for k in (0, 1):
        step = np.zeros(2)
        step[k] = DIFFERENCE_PX
        ahead, behind = projector_map(view, q_px + step), projector_map(view, q_px - step)
        out[:, k] = (ahead - behind)[:, axis] / (2.0 * DIFFERENCE_PX)
    return out
