"""From mirrors and sample maps to the image: blurred patterns, lens filter, decimation."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_common.kernel_cache import kernel

#: Entries of a blurred line per DMD pixel; linear between.
PHASES = 32
#: Blur levels are closer than this fraction of the smallest variance, up to MAX_LEVELS of them.
LEVEL_STEP = 0.08
MAX_LEVELS = 48
#: So many samples of a row are asked together whether the lit DMD's border is far.
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
    weights: NDArray[np.float32]


@kernel(error_model="python")
def _mirror_weights(variances: Any, reach: int) -> Any:
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
    """Levels between two variances, px^2."""
    steps = math.ceil((highest - lowest) / (LEVEL_STEP * lowest))
    count = min(max(steps + 1, 2), MAX_LEVELS)
    step = max(highest - lowest, 1e-6) / (count - 1)
    variances = lowest + step * np.arange(count)
    reach = math.ceil(REACH * math.sqrt(variances[-1])) + 1
    return Levels(lowest, 1.0 / step, count, reach, _mirror_weights(variances, reach))


@kernel(error_model="python")
def blurred_line(profile: Any, levels: Any) -> Any:
    """Blurred 1-D pattern ((size + 2 reach) PHASES + 1, levels), from u = -reach - 0.5 on.

    Its ends are dark, so that all beyond may be looked up there.
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
def _level(scale: Any, variance: Any) -> Any:
    """Level below a variance, and the share of the one above; scale: first, per step, levels."""
    q = (variance - scale[0]) * scale[1]
    k = np.int32(min(max(np.int32(q), np.int32(0)), np.int32(scale[2] - 2)))
    return k, q - np.float32(k)


@kernel(error_model="python", fastmath=True)
def _scale(levels: Any) -> Any:
    """Numbers of `Levels` alone: an array handed on with them is counted at every sample."""
    offset = np.float32(levels.reach + 0.5)
    return np.float32(levels.first), np.float32(levels.per_step), np.int32(levels.levels), offset


@kernel(error_model="python", fastmath=True)
def _place(scale: Any, entries: Any, x: Any, variance: Any) -> Any:
    """Where a coordinate, px, falls in a blurred line: flat index, shares of next entry, level."""
    at = (x + scale[3]) * np.float32(PHASES)
    at = min(max(at, np.float32(0.0)), np.float32(entries - 1))
    entry = np.int32(min(np.int32(at), np.int32(entries - 2)))
    k, g = _level(scale, variance)
    return np.int32(entry * scale[2] + k), at - np.float32(entry), g


@kernel(error_model="python", fastmath=True)
def _places(scale: Any, entries: Any, x: Any, variance: Any, places: Any) -> None:
    """`_place` of a row; apart from the look-up, so that it is made of vector instructions."""
    place, f, g = places
    for i in range(x.size):
        place[i], f[i], g[i] = _place(scale, entries, x[i], variance[i])


@kernel(error_model="python", fastmath=True)
def _between(line: Any, place: Any, levels: int, f: Any, g: Any) -> Any:
    """Brightness at a place of a blurred line, given flat."""
    here, there = line[place], line[place + 1]
    low = here + f * (line[place + levels] - here)
    high = there + f * (line[place + levels + 1] - there)
    return low + g * (high - low)


@kernel(error_model="python", fastmath=True)
def _tap_weights(levels: Any, fraction: Any, variance: Any, out: Any) -> None:
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
def _on_mirrors(mirrors: Any, levels: Any, q: Any, variance: Any, wu: Any, wv: Any) -> Any:
    """Brightness of a mirror image, padded by each axis's reach, at (u, v)."""
    column, row = int(np.floor(q[0] + 0.5)), int(np.floor(q[1] + 0.5))
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
def _across(even: Any, odd: Any, weights: Any, out: Any) -> None:
    """Filter a row of samples, given as its even and odd ones, to pixels."""
    out[:] = np.float32(0.0)
    for tap in range(weights.shape[1]):
        a, b = weights[0, tap], weights[1, tap]
        for x in range(out.size):
            out[x] += a * even[x + tap] + b * odd[x + tap]


@kernel(error_model="python", fastmath=True)
def _down(lines: Any, weights: Any, first: int, scale: Any, out: Any) -> None:
    """Filter rows of samples to one row of pixels."""
    out[:] = np.float32(0.0)
    for tap in range(weights.shape[1]):
        a, b = weights[0, tap] * scale, weights[1, tap] * scale
        even, odd = lines[first + 2 * tap], lines[first + 2 * tap + 1]
        for x in range(out.size):
            out[x] += a * even[x] + b * odd[x]


@kernel(error_model="python", fastmath=True)
def _line_samples(light: Any, line: Any, levels: int, places: Any, even: Any, odd: Any) -> None:
    """Light of one row of samples under a 1-D pattern."""
    place, f, g = places
    for i in range(even.size):
        a, b = 2 * i, 2 * i + 1
        even[i] = light[a] * _between(line, place[a], levels, f[a], g[a])
        odd[i] = light[b] * _between(line, place[b], levels, f[b], g[b])


@kernel(error_model="python", fastmath=True)
def _all_between(x: Any, low: Any, high: Any) -> bool:
    inside = np.int32(0)
    for i in range(x.size):
        inside += np.int32((x[i] > low) & (x[i] < high))
    return bool(inside == x.size)


