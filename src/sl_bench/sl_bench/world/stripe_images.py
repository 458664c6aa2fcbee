"""From mirrors and sample maps to the image: blurred patterns, lens filter, decimation."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_common.kernel_cache import kernel

Image = NDArray[np.float32]
Rows = tuple[int, int]
#: Flat index, share of the next entry, share of the next level, of a row of samples.
Places = tuple[NDArray[np.int32], Image, Image]

#: Entries of a blurred line per DMD pixel; linear between.
PHASES = 32
#: Blur levels are closer than this fraction of the smallest variance, up to MAX_LEVELS of them.
LEVEL_STEP = 0.08
MAX_LEVELS = 48
#: Samples of a row that are checked together for being far from the lit DMD's border.
CHUNK = 64
#: A Gaussian is cut off at this many standard deviations.
REACH = 4.5


class Levels(NamedTuple):
    """Blur of a DMD axis: levels of variance, and the mirrors' weights at each phase.

    ``weights`` (PHASES + 1, taps, levels): the share of mirror ``base + tap - reach`` at
    ``u = base - 0.5 + phase / PHASES``.
    """

    first: float
    per_step: float
    levels: int
    reach: int
    weights: Image


class Scale(NamedTuple):
    """Numbers of `Levels` alone: an array passed on with them is counted at every sample."""

    first: np.float32
    per_step: np.float32
    levels: np.int32
    offset: np.float32


class Samples(NamedTuple):
    """Sample maps, for a pattern that varies along one DMD axis (u for any other).

    Coordinate along the pattern and across it, px; reflected light; variance of the blur along
    and across, px^2.
    """

    along: Image
    across: Image
    light: Image
    spread: Image
    spread_across: Image


class Stripes(NamedTuple):
    """A pattern that varies along one DMD axis.

    ``line`` and ``border`` are `blurred_line` of the pattern and of the lit DMD across it. Between
    the two coordinates ``safe`` across, px, the border has no influence.
    """

    line: Image
    border: Image
    levels: tuple[Levels, Levels]
    safe: tuple[float, float]


class MirrorImage(NamedTuple):
    """Any mirror image, 0 or 1, padded by twice each axis's reach (rows, columns)."""

    mirrors: Image
    levels: tuple[Levels, Levels]


class Lens(NamedTuple):
    """What makes pixels of samples: `lens_weights`, and electrons per second of white."""

    weights: Image
    scale: np.float32


@kernel(error_model="python")
def _mirror_weights(variances: NDArray[np.float64], reach: int) -> Image:
    """Integral over each mirror of a Gaussian about the phase."""
    weights = np.empty((PHASES + 1, 2 * reach + 1, variances.size), dtype=np.float32)
    for phase in range(PHASES + 1):
        for tap in range(2 * reach + 1):
            for k in range(variances.size):
                scale = 1.0 / math.sqrt(2.0 * variances[k])
                low = tap - reach - phase / PHASES
                high = math.erf((low + 1.0) * scale)
                weights[phase, tap, k] = 0.5 * (high - math.erf(low * scale))
    return weights


def blur_levels(lowest: float, highest: float) -> Levels:
    """Levels of blur.

    Parameters
    ----------
    lowest, highest : float
        Variances, px^2.
    """
    steps = math.ceil((highest - lowest) / (LEVEL_STEP * lowest))
    count = min(max(steps + 1, 2), MAX_LEVELS)
    step = max(highest - lowest, 1e-6) / (count - 1)
    variances = np.asarray(lowest + step * np.arange(count), dtype=np.float64)
    reach = math.ceil(REACH * math.sqrt(variances[-1])) + 1
    return Levels(lowest, 1.0 / step, count, reach, _mirror_weights(variances, reach))


