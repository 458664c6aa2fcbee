"""Parts for the bench: height fields z = h(x, y) in the part's own frame, metres.

z points towards the devices and z = 0 is the part's reference plane. Steps have true vertical
walls. Every surface knows the distance of any point to itself, which is the truth that clouds
are judged against.
"""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sl_bench.world import raycast
from sl_bench.world.coin_relief import coin_heights
from sl_bench.world.height_files import read_height_file
from sl_bench.world.raycast import SurfaceData, Vector
from sl_common.errors import ConfigError
from sl_common.kernel_cache import kernel

Array = NDArray[np.float64]

#: Half of the side of a profile surface: further than any ray of a bench goes.
FAR_M = 10.0


@dataclass(frozen=True)
class Surface:
    """A part's shape and the reflectance that belongs to the shape (dark holes).

    Parameters
    ----------
    name : str
        What the registry calls it.
    data : SurfaceData
        What the ray kernels read.
    """

    name: str
    data: raycast.SurfaceData

    def height_m(self, x_m: Array, y_m: Array) -> Array:
        """Height of places on the part, metres; at a vertical wall, of its upper edge.

        Parameters
        ----------
        x_m, y_m : ndarray
            Of shapes that broadcast, which is the result's.
        """
        x, y = np.broadcast_arrays(np.asarray(x_m, dtype=float), np.asarray(y_m, dtype=float))
        return _heights(self.data, x.ravel(), y.ravel()).reshape(x.shape)

    def distance_m(self, points_m: Array) -> Array:
        """Unsigned distance of points (N, 3), part frame, to the surface: (N,) metres.

        NaN points give NaN.
        """
        raise NotImplementedError


@kernel()
def _heights(data: SurfaceData, x: Array, y: Array) -> Array:
    out = np.empty(x.size)
    for i in range(x.size):
        t, _, _, _ = raycast.first_hit(data, (x[i], y[i], 1.0), (0.0, 0.0, -1.0))
        out[i] = 1.0 - t
    return out


def _polyline_distance_m(s_m: Array, z_m: Array, vertices_m: Array) -> Array:
    """Distance of points (s, z), each (N,), to a polyline with vertices (V, 2): (N,) metres."""
    best = np.full(np.shape(s_m), np.inf)
    for (s0, z0), (s1, z1) in itertools.pairwise(vertices_m):
        length2 = (s1 - s0) ** 2 + (z1 - z0) ** 2
        along = np.clip(((s_m - s0) * (s1 - s0) + (z_m - z0) * (z1 - z0)) / length2, 0.0, 1.0)
        foot = np.hypot(s_m - s0 - along * (s1 - s0), z_m - z0 - along * (z1 - z0))
        best = np.minimum(best, foot)
    return best


class ProfileSurface(Surface):
    """A profile in x and z drawn out along y: flat plate, groove, steps."""

    def distance_m(self, points_m: Array) -> Array:  # noqa: D102
        return _polyline_distance_m(points_m[:, 0], points_m[:, 2], self.data.profile_m)


class HolePlate(Surface):
    """A plate with a lattice of dark round holes (or dots), chamfered or not."""

    @property
    def centres_m(self) -> Array:
        """Centres (rows, columns, 2) of the lattice, row 0 at the smallest y."""
        pitch, _, _, i0, j0 = self.data.params
        rows, columns = self.data.grid.shape
        return np.stack(
            np.meshgrid((np.arange(columns) - i0) * pitch, (np.arange(rows) - j0) * pitch), axis=-1
        )

    def distance_m(self, points_m: Array) -> Array:  # noqa: D102
        z, chamfer = points_m[:, 2], self.data.params[1]
        if chamfer == 0.0:
            return np.abs(z)
        distance = _hole_distances(self.data, points_m[:, 0], points_m[:, 1])
        profile = np.array([[-FAR_M, -chamfer], [0.0, -chamfer], [chamfer, 0.0], [FAR_M, 0.0]])
        return np.where(
            np.isfinite(distance), _polyline_distance_m(distance, z, profile), np.abs(z)
        )


@kernel()
def _hole_distances(data: SurfaceData, x: Array, y: Array) -> Array:
    """Distance outside the rim of the nearest hole; inf where that hole is blocked."""
    out = np.empty(x.size)
    for i in range(x.size):
        r, radius, _, _ = raycast.hole_distance(data, x[i], y[i])
        out[i] = r - radius if radius > 0.0 else np.inf
    return out


