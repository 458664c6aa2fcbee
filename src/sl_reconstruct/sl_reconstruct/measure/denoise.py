"""What noise adds to extremes and other curved functions of heights, and taking it off.

A function T of noisy heights (peak to valley, Sz, Sdr, ...) is biased: the highest of many noisy
heights is too high. The bias is measured by drawing the noise again about an estimate of the
surface without noise (parametric bootstrap; Efron and Tibshirani, An Introduction to the
Bootstrap, 1993, ch. 6 and 10). About the noisy heights themselves it would come out wrong: among
near ties they are spread by the noise already.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Axes = tuple[int, ...]
#: Noisy heights on a grid to the surface, and the part of the noise's variance left in it.
Estimate = Callable[[Array], tuple[Array, float]]

#: A mean over a window counts as the surface where it agrees with all smaller windows': within so
#: many standard deviations more than the largest of all points' noise.
AGREES_SD = 0.5
#: A band of coefficients holds surface when its power exceeds the noise's by this many deviations.
BAND_SD = 3.0
#: Draws of noise for a bias (each with both signs), to know its spectrum, and to repeat the
#: estimate: a standard deviation of 120 draws is known to 6.5 %.
DRAWS, FEW, REPEATS = 100, 16, 120
#: Powers of the noise's variance with which a bias may grow: near ties to a single peak.
GROWTHS = np.linspace(0.5, 1.0, 51)
#: Heights with noise at once: bounds memory.
AT_ONCE = 2_000_000
#: The part of a standard deviation beyond this many times the median one is no noise.
OUTLYING = 3.0
#: A place without noise counts as one with so little of the mean variance.
LEAST_VARIANCE = 1e-6
#: Of the polynomial that is taken out before cosines.
DEGREE = 4
#: Coefficients of one band.
BAND = 64


class Level(NamedTuple):
    """Windows of one reach: standard deviations of their means by noise, and their points."""

    reach: int
    sd: Array
    points: Array


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


def noise_part(sd: Array) -> Array:
    """What of standard deviations is noise.

    Beside bends and uneven light a point's sigma is far above the others', by errors that are the
    same each time (``sl_reconstruct.decode.edge_uncertainty``). Drawn as noise they would raise
    extremes which no measured height has.

    Parameters
    ----------
    sd : ndarray, any shape
        Standard deviations; NaN where there is none.

    Returns
    -------
    ndarray
        At most three times the median of those that are not 0.
    """
    some = sd[sd > 0.0]
    return np.asarray(np.minimum(sd, OUTLYING * np.median(some)) if some.size else sd)


def peak_to_valley(heights: Array, noise_sd: Array, there: Mask) -> Corrected:
    """Highest less lowest of a surface of which noisy heights are known.

    Parameters
    ----------
    heights, noise_sd : ndarray, any shape
        Heights on a grid and the standard deviations of their independent noise.
    there : ndarray of bool
        Where they count.

    Returns
    -------
    Corrected
        Of a surface without form it scatters about 0 and may be negative. Exact (uncertainty 0)
        where there is no noise.
    """
    if not np.any(noise_sd[there]):
        return Corrected(float(np.ptp(heights[there])), 0.0)
    filled, sd = (fill(np.where(there, a, np.nan)) for a in (heights, noise_sd))
    part = noise_part(sd)
    noise = part * np.random.default_rng(0).standard_normal((DRAWS, *sd.shape))
    return extremes(filled, noise, choose(filled, noise), there, np.sqrt(sd**2 - part**2))[2]


def extremes(
    heights: Array, noise: Array, estimate: Estimate, there: Mask, beyond: Array
) -> tuple[Corrected, Corrected, Corrected]:
    """Highest, minus the lowest, and highest less lowest height, less what noise adds.

    Parameters
    ----------
    heights : ndarray, any shape
        On a grid, none missing.
    noise : ndarray, (n, *shape)
        Draws of noise alone; each is used with both signs, so peaks and valleys get the same.
    estimate : callable
        Surface without noise.
    there : ndarray of bool
        Where heights count.
    beyond : ndarray, any shape
        Standard deviations of what is not noise: of the places that are the highest and the
        lowest they go into the uncertainty.

    Notes
    -----
    Noise that is left in the estimate hides a part of the bias, as far as it differs between the
    places that may be the extreme. A bias that grows with a power p of the noise's variance is
    hidden but for (1 + left)^p - left^p of it: nothing is hidden where one peak is rounded off
    (p = 1), more where many heights nearly tie (p = 1/2). The bias of half the noise shows which.
    The uncertainty is the scatter of the whole estimate, repeated on the estimated surface (double
    bootstrap).
    """
    alone = noise[:, there]
    parts = np.array_split(alone, min(len(alone), 1 + alone.size // AT_ONCE))

    def bias(z: Array, scale: float = 1.0) -> Array:
        tops = [_tops(both) for part in parts for both in (z + scale * part, z - scale * part)]
        return np.asarray(np.concatenate(tops).mean(axis=0) - _tops(z))

    clean = estimate(heights)[0]
    left = _left(estimate, clean, noise[:FEW], there)

    def corrected(measured: Array) -> Array:
        z = estimate(measured)[0][there]
        whole = bias(z)
        power = _growth(bias(z, 0.5), whole, left)
        shown = (1.0 + left) ** power - left**power
        return np.asarray(_tops(measured[there]) - whole / shown)

    values = corrected(heights)
    some = noise[: REPEATS // 2]
    repeated = np.stack([corrected(clean + draw) for draw in (*some, *-some)])
    own = [beyond[there][pick(heights[there])] ** 2 for pick in (np.argmax, np.argmin)]
    spread = np.sqrt(repeated.var(axis=0, ddof=1) + np.array([*own, sum(own)]))
    peak, valley, total = map(Corrected, values.tolist(), spread.tolist())
    return peak, valley, total


def _left(estimate: Estimate, clean: Array, noise: Array, there: Mask) -> Array:
    """Part of the noise's variance that an estimate keeps between places that may be extremes.

    Of the highest, the lowest, and both. A plateau's mean is off everywhere alike: that is none.
    """
    alone = noise[:, there]
    errors = np.stack([(estimate(clean + draw)[0] - clean)[there] for draw in noise])
    both = np.concatenate([clean[there] + alone, clean[there] - alone])
    places = both.argmax(axis=1), both.argmin(axis=1)
    least = LEAST_VARIANCE * np.mean(alone**2)
    high, low = (
        float(np.mean(np.var(errors[:, at], axis=1)) / max(least, np.mean(alone[:, at] ** 2)))
        for at in places
    )
    return np.array([high, low, 0.5 * (high + low)])


def _growth(half: Array, whole: Array, left: Array) -> Array:
    """Power of the noise's variance with which biases grow, from those by half and whole noise."""
    power = GROWTHS[:, None]
    ratio = ((0.25 + left) ** power - left**power) / ((1.0 + left) ** power - left**power)
    found = np.divide(half, whole, out=ratio[-1].copy(), where=whole > 0.0)
    return np.array(
        [np.interp(f, r[::-1], GROWTHS[::-1]) for f, r in zip(found, ratio.T, strict=True)]
    )


