"""Triangulation, Eqs. (3) and (4), of whole rows.

The camera ray ``O + t d`` in projector coordinates is ``a + t b``. A boundary fixes the
projector's observed u, so ``t = (X a_z - a_x) / (b_x - X b_z)`` with X the ideal slope u: three
equations, one solution. X depends weakly on the row through the lens, hence a short fixed-point
iteration. Lengths are metres, arithmetic is double.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sl_reconstruct.rig import Device, Division, Rig

DIVISION, BROWN_CONRADY = 0, 1
#: Iterations allowed to a lens model. They contract by the distortion (0.1 at most), so that the
#: last step, of SOLVED in slope, leaves less than 1e-10 m at 1 m.
MAX_ITERATIONS = 60
SOLVED = 1e-9
#: An undistortion without such a margin goes on to this step.
EXACT = 1e-14

Array = NDArray[np.float64]


class Optics(NamedTuple):
    """A device's image side: ``model``, (fx, fy, Cu, Cv) and the lens's five numbers."""

    model: int
    fx: float
    fy: float
    cu: float
    cv: float
    lens: Array


class Geometry(NamedTuple):
    """A rig for the kernels.

    ``origin``: camera centre in the world; ``world``: world_from_camera rotation; ``a``: camera
    centre in the projector; ``b``: projector_from_camera rotation.
    """

    camera: Optics
    projector: Optics
    origin: Array
    world: Array
    a: Array
    b: Array


class Rays(NamedTuple):
    """Scratch for one row, one entry per boundary.

    ``x``, ``y``: ideal camera slopes; ``dx``, ``dy``: their change per pixel of u; ``bx``,
    ``by``, ``bz``: the camera ray in the projector; ``state``: what the lens iteration keeps (h
    of the paper's lens, slope x of OpenCV's); ``slope``: ideal slope X of the boundary. Results:
    ``px``, ``py``, ``pz`` in the world, ``dz``: dz/du, ``depth``: the smaller of both depths.
    """

    x: Array
    y: Array
    dx: Array
    dy: Array
    bx: Array
    by: Array
    bz: Array
    state: Array
    slope: Array
    px: Array
    py: Array
    pz: Array
    dz: Array
    depth: Array


def optics(device: Device) -> Optics:
    """Return the numbers of a device's image side."""
    if isinstance(device.lens, Division):
        model, lens = DIVISION, [device.lens.kappa, 0, 0, 0, 0]
    else:
        model, lens = BROWN_CONRADY, list(device.lens.coefficients)
    (fx, fy), (cu, cv) = device.focal_length_px, device.image_centre_px
    return Optics(model, float(fx), float(fy), float(cu), float(cv), np.array(lens, dtype=float))


def geometry(rig: Rig) -> Geometry:
    """Prepare a rig for the kernels."""
    camera, projector = rig.camera, rig.projector
    return Geometry(
        optics(camera), optics(projector), camera.position_m,
        np.ascontiguousarray(camera.rotation.T),
        projector.rotation @ camera.position_m + projector.translation_m,
        np.ascontiguousarray(projector.rotation @ camera.rotation.T),
    )  # fmt: skip


def ray_row(n: int) -> Rays:
    """Return scratch for n boundaries."""
    return Rays(*(np.zeros(n) for _ in Rays._fields))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def brown_forward(lens: Any, x: float, y: float) -> tuple[float, float, float, float, float]:
    """Radial factor, tangential shifts, and derivatives dxd/dx, dyd/dx of OpenCV's model."""
    r2 = x * x + y * y
    radial = 1 + r2 * (lens[0] + r2 * (lens[1] + r2 * lens[4]))
    tx = 2 * lens[2] * x * y + lens[3] * (r2 + 2 * x * x)
    ty = lens[2] * (r2 + 2 * y * y) + 2 * lens[3] * x * y
    d = 2 * (lens[0] + r2 * (2 * lens[1] + 3 * r2 * lens[4]))
    return radial, tx, ty, radial + d * x * x, d * x * y


@njit(cache=True, nogil=True, error_model="numpy")
def _division_rays(o: Optics, u: Any, v: float, r: Rays) -> None:
    kappa, dv = o.lens[0], v - o.cv
    for k in range(r.x.size):
        du = u[k] - o.cu
        h = 1 + kappa * (du * du + dv * dv)
        r.x[k] = du * h / o.fx
        r.y[k] = dv * h / o.fy
        r.dx[k] = (h + 2 * kappa * du * du) / o.fx
        r.dy[k] = 2 * kappa * du * dv / o.fy


@njit(cache=True, nogil=True, error_model="numpy")
def brown_undistort(lens: Any, xd: float, yd: float) -> tuple[float, float]:
    """Ideal slopes of observed ones, by fixed-point iteration."""
    x, y = xd, yd
    for _ in range(MAX_ITERATIONS):
        radial, tx, ty, _, _ = brown_forward(lens, x, y)
        last_x, last_y = x, y
        x, y = (xd - tx) / radial, (yd - ty) / radial
        if not abs(x - last_x) + abs(y - last_y) > EXACT:
            break
    return x, y