class SphereCap(Surface):
    """A cap of a sphere that stands on a plane."""

    def distance_m(self, points_m: Array) -> Array:  # noqa: D102
        radius, base = self.data.params[:2]
        x, y, z = points_m.T
        r, cz = np.hypot(x, y), -np.sqrt(radius**2 - base**2)
        rim = np.hypot(r - base, z)
        over_cap = r * -cz <= base * (z - cz)  # inside the cone over the rim
        to_cap = np.where(over_cap, np.abs(np.hypot(r, z - cz) - radius), rim)
        return np.asarray(np.minimum(to_cap, np.where(r >= base, np.abs(z), rim)))


class GridSurface(Surface):
    """Heights on a square grid, bilinear between."""

    def distance_m(self, points_m: Array) -> Array:  # noqa: D102
        return _grid_distances(self.data, np.ascontiguousarray(points_m, dtype=float))


@kernel()
def _gap(data: SurfaceData, p: Array, x: float, y: float) -> float:
    """Distance of a point to the surface's point at (x, y)."""
    h, _, _ = raycast.height_gradient(data, x, y)
    return float(np.sqrt((p[0] - x) ** 2 + (p[1] - y) ** 2 + (p[2] - h) ** 2))


@kernel()
def _nearest_start(data: SurfaceData, p: Array) -> Vector:
    """Nearest of 21 x 21 feet around a point: the true foot is no further off than |z - h|."""
    best_x, best_y, best = p[0], p[1], _gap(data, p, p[0], p[1])
    reach = best
    if reach < 0.25 * data.params[0]:  # within a cell: the tangent plane will do
        return best_x, best_y, best
    for j in range(-10, 11):
        for i in range(-10, 11):
            x, y = p[0] + 0.1 * i * reach, p[1] + 0.1 * j * reach
            d = _gap(data, p, x, y)
            if d < best:
                best_x, best_y, best = x, y, d
    return best_x, best_y, best


@kernel()
def _grid_distances(data: SurfaceData, points: Array) -> Array:
    """Distance to the start's foot, moved along tangent planes, by ever smaller steps."""
    out = np.empty(points.shape[0])
    for k in range(points.shape[0]):
        p = points[k]
        x, y, best = _nearest_start(data, p)
        share = 1.0
        while share > 1e-3:
            h, hx, hy = raycast.height_gradient(data, x, y)
            off = (p[2] - h - hx * (p[0] - x) - hy * (p[1] - y)) / (1.0 + hx * hx + hy * hy)
            new_x = x + share * (p[0] + hx * off - x)
            new_y = y + share * (p[1] + hy * off - y)
            d = _gap(data, p, new_x, new_y)
            gain = best - d
            if gain > 0.0:
                x, y, best = new_x, new_y, d
            if not gain > 1e-12:
                share *= 0.5
        out[k] = best
    return out


def _data(
    kind: int,
    params: Sequence[float],
    z_m: tuple[float, float],
    max_slope: float,
    *,
    step_m: float = 1.0,
    profile_m: Array | None = None,
    grid: Array | None = None,
) -> SurfaceData:
    """Pack a surface for the kernels; arrays that a kind does not use are empty."""
    return SurfaceData(
        kind,
        raycast.numbers([*params, 0.0, 0.0, 0.0, 0.0, 0.0][:5]),
        np.zeros((0, 2)) if profile_m is None else profile_m,
        np.zeros((2, 2)) if grid is None else grid,
        float(z_m[0]),
        float(z_m[1]),
        float(max_slope),
        step_m,
    )


