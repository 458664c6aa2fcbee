"""Triangulation, Eqs. (3) and (4), of whole rows.

The camera ray ``O + t d`` in projector coordinates is ``a + t b``. A boundary fixes the
projector's observed u, so ``t = (X a_z - a_x) / (b_x - X b_z)`` with X the ideal slope u: three
equations, one solution. X depends weakly on the row through the lens, hence a short iteration.
Lengths are metres, arithmetic is double.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_common.kernel_cache import kernel
from sl_reconstruct.model.rig import Device, Division, Rig

DIVISION, BROWN_CONRADY = 0, 1
#: Iterations allowed to a lens model. They contract at least by the distortion (0.1 at most), so
#: that the last step, of SOLVED in slope, leaves less than 1e-10 m at 1 m.
MAX_ITERATIONS = 60
SOLVED = 1e-9
#: An undistortion without such a margin goes on to this step.
EXACT = 1e-14

Array = NDArray[np.float64]
#: Camera columns or DMD columns; the kernels take either precision.
Columns = NDArray[np.float32] | NDArray[np.float64]


class Optics(NamedTuple):
    """A device's image side.

    Parameters
    ----------
    model : int
        DIVISION or BROWN_CONRADY.
    fx, fy, cu, cv : float
        Focal lengths and image centre, pixels.
    lens : ndarray, (5,)
        kappa (px^-2), or k1, k2, p1, p2, k3.
    """

    model: int
    fx: float
    fy: float
    cu: float
    cv: float
    lens: Array


class Geometry(NamedTuple):
    """A rig for the kernels.

    Parameters
    ----------
    camera, projector : Optics
        Image sides of the devices.
    origin : ndarray, (3,)
        Camera centre in the world, metres.
    world : ndarray, (3, 3)
        world_from_camera rotation.
    a : ndarray, (3,)
        Camera centre in the projector, metres.
    b : ndarray, (3, 3)
        projector_from_camera rotation.
    """

    camera: Optics
    projector: Optics
    origin: Array
    world: Array
    a: Array
    b: Array


#: Boundaries that are solved together; their numbers lie in the lines of a tile, a constant
#: distance apart, so that the compiler knows that they do not overlap.
RAYS = 128
#: Ideal camera slopes, and their change per pixel of u; the camera ray in the projector; what the
#: lens iteration keeps (observed row); ideal slope X of the boundary; the lens equation's numbers.
X, Y, DX, DY, BX, BY, BZ, STATE, SLOPE, P, Q = range(0, 11 * RAYS, RAYS)
#: Results: point in the world, dz/du, the smaller of both depths.
PX, PY, PZ, DZ, DEPTH = range(11 * RAYS, 16 * RAYS, RAYS)


def _optics(device: Device) -> Optics:
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
        camera=_optics(camera),
        projector=_optics(projector),
        origin=camera.position_m,
        world=np.ascontiguousarray(camera.rotation.T),
        a=projector.rotation @ camera.position_m + projector.translation_m,
        b=np.ascontiguousarray(projector.rotation @ camera.rotation.T),
    )


def ray_tile() -> Array:
    """Return scratch for up to RAYS boundaries, a line for each of X to DEPTH."""
    return np.zeros(16 * RAYS)


@kernel(forceinline=True)
def _brown_forward(lens: Array, x: float, y: float) -> tuple[float, float, float, float, float]:
    """Radial factor, tangential shifts, and derivatives dxd/dx, dyd/dx of OpenCV's model."""
    r2 = x * x + y * y
    radial = 1 + r2 * (lens[0] + r2 * (lens[1] + r2 * lens[4]))
    tx = 2 * lens[2] * x * y + lens[3] * (r2 + 2 * x * x)
    ty = lens[2] * (r2 + 2 * y * y) + 2 * lens[3] * x * y
    d = 2 * (lens[0] + r2 * (2 * lens[1] + 3 * r2 * lens[4]))
    return radial, tx, ty, radial + d * x * x, d * x * y


