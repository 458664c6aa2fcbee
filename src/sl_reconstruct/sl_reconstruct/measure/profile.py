"""Cross-sections (the paper's Fig. 11b): height along a line, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sl_projector.documents import written_atomically
from sl_projector.errors import ConfigError, StackError
from sl_reconstruct.measure.denoise import peak_to_valley
from sl_reconstruct.measure.region import Region, select
from sl_reconstruct.measure.result import SIGNIFICANT, Measurement

Array = NDArray[np.float64]

#: Points along the section where no step is given: as many bins.
BINS = 500
#: A bin's scatter is measured where it holds so many points; below, only stated sigmas count.
SCATTER_POINTS = 5


@dataclass(frozen=True, kw_only=True)
class ProfileMeasurement(Measurement):
    """A section; the value is its total height, highest less lowest bin, less what noise adds.

    Parameters
    ----------
    from_m, to_m : tuple of float
        Ends of the line in x, y, metres.
    along_m, z_m, u_z_m : ndarray, (n,)
        Distance from the first end, mean height, and its standard uncertainty, metres.
    """

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
    """Average the points beside a line in bins along it.

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
    along = (chosen.xyz_m[:, :2] - start) @ ahead
    number = np.clip((along / length * bins).astype(np.int64), 0, bins - 1)
    count = np.bincount(number, minlength=bins)
    there = count > 0
    share = 1.0 / np.maximum(count, 1)
    z, s = (np.bincount(number, v, bins) * share for v in (chosen.xyz_m[:, 2], along))
    u = _uncertainty(chosen.xyz_m[:, 2] - z[number], chosen.sigma_m, number, count)
    z, s, u = z[there], s[there], u[there]
    if len(z) < 2:
        raise StackError("a section needs at least two bins with points; expected a longer line")
    total = peak_to_valley(z, u, np.isfinite(z))
    residual = chosen.xyz_m[:, 2] - np.interp(along, s, z)
    return ProfileMeasurement(
        kind="profile", value=total.value, uncertainty=total.uncertainty, unit="m",
        points=len(chosen), set_aside=0, rms_m=float(np.sqrt(np.mean(residual**2))),
        dof=len(chosen) - len(z), inflation=1.0, region=region, from_m=from_m, to_m=to_m,
        along_m=s, z_m=z, u_z_m=u,
    )  # fmt: skip


def _uncertainty(
    residual_m: Array, sigma_m: Array, number: NDArray[np.int64], count: NDArray[np.int64]
) -> Array:
    """Of each bin's mean: from the stated sigmas, or the scatter where it is clearly more.

    Whichever is more would be too much: the scatter of few points is by chance.
    """
    bins = len(count)
    n = np.maximum(count, 1)
    stated = np.bincount(number, sigma_m**2, bins) / n
    scatter = np.bincount(number, residual_m**2, bins) / np.maximum(count - 1, 1)
    more = scatter > stated * (1.0 + SIGNIFICANT * np.sqrt(2.0 / np.maximum(count - 1, 1)))
    trusted = (count >= SCATTER_POINTS) | (stated == 0.0)
    variance = np.where(trusted & more, scatter, stated)
    return np.asarray(np.sqrt(variance / n))


def save_profile(path: str | Path, profile: ProfileMeasurement) -> None:
    """Write a section as CSV: distance, height and its standard uncertainty, metres."""
    columns = np.column_stack([profile.along_m, profile.z_m, profile.u_z_m])
    with written_atomically(Path(path)) as partial:
        np.savetxt(partial, columns, fmt="%.9e", delimiter=",",
                   header="along_m,z_m,u_z_m", comments="")  # fmt: skip
