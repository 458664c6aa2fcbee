"""Planes, flatness, and the included angle of two planes (the paper's Table 2)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, TypedDict

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import StackError
from sl_reconstruct.cloud.plane_fit import TRIM_SD, Plane, fit_plane, robust_sd
from sl_reconstruct.measure.denoise import Corrected, peak_to_valley
from sl_reconstruct.measure.region import Selection
from sl_reconstruct.measure.result import Measurement, Quantity, uncertainties

Array = NDArray[np.float64]

#: Flatness is taken from means over this many cells along a side: a single point is mostly noise.
FLATNESS_CELLS = 40
#: A cell speaks when it holds this part of what a cell holds usually.
FULL_CELL = 0.5


@dataclass(frozen=True, kw_only=True)
class PlaneMeasurement(Measurement):
    """A plane; the value is its flatness.

    The flatness is the peak-to-valley deviation from the least squares plane (ISO 12781-1, FLTt)
    of means over `FLATNESS_CELLS` squared cells, less what noise adds to it on average. Of a
    surface flatter than the noise of the cells it scatters about 0 and may come out negative.

    Parameters
    ----------
    a, b, c_m : float
        Z = a X + b Y + c, metres.
    u_a, u_b, u_c_m : float
        Their standard uncertainties; ``u_c_m`` is that of the height over the points' centre.
    normal, point_m : tuple of float
        Unit normal with z > 0; centre of the points, on the plane.
    tilts : ndarray, (2, 3), tilt_covariance : ndarray, (2, 2)
        Two directions in the plane, and the covariance of the plane's slopes along them.
    """

    kind: str = "plane"
    a: float
    b: float
    c_m: float
    u_a: float
    u_b: float
    u_c_m: float
    normal: tuple[float, float, float]
    point_m: tuple[float, float, float]
    tilts: tuple[tuple[float, ...], ...]
    tilt_covariance: tuple[tuple[float, ...], ...]

    value_name: ClassVar[str] = "flatness"

    def _others(self) -> Iterator[Quantity]:
        yield Quantity("a", self.a, self.u_a, "1")
        yield Quantity("b", self.b, self.u_b, "1")
        yield Quantity("c", self.c_m, self.u_c_m, "m")


@dataclass(frozen=True, kw_only=True)
class AngleMeasurement(Measurement):
    """Included angle of two planes, degrees; 180 where they are one.

    Parameters
    ----------
    first, second : PlaneMeasurement
        The planes.
    """

    kind: str = "angle"
    unit: str = "deg"
    first: PlaneMeasurement
    second: PlaneMeasurement

    value_name: ClassVar[str] = "included_angle"

    def _others(self) -> Iterator[Quantity]:
        for side, plane in (("first", self.first), ("second", self.second)):
            yield from (q._replace(name=f"{side}_{q.name}") for q in plane._others())


def measure_plane(chosen: Selection, flatness: bool = True) -> PlaneMeasurement:
    """Fit a plane by orthogonal least squares and measure its flatness.

    Parameters
    ----------
    chosen : Selection
        Its points; those off by more than 5 robust standard deviations are set aside.
    flatness : bool
        Whether it is wanted; else it is NaN. It takes longer than the rest.

    Raises
    ------
    StackError
        When there are too few points, or they lie on a line.
    """
    plane = fit_plane(chosen.xyz_m)
    if plane is None:
        raise StackError(f"{len(chosen)} points make no plane; expected three that are not in line")
    distance = plane.distances_m(chosen.xyz_m)
    used = np.abs(distance) <= TRIM_SD * robust_sd(distance)
    # Points exactly on a plane have no spread; then all are used.
    used = used if np.count_nonzero(used) > 3 else np.ones(len(chosen), np.bool_)
    points, distance = chosen.at(used), distance[used]
    tilts = _tilts(plane.normal)
    local = (points.xyz_m - plane.point_m) @ tilts.T
    jacobian = np.column_stack([np.ones(len(points)), local])
    sigma = points.sigma_m * plane.normal[2]
    fit = uncertainties(jacobian, distance, sigma, points.xyz_m[:, :2])
    value = _flatness(local, distance, sigma) if flatness else Corrected(np.nan, np.nan)
    return PlaneMeasurement(
        value=value.value,
        uncertainty=value.uncertainty,
        **fit.evidence(len(chosen), chosen.region),
        normal=_three(plane.normal),
        point_m=_three(plane.point_m),
        tilts=tuple(map(tuple, tilts.tolist())),
        tilt_covariance=tuple(map(tuple, fit.covariance[1:, 1:].tolist())),
        **_explicit(plane, tilts, fit.covariance),
    )


def measure_angle(first: Selection, second: Selection) -> AngleMeasurement:
    """Included angle of the planes through two sets of points, as in the paper's Table 2.

    Parameters
    ----------
    first, second : Selection
        Points of one plane each; three or more.

    Raises
    ------
    StackError
        When one of them makes no plane.
    """
    one, two = measure_plane(first, flatness=False), measure_plane(second, flatness=False)
    n1, n2 = np.array(one.normal), np.array(two.normal)
    crossed = float(np.linalg.norm(np.cross(n1, n2)))
    between = float(np.arctan2(crossed, n1 @ n2))
    variance = 0.0
    for plane, other in ((one, n2), (two, n1)):
        # d(angle) = -(other . dn) / sin(angle); where the planes are nearly one, any tilt counts.
        slopes = np.array(plane.tilts) @ other / crossed if crossed > 1e-9 else np.ones(2)
        variance += float(slopes @ np.array(plane.tilt_covariance) @ slopes)
    rms = np.sqrt(
        (one.rms_m**2 * one.points + two.rms_m**2 * two.points) / (one.points + two.points)
    )
    return AngleMeasurement(
        value=180.0 - float(np.degrees(between)),
        uncertainty=float(np.degrees(np.sqrt(variance))),
        points=one.points + two.points,
        set_aside=one.set_aside + two.set_aside,
        rms_m=float(rms),
        dof=one.dof + two.dof,
        inflation=max(one.inflation, two.inflation),
        region=first.region,
        first=one,
        second=two,
    )


def _tilts(normal: Array) -> Array:
    """Two unit vectors in the plane, (2, 3)."""
    along = np.cross(normal, [0.0, 1.0, 0.0] if abs(normal[1]) < 0.9 else [1.0, 0.0, 0.0])
    along /= np.linalg.norm(along)
    return np.stack([along, np.cross(normal, along)])


class Explicit(TypedDict):
    """Fields of Z = a X + b Y + c, and their standard uncertainties."""

    a: float
    b: float
    c_m: float
    u_a: float
    u_b: float
    u_c_m: float


def _explicit(plane: Plane, tilts: Array, covariance: Array) -> Explicit:
    """Z = a X + b Y + c with uncertainties, from the covariance of offset and tilts."""
    nx, ny, nz = plane.normal
    x, y, z = plane.point_m
    a, b = -nx / nz, -ny / nz
    # A tilt t of slope e turns the normal by -e t; a = -nx / nz changes with it.
    slopes = np.array(
        [[t[0] / nz - nx * t[2] / nz**2, t[1] / nz - ny * t[2] / nz**2] for t in tilts]
    ).T
    u_a, u_b = np.sqrt(np.diag(slopes @ covariance[1:, 1:] @ slopes.T))
    c_m, u_c_m = float(z - a * x - b * y), float(np.sqrt(covariance[0, 0]) / nz)
    return Explicit(a=float(a), b=float(b), c_m=c_m, u_a=float(u_a), u_b=float(u_b), u_c_m=u_c_m)


def _flatness(local_m: Array, distance_m: Array, sigma_m: Array) -> Corrected:
    """Peak to valley of the means of cells, less what their noise adds."""
    side = int(np.clip(np.sqrt(len(distance_m) / 9), 1, FLATNESS_CELLS))
    low, span = local_m.min(axis=0), np.maximum(np.ptp(local_m, axis=0), 1e-30)
    cell = np.minimum((side * (local_m - low) / span).astype(np.int64), side - 1)
    number = cell[:, 0] * side + cell[:, 1]
    count = np.bincount(number, minlength=side * side)
    held = np.maximum(count, 1)
    full = count >= FULL_CELL * len(number) / np.count_nonzero(count)
    mean = np.bincount(number, distance_m, side * side) / held
    variance = sigma_m**2
    if not variance.any():  # none is stated: the scatter within the cells, form included
        inside = distance_m - mean[number]
        variance = inside**2 * len(inside) / max(len(inside) - np.count_nonzero(count), 1)
    noise = np.sqrt(np.bincount(number, variance, side * side)) / held
    grid = (side, side)
    return peak_to_valley(mean.reshape(grid), noise.reshape(grid), full.reshape(grid))


def _three(vector: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z