@kernel(error_model="python")
def blurred_line(profile: NDArray[np.bool_], levels: Levels) -> Image:
    """Blurred 1-D pattern ((size + 2 reach) PHASES + 1, levels), from u = -reach - 0.5 on.

    Its ends are dark, so that all beyond may be looked up there.

    Parameters
    ----------
    profile : ndarray, (size,)
        Mirrors along the pattern.
    levels : Levels
        Of that axis.
    """
    reach, size = levels.reach, profile.size
    out = np.zeros(((size + 2 * reach) * PHASES + 1, levels.levels), dtype=np.float32)
    for entry in range(1, out.shape[0] - 1):
        base, phase = entry // PHASES - reach, entry % PHASES
        for m in range(max(base - reach, 0), min(base + reach + 1, size)):
            if profile[m]:
                for k in range(levels.levels):
                    out[entry, k] += levels.weights[phase, m - base + reach, k]
    return out


@kernel(error_model="python", fastmath=True)
def _level(scale: Scale, variance: np.float32) -> tuple[np.int32, np.float32]:
    """Level below a variance, and the share of the one above."""
    q = (variance - scale.first) * scale.per_step
    k = np.int32(min(max(np.int32(q), np.int32(0)), np.int32(scale.levels - 2)))
    return k, q - np.float32(k)


@kernel(error_model="python", fastmath=True)
def _scale(levels: Levels) -> Scale:
    offset = np.float32(levels.reach + 0.5)
    first, per_step = np.float32(levels.first), np.float32(levels.per_step)
    return Scale(first, per_step, np.int32(levels.levels), offset)


@kernel(error_model="python", fastmath=True)
def _place(
    scale: Scale, entries: int, x: np.float32, variance: np.float32
) -> tuple[np.int32, np.float32, np.float32]:
    """Where a coordinate, px, falls in a blurred line; see `Places`."""
    at = (x + scale.offset) * np.float32(PHASES)
    at = min(max(at, np.float32(0.0)), np.float32(entries - 1))
    entry = np.int32(min(np.int32(at), np.int32(entries - 2)))
    k, g = _level(scale, variance)
    return np.int32(entry * scale.levels + k), at - np.float32(entry), g


@kernel(error_model="python", fastmath=True)
def _places(scale: Scale, entries: int, x: Image, variance: Image, places: Places) -> None:
    """`_place` of a row; apart from the look-up, so that it is made of vector instructions."""
    place, f, g = places
    for i in range(x.size):
        place[i], f[i], g[i] = _place(scale, entries, x[i], variance[i])


@kernel(error_model="python", fastmath=True)
def _between(
    line: Image, place: np.int32, levels: np.int32, f: np.float32, g: np.float32
) -> np.float32:
    """Brightness at a place of a blurred line, given flat."""
    here, there = line[place], line[place + 1]
    low = here + f * (line[place + levels] - here)
    high = there + f * (line[place + levels + 1] - there)
    return np.float32(low + g * (high - low))


@kernel(error_model="python", fastmath=True)
def _tap_weights(levels: Levels, fraction: np.float32, variance: np.float32, out: Image) -> None:
    """Weights of the mirrors about a point at that fraction of its mirror."""
    at = fraction * PHASES
    i = min(int(at), PHASES - 1)
    f = np.float32(at - i)
    k, g = _level(_scale(levels), variance)
    w = levels.weights
    for tap in range(2 * levels.reach + 1):
        low = w[i, tap, k] + f * (w[i + 1, tap, k] - w[i, tap, k])
        high = w[i, tap, k + 1] + f * (w[i + 1, tap, k + 1] - w[i, tap, k + 1])
        out[tap] = low + g * (high - low)


@kernel(error_model="python", fastmath=True)
def _on_mirrors(
    image: MirrorImage,
    q: tuple[np.float32, np.float32],
    variance: tuple[np.float32, np.float32],
    scratch: tuple[Image, Image],
) -> np.float32:
    """Brightness of a mirror image at (u, v)."""
    column, row = int(np.floor(q[0] + 0.5)), int(np.floor(q[1] + 0.5))
    mirrors, levels = image.mirrors, image.levels
    wu, wv = scratch
    ru, rv = levels[0].reach, levels[1].reach
    height, width = mirrors.shape[0] - 4 * rv, mirrors.shape[1] - 4 * ru
    if not (-ru <= column < width + ru and -rv <= row < height + rv):
        return np.float32(0.0)
    _tap_weights(levels[0], q[0] + np.float32(0.5) - column, variance[0], wu)
    _tap_weights(levels[1], q[1] + np.float32(0.5) - row, variance[1], wv)
    total = np.float32(0.0)
    for j in range(2 * rv + 1):
        line = np.float32(0.0)
        for i in range(2 * ru + 1):
            line += wu[i] * mirrors[row + rv + j, column + ru + i]
        total += wv[j] * line
    return total


