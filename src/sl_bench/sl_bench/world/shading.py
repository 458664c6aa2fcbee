"""Where each camera sample looks, where the projector lights it and how much of it comes back."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sl_bench.world import raycast
from sl_bench.world.optics import Finish, Optics
from sl_bench.world.photons import Image, mix
from sl_bench.world.raycast import DeviceData, Numbers, SurfaceData, Vector, View, inlined
from sl_common.errors import ConfigError
from sl_common.kernel_cache import kernel
from sl_reconstruct.model.rig import Rig

#: Map coordinate of a sample that sees no lit surface.
NOWHERE_PX = -1e6
#: Largest blur, pixels; more is taken for this.
MAX_BLUR_PX = 5.0
#: DMD pixels per camera pixel beyond which a map's gradient is a jump, not a slope.
MAX_GRADIENT = 6.0
#: Spacing of the samples, camera px; each stands for a square of that side.
SAMPLE_PX = 0.5
#: A sample nearer to a hole's rim than this many times its side may straddle it: half a diagonal,
#: seen along a 45 degree slope that leans away.
RIM_REACH = 2.0
#: Lines through a sample that straddles a rim, and steps to where the rim crosses each.
RIM_LINES = 4
RIM_STEPS = 5


Rows = tuple[int, int]
Pixel = tuple[float, float]
#: Sample maps in the order of `Sample`.
Maps = tuple[Image, ...]


class Light(NamedTuple):
    """`Optics` and `Finish` as the kernels read them; ``gain`` makes white 1 at the origin."""

    gain: float
    projector_blur_px: float
    projector_defocus: float
    projector_focus_m: float
    lens_defocus: float
    lens_focus_m: float
    uneven: float
    vignetting: float
    diffuse: float
    specular: float
    lobe_tan: float
    texture: float
    texture_m: float


class Sample(NamedTuple):
    """What one camera ray sees."""

    #: DMD coordinate that lights it, px.
    u: float
    v: float
    #: Light relative to white.
    reflected: float
    ambient: float
    #: Blur of the projector, DMD px^2, and of the lens beyond that in focus, camera px.
    variance: float
    extra_blur: float
    #: Whether a hole's rim is within reach of a sample about the ray.
    at_rim: bool


def light_data(rig: Rig, optics: Optics, finish: Finish) -> Light:
    """Pack the settings; white is a matt plate z = 0 at the world's origin.

    Parameters
    ----------
    rig : Rig
        The true one.
    optics : Optics
        Blur and light.
    finish : Finish
        Of the part.

    Raises
    ------
    ConfigError
        When the projector does not stand above the world's origin.
    """
    x, y, z = rig.projector.position_m
    if z <= 0.0 or rig.camera.position_m[2] <= 0.0:
        raise ConfigError(
            f"rig: projector at z={z:.4g} m, camera at z={rig.camera.position_m[2]:.4g} m; "
            f"expected both above the world's plane z = 0"
        )
    distance2 = x * x + y * y + z * z
    return Light(
        float(distance2**1.5 / z),
        optics.projector_blur_px,
        optics.projector_defocus_px_per_m,
        float(rig.projector.translation_m[2]),
        optics.lens_defocus_px_per_m,
        float(rig.camera.translation_m[2]),
        optics.uneven_light,
        optics.vignetting,
        finish.diffuse,
        finish.specular,
        finish.lobe_tan,
        finish.texture,
        finish.texture_m,
    )


@inlined
def _fall_off(size_px: Numbers, u: float, v: float, loss: float) -> float:
    """Quadratic loss from the middle of an image to its corner."""
    w, h = 0.5 * size_px[0], 0.5 * size_px[1]
    du, dv = u - w + 0.5, v - h + 0.5
    return float(max(1.0 - loss * (du * du + dv * dv) / (w * w + h * h), 0.0))


@kernel()
def _lattice(i: int, j: int) -> float:
    """Random number in [-1, 1) of a lattice point."""
    bits = mix(np.uint64(i) * np.uint64(0x9E3779B97F4A7C15) + mix(np.uint64(j)))
    return (bits >> np.uint64(40)) * (2.0 / 16777216.0) - 1.0


@inlined
def _texture(x: float, y: float) -> float:
    """Smooth random field in [-1, 1], grain 1, over the part's own x and y."""
    i, j = np.floor(x), np.floor(y)
    fx, fy = x - i, y - j
    fx, fy = fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy)
    i, j = int(i), int(j)
    low = _lattice(i, j) * (1.0 - fx) + _lattice(i + 1, j) * fx
    high = _lattice(i, j + 1) * (1.0 - fx) + _lattice(i + 1, j + 1) * fx
    return float(low * (1.0 - fy) + high * fy)


