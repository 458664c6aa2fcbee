"""Spheres and cylinders by geometric least squares: orthogonal distances, Gauss-Newton."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import StackError
from sl_reconstruct.cloud.trimmed_fit import trim
from sl_reconstruct.measure.region import Selection
from sl_reconstruct.measure.result import Fitted, Measurement, Quantity, uncertainties

Array = NDArray[np.float64]
#: Parameters to residuals (n,), their derivatives (n, p), and the normals' z (n,).
Model = Callable[[Array, Array], tuple[Array, Array, Array]]

ITERATIONS, ROUNDS = 60, 3
#: Converged when a step changes no parameter by more than this part of the radius.
CONVERGED = 1e-12


@dataclass(frozen=True, kw_only=True)
class SphereMeasurement(Measurement):
    """A sphere; the value is its radius.

    Parameters
    ----------
    centre_m, u_centre_m : tuple of float
        Centre and standard uncertainties of its coordinates.
    """

    kind: str = "sphere"
    centre_m: tuple[float, ...]
    u_centre_m: tuple[float, ...]

    value_name: ClassVar[str] = "radius"

    def _others(self) -> Iterator[Quantity]:
        for axis, c, u in zip("xyz", self.centre_m, self.u_centre_m, strict=True):
            yield Quantity(f"centre_{axis}", c, u, "m")


@dataclass(frozen=True, kw_only=True)
class CylinderMeasurement(Measurement):
    """A cylinder; the value is its radius.

    Parameters
    ----------
    point_m : tuple of float
        Point of the axis nearest to the points' centre.
    direction : tuple of float
        Unit vector along the axis, x > 0 (y > 0 where x is 0).
    """

    kind: str = "cylinder"
    point_m: tuple[float, ...]
    direction: tuple[float, ...]

    value_name: ClassVar[str] = "radius"


def measure_sphere(chosen: Selection) -> SphereMeasurement:
    """Fit a sphere; convex and hollow ones alike.

    Parameters
    ----------
    chosen : Selection
        Its points; those off by more than 5 robust standard deviations are set aside.

    Raises
    ------
    StackError
        When the points make no sphere.
    """
    found = fit_rounds(_sphere, chosen, _algebraic_sphere(chosen.xyz_m))
    values, u = found.values, found.fit.u
    return SphereMeasurement(
        value=float(values[3]),
        uncertainty=float(u[3]),
        **found.fit.evidence(len(chosen), chosen.region),
        centre_m=tuple(values[:3].tolist()),
        u_centre_m=tuple(u[:3].tolist()),
    )


def measure_cylinder(chosen: Selection) -> CylinderMeasurement:
    """Fit a cylinder that lies roughly flat; convex and hollow ones alike.

    Parameters
    ----------
    chosen : Selection
        Its points; those off by more than 5 robust standard deviations are set aside.

    Raises
    ------
    StackError
        When the points make no cylinder.
    """
    centre = chosen.xyz_m.mean(axis=0)
    local = chosen.xyz_m - centre
    frame, start = _paraboloid_cylinder(local)
    # In the turned frame the axis runs along x; z is that of the world, along which the noise is.
    found = fit_rounds(_cylinder, chosen, start, local @ frame.T)
    values, fit = found.values, found.fit
    direction = np.array([1.0, values[2], values[3]]) / np.hypot(1.0, np.hypot(*values[2:4]))
    point = np.array([0.0, values[0], values[1]])
    point -= (point @ direction) * direction
    direction, point = direction @ frame, point @ frame + centre
    direction = direction if tuple(direction[:2]) > (0.0, 0.0) else -direction
    return CylinderMeasurement(
        value=float(values[4]),
        uncertainty=float(fit.u[4]),
        **fit.evidence(len(chosen), chosen.region),
        point_m=tuple(point.tolist()),
        direction=tuple(direction.tolist()),
    )


class Round(NamedTuple):
    """A fitted sphere, cylinder or circle: parameters, the last a radius, and their evidence."""

    values: Array
    fit: Fitted


def fit_rounds(
    model: Model, chosen: Selection, start: Array, local_m: Array | None = None
) -> Round:
    """Least squares in rounds that set outliers aside.

    Parameters
    ----------
    model : callable
        Parameters and points to residuals, derivatives and the normals' z.
    chosen : Selection
        The points; those off by more than 5 robust standard deviations are set aside.
    start : ndarray, (p,)
        Where to begin; the last parameter is a radius.
    local_m : ndarray, (n, 3), optional
        The points in a frame of the model, with the world's z; their own where left out.
    """
    xyz_m = chosen.xyz_m if local_m is None else local_m
    values, used = trim(
        lambda used, last: _gauss_newton(model, xyz_m[used], last),
        lambda values: model(values, xyz_m)[0],
        start,
        ROUNDS,
    )
    residual, jacobian, normal_z = model(values, xyz_m[used])
    points = chosen.at(used)
    sigma_m = points.sigma_m * np.abs(normal_z)
    return Round(values, uncertainties(jacobian, residual, sigma_m, points.xyz_m[:, :2]))


def _gauss_newton(model: Model, xyz_m: Array, values: Array) -> Array:
    residual, jacobian, _ = model(values, xyz_m)
    for _ in range(ITERATIONS):
        step = np.linalg.lstsq(jacobian, -residual, rcond=None)[0]
        shrink = 1.0
        while shrink > 1e-4:
            trial = values + shrink * step
            new, new_jacobian, _ = model(trial, xyz_m)
            if trial[-1] > 0.0 and new @ new <= (residual @ residual) * (1.0 + 1e-9):
                break
            shrink *= 0.5
        else:
            return values
        values, residual, jacobian = trial, new, new_jacobian
        if np.abs(shrink * step).max() <= CONVERGED * abs(values[-1]):
            return values
    raise StackError("the fit does not settle: the points make no sphere or cylinder")


def _sphere(values: Array, xyz_m: Array) -> tuple[Array, Array, Array]:
    offset = xyz_m - values[:3]
    distance = np.linalg.norm(offset, axis=1)
    normal = offset / distance[:, None]
    return distance - values[3], np.column_stack([-normal, -np.ones(len(xyz_m))]), normal[:, 2]


def _cylinder(values: Array, xyz_m: Array) -> tuple[Array, Array, Array]:
    """Axis through (0, y0, z0) along (1, my, mz); values are y0, z0, my, mz, radius."""
    normal = _cylinder_normals(values, xyz_m)
    y0, z0, my, mz, radius = values
    offset = xyz_m - np.array([0.0, y0, z0])
    length = np.sqrt(1.0 + my**2 + mz**2)
    along = offset @ np.array([1.0, my, mz]) / length**2
    distance = np.einsum("ij,ij->i", offset, normal)
    jacobian = np.column_stack(
        [
            -normal[:, 1],
            -normal[:, 2],
            -normal[:, 1] * along,
            -normal[:, 2] * along,
            -np.ones(len(xyz_m)),
        ]
    )
    return distance - radius, jacobian, normal[:, 2]


def _cylinder_normals(values: Array, xyz_m: Array) -> Array:
    """Unit vectors from the axis to the points, (n, 3)."""
    direction = np.array([1.0, values[2], values[3]])
    direction /= np.linalg.norm(direction)
    offset = xyz_m - np.array([0.0, values[0], values[1]])
    radial = offset - (offset @ direction)[:, None] * direction
    return np.asarray(radial / np.linalg.norm(radial, axis=1, keepdims=True))


def _algebraic_sphere(xyz_m: Array) -> Array:
    """Start: |p|^2 = 2 c.p + d is linear in c and d."""
    if len(xyz_m) < 5:
        raise StackError(f"{len(xyz_m)} points; expected at least 5 for a sphere")
    middle = xyz_m.mean(axis=0)
    local = xyz_m - middle
    design = np.column_stack([2.0 * local, np.ones(len(local))])
    solution, _, rank, _ = np.linalg.lstsq(design, np.sum(local**2, axis=1), rcond=1e-14)
    squared = float(solution[3] + solution[:3] @ solution[:3])
    if rank < 4 or squared <= 0.0:
        raise StackError("the points make no sphere (a plane?); expected some curvature")
    return np.append(solution[:3] + middle, np.sqrt(squared))


def _paraboloid_cylinder(local_m: Array) -> tuple[Array, Array]:
    """Frame whose x is the flattest direction, and a start in it, from a fitted paraboloid."""
    if len(local_m) < 7:
        raise StackError(f"{len(local_m)} points; expected at least 7 for a cylinder")
    x, y, z = local_m.T
    size = max(float(np.abs(local_m[:, :2]).max()), 1e-30)
    x, y = x / size, y / size
    design = np.column_stack([x * x, x * y, y * y, x, y, np.ones(len(x))])
    xx, xy, yy, _, _, top = np.linalg.lstsq(design, z, rcond=None)[0]
    bends, directions = np.linalg.eigh(np.array([[2 * xx, xy], [xy, 2 * yy]]) / size**2)
    round_one = int(np.argmax(np.abs(bends)))
    bend = float(bends[round_one])
    if abs(bend) < 1e-9 / size:
        raise StackError("the points make no cylinder (a plane?); expected some curvature")
    flat = directions[:, 1 - round_one]
    frame = np.array([[flat[0], flat[1], 0.0], [-flat[1], flat[0], 0.0], [0.0, 0.0, 1.0]])
    return frame, np.array([0.0, top + 1.0 / bend, 0.0, 0.0, abs(1.0 / bend)])