@njit(cache=True, nogil=True, error_model="numpy")
def _brown_rays(o: Optics, u: Any, v: float, r: Rays) -> None:
    for k in range(r.x.size):
        x, y = brown_undistort(o.lens, (u[k] - o.cu) / o.fx, (v - o.cv) / o.fy)
        radial, _, _, dxx, dyx = brown_forward(o.lens, x, y)
        r.x[k], r.y[k] = x, y
        r.dx[k] = 1 / (dxx * o.fx)
        r.dy[k] = -dyx / (dxx * radial * o.fx)


@njit(cache=True, nogil=True, error_model="numpy")
def camera_rays(g: Geometry, u: Any, v: float, r: Rays) -> None:
    """Fill the rays of observed camera pixels (u, v): ideal slopes, derivatives along u."""
    if g.camera.model == DIVISION:
        _division_rays(g.camera, u, v, r)
    else:
        _brown_rays(g.camera, u, v, r)
    b = g.b
    for k in range(r.x.size):
        x, y = r.x[k], r.y[k]
        r.bx[k] = b[0, 0] * x + b[0, 1] * y + b[0, 2]
        r.by[k] = b[1, 0] * x + b[1, 1] * y + b[1, 2]
        r.bz[k] = b[2, 0] * x + b[2, 1] * y + b[2, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def _start(g: Geometry, u_d: Any, r: Rays) -> None:
    o = g.projector
    for k in range(r.x.size):
        du = u_d[k] - o.cu
        h = 1 + o.lens[0] * du * du
        r.state[k] = h if o.model == DIVISION else du / o.fx
        r.slope[k] = du * h / o.fx if o.model == DIVISION else du / o.fx


@njit(cache=True, nogil=True, error_model="numpy")
def _division_step(g: Geometry, u_d: Any, r: Rays) -> int:
    a0, a1, a2 = g.a[0], g.a[1], g.a[2]
    o = g.projector
    kappa = o.lens[0]
    moving = 0
    for k in range(r.x.size):
        over = r.slope[k] * a2 - a0
        under = r.bx[k] - r.slope[k] * r.bz[k]
        dv = o.fy * (a1 * under + over * r.by[k]) / ((a2 * under + over * r.bz[k]) * r.state[k])
        du = u_d[k] - o.cu
        h = 1 + kappa * (du * du + dv * dv)
        moving += abs(h - r.state[k]) > SOLVED
        r.state[k] = h
        r.slope[k] = du * h / o.fx
    return moving


@njit(cache=True, nogil=True, error_model="numpy")
def _brown_step(g: Geometry, u_d: Any, r: Rays) -> int:
    a, o = g.a, g.projector
    moving = 0
    for k in range(r.x.size):
        over = r.slope[k] * a[2] - a[0]
        under = r.bx[k] - r.slope[k] * r.bz[k]
        y = (a[1] * under + over * r.by[k]) / (a[2] * under + over * r.bz[k])
        radial, tx, _, _, _ = brown_forward(o.lens, r.slope[k], y)
        last = r.slope[k]
        r.slope[k] = ((u_d[k] - o.cu) / o.fx - tx) / radial
        moving += abs(r.slope[k] - last) > SOLVED
    return moving


@njit(cache=True, nogil=True, error_model="numpy")
def solve_slopes(g: Geometry, u_d: Any, r: Rays) -> None:
    """Fill ``slope``: the ideal slope X of each observed column, where the camera ray meets it."""
    _start(g, u_d, r)
    for _ in range(MAX_ITERATIONS):
        if g.projector.model == DIVISION:
            moving = _division_step(g, u_d, r)
        else:
            moving = _brown_step(g, u_d, r)
        if moving == 0:
            break


@njit(cache=True, nogil=True, error_model="numpy")
def solve_points(g: Geometry, r: Rays) -> None:
    """Fill the world points and dz/du; depth is not positive where no rays meet in front."""
    a0, a2, b, w, o = g.a[0], g.a[2], g.b, g.world, g.origin
    b00, b01, b20, b21 = b[0, 0], b[0, 1], b[2, 0], b[2, 1]
    for k in range(r.x.size):
        t = (r.slope[k] * a2 - a0) / (r.bx[k] - r.slope[k] * r.bz[k])
        depth = a2 + t * r.bz[k]
        r.depth[k] = t if t < depth else depth
        r.state[k] = t
    for k in range(r.x.size):
        t, x, y = r.state[k], r.x[k], r.y[k]
        r.px[k] = o[0] + t * (w[0, 0] * x + w[0, 1] * y + w[0, 2])
        r.py[k] = o[1] + t * (w[1, 0] * x + w[1, 1] * y + w[1, 2])
        r.pz[k] = o[2] + t * (w[2, 0] * x + w[2, 1] * y + w[2, 2])
    for k in range(r.x.size):
        t, dx, dy = r.state[k], r.dx[k], r.dy[k]
        turn = b00 * dx + b01 * dy - r.slope[k] * (b20 * dx + b21 * dy)
        dt = -t * turn / (r.bx[k] - r.slope[k] * r.bz[k])
        ray_z = w[2, 0] * r.x[k] + w[2, 1] * r.y[k] + w[2, 2]
        r.dz[k] = dt * ray_z + t * (w[2, 0] * dx + w[2, 1] * dy)