def lens_weights(blur_px: float) -> NDArray[np.float32]:
    """Weights (2, 2 m + 1) of the samples at -0.25 and at +0.25 px of each pixel, m the margin.

    A Gaussian integrated over the pixel's aperture; the samples are twice as dense as the
    pixels, which keeps both blurs exact (aliasing is below 1e-6 from 0.5 px on).
    """
    margin = math.ceil(0.25 + 3.4 * blur_px)
    offset = np.arange(-margin, margin + 1) + np.array([[-0.25], [0.25]])
    scale = 1.0 / (math.sqrt(2.0) * blur_px)
    erf = np.vectorize(math.erf)
    weights = erf((offset + 0.5) * scale) - erf((offset - 0.5) * scale)
    return np.asarray(weights / weights.sum(), dtype=np.float32)


@kernel(error_model="python", fastmath=True)
def _across(even: Image, odd: Image, weights: Image, out: Image) -> None:
    """Filter a row of samples, given as its even and odd ones, to pixels."""
    out[:] = np.float32(0.0)
    for tap in range(weights.shape[1]):
        a, b = weights[0, tap], weights[1, tap]
        for x in range(out.size):
            out[x] += a * even[x + tap] + b * odd[x + tap]


@kernel(error_model="python", fastmath=True)
def _down(lines: Image, lens: Lens, first: int, out: Image) -> None:
    """Filter rows of samples to one row of pixels."""
    weights = lens.weights
    out[:] = np.float32(0.0)
    for tap in range(weights.shape[1]):
        a, b = weights[0, tap] * lens.scale, weights[1, tap] * lens.scale
        even, odd = lines[first + 2 * tap], lines[first + 2 * tap + 1]
        for x in range(out.size):
            out[x] += a * even[x] + b * odd[x]


@kernel(error_model="python", fastmath=True)
def _line_samples(
    light: Image, line: Image, levels: np.int32, places: Places, even: Image, odd: Image
) -> None:
    """Light of one row of samples under a 1-D pattern."""
    place, f, g = places
    for i in range(even.size):
        a, b = 2 * i, 2 * i + 1
        even[i] = light[a] * _between(line, place[a], levels, f[a], g[a])
        odd[i] = light[b] * _between(line, place[b], levels, f[b], g[b])


@kernel(error_model="python", fastmath=True)
def _all_between(x: Image, low: np.float32, high: np.float32) -> bool:
    inside = np.int32(0)
    for i in range(x.size):
        inside += np.int32((x[i] > low) & (x[i] < high))
    return bool(inside == x.size)


@kernel(error_model="python", fastmath=True)
def _border(
    across: Image, variance: Image, stripes: Stripes, scale: Scale, even: Image, odd: Image
) -> None:
    """Darken the samples near and beyond the lit DMD's border."""
    flat, entries = stripes.border.ravel(), stripes.border.shape[0]
    low, high = np.float32(stripes.safe[0]), np.float32(stripes.safe[1])
    for first in range(0, across.size, CHUNK):
        end = min(first + CHUNK, across.size)
        if _all_between(across[first:end], low, high):
            continue
        for i in range(first, end):
            half = odd if i & 1 else even
            if half[i >> 1] > np.float32(0.0):
                place, f, g = _place(scale, entries, across[i], variance[i])
                half[i >> 1] *= _between(flat, place, scale.levels, f, g)