@kernel()
def _division_rays(o: Optics, u: Columns, v: float, r: Array) -> None:
    kappa, dv = o.lens[0], v - o.cv
    cu, per_fx, y = o.cu, 1 / o.fx, dv / o.fy
    for k in range(u.size):
        du = u[k] - cu
        h = 1 + kappa * (du * du + dv * dv)
        r[X + k] = du * h * per_fx
        r[Y + k] = y * h
        r[DX + k] = (h + 2 * kappa * du * du) * per_fx
        r[DY + k] = 2 * kappa * du * y


@kernel()
def brown_undistort(lens: Array, xd: float, yd: float) -> tuple[float, float]:
    """Ideal slopes of observed ones in OpenCV's model, by fixed-point iteration.

    Parameters
    ----------
    lens : ndarray, (5,)
        k1, k2, p1, p2, k3.
    xd, yd : float
        Observed slopes.
    """
    x, y = xd, yd
    for _ in range(MAX_ITERATIONS):
        radial, tx, ty, _, _ = _brown_forward(lens, x, y)
        last_x, last_y = x, y
        x, y = (xd - tx) / radial, (yd - ty) / radial
        if not abs(x - last_x) + abs(y - last_y) > EXACT:
            break
    return x, y


@kernel()
def _brown_rays(o: Optics, u: Columns, v: float, r: Array) -> None:
    for k in range(u.size):
        x, y = brown_undistort(o.lens, (u[k] - o.cu) / o.fx, (v - o.cv) / o.fy)
        radial, _, _, dxx, dyx = _brown_forward(o.lens, x, y)
        r[X + k], r[Y + k] = x, y
        r[DX + k] = 1 / (dxx * o.fx)
        r[DY + k] = -dyx / (dxx * radial * o.fx)


@kernel()
def camera_rays(g: Geometry, u: Columns, v: float, r: Array) -> None:
    """Fill the rays of camera pixels: ideal slopes, and their derivatives along u.

    Parameters
    ----------
    g : Geometry
        The rig.
    u : ndarray, (n,)
        Observed columns, at most RAYS.
    v : float
        Observed row.
    r : ndarray
        Tile of `ray_tile`; X to BZ are written.
    """
    if g.camera.model == DIVISION:
        _division_rays(g.camera, u, v, r)
    else:
        _brown_rays(g.camera, u, v, r)
    b = g.b
    b00, b01, b02, b10, b11, b12 = b[0, 0], b[0, 1], b[0, 2], b[1, 0], b[1, 1], b[1, 2]
    b20, b21, b22 = b[2, 0], b[2, 1], b[2, 2]
    for k in range(u.size):
        x, y = r[X + k], r[Y + k]
        r[BX + k] = b00 * x + b01 * y + b02
        r[BY + k] = b10 * x + b11 * y + b12
        r[BZ + k] = b20 * x + b21 * y + b22


@kernel()
def _division_slopes(g: Geometry, u_d: Array, r: Array) -> None:
    """Slopes through the paper's lens, by Newton's method.

    The ideal row is linear in the slope, and the slope in h: ``dv h = p + q h`` with the observed
    ``dv`` and ``h = 1 + kappa (du^2 + dv^2)``, a cubic in dv whose root lies near ``p + q``.
    """
    a0, a1, a2 = g.a[0], g.a[1], g.a[2]
    o = g.projector
    kappa, cu, per_fx, fy, three = o.lens[0], o.cu, 1 / o.fx, o.fy, 3 * o.lens[0]
    for k in range(u_d.size):
        bx, by, bz, du = r[BX + k], r[BY + k], r[BZ + k], u_d[k] - cu
        scale = fy / (a2 * bx - a0 * bz)
        p, q = scale * (a1 * bx - a0 * by), scale * (a2 * by - a1 * bz) * du * per_fx
        c = 1 + kappa * du * du
        r[P + k], r[Q + k], r[STATE + k] = p, q, q + p / (c + kappa * (p + q) * (p + q))
    for _ in range(MAX_ITERATIONS):
        moving = 0
        for k in range(u_d.size):
            p, q, dv, du = r[P + k], r[Q + k], r[STATE + k], u_d[k] - cu
            c = 1 + kappa * du * du
            slope = c + three * dv * dv - 2 * kappa * dv * q
            dv -= ((dv - q) * (c + kappa * dv * dv) - p) / slope
            h = c + kappa * dv * dv
            # what Newton's next step would change h by
            moving += abs(((dv - q) * h - p) * 2 * kappa * dv) > SOLVED * abs(slope)
            r[STATE + k] = dv
            r[SLOPE + k] = du * h * per_fx
        if moving == 0:
            break