def _profile(name: str, vertices_m: list[tuple[float, float]]) -> ProfileSurface:
    vertices = np.array([(-FAR_M, vertices_m[0][1]), *vertices_m, (FAR_M, vertices_m[-1][1])])
    run, rise = np.abs(np.diff(vertices, axis=0)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = float(np.nanmax(rise / run))
    z = vertices[:, 1]
    data = _data(raycast.PROFILE, (), (z.min(), z.max()), slope, profile_m=vertices)
    return ProfileSurface(name, data)


def flat() -> ProfileSurface:
    """Return the plane z = 0."""
    return _profile("flat", [(0.0, 0.0)])


def groove(included_angle_deg: float = 155.92, width_m: float = 6e-3) -> ProfileSurface:
    """Return a V-groove along y in the plane z = 0.

    Parameters
    ----------
    included_angle_deg : float
        In (0, 180); the paper's groove has 155.92 (Table 2).
    width_m : float
        At the top.
    """
    angle = included_angle_deg
    _check(0.0 < angle < 180.0, "included_angle_deg", angle, "in (0, 180)")
    _check(width_m > 0.0, "width_m", width_m, "positive")
    depth = 0.5 * width_m / np.tan(np.deg2rad(0.5 * angle))
    return _profile("groove", [(-width_m / 2, 0.0), (0.0, -float(depth)), (width_m / 2, 0.0)])


def steps(
    heights_m: Iterable[float] = (10e-6, 50e-6, 200e-6), width_m: float = 1.6e-3
) -> ProfileSurface:
    """Return bars along y on the plane z = 0, with vertical walls.

    Parameters
    ----------
    heights_m : iterable of float
        Of the bars from left to right; negative ones are channels.
    width_m : float
        Of bars and gaps: bar i of n spans ``((2 i - n + 1/2) width, (2 i - n + 3/2) width)``.
    """
    heights = [float(h) for h in heights_m]
    _check(len(heights) > 0 and all(np.isfinite(heights)), "heights_m", heights, "finite numbers")
    _check(width_m > 0.0, "width_m", width_m, "positive")
    vertices: list[tuple[float, float]] = []
    for i, height in enumerate(heights):
        left, right = (2 * i - len(heights) + 0.5) * width_m, (2 * i - len(heights) + 1.5) * width_m
        vertices += [(left, 0.0), (left, height), (right, height), (right, 0.0)]
    return _profile("steps", vertices)


def sphere_cap(radius_m: float = 50e-3, base_radius_m: float = 4e-3) -> SphereCap:
    """Return a cap of a sphere on the plane z = 0.

    Parameters
    ----------
    radius_m : float
        Of the sphere.
    base_radius_m : float
        Of the cap's foot circle.
    """
    _check(0.0 < base_radius_m < radius_m, "base_radius_m", base_radius_m, "in (0, radius_m)")
    down = float(np.sqrt(radius_m**2 - base_radius_m**2))
    params, slope = (radius_m, base_radius_m), base_radius_m / down
    return SphereCap("sphere_cap", _data(raycast.SPHERE, params, (0.0, radius_m - down), slope))


def hole_plate(
    pitch_m: float = 0.9e-3,
    diameter_m: float = 0.45e-3,
    columns: int = 10,
    rows: int = 10,
    chamfer_m: float = 0.0,
    hole_albedo: float = 0.02,
    origin_diameter_m: float | None = 0.6e-3,
    origin_id: tuple[int, int] = (3, 2),
    blocked: Iterable[tuple[int, int]] = (),
    turned_over: bool = False,
) -> HolePlate:
    """Return a plate with dark round holes on a square lattice centred on the origin.

    Parameters
    ----------
    pitch_m, diameter_m : float
        Distance of neighbours and diameter at the bottom of the chamfer.
    columns, rows : int
        Holes along x and y.
    chamfer_m : float
        Width (and depth) of a 45 degree chamfer around each hole; 0 for none.
    hole_albedo : float
        Reflectance in the hole, relative to the plate's.
    origin_diameter_m : float, optional
        Another diameter for one hole, the mark; None (or 0) for no mark.
    origin_id : (column, row)
        The mark; (0, 0) is the hole at the smallest x and y. Off diagonals and middle lines it
        shows which side of the plate is up.
    blocked : iterable of (column, row)
        Holes that are not there.
    turned_over : bool
        The plate lies on its face, turned about y: its holes go through, so that its back shows
        them mirrored in x.
    """
    _check(columns >= 2 and rows >= 2, "columns, rows", (columns, rows), "at least 2")
    widest = max(diameter_m, origin_diameter_m or 0.0)
    _check(min(diameter_m, pitch_m) > 0.0, "diameter_m, pitch_m", (diameter_m, pitch_m), "positive")
    _check(chamfer_m >= 0.0 and widest + 2 * chamfer_m < pitch_m, "widest hole", widest, "< pitch")
    _check(0.0 <= hole_albedo <= 1.0, "hole_albedo", hole_albedo, "in [0, 1]")
    radii = np.full((rows, columns), diameter_m / 2, dtype=np.float64)
    marked = [(*origin_id, origin_diameter_m / 2)] if origin_diameter_m else []
    for column, row, radius in [*marked, *((*hole, 0.0) for hole in blocked)]:
        inside = 0 <= column < columns and 0 <= row < rows
        _check(inside, "blocked, origin_id", (column, row), "in the lattice")
        radii[row, column] = radius
    if turned_over:
        radii = np.ascontiguousarray(radii[:, ::-1])
    data = _data(
        raycast.HOLES,
        (pitch_m, chamfer_m, hole_albedo, (columns - 1) / 2, (rows - 1) / 2),
        (-chamfer_m, 0.0),
        1.0 if chamfer_m else 0.0,
        step_m=max(chamfer_m, 1e-6) / 4,
        grid=radii,
    )
    return HolePlate("hole_plate", data)


def _grid(name: str, heights_m: NDArray[np.floating], step_m: float) -> GridSurface:
    grid = np.ascontiguousarray(heights_m, dtype=np.float64)
    slope_y, slope_x = np.abs(np.diff(grid, axis=0)).max(), np.abs(np.diff(grid, axis=1)).max()
    slope = float(np.hypot(slope_x, slope_y)) / step_m
    z = (grid.min(), grid.max())
    data = _data(raycast.GRID, (step_m,), z, slope, step_m=step_m / 2, grid=grid)
    return GridSurface(name, data)


def coin(height_m: float = 50e-6, flank_m: float = 80e-6) -> GridSurface:
    """Return a coin-like relief on the plane z = 0: rim, letters and a dome, flanks sloped.

    Parameters
    ----------
    height_m : float
        Height of rim and letters.
    flank_m : float
        Width of a flank; the steepest slope is 1.5 height / flank. From about 60 micrometres on
        (at 50 micrometres height) neither device of the reference rig finds a shadow.
    """
    _check(height_m > 0.0, "height_m", height_m, "positive")
    _check(20e-6 <= flank_m <= 200e-6, "flank_m", flank_m, "in [20e-6, 200e-6]")
    heights, step_m = coin_heights(height_m, flank_m)
    return _grid("coin", heights, step_m)


def height_map(
    source: str | Path | Array, step_m: float | None = None, unit_m: float = 1.0
) -> GridSurface:
    """Return a measured surface, centred on the origin, its mean height at z = 0.

    Parameters
    ----------
    source : path or ndarray (rows, columns)
        Heights, or a file of them: ``.npy``, 32-bit ``.tif``, GelSight ``.tmd``. The picture's
        first row lies at the largest y.
    step_m : float, optional
        Distance of neighbours; a TMD file has its own.
    unit_m : float
        What one unit of height is; ignored for a TMD file, which is in millimetres.

    Raises
    ------
    ConfigError
        When the file cannot be read, heights are not finite, or the step is missing.
    """
    if isinstance(source, str | Path):
        heights, file_step = read_height_file(Path(source), unit_m)
        step_m = step_m if file_step is None else file_step
    else:
        heights = np.asarray(source, dtype=np.float64) * unit_m
    _check(heights.ndim == 2 and min(heights.shape) >= 2, "heights.shape", heights.shape, "2-D")
    _check(bool(np.isfinite(heights).all()), "heights", "NaN or inf", "finite everywhere")
    if step_m is None or not 0.0 < step_m < 1.0:
        raise ConfigError(f"height map: step_m={step_m}; expected metres between samples")
    return _grid("height_map", heights[::-1] - heights.mean(), step_m)


def _check(good: bool, name: str, found: object, expected: str) -> None:
    if not good:
        raise ConfigError(f"surface: {name}={found}; expected {expected}")


SURFACES: dict[str, Callable[..., Surface]] = {
    "flat": flat,
    "hole_plate": hole_plate,
    "groove": groove,
    "coin": coin,
    "steps": steps,
    "sphere_cap": sphere_cap,
    "height_map": height_map,
}


def make_surface(name: str, **params: object) -> Surface:
    """Return a surface of the registry.

    Parameters
    ----------
    name : str
        A key of `SURFACES`.
    **params
        Its factory's parameters.

    Raises
    ------
    ConfigError
        When the name, a parameter's name or its value is not known.

    Examples
    --------
    >>> make_surface("groove", included_angle_deg=120.0).data.z_min_m < 0
    True
    """
    if name not in SURFACES:
        raise ConfigError(f"no surface is called {name!r}; expected one of {sorted(SURFACES)}")
    try:
        inspect.signature(SURFACES[name]).bind(**params)
    except TypeError as error:
        raise ConfigError(f"surface {name!r}: {error}") from None
    return SURFACES[name](**params)
