"""Step height after ISO 5436-1:2000 (type A1: wide grooves and bars with flat bottoms)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import ConfigError, StackError
from sl_reconstruct.cloud.plane_fit import TRIM_SD, robust_sd
from sl_reconstruct.cloud.trimmed_fit import trimmed_fit
from sl_reconstruct.measure.region import Selection
from sl_reconstruct.measure.result import Measurement, uncertainties

Array = NDArray[np.float64]
Axis = Literal["x", "y"]

#: Walls are looked for among medians of this many slices across the step.
SLICES = 300


@dataclass(frozen=True, kw_only=True)
class StepMeasurement(Measurement):
    """Height of a bar (negative: depth of a groove) over its surroundings.

    Parameters
    ----------
    walls_m : tuple of float
        Where the step begins and ends along the axis, metres.
    axis : {"x", "y"}
        Direction across the step.
    slope_x, slope_y : float
        Of the surroundings.
    """

    kind: str = "step"
    walls_m: tuple[float, float]
    axis: Axis
    slope_x: float
    slope_y: float

    value_name: ClassVar[str] = "step_height"


def measure_step(
    chosen: Selection, axis: Axis = "x", walls_m: tuple[float, float] | None = None
) -> StepMeasurement:
    """Fit ``Z = a X + b Y + c + h delta``, delta being 1 on the step and 0 beside it.

    Of a step of width W only the central third counts; on either side a strip W/3 next to the
    wall is left out, and the 2W/3 behind it are the reference.

    Parameters
    ----------
    chosen : Selection
        Points of the step and at least W/2 beside it on both sides; those off by more than 5
        robust standard deviations are set aside.
    axis : {"x", "y"}
        Direction across the step.
    walls_m : tuple of float, optional
        Where the step begins and ends, metres; found where left out.

    Raises
    ------
    StackError
        When no step is found, or one of its three parts has no points.
    """
    if axis not in ("x", "y"):
        raise ConfigError(f"axis={axis!r}; expected 'x' or 'y'")
    across = chosen.xyz_m[:, 0 if axis == "x" else 1]
    left, right = find_walls(across, chosen.xyz_m[:, 2]) if walls_m is None else sorted(walls_m)
    width = right - left
    on = np.abs(across - 0.5 * (left + right)) <= width / 6
    before = (across >= left - width) & (across <= left - width / 3)
    behind = (across >= right + width / 3) & (across <= right + width)
    for name, part in (("on the step", on), ("before it", before), ("behind it", behind)):
        if not part.any():
            raise StackError(
                f"a step from {left:.6g} to {right:.6g} m has no points {name}; expected some in "
                "its middle third and between 1/3 and 1 of its width on either side"
            )
    points = chosen.at(on | before | behind)
    delta = on[on | before | behind].astype(np.float64)
    design = _design(points, delta)
    found, used = trimmed_fit(design, points.xyz_m[:, 2])
    points, jacobian = points.at(used), design[used]
    residual = points.xyz_m[:, 2] - jacobian @ found
    fit = uncertainties(jacobian, residual, points.sigma_m, points.xyz_m[:, :2])
    return StepMeasurement(
        value=float(found[3]),
        uncertainty=float(fit.u[3]),
        **fit.evidence(len(used), chosen.region),
        walls_m=(float(left), float(right)),
        axis=axis,
        slope_x=float(found[0]),
        slope_y=float(found[1]),
    )


def find_walls(across_m: Array, z_m: Array) -> tuple[float, float]:
    """Where the two largest jumps of opposite direction are, metres, in order.

    Parameters
    ----------
    across_m, z_m : ndarray, (n,)
        Position across the step, and height.

    Raises
    ------
    StackError
        When the heights do not jump up and down.
    """
    low, span = float(across_m.min()), float(np.ptp(across_m))
    count = int(np.clip(len(z_m) // 10, 8, SLICES))
    number = np.minimum((count * (across_m - low) / max(span, 1e-30)).astype(int), count - 1)
    order = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[order], np.arange(count + 1))
    medians = np.array(
        [np.median(z_m[order[a:b]]) if b > a else np.nan for a, b in itertools.pairwise(starts)]
    )
    there = np.flatnonzero(np.isfinite(medians))
    jumps = np.diff(medians[there])
    jumps = jumps - np.median(jumps)
    up, down = int(np.argmax(jumps)), int(np.argmin(jumps))
    noise = max(robust_sd(jumps), 1e-15)
    if min(jumps[up], -jumps[down]) < TRIM_SD * noise:
        raise StackError("no step found: the heights do not jump up and down in the region")
    at = low + span / count * (0.5 * (there[:-1] + there[1:]) + 0.5)
    first, last = sorted((float(at[up]), float(at[down])))
    return first, last


def _design(points: Selection, delta: Array) -> Array:
    """Derivatives by a, b, c (at the points' centre) and h."""
    xy = points.xyz_m[:, :2] - points.xyz_m[:, :2].mean(axis=0)
    return np.column_stack([xy, np.ones(len(points)), delta])
