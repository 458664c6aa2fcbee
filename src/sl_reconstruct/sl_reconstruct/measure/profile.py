"""Cross-sections (the paper's Fig. 11b): height along a line, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sl_common.documents import written_atomically
from sl_common.errors import ConfigError, StackError
from sl_reconstruct.measure.denoise import peak_to_valley
from sl_reconstruct.measure.region import Region, Selection, select
from sl_reconstruct.measure.result import SIGNIFICANT, Measurement

Array = NDArray[np.float64]

#: Points along the section where no step is given: as many bins.
BINS = 500
#: A bin's scatter is measured where it holds this many points; below, only stated sigmas count.
SCATTER_POINTS = 5
#: The surface's tilt is taken from this many points.
TILT_POINTS = 30
#: Points are as good as in line when so little of their spread is left across it.
IN_LINE = 0.1


@dataclass(frozen=True, kw_only=True)
class ProfileMeasurement(Measurement):
    """A section; the value is its total height, highest less lowest bin, less what noise adds.

    Parameters
    ----------
    from_m, to_m : tuple of float
        Ends of the line in x, y, metres.
    along_m, z_m, u_z_m : ndarray, (n,)
        Distance from the first end, mean height on the line, and its standard uncertainty, metres.
    """

    kind: str = "profile"
    from_m: tuple[float, float]
    to_m: tuple[float, float]
    along_m: Array
    z_m: Array
    u_z_m: Array

    value_name: ClassVar[str] = "height"


def measure_profile(
    points: NDArray[Any],
    from_m: tuple[float, float],
    to_m: tuple[float, float],
    width_m: float,
    step_m: float | None = None,
) -> ProfileMeasurement:
    """Average the points beside a line in bins along it, a tilt across the line taken out.

    Parameters
    ----------
    points : ndarray, structured
        The cloud.
    from_m, to_m : tuple of float
        Ends of the line in x, y, metres.
    width_m : float
        Points up to half of it on either side count, metres.
    step_m : float, optional
        Length of a bin, metres; a five hundredth of the line where left out.

    Raises
    ------
    ConfigError, StackError
        When the line has no length or width, or no points lie beside it.
    """
    start, end = np.asarray(from_m, np.float64), np.asarray(to_m, np.float64)
    length = float(np.hypot(*(end - start)))
    if not (length > 0.0 and width_m > 0.0 and (step_m is None or step_m > 0.0)):
        raise ConfigError(
            f"line {from_m} to {to_m}, width {width_m} m; expected a length and width"
        )
    ahead = (end - start) / length
    side = 0.5 * width_m * np.array([-ahead[1], ahead[0]])
    corners = (start + side, end + side, end - side, start - side)
    region = Region(tuple((float(x), float(y)) for x, y in corners))
    chosen = select(points, region)
    step = length / BINS if step_m is None else step_m
    bins = max(1, round(length / step))
    local = (chosen.xyz_m[:, :2] - start) @ np.array([ahead, [-ahead[1], ahead[0]]]).T
    number = np.clip((local[:, 0] / length * bins).astype(np.int64), 0, bins - 1)
    s, z, u = _means(local, chosen, number, bins)
    if len(z) < 2:
        raise StackError("a section needs at least two bins with points; expected a longer line")
    total = peak_to_valley(z, u, np.isfinite(z))
    residual = chosen.xyz_m[:, 2] - np.interp(local[:, 0], s, z)
    return ProfileMeasurement(
        value=total.value,
        uncertainty=total.uncertainty,
        points=len(chosen),
        set_aside=0,
        rms_m=float(np.sqrt(np.mean(residual**2))),
        dof=len(chosen) - len(z),
        inflation=1.0,
        region=region,
        from_m=from_m,
        to_m=to_m,
        along_m=s,
        z_m=z,
        u_z_m=u,
    )


def _means(
    local_m: Array, chosen: Selection, number: NDArray[np.int64], bins: int
) -> tuple[Array, Array, Array]:
    """Mean place along the line, height on the line and its uncertainty, of bins with points.

    The surface's tilt is no scatter, and would shift the mean where points lie more on one side of
    the line. Along the line each bin has its own, across it neighbouring bins that
    hold enough points together share one.
    """
    count = np.bincount(number, minlength=bins)
    share = 1.0 / np.maximum(count, 1)
    parts = np.stack([*local_m.T, chosen.xyz_m[:, 2]])
    means = np.stack([np.bincount(number, part, bins) * share for part in parts])
    along, *rest = parts - means[:, number]
    length2 = np.bincount(number, along**2, bins)
    aside, above = (part - _slope(along, part, length2, number)[number] * along for part in rest)
    group = np.arange(bins) // int(np.ceil(TILT_POINTS / count[count > 0].mean()))
    of = group[number]
    spread = np.bincount(of, aside**2)
    known = spread > IN_LINE * np.bincount(of, rest[0] ** 2)
    tilt = np.where(known, _slope(aside, above, spread, of), 0.0)
    held = np.bincount(group, count)[group]
    free = count - 1.0 - (length2 > 0.0) - count / np.maximum(held, 1)
    variance = _variance(above - tilt[of] * aside, chosen.sigma_m, number, count, free)
    s, w, z = means
    u = np.sqrt(variance * (share + w**2 / np.where(known, spread, np.inf)[group]))
    there = count > 0
    return s[there], (z - tilt[group] * w)[there], u[there]


def _slope(x: Array, y: Array, squares: NDArray[Any], number: NDArray[np.int64]) -> Array:
    """Of y over x in each bin, both without their means; 0 where all x are the same."""
    products = np.bincount(number, x * y, len(squares))
    slopes = np.zeros(len(squares))
    np.divide(products, squares, out=slopes, where=squares > 0.0)
    return slopes


def _variance(
    residual_m: Array,
    sigma_m: Array,
    number: NDArray[np.int64],
    count: NDArray[np.int64],
    free: Array,
) -> Array:
    """Of each bin's points: as stated, or their scatter where it is clearly more.

    Whichever is more would be too much: the scatter of few points is by chance.
    """
    bins = len(count)
    free = np.maximum(free, 1.0)
    stated = np.bincount(number, sigma_m**2, bins) / np.maximum(count, 1)
    scatter = np.bincount(number, residual_m**2, bins) / free
    more = scatter > stated * (1.0 + SIGNIFICANT * np.sqrt(2.0 / free))
    trusted = (count >= SCATTER_POINTS) | (stated == 0.0)
    return np.asarray(np.where(trusted & more, scatter, stated))


def save_profile(path: str | Path, profile: ProfileMeasurement) -> None:
    """Write a section as CSV: distance, height and its standard uncertainty, metres.

    Parameters
    ----------
    path : str or Path
        The file.
    profile : ProfileMeasurement
        Bins without points are written as NaN.
    """
    columns = np.column_stack([profile.along_m, profile.z_m, profile.u_z_m])
    with written_atomically(Path(path)) as partial:
        np.savetxt(
            partial, columns, fmt="%.9e", delimiter=",", header="along_m,z_m,u_z_m", comments=""
        )
