"""What noise adds to extremes and other curved functions of heights, and taking it off.

A function T of noisy heights (peak to valley, Sz, Sdr, ...) is biased: the highest of many noisy
heights is too high. The bias is measured by drawing the noise again about an estimate of the
surface without noise (parametric bootstrap; Efron and Tibshirani, An Introduction to the
Bootstrap, 1993, ch. 6 and 10). About the noisy heights themselves it would come out wrong: among
near ties they are spread by the noise already.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: A mean over a window counts as the surface where it agrees with all smaller windows' so well.
AGREES_SD = 3.0
#: A band of coefficients holds surface when its power exceeds the noise's by so many deviations.
BAND_SD = 2.0
#: Coefficients of one band.
BAND = 64


class Corrected(NamedTuple):
    """A value less what noise adds to it, and its standard uncertainty."""

    value: float
    uncertainty: float


def take_off(raw: float, clean: float, drawn: Array, squares: bool = False) -> Corrected:
    """Correct a function of noisy heights.

    Parameters
    ----------
    raw : float
        Of the heights as measured.
    clean : float
        Of an estimate of the surface without noise.
    drawn : ndarray, (n,)
        Of that estimate with noise drawn again.
    squares : bool
        The bias is taken off the square: of functions like Sq, to which variances add.
    """
    if not squares:
        return Corrected(raw - float(drawn.mean() - clean), float(drawn.std(ddof=1)))
    bias = float(np.mean(drawn**2) - clean**2)
    value = float(np.sqrt(max(0.0, raw**2 - bias)))
    again = np.sqrt(np.maximum(0.0, drawn**2 - bias))
    return Corrected(value, float(again.std(ddof=1)))


def peak_to_valley(heights: Array, noise_sd: Array, there: Mask, draws: int = 400) -> Corrected:
    """Highest less lowest of a surface of which noisy heights are known.

    Parameters
    ----------
    heights, noise_sd : ndarray, any shape
        Heights on a grid and the standard deviations of their independent noise.
    there : ndarray of bool
        Where they count.
    draws : int
        Repetitions of the noise; seeded.

    Returns
    -------
    Corrected
        Of a surface without form it scatters about 0 and may be negative.
    """
    filled, sd = (fill(np.where(there, a, np.nan)) for a in (heights, noise_sd))
    rng = np.random.default_rng(0)
    clean = estimate(filled, sd * rng.standard_normal((16, *sd.shape)))
    clean = clean[there]
    noise = rng.standard_normal((draws, clean.size)) * sd[there]
    drawn = np.ptp(clean + noise, axis=1)
    return take_off(float(np.ptp(heights[there])), float(np.ptp(clean)), drawn)


def estimate(heights: Array, noise: Array) -> Array:
    """Estimate the surface under noisy heights, from waves or from windows, whichever needs less.

    Parameters
    ----------
    heights : ndarray, any shape
        On a grid, none missing.
    noise : ndarray, (n, *shape)
        Draws of noise alone.

    Returns
    -------
    ndarray
        Shape of the heights. Waves suit what is smooth or repeats, windows suit plateaus and
        steps; the fewer numbers one of them needs to tell the surface, the less noise is in it.
    """
    waves, windows = _by_waves(heights, noise), _by_windows(heights, noise)
    return waves[0] if waves[1] <= windows[1] else windows[0]


def fill(heights: Array) -> Array:
    """Give every missing (NaN) height its nearest neighbour's."""
    missing = ~np.isfinite(heights)
    if not missing.any() or missing.all():
        return heights
    nearest = ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
    return np.asarray(heights[tuple(nearest)])


def _by_waves(heights: Array, noise: Array) -> tuple[Array, float]:
    """Cosine transform; coefficients keep the part of their power that is not noise.

    Those above the universal threshold (Donoho and Johnstone, Biometrika 81, 1994) speak for
    themselves, of the others only the power of a band is known. Also the numbers it took.
    """
    axes = tuple(range(1, noise.ndim))
    c = fft.dctn(heights, norm="ortho")
    power = ndimage.uniform_filter(np.mean(fft.dctn(noise, norm="ortho", axes=axes) ** 2, 0), 5)
    power = np.maximum(power, np.finfo(np.float64).tiny)
    over = (c**2 / power).ravel()  # in units of the noise
    kept = over > 2.0 * np.log(max(over.size, 2))
    share = np.where(kept, 1.0 - 1.0 / np.maximum(over, 1.0), 0.0)
    order = np.argsort(_frequency(heights.shape).ravel(), kind="stable")
    rest = order[~kept[order]]
    for band in np.array_split(rest, max(1, len(rest) // BAND)):
        excess = float(over[band].mean()) - 1.0 if len(band) else 0.0
        if excess > BAND_SD * np.sqrt(2.0 / max(len(band), 1)):
            share[band] = excess / (1.0 + excess)
    mean = fft.idctn(c * np.sqrt(share).reshape(c.shape), norm="ortho")
    return np.asarray(mean), float(share.sum())


def _frequency(shape: tuple[int, ...]) -> Array:
    parts = np.meshgrid(*(np.arange(n) / n for n in shape), indexing="ij")
    return np.sqrt(sum(part**2 for part in parts))


def _by_windows(heights: Array, noise: Array) -> tuple[Array, float]:
    """Means over the largest windows that agree with all smaller ones (Lepski's method).

    Also the numbers it took: the sum of one over the points of each window.
    """
    found, lower, upper = heights.copy(), np.full(heights.shape, -np.inf), np.full(
        heights.shape, np.inf)  # fmt: skip
    growing = np.ones(heights.shape, np.bool_)
    numbers = np.ones(heights.shape)
    size = 1
    while size < 2 * max(heights.shape):
        mean, count = _window(heights, size), _window(np.ones(heights.shape), size, total=True)
        variance = np.mean([_window(draw, size) ** 2 for draw in noise], axis=0)
        sd = np.sqrt(_window(variance, size))
        growing &= (mean >= lower) & (mean <= upper)
        if not growing.any():
            break
        found[growing], numbers[growing] = mean[growing], 1.0 / count[growing]
        lower = np.maximum(lower, mean - AGREES_SD * sd)
        upper = np.minimum(upper, mean + AGREES_SD * sd)
        size = 2 * size + 1
    return found, float(numbers.sum())


def _window(values: Array, size: int, total: bool = False) -> Array:
    """Means, or sums, over windows of a side, cut off at the border."""
    sums = values
    shares = np.ones(values.shape)
    for axis, n in enumerate(values.shape):
        reach = min(size // 2, n - 1)
        length = 2 * reach + 1
        sums = ndimage.uniform_filter1d(sums, length, axis, mode="constant") * length
        shares = ndimage.uniform_filter1d(shares, length, axis, mode="constant") * length
    return np.asarray(sums if total else sums / shares)