def _tops(heights: Array) -> Array:
    """Highest, minus lowest, and their sum along the last axis."""
    high, low = heights.max(axis=-1), -heights.min(axis=-1)
    return np.stack([high, low, high + low], axis=-1)


def fill(heights: Array) -> Array:
    """Give every missing (NaN) height its nearest neighbour's."""
    missing = ~np.isfinite(heights)
    if not missing.any() or missing.all():
        return heights
    nearest = ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
    return np.asarray(heights[tuple(nearest)])


class Waves:
    """Estimates a surface by its cosine transform: coefficients keep what is not noise of them.

    Those above the universal threshold (Donoho and Johnstone, Biometrika 81, 1994) speak for
    themselves, of the others only the power of a band is known. A polynomial is taken out before:
    cosines end flat, and would round off the corners of a bow. Suits what is smooth or repeats.

    Parameters
    ----------
    noise : ndarray, (n, *shape)
        Draws of noise alone.
    """

    def __init__(self, noise: Array) -> None:
        axes = tuple(range(1, noise.ndim))
        power = np.mean(fft.dctn(noise[:FEW], norm="ortho", axes=axes) ** 2, axis=0)
        self._power = np.maximum(ndimage.uniform_filter(power, 5), np.finfo(np.float64).tiny)
        parts = np.meshgrid(*(np.arange(n) / n for n in power.shape), indexing="ij")
        self._order = np.argsort(sum(part**2 for part in parts).ravel(), kind="stable")
        self._form = _polynomials(power.shape)

    def __call__(self, heights: Array) -> tuple[Array, float]:
        """Surface, and the part of the noise's variance that is left in it."""
        form = (self._form @ (heights.ravel() @ self._form)).reshape(heights.shape)
        c = fft.dctn(heights - form, norm="ortho")
        over = (c**2 / self._power).ravel()  # in units of the noise
        kept = over > 2.0 * np.log(max(over.size, 2))
        share = np.where(kept, 1.0 - 1.0 / np.maximum(over, 1.0), 0.0)
        rest = self._order[~kept[self._order]]
        for band in np.array_split(rest, max(1, len(rest) // BAND)):
            excess = float(over[band].mean()) - 1.0 if len(band) else 0.0
            if excess > BAND_SD * np.sqrt(2.0 / max(len(band), 1)):
                share[band] = excess / (1.0 + excess)
        surface = form + fft.idctn(c * np.sqrt(share).reshape(c.shape), norm="ortho")
        return surface, float(share.mean()) + self._form.shape[1] / heights.size


class Windows:
    """Estimates a surface by means over the largest windows that agree with all smaller ones.

    Lepski's method. Windows are square or along one axis, about the point or beside it, so that
    they fill plateaus and ridges up to the edge. Suits plateaus and steps.

    Parameters
    ----------
    noise : ndarray, (n, *shape)
        Draws of noise alone.
    """

    def __init__(self, noise: Array) -> None:
        shape, every = noise.shape[1:], tuple(range(noise.ndim - 1))
        self._limit = np.sqrt(2.0 * np.log(noise[0].size)) + AGREES_SD
        self._kinds = [
            (axes, _levels(noise[:FEW], axes))
            for axes in (every, *((axis,) for axis in every if len(every) > 1))
        ]
        self._shape = shape

    def __call__(self, heights: Array) -> tuple[Array, float]:
        """Surface, and the part of the noise's variance that is left in it."""
        found, points = heights.copy(), np.ones(heights.shape)
        for axes, levels in self._kinds:
            means = [_window(heights, level.reach, axes) for level in levels]
            for sides in itertools.product((-1, 0, 1), repeat=len(axes)):
                mean, count = self._largest(means, levels, axes, sides)
                more = count > points
                found[more], points[more] = mean[more], count[more]
        return found, float(np.mean(1.0 / points))

    def _largest(
        self, means: list[Array], levels: list[Level], axes: Axes, sides: Axes
    ) -> tuple[Array, Array]:
        """Means over the largest windows on one side, and their points."""
        found, points = means[0].copy(), np.ones(self._shape)
        lower, upper = np.full(self._shape, -np.inf), np.full(self._shape, np.inf)
        growing = np.ones(self._shape, np.bool_)
        for level, every in zip(levels, means, strict=True):
            at = _beside(self._shape, axes, sides, level.reach)
            mean, margin, count = every[at], self._limit * level.sd[at], level.points[at]
            growing &= (mean >= lower) & (mean <= upper)
            found[growing], points[growing] = mean[growing], count[growing]
            lower, upper = np.maximum(lower, mean - margin), np.minimum(upper, mean + margin)
        return found, points


def choose(heights: Array, noise: Array) -> Estimate:
    """Waves or windows, whichever is nearer to the surface of these heights.

    By Stein's unbiased estimate of the squared error (Annals of Statistics 9, 1981).

    Parameters
    ----------
    heights, noise : ndarray, (H, W)
        Heights and their standard deviations, metres.
    """
    variance = np.mean(noise**2, axis=0)
    variance = np.maximum(variance, LEAST_VARIANCE * variance.mean())

    def error(way: Estimate) -> float:
        surface, left = way(heights)
        return float(np.mean((heights - surface) ** 2 / variance)) + 2.0 * left

    waves, windows = Waves(noise), Windows(noise)
    return waves if error(waves) <= error(windows) else windows


def _polynomials(shape: tuple[int, ...]) -> Array:
    """Orthonormal columns (points, terms): polynomials up to a degree of all axes together."""
    lines = [
        np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, n), min(DEGREE, n - 1))
        for n in shape
    ]
    terms = itertools.product(*(range(line.shape[1]) for line in lines))
    chosen = [term for term in terms if sum(term) <= DEGREE]
    lines_of = [[line[:, k] for line, k in zip(lines, term, strict=True)] for term in chosen]
    columns = [functools.reduce(np.multiply.outer, each) for each in lines_of]
    return np.linalg.qr(np.stack([column.ravel() for column in columns], axis=1))[0]


