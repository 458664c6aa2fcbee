"""Areal roughness after ISO 25178-2, computed by surfalize (optional: ``pip install surfalize``).

docs/decisions/0007 says why that library, and which of its parameters are used.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import ConfigError, StackError
from sl_reconstruct.cloud.height_map import HeightMap, make_height_map
from sl_reconstruct.measure.denoise import Corrected, Waves, extremes, fill, noise_part, take_off
from sl_reconstruct.measure.region import Region
from sl_reconstruct.measure.result import Measurement, Quantity

Array = NDArray[np.float64]

#: Height parameters in metres, and those without unit (Sdr as a ratio, not percent).
LENGTHS = ("Sa", "Sq", "Sp", "Sv", "Sz")
NUMBERS = ("Ssk", "Sku", "Sdr", "Sdq")
#: Parameters to which noise adds as variances do.
SQUARES = ("Sa", "Sq", "Sdq")
EXTREMES = ("Sp", "Sv", "Sz")
#: Repetitions of the points' noise for bias and uncertainty; of extremes, as many as fit.
DRAWS, MANY, HEIGHTS = 48, 120, 50_000_000
#: Ssk and Sku are powers of 1 / Sq: given where Sq is at least this many uncertainties.
KNOWN = 3.0
MICROMETRE_M = 1e-6


@dataclass(frozen=True, kw_only=True)
class RoughnessMeasurement(Measurement):
    """Areal parameters; the value is Sq.

    Parameters
    ----------
    raw : dict of str to float
        Parameters as the height map has them: what any program finds in it. Metres for Sa, Sq,
        Sp, Sv and Sz, numbers for Ssk, Sku, Sdr and Sdq.
    corrected, uncertainties : dict of str to float
        The same less what the points' stated noise adds, and standard uncertainties; Ssk and Sku
        are NaN where Sq is less than three of its uncertainties.
    step_m : float
        Distance of the map's nodes, metres.
    """

    kind: str = "roughness"
    raw: dict[str, float]
    corrected: dict[str, float]
    uncertainties: dict[str, float]
    step_m: float

    value_name: ClassVar[str] = "Sq"

    def _others(self) -> Iterator[Quantity]:
        for name in (n for n in self.corrected if n != "Sq"):
            unit = "m" if name in LENGTHS else "1"
            yield Quantity(name, self.corrected[name], self.uncertainties[name], unit)


def measure_roughness(
    points: NDArray[Any], region: Region | None = None, step_m: float | None = None
) -> RoughnessMeasurement:
    """Roughness of a region, a plane taken out (F-operation), no further filter.

    Parameters
    ----------
    points : ndarray, (H, K), structured
        Organised cloud; ``sigma`` where known.
    region : Region, optional
        Everywhere when left out; the largest full rectangle of nodes inside counts.
    step_m : float, optional
        Distance of the map's nodes, metres; the points' typical spacing when left out.

    Raises
    ------
    ConfigError
        When surfalize is not installed.
    StackError
        When the region holds too few points.

    Notes
    -----
    The points' noise adds to every parameter. It is drawn again from the stated sigmas, put
    through the same map onto an estimate of the surface without noise, and what it adds is taken
    off (`sl_reconstruct.measure.denoise`). Points without sigma give no uncertainty (NaN).
    """
    cut = crop(points, region)
    height = make_height_map(cut, step_m)
    raw = areal_parameters(height.z_m, height.step_m)
    found = _corrected(cut, height, raw)
    corrected = {name: one.value for name, one in found.items()}
    spread = {name: one.uncertainty for name, one in found.items()}
    count = int(np.count_nonzero(np.isfinite(height.z_m)))
    return RoughnessMeasurement(
        value=corrected["Sq"],
        uncertainty=spread["Sq"],
        points=int(np.count_nonzero(np.isfinite(cut["z"]))),
        set_aside=0,
        rms_m=raw["Sq"],
        dof=count - 3,
        inflation=1.0,
        region=region,
        raw=raw,
        corrected=corrected,
        uncertainties=spread,
        step_m=height.step_m,
    )


def areal_parameters(z_m: NDArray[Any], step_m: float) -> dict[str, float]:
    """Parameters of a height map after levelling by the least squares plane.

    Parameters
    ----------
    z_m : ndarray, (rows, columns)
        Heights, metres. Borders with NaN are cut off; a NaN within is filled from its nearest node.
    step_m : float
        Distance of nodes, metres.

    Returns
    -------
    dict of str to float
        Metres for Sa, Sq, Sp, Sv and Sz, numbers for Ssk, Sku, Sdr and Sdq.

    Raises
    ------
    ConfigError, StackError
        Without surfalize; with fewer than 3 x 3 nodes.
    """
    try:
        from surfalize import Surface
    except ImportError:
        raise ConfigError(
            "roughness needs surfalize, which is not installed; expected: pip install surfalize"
        ) from None
    inner = _without_border(np.asarray(z_m, dtype=np.float64))
    step_um = step_m / MICROMETRE_M
    surface = Surface(inner / MICROMETRE_M, step_um, step_um)
    if not np.isfinite(inner).all():
        surface = surface.fill_nonmeasured()
    surface = surface.level()
    found = {name: float(getattr(surface, name)()) for name in LENGTHS + NUMBERS}
    return {
        **{name: found[name] * MICROMETRE_M for name in LENGTHS},
        **{name: found[name] for name in NUMBERS},
        "Sdr": found["Sdr"] / 100.0,
    }


def crop(points: NDArray[Any], region: Region | None) -> NDArray[Any]:
    """Smallest rows and columns of an organised cloud that hold a region; NaN outside it.

    Parameters
    ----------
    points : structured ndarray, (H, W)
        An organised cloud.
    region : Region or None
        None for all of it.

    Raises
    ------
    StackError
        When the cloud is not organised, or has no points there.
    """
    if points.ndim != 2 or min(points.shape) < 2:
        raise StackError(
            f"a cloud of shape {points.shape}; expected an organised one (rows, columns), "
            "such as cloud.pcd or height.tiff"
        )
    inside = np.isfinite(points["z"])
    if region is not None:
        inside &= region.contains(points["x"], points["y"])
    if not inside.any():
        raise StackError("no points in the region; expected some")
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    cut = points[window].copy()
    cut["z"][~inside[window]] = np.nan
    return np.asarray(cut)


def _without_border(z: Array) -> Array:
    """Cut off outer rows and columns that are less than nine tenths full."""
    there = np.isfinite(z)
    while min(z.shape) >= 3:
        sides = [there[0], there[-1], there[:, 0], there[:, -1]]
        full = [float(side.mean()) for side in sides]
        worst = int(np.argmin(full))
        if full[worst] >= 0.9:
            return z
        top, bottom, left, right = (int(worst == side) for side in range(4))
        rows, columns = z.shape
        z = z[top : rows - bottom, left : columns - right]
        there = there[top : rows - bottom, left : columns - right]
    raise StackError("too few heights for roughness; expected a region of at least 3 x 3 nodes")


def _corrected(
    points: NDArray[Any], height: HeightMap, raw: dict[str, float]
) -> dict[str, Corrected]:
    """Parameters less what the points' noise adds to them."""
    names = points.dtype.names or ()
    sigma = points["sigma"] if "sigma" in names else np.zeros(points.shape, np.float32)
    if not np.nanmax(np.where(np.isfinite(points["z"]), sigma, 0.0), initial=0.0) > 0.0:
        return {name: Corrected(value, float("nan")) for name, value in raw.items()}
    part = noise_part(np.where(np.isfinite(points["z"]), sigma, np.nan))
    noise = _noise_maps(points, part, height)
    beyond = _map_of(points, np.sqrt(sigma**2 - part**2), height)
    inner = _levelled(fill(_without_border(np.asarray(height.z_m, dtype=np.float64))))
    estimate = Waves(noise)
    clean = estimate(inner)[0]
    smooth = areal_parameters(clean, height.step_m)
    drawn = [areal_parameters(clean + draw, height.step_m) for draw in noise[:DRAWS]]
    found = {
        name: take_off(
            raw[name], smooth[name], np.array([one[name] for one in drawn]), name in SQUARES
        )
        for name in raw
    }
    # Highest and lowest of levelled heights are Sp and Sv themselves.
    level = np.stack([_levelled(draw) for draw in noise])
    tops = extremes(inner, level, estimate, np.ones(inner.shape, np.bool_), beyond)
    return found | dict(zip(EXTREMES, tops, strict=True)) | _shapes(raw, found, noise)


