"""Comparison of a surface with a reference: the map of deviations."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sl_common.errors import StackError
from sl_reconstruct.cloud.height_map import HeightMap
from sl_reconstruct.cloud.trimmed_fit import trimmed_fit
from sl_reconstruct.measure.region import Region, select
from sl_reconstruct.measure.result import Measurement, Quantity, uncertainties

Array = NDArray[np.float64]
#: Heights (n,) of the reference at x, y (n,), metres; NaN where it has none.
Reference = Callable[[Array, Array], Array]


@dataclass(frozen=True, kw_only=True)
class DeviationMeasurement(Measurement):
    """Deviation from a reference; the value is its mean, positive above the reference.

    Parameters
    ----------
    form_rms_m : float
        Root mean square of the deviation from its mean, less the points' stated noise.
    peak_m, valley_m : float
        Largest and smallest deviation of the points used.
    deviation_m : ndarray
        Deviation of every point of the cloud, its shape; NaN where there is none.
    """

    kind: str = "deviation"
    form_rms_m: float
    peak_m: float
    valley_m: float
    deviation_m: NDArray[np.float32]

    value_name: ClassVar[str] = "mean_deviation"

    def _others(self) -> Iterator[Quantity]:
        nan = float("nan")
        yield Quantity("form_rms", self.form_rms_m, nan, "m")
        yield Quantity("peak", self.peak_m, nan, "m")
        yield Quantity("valley", self.valley_m, nan, "m")


def measure_deviation(
    points: NDArray[Any], reference: Reference, region: Region | None = None, level: bool = False
) -> DeviationMeasurement:
    """Compare a cloud with a reference surface, along z.

    Parameters
    ----------
    points : ndarray, structured
        The cloud.
    reference : callable
        Heights of the reference at x, y.
    region : Region, optional
        Where; everywhere when left out.
    level : bool
        Take out the best plane of the deviations: offset and tilt are the mounting's, not the
        part's. The mean is then zero.

    Raises
    ------
    StackError
        When no point lies over the reference.
    """
    wanted = reference(
        points["x"].ravel().astype(np.float64), points["y"].ravel().astype(np.float64)
    ).reshape(points.shape)
    deviation = points["z"].astype(np.float64) - wanted
    over = np.isfinite(deviation)
    if not over.any():
        raise StackError("no point lies over the reference; expected surfaces in the same place")
    chosen = select(points, region, over)
    inside = over if region is None else over & region.contains(points["x"], points["y"])
    found = deviation[inside]
    design = _design(chosen.xyz_m, level)
    plane, used = trimmed_fit(design, found)
    kept, found, design = chosen.at(used), found[used], design[used]
    residual = found - design @ plane
    fit = uncertainties(design, residual, kept.sigma_m, kept.xyz_m[:, :2])
    if level:
        every = np.stack([points["x"].ravel(), points["y"].ravel()], axis=1).astype(np.float64)
        deviation -= (_design(every, level) @ plane).reshape(points.shape)
        found = residual
    form = float(np.mean(residual**2) - np.mean(kept.sigma_m**2))
    return DeviationMeasurement(
        value=0.0 if level else float(plane[0]),
        uncertainty=float(fit.u[0]),
        **fit.evidence(len(chosen), region),
        form_rms_m=float(np.sqrt(max(form, 0.0))),
        peak_m=float(found.max()),
        valley_m=float(found.min()),
        deviation_m=deviation.astype(np.float32),
    )


def _design(xyz_m: Array, level: bool) -> Array:
    one = np.ones(len(xyz_m))
    return np.column_stack([one, xyz_m[:, 0], xyz_m[:, 1]]) if level else one[:, None]


def map_reference(height: HeightMap) -> Reference:
    """Use a height map as the reference, interpolated linearly between its nodes."""
    z = height.z_m.astype(np.float64)

    def heights(x_m: Array, y_m: Array) -> Array:
        at = [(height.y0_m - y_m) / height.step_m, (x_m - height.x0_m) / height.step_m]
        missing = ~(np.isfinite(at[0]) & np.isfinite(at[1]))
        at = [np.where(missing, -10.0, axis) for axis in at]
        return np.asarray(ndimage.map_coordinates(z, at, order=1, mode="constant", cval=np.nan))

    return heights