@inlined
def _unit(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Direction of a vector, and its length."""
    length = np.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length, length


@inlined
def _lobe(light: Light, n: Vector, to_light: Vector, to_eye: Vector) -> float:
    """Specular lobe about the mirror direction, over the half vector (Beckmann)."""
    hx, hy, hz, _ = _unit(to_light[0] + to_eye[0], to_light[1] + to_eye[1], to_light[2] + to_eye[2])
    c = n[0] * hx + n[1] * hy + n[2] * hz
    if c <= 0.0:
        return 0.0
    slope2 = (1.0 / (c * c) - 1.0) / (light.lobe_tan * light.lobe_tan)
    return float(light.specular * np.exp(-slope2))


@inlined
def _reflected(view: View, light: Light, p: Vector, n: Vector, d: Vector, base: float) -> float:
    """Share of the projector's light that point p sends along -d; 0 in shadow."""
    o = view.projector.position_m
    lx, ly, lz, distance = _unit(o[0] - p[0], o[1] - p[1], o[2] - p[2])
    cos_in = n[0] * lx + n[1] * ly + n[2] * lz
    if cos_in <= 0.0 or raycast.shadowed(view.surface, p, o):
        return 0.0
    share = light.diffuse
    if light.specular > 0.0:
        ex, ey, ez, _ = _unit(-d[0], -d[1], -d[2])
        share += _lobe(light, n, (lx, ly, lz), (ex, ey, ez))
    return base * share * light.gain * cos_in / (distance * distance)


@inlined
def _defocused(depth: float, focus: float, per_m: float) -> float:
    """Standard deviation, px, that defocus adds in quadrature."""
    return per_m * (depth - focus)


@inlined
def _sample(view: View, light: Light, qu: float, qv: float) -> Sample:
    """One camera ray."""
    surface, camera, projector = view.surface, view.camera, view.projector
    o, d = camera.position_m, raycast.ray(camera, qu, qv)
    t, nx, ny, nz = raycast.first_hit(surface, (o[0], o[1], o[2]), d)
    if not t < np.inf:
        return Sample(NOWHERE_PX, NOWHERE_PX, 0.0, 0.0, 0.0, 0.0, False)
    p = (o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2])
    off, _ = raycast.rim_distance(surface, p[0], p[1])
    at_rim = abs(off) < RIM_REACH * SAMPLE_PX * t / camera.focal_px[0]
    base = raycast.albedo(surface, p[0], p[1])
    base *= _fall_off(camera.size_px, qu, qv, light.vignetting)
    if light.texture > 0.0:
        base *= 1.0 + light.texture * _texture(p[0] / light.texture_m, p[1] / light.texture_m)
    ambient = base * light.diffuse
    u, v, depth = raycast.project(projector, p[0], p[1], p[2])
    spread = _defocused(depth, light.projector_focus_m, light.projector_defocus)
    extra = _defocused(t, light.lens_focus_m, light.lens_defocus)
    if not (abs(u) < 1e5 and abs(v) < 1e5):
        return Sample(NOWHERE_PX, NOWHERE_PX, 0.0, ambient, 0.0, extra, at_rim)
    reflected = 0.0
    pad = 4.0 * MAX_BLUR_PX
    if -pad < u < projector.size_px[0] + pad and -pad < v < projector.size_px[1] + pad:
        reflected = _reflected(view, light, p, (nx, ny, nz), d, base)
        reflected *= _fall_off(projector.size_px, u, v, light.uneven)
    variance = light.projector_blur_px**2 + spread * spread
    return Sample(u, v, reflected, ambient, variance, extra, at_rim)