@kernel(error_model="python", fastmath=True)
def render_lines(maps: Samples, stripes: Stripes, lens: Lens, rows: Rows, out: Image) -> None:
    """Rows of the image under a pattern that varies along one DMD axis.

    Parameters
    ----------
    maps : Samples
        What the samples see.
    stripes : Stripes
        The pattern.
    lens : Lens
        From samples to pixels.
    rows : tuple of int
        First row and the one behind the last.
    out : ndarray, (H, W) float32
        Receives electrons per second.
    """
    taps, width = lens.weights.shape[1], out.shape[1]
    even = np.empty(width + taps - 1, dtype=np.float32)
    odd = np.empty_like(even)
    places = (
        np.empty(2 * even.size, dtype=np.int32),
        np.empty(2 * even.size, dtype=np.float32),
        np.empty(2 * even.size, dtype=np.float32),
    )
    flat, entries = stripes.line.ravel(), stripes.line.shape[0]
    along, across = _scale(stripes.levels[0]), _scale(stripes.levels[1])
    samples = np.empty((2 * (rows[1] - rows[0] + taps - 1), width), dtype=np.float32)
    for k in range(samples.shape[0]):
        j = 2 * rows[0] + k
        _places(along, entries, maps.along[j], maps.spread[j], places)
        _line_samples(maps.light[j], flat, along.levels, places, even, odd)
        _border(maps.across[j], maps.spread_across[j], stripes, across, even, odd)
        _across(even, odd, lens.weights, samples[k])
    for y in range(rows[0], rows[1]):
        _down(samples, lens, 2 * (y - rows[0]), out[y])


@kernel(error_model="python", fastmath=True)
def _mirror_samples(
    maps: Samples, j: int, image: MirrorImage, scratch: tuple[Image, Image], even: Image, odd: Image
) -> None:
    """Light of one row of samples under any mirror image."""
    for i in range(maps.along.shape[1]):
        value = maps.light[j, i]
        if value > np.float32(0.0):
            q = (maps.along[j, i], maps.across[j, i])
            variance = (maps.spread[j, i], maps.spread_across[j, i])
            value *= _on_mirrors(image, q, variance, scratch)
        if i & 1:
            odd[i >> 1] = value
        else:
            even[i >> 1] = value


@kernel(error_model="python", fastmath=True)
def render_mirrors(maps: Samples, image: MirrorImage, lens: Lens, rows: Rows, out: Image) -> None:
    """Rows of the image under any mirror image.

    Parameters
    ----------
    maps : Samples
        What the samples see.
    image : MirrorImage
        The mirrors.
    lens, rows, out
        See `render_lines`.
    """
    taps, width = lens.weights.shape[1], out.shape[1]
    even = np.empty(width + taps - 1, dtype=np.float32)
    odd = np.empty_like(even)
    most = 2 * max(image.levels[0].reach, image.levels[1].reach) + 1
    scratch = (np.empty(most, dtype=np.float32), np.empty(most, dtype=np.float32))
    samples = np.empty((2 * (rows[1] - rows[0] + taps - 1), width), dtype=np.float32)
    for k in range(samples.shape[0]):
        _mirror_samples(maps, 2 * rows[0] + k, image, scratch, even, odd)
        _across(even, odd, lens.weights, samples[k])
    for y in range(rows[0], rows[1]):
        _down(samples, lens, 2 * (y - rows[0]), out[y])


@kernel(error_model="python", fastmath=True)
def render_plain(light: Image, lens: Lens, rows: Rows, out: Image) -> None:
    """Rows of the image of a sample map as it is: ambient light.

    Parameters
    ----------
    light : ndarray
        Sample map.
    lens, rows, out
        See `render_lines`.
    """
    taps, width = lens.weights.shape[1], out.shape[1]
    samples = np.empty((2 * (rows[1] - rows[0] + taps - 1), width), dtype=np.float32)
    for k in range(samples.shape[0]):
        line = light[2 * rows[0] + k]
        _across(line[::2], line[1::2], lens.weights, samples[k])
    for y in range(rows[0], rows[1]):
        _down(samples, lens, 2 * (y - rows[0]), out[y])