def _levels(noise: Array, axes: Axes) -> list[Level]:
    """Windows from the smallest to the largest, and what noise does to their means."""
    shape, levels, reach = noise.shape[1:], [], 0
    while reach == 0 or 2 * reach < max(shape[axis] for axis in axes):
        variance = np.mean([_window(draw, reach, axes) ** 2 for draw in noise], axis=0)
        sd = np.sqrt(_window(variance, reach, axes))
        levels.append(Level(reach, sd, _sums(np.ones(shape), reach, axes)))
        reach = 2 * reach + 1
    return levels


def _beside(
    shape: tuple[int, ...], axes: Axes, sides: Axes, reach: int
) -> tuple[NDArray[np.int64], ...]:
    """Indices of the centres of windows that lie beside every point and still hold it."""
    lines = [np.arange(n) for n in shape]
    for axis, side in zip(axes, sides, strict=True):
        lines[axis] = np.clip(lines[axis] + side * reach, 0, shape[axis] - 1)
    return np.ix_(*lines)


def _window(values: Array, reach: int, axes: Axes) -> Array:
    """Means over windows, cut off at the border."""
    return _sums(values, reach, axes) / _sums(np.ones(values.shape), reach, axes)


def _sums(values: Array, reach: int, axes: Axes) -> Array:
    for axis in axes:
        length = 2 * min(reach, values.shape[axis] - 1) + 1
        values = length * ndimage.uniform_filter1d(values, length, axis, mode="constant")
    return values