@inlined
def _off_rim(surface: SurfaceData, camera: DeviceData, qu: float, qv: float, rim_m: float) -> float:
    """Distance outside a circle about the axis of the hole that a camera ray sees."""
    o, d = camera.position_m, raycast.ray(camera, qu, qv)
    t, _, _, _ = raycast.first_hit(surface, (o[0], o[1], o[2]), d)
    return raycast.hole_distance(surface, o[0] + t * d[0], o[1] + t * d[1])[0] - rim_m


@kernel()
def _crossing(
    surface: SurfaceData, camera: DeviceData, q: Pixel, along: Pixel, rim_m: float
) -> float:
    """Where in [-1, 1] a line ``q + x along`` crosses a rim; 1 where it does not (Illinois)."""
    a, b = -1.0, 1.0
    fa = _off_rim(surface, camera, q[0] - along[0], q[1] - along[1], rim_m)
    fb = _off_rim(surface, camera, q[0] + along[0], q[1] + along[1], rim_m)
    if (fa > 0.0) == (fb > 0.0):
        return 1.0
    x = a
    for _ in range(RIM_STEPS):
        x = (a * fb - b * fa) / (fb - fa)
        f = _off_rim(surface, camera, q[0] + x * along[0], q[1] + x * along[1], rim_m)
        if (f > 0.0) == (fb > 0.0):
            b, fb, fa = x, f, 0.5 * fa
        else:
            a, fa, fb = x, f, 0.5 * fb
    return x


@kernel()
def _across_rim(surface: SurfaceData, camera: DeviceData, q: Pixel, rim_m: float) -> Pixel:
    """Half a sample's side (du, dv) along the image axis that crosses the rim more squarely."""
    h = 0.5 * SAMPLE_PX
    by_u = _off_rim(surface, camera, q[0] + h, q[1], rim_m)
    by_u -= _off_rim(surface, camera, q[0] - h, q[1], rim_m)
    by_v = _off_rim(surface, camera, q[0], q[1] + h, rim_m)
    by_v -= _off_rim(surface, camera, q[0], q[1] - h, rim_m)
    return (h, 0.0) if abs(by_u) > abs(by_v) else (0.0, h)


@kernel()
def _straddling(view: View, light: Light, q: Pixel) -> tuple[float, float]:
    """Mean (reflected, ambient) over a sample that straddles rims of a hole.

    On each of a few lines through the sample, hole, chamfer and face count with their exact
    lengths: a ramp over the rim would shift it where slope and floor are foreshortened unlike.
    """
    surface, camera = view.surface, view.camera
    o, d = camera.position_m, raycast.ray(camera, q[0], q[1])
    t, _, _, _ = raycast.first_hit(surface, (o[0], o[1], o[2]), d)
    _, rim_m = raycast.rim_distance(surface, o[0] + t * d[0], o[1] + t * d[1])
    _, radius_m, _, _ = raycast.hole_distance(surface, o[0] + t * d[0], o[1] + t * d[1])
    along = _across_rim(surface, camera, q, rim_m)
    reflected, ambient = 0.0, 0.0
    for line in range(RIM_LINES):
        aside = (2.0 * line + 1.0) / RIM_LINES - 1.0
        at = (q[0] + aside * along[1], q[1] + aside * along[0])
        one = _crossing(surface, camera, at, along, radius_m)
        two = _crossing(surface, camera, at, along, radius_m + surface.params[1])
        start = -1.0
        for stop in (min(one, two), max(one, two), 1.0):
            if stop > start:
                x = 0.5 * (start + stop)
                found = _sample(view, light, at[0] + x * along[0], at[1] + x * along[1])
                reflected += (stop - start) * found.reflected
                ambient += (stop - start) * found.ambient
                start = stop
    return reflected / (2.0 * RIM_LINES), ambient / (2.0 * RIM_LINES)