@kernel(error_model="python", fastmath=True)
def _border(
    across: Any, variance: Any, line: Any, scale: Any, safe: Any, even: Any, odd: Any
) -> None:
    """Darken the samples near and beyond the lit DMD's border."""
    flat, low, high = line.ravel(), np.float32(safe[0]), np.float32(safe[1])
    for first in range(0, across.size, CHUNK):
        end = min(first + CHUNK, across.size)
        if _all_between(across[first:end], low, high):
            continue
        for i in range(first, end):
            half = odd if i & 1 else even
            if half[i >> 1] > np.float32(0.0):
                place, f, g = _place(scale, line.shape[0], across[i], variance[i])
                half[i >> 1] *= _between(flat, place, scale[2], f, g)


@kernel(error_model="python", fastmath=True)
def render_lines(
    maps: Any, lines: Any, levels: Any, safe: Any, weights: Any, scale: Any, rows: Any, out: Any
) -> None:
    """Rows of the image under a pattern that varies along one DMD axis.

    Parameters
    ----------
    maps : tuple of ndarray
        Sample maps: coordinate along the pattern, across it, reflectance, variance along, across.
    lines : tuple of ndarray
        `blurred_line` of the pattern, and of the lit DMD across it.
    levels : tuple of Levels
        Along, across.
    safe : tuple of float
        Between these coordinates across, the DMD's border has no influence.
    weights : ndarray
        From `lens_weights`.
    scale : float32
        Electrons per second of white.
    rows : tuple of int
        First row and the one behind the last.
    out : ndarray, (H, W) float32
        Receives electrons per second.
    """
    taps, width = weights.shape[1], out.shape[1]
    even = np.empty(width + taps - 1, dtype=np.float32)
    odd = np.empty_like(even)
    places = (
        np.empty(2 * even.size, dtype=np.int32),
        np.empty(2 * even.size, dtype=np.float32),
        np.empty(2 * even.size, dtype=np.float32),
    )
    along, across, light, spread, spread_across = maps
    flat, scales = lines[0].ravel(), (_scale(levels[0]), _scale(levels[1]))
    samples = np.empty((2 * (rows[1] - rows[0] + taps - 1), width), dtype=np.float32)
    for k in range(samples.shape[0]):
        j = 2 * rows[0] + k
        _places(scales[0], lines[0].shape[0], along[j], spread[j], places)
        _line_samples(light[j], flat, scales[0][2], places, even, odd)
        _border(across[j], spread_across[j], lines[1], scales[1], safe, even, odd)
        _across(even, odd, weights, samples[k])
    for y in range(rows[0], rows[1]):
        _down(samples, weights, 2 * (y - rows[0]), scale, out[y])


@kernel(error_model="python", fastmath=True)
def _mirror_samples(
    maps: Any, j: int, mirrors: Any, levels: Any, scratch: Any, even: Any, odd: Any
) -> None:
    """Light of one row of samples under any mirror image."""
    for i in range(maps[0].shape[1]):
        value = maps[2][j, i]
        if value > np.float32(0.0):
            q = (maps[0][j, i], maps[1][j, i])
            variance = (maps[3][j, i], maps[4][j, i])
            value *= _on_mirrors(mirrors, levels, q, variance, scratch[0], scratch[1])
        if i & 1:
            odd[i >> 1] = value
        else:
            even[i >> 1] = value


@kernel(error_model="python", fastmath=True)
def render_mirrors(
    maps: Any, mirrors: Any, levels: Any, weights: Any, scale: Any, rows: Any, out: Any
) -> None:
    """Rows of the image under any mirror image, padded by twice each axis's reach.

    Parameters are those of `render_lines`; ``mirrors`` is float32, 0 or 1.
    """
    taps, width = weights.shape[1], out.shape[1]
    even = np.empty(width + taps - 1, dtype=np.float32)
    odd = np.empty_like(even)
    most = 2 * max(levels[0].reach, levels[1].reach) + 1
    scratch = (np.empty(most, dtype=np.float32), np.empty(most, dtype=np.float32))
    samples = np.empty((2 * (rows[1] - rows[0] + taps - 1), width), dtype=np.float32)
    for k in range(samples.shape[0]):
        _mirror_samples(maps, 2 * rows[0] + k, mirrors, levels, scratch, even, odd)
        _across(even, odd, weights, samples[k])
    for y in range(rows[0], rows[1]):
        _down(samples, weights, 2 * (y - rows[0]), scale, out[y])


@kernel(error_model="python", fastmath=True)
def render_plain(light: Any, weights: Any, scale: Any, rows: Any, out: Any) -> None:
    """Rows of the image of a sample map as it is: ambient light."""
    taps, width = weights.shape[1], out.shape[1]
    samples = np.empty((2 * (rows[1] - rows[0] + taps - 1), width), dtype=np.float32)
    for k in range(samples.shape[0]):
        line = light[2 * rows[0] + k]
        _across(line[::2], line[1::2], weights, samples[k])
    for y in range(rows[0], rows[1]):
        _down(samples, weights, 2 * (y - rows[0]), scale, out[y])
