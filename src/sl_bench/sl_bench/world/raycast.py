"""Rays against surfaces: the geometry kernels of the bench, in the part's own frame.

The device kernels write Eqs. (1) and (2) of Tsai & Hung (2005) a second time, apart from
``sl_reconstruct.model.rig``; a test holds the two together. All lengths are metres. A ray is
``origin + t * direction``; a camera ray's direction has unit depth, so t is its depth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numba import carray, njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from sl_common.kernel_cache import kernel
from sl_reconstruct.model.rig import Device, Division

Array = NDArray[np.float64]
Numbers = tuple[float, ...]
Vector = tuple[float, float, float]
_FunctionT = TypeVar("_FunctionT", bound=Callable[..., Any])

#: Kinds of surface that the kernels tell apart.
PROFILE, SPHERE, HOLES, GRID = 0, 1, 2, 3
#: Kinds of lens.
DIVISION, BROWN_CONRADY = 0, 1


class SurfaceData(NamedTuple):
    """What the kernels know of a surface; numbers are tuples, which cost no reference counting.

    ``params`` means: SPHERE (radius, base radius); HOLES (pitch, chamfer, hole albedo, pitches
    from the lattice's first hole to the origin in x, in y); GRID (grid step). ``grid`` means: HOLES
    radius of each hole (0: none), row 0 at the smallest y; GRID heights, likewise.
    """

    kind: int
    params: Numbers
    profile_m: Array
    grid: Array
    z_min_m: float
    z_max_m: float
    max_slope: float
    step_m: float


class DeviceData(NamedTuple):
    """A device as seen from the part; ``rotation`` and ``translation_m`` are device_from_part."""

    focal_px: Numbers
    centre_px: Numbers
    lens: int
    coefficients: Numbers
    rotation: tuple[Numbers, Numbers, Numbers]
    translation_m: Vector
    position_m: Vector
    size_px: Numbers


class View(NamedTuple):
    """A part and the devices that look at it."""

    surface: SurfaceData
    camera: DeviceData
    projector: DeviceData


def device_data(device: Device, rotation: Array, translation_m: Array) -> DeviceData:
    """Pack a device for the kernels.

    Parameters
    ----------
    device : Device
        Camera or projector.
    rotation, translation_m : ndarray, (3, 3), (3,)
        world_from_part.
    """
    if isinstance(device.lens, Division):
        lens, coefficients = DIVISION, [device.lens.kappa, 0.0, 0.0, 0.0, 0.0]
    else:
        lens, coefficients = BROWN_CONRADY, list(device.lens.coefficients)
    turn = device.rotation @ rotation
    shift = device.rotation @ translation_m + device.translation_m
    return DeviceData(
        focal_px=numbers(device.focal_px),
        centre_px=numbers(device.centre_px),
        lens=lens,
        coefficients=numbers(coefficients),
        rotation=(numbers(turn[0]), numbers(turn[1]), numbers(turn[2])),
        translation_m=_vector(shift),
        position_m=_vector(-turn.T @ shift),
        size_px=numbers(device.image_size),
    )


def numbers(values: Iterable[float]) -> Numbers:
    """Python floats of any row of numbers."""
    return tuple(float(v) for v in values)


def _vector(values: Iterable[float]) -> Vector:
    x, y, z = map(float, values)
    return x, y, z


def inlined(function: _FunctionT) -> _FunctionT:
    """Compile a part of a kernel: handing surface and devices on costs more than its work."""
    compile_ = njit(
        nogil=True, error_model="numpy", forceinline=True, fastmath={"arcp", "contract"}
    )
    compiled: _FunctionT = compile_(function)
    return compiled


@intrinsic
def _pointer(typing_context: Any, address: Any) -> Any:
    """Address of an array's data as a pointer that `carray` takes."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(address), code


@kernel()
def bare(surface: SurfaceData) -> SurfaceData:
    """Return the surface with views of its arrays that are not reference-counted.

    Counting is atomic: done at every ray by every thread it costs ten times the ray.
    """
    return SurfaceData(
        surface.kind,
        surface.params,
        carray(_pointer(surface.profile_m.ctypes.data), surface.profile_m.shape, np.float64),
        carray(_pointer(surface.grid.ctypes.data), surface.grid.shape, np.float64),
        surface.z_min_m,
        surface.z_max_m,
        surface.max_slope,
        surface.step_m,
    )


@kernel()
def _brown(c: Numbers, x: float, y: float) -> Vector:
    """Radial factor and tangential shift (x, y) of OpenCV's k1 k2 p1 p2 k3."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (c[0] + r2 * (c[1] + r2 * c[4]))
    tx = 2.0 * c[2] * x * y + c[3] * (r2 + 2.0 * x * x)
    ty = c[2] * (r2 + 2.0 * y * y) + 2.0 * c[3] * x * y
    return radial, tx, ty


@inlined
def ray(device: DeviceData, u: float, v: float) -> Vector:
    """Direction (x, y, z), unit depth, of the ray through an observed pixel (Eq. 2).

    Parameters
    ----------
    device, u, v
        The device; its pixel.
    """
    du, dv = u - device.centre_px[0], v - device.centre_px[1]
    if device.lens == DIVISION:
        scale = 1.0 + device.coefficients[0] * (du * du + dv * dv)
        x, y = du * scale / device.focal_px[0], dv * scale / device.focal_px[1]
    else:
        xd, yd = du / device.focal_px[0], dv / device.focal_px[1]
        x, y = xd, yd
        for _ in range(40):
            radial, tx, ty = _brown(device.coefficients, x, y)
            x, y = (xd - tx) / radial, (yd - ty) / radial
    R = device.rotation
    return (
        R[0][0] * x + R[1][0] * y + R[2][0],
        R[0][1] * x + R[1][1] * y + R[2][1],
        R[0][2] * x + R[1][2] * y + R[2][2],
    )


@inlined
def project(device: DeviceData, x: float, y: float, z: float) -> Vector:
    """Observed pixel and depth (u, v, depth) of a point; (nan, nan, depth) where there is none.

    Parameters
    ----------
    device, x, y, z
        The device; the point, part frame.
    """
    R, T = device.rotation, device.translation_m
    depth = R[2][0] * x + R[2][1] * y + R[2][2] * z + T[2]
    if depth <= 0.0:
        return np.nan, np.nan, depth
    xn = (R[0][0] * x + R[0][1] * y + R[0][2] * z + T[0]) / depth
    yn = (R[1][0] * x + R[1][1] * y + R[1][2] * z + T[1]) / depth
    if device.lens == DIVISION:
        xn, yn = xn * device.focal_px[0], yn * device.focal_px[1]
        a = device.coefficients[0] * (xn * xn + yn * yn)
        s = 1.0 + a * (-1.0 + a * (3.0 - 12.0 * a))
        miss = s + a * s * s * s - 1.0
        for _ in range(3):  # s (1 + a s^2) = 1: the series is within 0.01 for |a| < 0.1
            if abs(miss) > 1e-14:
                s -= miss / (1.0 + 3.0 * a * s * s)
                miss = s + a * s * s * s - 1.0
        if not abs(miss) <= 1e-9:
            s = np.nan
        return device.centre_px[0] + xn * s, device.centre_px[1] + yn * s, depth
    radial, tx, ty = _brown(device.coefficients, xn, yn)
    return (
        device.centre_px[0] + device.focal_px[0] * (xn * radial + tx),
        device.centre_px[1] + device.focal_px[1] * (yn * radial + ty),
        depth,
    )


@inlined
def hole_distance(surface: SurfaceData, x: float, y: float) -> tuple[float, float, float, float]:
    """Distance to the nearest lattice hole's axis, its radius (0: no hole), and its (cx, cy).

    Parameters
    ----------
    surface, x, y
        Of kind HOLES; place on it.
    """
    pitch = surface.params[0]
    rows, columns = surface.grid.shape
    i = min(max(int(np.rint(x / pitch + surface.params[3])), 0), columns - 1)
    j = min(max(int(np.rint(y / pitch + surface.params[4])), 0), rows - 1)
    cx = (i - surface.params[3]) * pitch
    cy = (j - surface.params[4]) * pitch
    return np.sqrt((x - cx) ** 2 + (y - cy) ** 2), surface.grid[j, i], cx, cy


@inlined
def albedo(surface: SurfaceData, x: float, y: float) -> float:
    """Reflectance of the shape itself, relative to the finish: 1 except in holes.

    Parameters
    ----------
    surface, x, y
        The surface; place on it.
    """
    if surface.kind != HOLES:
        return 1.0
    r, radius, _, _ = hole_distance(surface, x, y)
    return 1.0 if r > radius or radius == 0.0 else surface.params[2]


@inlined
def rim_distance(surface: SurfaceData, x: float, y: float) -> tuple[float, float]:
    """Distance outside the nearest rim of the nearest hole, and that rim's radius.

    A chamfer has a rim at its bottom and one at its top; (inf, 0) where there is no hole.

    Parameters
    ----------
    surface, x, y
        The surface; place on it.
    """
    if surface.kind != HOLES:
        return np.inf, 0.0
    r, radius, _, _ = hole_distance(surface, x, y)
    if radius == 0.0:
        return np.inf, 0.0
    top = radius + surface.params[1]
    return (r - radius, radius) if r < 0.5 * (radius + top) else (r - top, top)


@inlined
def _chamfer_height(surface: SurfaceData, x: float, y: float) -> Vector:
    """45 degree chamfer around each hole, then a floor: the hole itself is only dark."""
    r, radius, cx, cy = hole_distance(surface, x, y)
    chamfer = surface.params[1]
    if radius == 0.0 or r >= radius + chamfer:
        return 0.0, 0.0, 0.0
    if r <= radius:
        return -chamfer, 0.0, 0.0
    return r - radius - chamfer, (x - cx) / r, (y - cy) / r


@inlined
def _grid_height(surface: SurfaceData, x: float, y: float) -> Vector:
    """Bilinear height and its gradient; the border's height goes on outside."""
    grid, step = surface.grid, surface.params[0]
    rows, columns = grid.shape
    gx = x / step + 0.5 * (columns - 1)
    gy = y / step + 0.5 * (rows - 1)
    in_x = 1.0 if 0.0 <= gx <= columns - 1 else 0.0
    in_y = 1.0 if 0.0 <= gy <= rows - 1 else 0.0
    gx = min(max(gx, 0.0), columns - 1.0)
    gy = min(max(gy, 0.0), rows - 1.0)
    i, j = min(int(gx), columns - 2), min(int(gy), rows - 2)
    fx, fy = gx - i, gy - j
    a, b = np.float64(grid[j, i]), np.float64(grid[j, i + 1])
    c, d = np.float64(grid[j + 1, i]), np.float64(grid[j + 1, i + 1])
    low, high = a + fx * (b - a), c + fx * (d - c)
    slope_x = ((b - a) * (1.0 - fy) + (d - c) * fy) / step
    return low + fy * (high - low), in_x * slope_x, in_y * (high - low) / step


@inlined
def height_gradient(surface: SurfaceData, x: float, y: float) -> Vector:
    """Height and gradient (h, dh/dx, dh/dy).

    Parameters
    ----------
    surface, x, y
        Of a kind that is solved for, HOLES or GRID; place on it.
    """
    if surface.kind == GRID:
        return _grid_height(surface, x, y)
    return _chamfer_height(surface, x, y)


@inlined
def _hit_profile(
    surface: SurfaceData, ox: float, oz: float, dx: float, dz: float, nearest: float
) -> Vector:
    """First t > nearest at which the ray meets the polyline, and that segment's normal."""
    best, nx, nz = np.inf, 0.0, 1.0
    vertices = surface.profile_m
    for k in range(vertices.shape[0] - 1):
        ex, ez = vertices[k + 1, 0] - vertices[k, 0], vertices[k + 1, 1] - vertices[k, 1]
        ax, az = vertices[k, 0] - ox, vertices[k, 1] - oz
        # Cross products tell the side before a division is paid for; the slack closes the seams.
        det = dx * ez - dz * ex
        along = ax * dz - az * dx
        if det < 0.0:
            det, along = -det, -along
            sign = -1.0
        else:
            sign = 1.0
        slack = 1e-12 * det
        if det == 0.0 or along < -slack or along > det + slack:
            continue
        t = sign * (ax * ez - az * ex) / det
        if nearest < t < best:
            best, nx, nz = t, -ez, ex
    length = np.sqrt(nx * nx + nz * nz)
    return best, nx / length, nz / length


@inlined
def _hit_sphere(
    surface: SurfaceData, o: Vector, d: Vector, nearest: float
) -> tuple[float, float, float, float]:
    """First hit of a sphere cap that stands on the plane z = 0."""
    radius, base = surface.params[0], surface.params[1]
    cz = -np.sqrt(radius * radius - base * base)
    best, nx, ny, nz = np.inf, 0.0, 0.0, 1.0
    if d[2] != 0.0:
        t = -o[2] / d[2]
        x, y = o[0] + t * d[0], o[1] + t * d[1]
        if t > nearest and x * x + y * y >= base * base:
            best = t
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    b = o[0] * d[0] + o[1] * d[1] + (o[2] - cz) * d[2]
    c = o[0] * o[0] + o[1] * o[1] + (o[2] - cz) * (o[2] - cz) - radius * radius
    disc = b * b - a * c
    if disc > 0.0:
        # The nearer root without cancellation; b < 0 for a ray that comes towards the centre.
        t = c / (-b + np.sqrt(disc)) if b < 0.0 else (-b - np.sqrt(disc)) / a
        if nearest < t < best and o[2] + t * d[2] >= 0.0:
            best = t
            nx, ny = (o[0] + t * d[0]) / radius, (o[1] + t * d[1]) / radius
            nz = (o[2] + t * d[2] - cz) / radius
    return best, nx, ny, nz


@inlined
def _refine(surface: SurfaceData, o: Vector, d: Vector, above: float, below: float) -> float:
    """Root of ray height over surface between ``above`` (> 0) and ``below`` (< 0): safe Newton."""
    t = 0.5 * (above + below)
    for _ in range(60):
        h, hx, hy = height_gradient(surface, o[0] + t * d[0], o[1] + t * d[1])
        gap = o[2] + t * d[2] - h
        if gap > 0.0:
            above = t
        else:
            below = t
        rate = d[2] - hx * d[0] - hy * d[1]
        new = t - gap / rate if rate < 0.0 else above
        if abs(new - t) * abs(d[2]) < 1e-13:
            return new
        if not above < new < below:
            new = 0.5 * (above + below)
        t = new
    return t


@inlined
def _hit_field(surface: SurfaceData, o: Vector, d: Vector) -> float:
    """First hit of a ray that comes down on a HOLES or GRID surface."""
    start = (surface.z_max_m + 1e-9 - o[2]) / d[2]
    stop = (surface.z_min_m - 1e-9 - o[2]) / d[2]
    level = np.hypot(d[0], d[1])
    if surface.max_slope * level < -d[2]:  # the gap falls all along the ray: one root
        return _refine(surface, o, d, start, stop)
    steps = int((stop - start) * level / surface.step_m) + 1
    dt = (stop - start) / steps
    for k in range(1, steps + 1):
        t = start + k * dt
        h, _, _ = height_gradient(surface, o[0] + t * d[0], o[1] + t * d[1])
        if o[2] + t * d[2] <= h:
            return _refine(surface, o, d, t - dt, t)
    return np.inf


@inlined
def first_hit(surface: SurfaceData, o: Vector, d: Vector) -> tuple[float, float, float, float]:
    """First hit (t, nx, ny, nz) of a ray that comes from above; t is inf where there is none.

    Parameters
    ----------
    surface, o, d
        The surface; origin and direction (x, y, z) of the ray, part frame.
    """
    if surface.kind == PROFILE:
        t, nx, nz = _hit_profile(surface, o[0], o[2], d[0], d[2], 0.0)
        return t, nx, 0.0, nz
    if surface.kind == SPHERE:
        return _hit_sphere(surface, o, d, 0.0)
    if d[2] >= 0.0:
        return np.inf, 0.0, 0.0, 1.0
    if surface.z_max_m == surface.z_min_m:  # holes without chamfer: a plane
        return (surface.z_max_m - o[2]) / d[2], 0.0, 0.0, 1.0
    t = _hit_field(surface, o, d)
    _, hx, hy = height_gradient(surface, o[0] + t * d[0], o[1] + t * d[1])
    scale = 1.0 / np.sqrt(1.0 + hx * hx + hy * hy)
    return t, -hx * scale, -hy * scale, scale


@inlined
def _shadow_field(surface: SurfaceData, p: Vector, d: Vector) -> bool:
    """Whether a HOLES or GRID surface is met on the way from p along d."""
    if d[2] <= 0.0:
        return True
    level = np.hypot(d[0], d[1])
    if surface.max_slope * level < d[2]:
        return False
    steps = int((surface.z_max_m - p[2]) / d[2] * level / surface.step_m) + 1
    dt = surface.step_m / level
    for k in range(steps):
        t = (k + 0.5) * dt
        h, _, _ = height_gradient(surface, p[0] + t * d[0], p[1] + t * d[1])
        if h > p[2] + t * d[2] + 1e-9:
            return True
    return False


@inlined
def shadowed(surface: SurfaceData, p: Vector, light: Vector) -> bool:
    """Whether the surface stands between its own point p and the light.

    Parameters
    ----------
    surface, p, light
        The surface; (x, y, z) of both points, part frame.
    """
    d = (light[0] - p[0], light[1] - p[1], light[2] - p[2])
    # t is 1 at the light, about 0.1 m away: 1e-7 steps 10 nm off the point's own facet.
    if surface.kind == PROFILE:
        t, _, _ = _hit_profile(surface, p[0], p[2], d[0], d[2], 1e-7)
        return t < 1.0
    if surface.kind == SPHERE:
        t, _, _, _ = _hit_sphere(surface, p, d, 1e-7)
        return t < 1.0
    if surface.z_max_m == surface.z_min_m:
        return d[2] <= 0.0
    return _shadow_field(surface, p, d)
