"""Height maps: z of an organised cloud at the nodes of a regular grid in x and y."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_common.documents import written_atomically
from sl_common.errors import SlError, StackError
from sl_common.kernel_cache import kernel

#: Neighbours further apart than this many typical spacings lie on different sides of a step or gap.
MAX_STRETCH = 4.0
MAX_NODES = 16_000_000
#: A node counts as under a triangle so far beyond its edge, in parts of the triangle.
EDGE = 1e-9
#: Spacings are measured on about this many neighbours.
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

    Two rows at a time are copied, in units of nodes, whatever the cloud's order in memory.
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
            here = Corner(u[0, c], v[0, c], w[0, c])
            right = Corner(u[0, c + 1], v[0, c + 1], w[0, c + 1])
            below = Corner(u[1, c], v[1, c], w[1, c])
            beyond = Corner(u[1, c + 1], v[1, c + 1], w[1, c + 1])
            if not _quad(here, right, below, beyond, limit_m / step_m, out):
                _triangle(here, right, below, limit_m, step_m, out)
                _triangle(beyond, below, right, limit_m, step_m, out)


class Corner(NamedTuple):
    """A point of the cloud: column and row in units of nodes, height in metres."""

    u: float
    v: float
    z: float


@kernel(error_model="python", forceinline=True)
def _area(a: Corner, b: Corner, c: Corner) -> float:
    """Twice the area of a triangle, with a sign."""
    return (b.u - a.u) * (c.v - a.v) - (c.u - a.u) * (b.v - a.v)


@kernel(error_model="python", forceinline=True)
def _raise_node(
    out: NDArray[np.float32], j: int, i: int, a: Corner, b: Corner, c: Corner, area: float
) -> None:
    """Give a node the height of a triangle that it lies under, unless it has a greater one."""
    wb = ((i - a.u) * (c.v - a.v) - (c.u - a.u) * (j - a.v)) / area
    wc = ((b.u - a.u) * (j - a.v) - (i - a.u) * (b.v - a.v)) / area
    if wb >= -EDGE and wc >= -EDGE and wb + wc <= 1 + EDGE:
        height = a.z + wb * (b.z - a.z) + wc * (c.z - a.z)
        if not out[j, i] >= height:
            out[j, i] = height


@kernel(error_model="python", forceinline=True)
def _nodes(least: float, most: float, count: int) -> tuple[int, int]:
    """First node, and the one after the last, of those that lie in a range."""
    return max(int(np.ceil(least)), 0), min(int(np.floor(most)), count - 1) + 1


@kernel(error_model="python")
def _quad(
    a: Corner, b: Corner, c: Corner, d: Corner, limit: float, out: NDArray[np.float32]
) -> bool:
    """Fill the nodes under the two triangles of a cell at once; false where that cannot be done.

    That is where a corner is missing, or the cell is large or flat.
    """
    least_u, most_u = min(min(a.u, b.u), min(c.u, d.u)), max(max(a.u, b.u), max(c.u, d.u))
    least_v, most_v = min(min(a.v, b.v), min(c.v, d.v)), max(max(a.v, b.v), max(c.v, d.v))
    area, other = _area(a, b, c), _area(d, c, b)
    small = (most_u - least_u <= limit) & (most_v - least_v <= limit)
    there = a.z + b.z + c.z + d.z == a.z + b.z + c.z + d.z
    if not (small & (abs(area) >= 1e-12) & (abs(other) >= 1e-12) & there):
        return False
    first_j, last_j = _nodes(least_v, most_v, out.shape[0])
    first_i, last_i = _nodes(least_u, most_u, out.shape[1])
    for j in range(first_j, last_j):
        for i in range(first_i, last_i):
            _raise_node(out, j, i, a, b, c, area)
            _raise_node(out, j, i, d, c, b, other)
    return True


@kernel(error_model="python")
def _triangle(
    a: Corner, b: Corner, c: Corner, limit_m: float, step_m: float, out: NDArray[np.float32]
) -> None:
    """Fill the nodes under one triangle, unless a corner is missing or it is stretched."""
    if not (np.isfinite(a.z) and np.isfinite(b.z) and np.isfinite(c.z)):
        return
    longest = max(
        max(abs(a.u - b.u), abs(b.u - c.u), abs(c.u - a.u)),
        max(abs(a.v - b.v), abs(b.v - c.v), abs(c.v - a.v)),
    )
    area = _area(a, b, c)
    if longest * step_m > limit_m or abs(area) < 1e-12:
        return
    first_j, last_j = _nodes(min(a.v, b.v, c.v), max(a.v, b.v, c.v), out.shape[0])
    first_i, last_i = _nodes(min(a.u, b.u, c.u), max(a.u, b.u, c.u), out.shape[1])
    for j in range(first_j, last_j):
        for i in range(first_i, last_i):
            _raise_node(out, j, i, a, b, c, area)


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
