"""From mirrors and sample maps to the image: blurred patterns, lens filter, decimation."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

#: Entries of a blurred line per DMD pixel; linear between.
PHASES = 32
#: Blur levels are closer than this fraction of the smallest variance, up to MAX_LEVELS of them.
LEVEL_STEP = 0.08
MAX_LEVELS = 48
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def blurred_line(profile: Any, levels: Any) -> Any:
    """Blurred 1-D pattern ((size + 2 reach) PHASES + 1, levels), from u = -reach - 0.5 on."""
    reach, size = levels.reach, profile.size
    out = np.zeros(((size + 2 * reach) * PHASES + 1, levels.levels), dtype=np.float32)
    for entry in range(out.shape[0]):
        base, phase = entry // PHASES - reach, entry % PHASES
        for m in range(max(base - reach, 0), min(base + reach + 1, size)):
            if profile[m]:
                for k in range(levels.levels):
                    out[entry, k] += levels.weights[phase, m - base + reach, k]
    return out


@njit(cache=True, nogil=True, fastmath=True)
def _level(levels: Any, variance: Any) -> Any:
    """Level below a variance, and the share of the one above."""
    q = (variance - np.float32(levels.first)) * np.float32(levels.per_step)
    k = min(max(int(q), 0), levels.levels - 2)
    return k, q - np.float32(k)


@njit(cache=True, nogil=True, fastmath=True)
def _on_line(line: Any, levels: Any, x: Any, variance: Any) -> Any:
    """Brightness of a blurred line at coordinate x, px."""
    at = (x + np.float32(levels.reach + 0.5)) * np.float32(PHASES)
    if not np.float32(0.0) <= at < np.float32(line.shape[0] - 1):
        return np.float32(0.0)
    i = int(at)
    f = at - np.float32(i)
    k, g = _level(levels, variance)
    low = line[i, k] + f * (line[i + 1, k] - line[i, k])
    high = line[i, k + 1] + f * (line[i + 1, k + 1] - line[i, k + 1])
    return low + g * (high - low)


@njit(cache=True, nogil=True, fastmath=True)
def _tap_weights(levels: Any, fraction: Any, variance: Any, out: Any) -> None:
    """Weights of the mirrors about a point at that fraction of its mirror."""
    at = fraction * PHASES
    i = min(int(at), PHASES - 1)
    f = np.float32(at - i)
    k, g = _level(levels, variance)
    w = levels.weights
    for tap in range(2 * levels.reach + 1):
        low = w[i, tap, k] + f * (w[i + 1, tap, k] - w[i, tap, k])
        high = w[i, tap, k + 1] + f * (w[i + 1, tap, k + 1] - w[i, tap, k + 1])
        out[tap] = low + g * (high - low)


@njit(cache=True, nogil=True, fastmath=True)
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


@njit(cache=True, nogil=True, fastmath=True)
def _across(even: Any, odd: Any, weights: Any, out: Any) -> None:
    """Filter a row of samples, given as its even and odd ones, to pixels."""
    out[:] = np.float32(0.0)
    for tap in range(weights.shape[1]):
        a, b = weights[0, tap], weights[1, tap]
        for x in range(out.size):
            out[x] += a * even[x + tap] + b * odd[x + tap]


@njit(cache=True, nogil=True, fastmath=True)
def _down(lines: Any, weights: Any, first: int, scale: Any, out: Any) -> None:
    """Filter rows of samples to one row of pixels."""
    out[:] = np.float32(0.0)
    for tap in range(weights.shape[1]):
        a, b = weights[0, tap] * scale, weights[1, tap] * scale
        even, odd = lines[first + 2 * tap], lines[first + 2 * tap + 1]
        for x in range(out.size):
            out[x] += a * even[x] + b * odd[x]


@njit(cache=True, nogil=True, fastmath=True)
def _line_samples(
    maps: Any, j: int, lines: Any, levels: Any, safe: Any, even: Any, odd: Any
) -> None:
    """Light of one row of samples under a 1-D pattern; maps are (along, across, ...)."""
    for i in range(maps[0].shape[1]):
        value = maps[2][j, i]
        if value > np.float32(0.0):
            across = maps[1][j, i]
            value *= _on_line(lines[0], levels[0], maps[0][j, i], maps[3][j, i])
            if not safe[0] < across < safe[1]:
                value *= _on_line(lines[1], levels[1], across, maps[4][j, i])
        if i & 1:
            odd[i >> 1] = value
        else:
            even[i >> 1] = value


@njit(cache=True, nogil=True, fastmath=True)
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
    samples = np.empty((2 * (rows[1] - rows[0] + taps - 1), width), dtype=np.float32)
    for k in range(samples.shape[0]):
        _line_samples(maps, 2 * rows[0] + k, lines, levels, safe, even, odd)
        _across(even, odd, weights, samples[k])
    for y in range(rows[0], rows[1]):
        _down(samples, weights, 2 * (y - rows[0]), scale, out[y])


@njit(cache=True, nogil=True, fastmath=True)
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


@njit(cache=True, nogil=True, fastmath=True)
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


@njit(cache=True, nogil=True, fastmath=True)
def render_plain(light: Any, weights: Any, scale: Any, rows: Any, out: Any) -> None:
    """Rows of the image of a sample map as it is: ambient light."""
    taps, width = weights.shape[1], out.shape[1]
    samples = np.empty((2 * (rows[1] - rows[0] + taps - 1), width), dtype=np.float32)
    for k in range(samples.shape[0]):
        line = light[2 * rows[0] + k]
        _across(line[::2], line[1::2], weights, samples[k])
    for y in range(rows[0], rows[1]):
        _down(samples, weights, 2 * (y - rows[0]), scale, out[y])
