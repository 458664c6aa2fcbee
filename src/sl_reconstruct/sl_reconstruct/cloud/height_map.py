"""Height maps: z of an organised cloud at the nodes of a regular grid in x and y."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_common.documents import written_atomically
from sl_common.errors import SlError, StackError
from sl_common.kernel_cache import kernel

#: Neighbours further apart than so many typical spacings lie on different sides of a step or gap.
MAX_STRETCH = 4.0
MAX_NODES = 16_000_000
#: A node counts as under a triangle so far beyond its edge, in parts of the triangle.
EDGE = 1e-9
#: Spacings are measured on about so many neighbours.
SAMPLES = 200_000


@dataclass(frozen=True)
class HeightMap:
    """Heights on a grid whose first row has the largest y, so that it looks as the part does.

    Parameters
    ----------
    z_m : ndarray, (rows, columns), float32
        Heights in metres, NaN where nothing was measured.
    x0_m, y0_m : float
        Position of the upper left node, metres.
    step_m : float
        Distance of neighbouring nodes, metres; x grows with the column, y falls with the row.
    """

    z_m: NDArray[np.float32]
    x0_m: float
    y0_m: float
    step_m: float

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """(left, right, bottom, top) of the outermost nodes, metres."""
        rows, columns = self.z_m.shape
        return (
            self.x0_m,
            self.x0_m + (columns - 1) * self.step_m,
            self.y0_m - (rows - 1) * self.step_m,
            self.y0_m,
        )


def typical_spacing_m(points: NDArray[Any]) -> float:
    """Median distance of neighbours in x and y along rows and columns, the larger of the two.

    NaN when no two neighbours are there.
    """
    spacings = []
    for a, b in ((points[:, :-1], points[:, 1:]), (points[:-1], points[1:])):
        every = max(1, round((a.size / SAMPLES) ** 0.5))
        a, b = a[::every, ::every], b[::every, ::every]
        apart = np.hypot(a["x"] - b["x"], a["y"] - b["y"])
        apart = apart[np.isfinite(apart)]
        spacings.append(float(np.median(apart)) if apart.size else np.nan)
    return max(spacings)


def make_height_map(points: NDArray[Any], step_m: float | None = None) -> HeightMap:
    """Interpolate an organised cloud linearly at the nodes of a grid.

    Each two triangles between four neighbours give z at the nodes under them. Triangles with a
    missing corner give nothing, nor do those that bridge a gap (`MAX_STRETCH`): no height is
    invented. Where triangles overlap, the highest counts.

    Parameters
    ----------
    points : ndarray (rows, columns), structured
        The cloud; ``x, y, z`` in metres, NaN where there is no point.
    step_m : float, optional
        Distance of nodes, metres; the typical spacing of the points when left out.

    Raises
    ------
    StackError
        When there are no two neighbouring points, or the grid would be too large.
    """
    spacing = typical_spacing_m(points)
    if not spacing > 0:
        raise StackError("the cloud has no two neighbouring points; expected a surface")
    step = spacing if step_m is None else step_m
    x, y = points["x"], points["y"]
    left, right, bottom, top = _bounds(x, y)
    x0, y0 = np.floor(left / step) * step, np.ceil(top / step) * step
    columns = int(np.ceil((right - x0) / step)) + 1
    rows = int(np.ceil((y0 - bottom) / step)) + 1
    if rows * columns > MAX_NODES:
        raise StackError(
            f"a height map of {columns} x {rows} nodes {step:.3g} m apart is too large; expected "
            f"at most {MAX_NODES} nodes (some points lie far off, or the step is too small)"
        )
    z = np.full((rows, columns), np.nan, dtype=np.float32)
    limit = MAX_STRETCH * max(spacing, step)
    _rasterise(x, y, points["z"], z, (float(x0), float(y0), limit, float(step)))
    return HeightMap(z, float(x0), float(y0), float(step))


@kernel(error_model="python")
def _bounds(x: NDArray[np.float32], y: NDArray[np.float32]) -> tuple[float, float, float, float]:
    """Least and greatest x, least and greatest y of the points that are there."""
    left, right, bottom, top = np.inf, -np.inf, np.inf, -np.inf
    for r in range(x.shape[0]):
        for c in range(x.shape[1]):
            if np.isfinite(x[r, c]):
                left, right = min(left, x[r, c]), max(right, x[r, c])
                bottom, top = min(bottom, y[r, c]), max(top, y[r, c])
    return left, right, bottom, top


@kernel(error_model="python")
def _rasterise(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    z: NDArray[np.float32],
    out: NDArray[np.float32],
    grid: tuple[float, float, float, float],
) -> None:
    """Fill the nodes under all triangles; the grid is x0, y0, greatest length, step in metres.

    Two rows at a time, in units of nodes: the cloud itself may lie in memory as it will.
    """
    rows, columns = z.shape
    x0_m, y0_m, limit_m, step_m = grid
    u, v, w = np.empty((2, columns)), np.empty((2, columns)), np.empty((2, columns))
    for r in range(rows):
        for c in range(columns):
            u[0, c], v[0, c], w[0, c] = u[1, c], v[1, c], w[1, c]
            u[1, c], v[1, c] = (x[r, c] - x0_m) / step_m, (y0_m - y[r, c]) / step_m
            w[1, c] = z[r, c]
        if r == 0:
            continue
        for c in range(columns - 1):
            if not _quad(u, v, w, out, limit_m / step_m, c):
                _triangle(u, v, w, out, limit_m, step_m, (0, c), (0, c + 1), (1, c))
                _triangle(u, v, w, out, limit_m, step_m, (1, c + 1), (1, c), (0, c + 1))


@kernel(error_model="python")
def _quad(
    u: NDArray[np.float64],
    v: NDArray[np.float64],
    z: NDArray[np.float64],
    out: NDArray[np.float32],
    limit: float,
    c: int,
) -> bool:
    """Fill the nodes under the two triangles of a cell at once; false where that cannot be done.

    That is where a corner is missing, or the cell is large or flat.
    """
    ua, ub, uc, ud = u[0, c], u[0, c + 1], u[1, c], u[1, c + 1]
    va, vb, vc, vd = v[0, c], v[0, c + 1], v[1, c], v[1, c + 1]
    za, zb, zc, zd = z[0, c], z[0, c + 1], z[1, c], z[1, c + 1]
    least_u, most_u = min(min(ua, ub), min(uc, ud)), max(max(ua, ub), max(uc, ud))
    least_v, most_v = min(min(va, vb), min(vc, vd)), max(max(va, vb), max(vc, vd))
    area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
    other = (uc - ud) * (vb - vd) - (ub - ud) * (vc - vd)
    small = (most_u - least_u <= limit) & (most_v - least_v <= limit)
    if not (
        small
        & (abs(area) >= 1e-12)
        & (abs(other) >= 1e-12)
        & (za + zb + zc + zd == za + zb + zc + zd)
    ):
        return False
    for j in range(max(int(np.ceil(least_v)), 0), min(int(np.floor(most_v)), out.shape[0] - 1) + 1):
        for i in range(
            max(int(np.ceil(least_u)), 0), min(int(np.floor(most_u)), out.shape[1] - 1) + 1
        ):
            wb = ((i - ua) * (vc - va) - (uc - ua) * (j - va)) / area
            wc = ((ub - ua) * (j - va) - (i - ua) * (vb - va)) / area
            if wb >= -EDGE and wc >= -EDGE and wb + wc <= 1 + EDGE:
                height = za + wb * (zb - za) + wc * (zc - za)
                if not out[j, i] >= height:
                    out[j, i] = height
            wb = ((i - ud) * (vb - vd) - (ub - ud) * (j - vd)) / other
            wc = ((uc - ud) * (j - vd) - (i - ud) * (vc - vd)) / other
            if wb >= -EDGE and wc >= -EDGE and wb + wc <= 1 + EDGE:
                height = zd + wb * (zc - zd) + wc * (zb - zd)
                if not out[j, i] >= height:
                    out[j, i] = height
    return True


@kernel(error_model="python")
def _triangle(
    u: NDArray[np.float64],
    v: NDArray[np.float64],
    z: NDArray[np.float64],
    out: NDArray[np.float32],
    limit_m: float,
    step_m: float,
    a: tuple[int, int],
    b: tuple[int, int],
    c: tuple[int, int],
) -> None:
    """Fill the nodes under one triangle, unless a corner is missing or it is stretched."""
    if not (np.isfinite(z[a]) and np.isfinite(z[b]) and np.isfinite(z[c])):
        return
    longest = max(
        max(abs(u[a] - u[b]), abs(u[b] - u[c]), abs(u[c] - u[a])),
        max(abs(v[a] - v[b]), abs(v[b] - v[c]), abs(v[c] - v[a])),
    )
    if longest * step_m > limit_m:
        return
    area = (u[b] - u[a]) * (v[c] - v[a]) - (u[c] - u[a]) * (v[b] - v[a])
    if abs(area) < 1e-12:
        return
    first_v, last_v = int(np.ceil(min(v[a], v[b], v[c]))), int(np.floor(max(v[a], v[b], v[c])))
    first_u, last_u = int(np.ceil(min(u[a], u[b], u[c]))), int(np.floor(max(u[a], u[b], u[c])))
    for j in range(max(first_v, 0), min(last_v, out.shape[0] - 1) + 1):
        for i in range(max(first_u, 0), min(last_u, out.shape[1] - 1) + 1):
            wb = ((i - u[a]) * (v[c] - v[a]) - (u[c] - u[a]) * (j - v[a])) / area
            wc = ((u[b] - u[a]) * (j - v[a]) - (i - u[a]) * (v[b] - v[a])) / area
            if wb >= -EDGE and wc >= -EDGE and wb + wc <= 1 + EDGE:
                height = z[a] + wb * (z[b] - z[a]) + wc * (z[c] - z[a])
                if not out[j, i] >= height:
                    out[j, i] = height


def save_tiff(path: str | Path, height: HeightMap) -> None:
    """Write a height map as 32-bit float TIFF: metres, NaN where nothing was measured.

    Parameters
    ----------
    path : str or Path
        The file.
    height : HeightMap
        Written as it is, z up.
    """
    _write(Path(path), height.z_m)


def save_png(path: str | Path, height: HeightMap) -> tuple[float, float]:
    """Write a height map as 16-bit grey PNG: 0 is missing, 1 to 65535 from lowest to highest.

    Parameters
    ----------
    path : str or Path
        The file.
    height : HeightMap
        Scaled to its own range.

    Returns
    -------
    tuple of float
        Heights of the values 1 and 65535, metres.
    """
    z = height.z_m
    there = np.isfinite(z)
    low = float(z.min(where=there, initial=np.inf))
    high = float(z.max(where=there, initial=-np.inf))
    low, high = (low, high) if low <= high else (0.0, 0.0)
    scale = 65534.0 / (high - low) if high > low else 0.0
    steps = np.where(there, z, low).astype(np.float64)
    steps -= low
    steps *= scale
    grey = (np.rint(steps, out=steps).astype(np.uint16) + np.uint16(1)) * there
    _write(Path(path), grey)
    return low, high


def _write(path: Path, image: NDArray[Any]) -> None:
    with written_atomically(path) as partial:
        if not cv2.imwrite(str(partial), image):
            raise SlError(f"cannot write the image {path}")