@kernel()
def _brown_slopes(g: Geometry, u_d: Array, r: Array) -> None:
    """Slopes through OpenCV's lens, by a fixed-point iteration."""
    a, o = g.a, g.projector
    for k in range(u_d.size):
        r[SLOPE + k] = (u_d[k] - o.cu) / o.fx
    for _ in range(MAX_ITERATIONS):
        moving = 0
        for k in range(u_d.size):
            last = r[SLOPE + k]
            over = last * a[2] - a[0]
            under = r[BX + k] - last * r[BZ + k]
            y = (a[1] * under + over * r[BY + k]) / (a[2] * under + over * r[BZ + k])
            radial, tx, _, _, _ = _brown_forward(o.lens, last, y)
            slope = ((u_d[k] - o.cu) / o.fx - tx) / radial
            moving += abs(slope - last) > SOLVED
            r[SLOPE + k] = slope
        if moving == 0:
            break


@kernel()
def solve_slopes(g: Geometry, u_d: Array, r: Array) -> None:
    """Fill SLOPE: the ideal slope X of each DMD column, where the camera ray meets it.

    Parameters
    ----------
    g : Geometry
        The rig.
    u_d : ndarray, (n,)
        Observed DMD columns, pixels.
    r : ndarray
        Tile with the rays of `camera_rays`.
    """
    if g.projector.model == DIVISION:
        _division_slopes(g, u_d, r)
    else:
        _brown_slopes(g, u_d, r)


@kernel()
def solve_points(g: Geometry, n: int, r: Array) -> None:
    """Fill the world points and dz/du; depth is not positive where no rays meet in front.

    Parameters
    ----------
    g : Geometry
        The rig.
    n : int
        Number of rays.
    r : ndarray
        Tile with rays and slopes; PX to DEPTH are written.
    """
    a0, a2, b, w = g.a[0], g.a[2], g.b, g.world
    o0, o1, o2 = g.origin[0], g.origin[1], g.origin[2]
    b00, b01, b20, b21 = b[0, 0], b[0, 1], b[2, 0], b[2, 1]
    w00, w01, w02, w10, w11, w12 = w[0, 0], w[0, 1], w[0, 2], w[1, 0], w[1, 1], w[1, 2]
    w20, w21, w22 = w[2, 0], w[2, 1], w[2, 2]
    for k in range(n):
        x, y, dx, dy, slope, bz = r[X + k], r[Y + k], r[DX + k], r[DY + k], r[SLOPE + k], r[BZ + k]
        per_under = 1 / (r[BX + k] - slope * bz)
        t = (slope * a2 - a0) * per_under
        depth = a2 + t * bz
        r[DEPTH + k] = t if t < depth else depth
        ray_z = w20 * x + w21 * y + w22
        r[PX + k] = o0 + t * (w00 * x + w01 * y + w02)
        r[PY + k] = o1 + t * (w10 * x + w11 * y + w12)
        r[PZ + k] = o2 + t * ray_z
        dt = -t * (b00 * dx + b01 * dy - slope * (b20 * dx + b21 * dy)) * per_under
        r[DZ + k] = dt * ray_z + t * (w20 * dx + w21 * dy)