def _shapes(
    raw: dict[str, float], found: dict[str, Corrected], noise: Array
) -> dict[str, Corrected]:
    """Ssk and Sku from central moments, less the noise's: no third cumulant, and a fourth one
    where its variance differs from place to place. Unknown (NaN) where Sq is.
    """
    if not found["Sq"].value > KNOWN * found["Sq"].uncertainty:
        return dict.fromkeys(("Ssk", "Sku"), Corrected(float("nan"), float("nan")))
    variance = np.mean(noise**2, axis=0)
    # The square of a variance from n draws is too large by 2 / n.
    fourth = np.mean(variance**2) / (1.0 + 2.0 / len(noise)) - np.mean(variance) ** 2
    grown = raw["Sq"] / found["Sq"].value
    excess = (raw["Sku"] - 3.0) * grown**4 - 3.0 * float(fourth) / found["Sq"].value ** 4
    return {
        "Ssk": Corrected(raw["Ssk"] * grown**3, found["Ssk"].uncertainty * grown**3),
        "Sku": Corrected(3.0 + excess, found["Sku"].uncertainty * grown**4),
    }


def _noise_maps(points: NDArray[Any], sigma: NDArray[Any], height: HeightMap) -> Array:
    """Draws of the points' noise alone, (n, rows, columns) of the map without its border."""
    rng = np.random.default_rng(0)
    draws = int(np.clip(HEIGHTS / height.z_m.size, DRAWS, MANY))
    normal = (rng.standard_normal(points.shape, np.float32) for _ in range(draws))
    return np.stack([_map_of(points, sigma * draw, height) for draw in normal])


def _map_of(points: NDArray[Any], values: NDArray[Any], height: HeightMap) -> Array:
    """Values of points instead of their heights, on the map's nodes without its border."""
    other = points.copy()
    other["z"] = np.where(np.isfinite(points["z"]), values, np.nan)
    z = make_height_map(other, height.step_m).z_m
    return fill(_without_border(np.asarray(z, dtype=np.float64)))


def _levelled(z: Array) -> Array:
    """Heights without their least squares plane; none may be missing."""
    v, u = np.indices(z.shape)
    design = np.column_stack([u.ravel(), v.ravel(), np.ones(z.size)])
    plane = np.linalg.lstsq(design, z.ravel(), rcond=None)[0]
    return np.asarray(z - (design @ plane).reshape(z.shape))