@kernel()
def trace_rows(view: View, light: Light, margin: int, rows: Rows, maps: Maps) -> None:
    """Fill some rows of six sample maps.

    Samples lie at -0.25 and +0.25 px of each pixel. A sample is what its middle ray sees; where a
    hole's rim goes through it, its light is the mean over its square.

    Parameters
    ----------
    view : View
        Part and devices.
    light : Light
        From `light_data`.
    margin : int
        Pixels that the maps have more than the image on each side.
    rows : tuple of int
        First row of the maps and the one behind the last.
    maps : tuple of ndarray, (2 (H + 2 margin), 2 (W + 2 margin)) float32
        Receive u, v, reflected, ambient, variance, extra blur; see `Sample`.
    """
    view = View(raycast.bare(view.surface), view.camera, view.projector)
    for j in range(rows[0], rows[1]):
        for i in range(maps[0].shape[1]):
            q = (SAMPLE_PX * i - 0.25 - margin, SAMPLE_PX * j - 0.25 - margin)
            found = _sample(view, light, q[0], q[1])
            maps[0][j, i], maps[1][j, i], maps[2][j, i] = found.u, found.v, found.reflected
            maps[3][j, i], maps[4][j, i] = found.ambient, found.variance
            maps[5][j, i] = found.extra_blur
            if found.at_rim:
                maps[2][j, i], maps[3][j, i] = _straddling(view, light, q)


@inlined
def _slope(before: float, here: float, after: float) -> float:
    """Change per sample, by the smoother side: a jump of the surface is no slope."""
    a, b = here - before, after - here
    return a if abs(a) < abs(b) else b


@kernel()
def _carry(m: Image, j: int, spread: Image, extra: Image, out: Image) -> None:
    """Variance on the DMD along one of its axes, px^2, of a row of samples.

    The squared gradient of the map, per camera pixel squared, carries the lens's extra blur to
    the DMD; at the border of the map there is none.
    """
    top, steep = np.float32(MAX_BLUR_PX**2), np.float32(MAX_GRADIENT**2)
    here, last = m[j], m.shape[1] - 1
    inner = 0 < j < m.shape[0] - 1
    above, below = (m[j - 1], m[j + 1]) if inner else (here, here)
    for i in range(1, last):
        gx = _slope(here[i - 1], here[i], here[i + 1])
        gy = _slope(above[i], here[i], below[i])
        steepness = min(np.float32(4.0) * (gx * gx + gy * gy), steep)
        out[i] = min(spread[i] + extra[i] * extra[i] * steepness, top)
    for i in (0, last):
        gy = _slope(above[i], here[i], below[i])
        steepness = min(np.float32(4.0) * gy * gy, steep)
        out[i] = min(spread[i] + extra[i] * extra[i] * steepness, top)


@kernel()
def blur_rows(maps: Maps, rows: Rows) -> None:
    """Turn maps 4 and 5 into the variances of columns and of rows on the DMD, px^2.

    The lens's blur beyond that in focus is carried to the DMD by the local gradient of u (v).

    Parameters
    ----------
    maps : tuple of ndarray
        From `trace_rows`.
    rows : tuple of int
        First row and the one behind the last.
    """
    spread = np.empty(maps[0].shape[1], dtype=np.float32)
    extra = np.empty_like(spread)
    for j in range(rows[0], rows[1]):
        spread[:], extra[:] = maps[4][j], maps[5][j]
        _carry(maps[0], j, spread, extra, maps[4][j])
        _carry(maps[1], j, spread, extra, maps[5][j])


@kernel()
def variance_range(variance: Image, lit: Image, rows: Rows) -> tuple[float, float]:
    """Smallest and largest variance of lit samples; (inf, 0) where none is.

    Parameters
    ----------
    variance, lit : ndarray
        Sample maps: blur, reflected light.
    rows : tuple of int
        First row and the one behind the last.
    """
    low, high = np.inf, 0.0
    for j in range(rows[0], rows[1]):
        for i in range(lit.shape[1]):
            if lit[j, i] > 0.0:
                low, high = min(low, variance[j, i]), max(high, variance[j, i])
    return low, high
