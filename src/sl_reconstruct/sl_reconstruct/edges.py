"""Sub-pixel edges and centres along one camera row, and which boundary each is.

The signal of a pair is (P - N)/(P + N), of a single image (I - T)/(B - D): both cross zero at
the edge whatever the albedo. "matched" takes the zero crossing of the signal after a matched
filter, which is the maximum-likelihood position of a blurred step in white noise; "cubic" fits
a third-order curve to the samples around the crossing and finds its zero by secants (section
4.1 of the paper).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sl_reconstruct.pixels import PixelRow, count_shift
from sl_reconstruct.reasons import Reason

#: Sub-pixel phases at which the noise gain of the estimator is tabulated.
PHASES = 16
#: Where a pattern's edges are far apart, the code beside an edge may be off by so many DMD px.
MISREAD_PX = 6.0
#: A narrow shadow under an edge leaves less than this part of the light beside it.
DIP = 0.6
SQRT_2PI = float(np.sqrt(2 * np.pi))

CONTRAST = int(Reason.CONTRAST)
SATURATION = int(Reason.SATURATION)
IDENTITY = int(Reason.IDENTITY)
SHADOW = int(Reason.SHADOW)
SHAPE = int(Reason.SHAPE)
UNLIT = int(Reason.UNLIT)
PRESENT = int(Reason.PRESENT)


class Filter(NamedTuple):
    """How a signal becomes positions; one row for each source.

    ``taps``: (sources, 1 + radius) half of the symmetric smoothing kernel. ``gain``: (sources,
    PHASES + 1, 2) the sum of squared weights, alone and times the squared profile of a blurred
    step. ``slope``: (sources,) expected slope of a unit step. The last row of gain and the last
    slope are those of BR8.
    """

    taps: NDArray[np.float32]
    gain: NDArray[np.float32]
    slope: NDArray[np.float32]


class Tuning(NamedTuple):
    """What survey and settings say, in pixels, DMD pixels and DN.

    ``direction``: +1 where k grows with u, -1 where it falls. ``reach_px``: beyond it an edge's
    blur does not matter. ``around_px``: a fine stripe's half width. ``scale``: camera pixels per
    DMD pixel. ``floor_dn``: keeps quotients finite. ``least_width``, ``most_width``: of an edge,
    over what is expected. ``noise_dn2``, ``noise_dn``: variance = noise_dn2 + noise_dn * level.
    ``jump_px``: a centre may lie so far from where the edges on a side lead.
    """

    direction: int
    reach_px: int
    around_px: int
    scale: float
    division_px: int
    size_px: int
    floor_dn: float
    lit_dn: float
    contrast_dn: float
    saturation: int
    least_width: float
    most_width: float
    min_light: float
    noise_dn2: float
    noise_dn: float
    jump_px: float


class SourceRow(NamedTuple):
    """Scratch for one source in one row: signal, filtered signal, crossings.

    ``marks`` has a byte for each pixel, and is seen as ``words``; ``at`` lists the crossings.
    For each of them: ``fraction`` and ``slope`` of the zero, ``sigma`` and ``width``, ``k`` with
    ``agreed``, and ``why`` it is refused or 0.
    """

    signal: NDArray[np.float32]
    filtered: NDArray[np.float32]
    words: NDArray[np.uint64]
    marks: NDArray[np.uint8]
    at: NDArray[np.int32]
    fraction: NDArray[np.float32]
    slope: NDArray[np.float32]
    sigma: NDArray[np.float32]
    width: NDArray[np.float32]
    k: NDArray[np.int32]
    agreed: NDArray[np.uint8]
    why: NDArray[np.uint8]


class Found(NamedTuple):
    """What a row's edges are written to, one entry for each boundary."""

    u_px: NDArray[np.float32]
    sigma_px: NDArray[np.float32]
    width_px: NDArray[np.float32]
    level_dn: NDArray[np.float32]
    reason: NDArray[np.uint8]


def source_row(width: int) -> SourceRow:
    """Return scratch for rows of ``width`` pixels."""
    words = np.zeros((width + 7) // 8, np.uint64)
    types = [np.int32, *[np.float32] * 4, np.int32, np.uint8, np.uint8]
    return SourceRow(
        np.zeros(width, np.float32), np.zeros(width, np.float32), words, words.view(np.uint8),
        *(np.zeros(width + 8, t) for t in types),
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def pair_signal(pattern: Any, inverse: Any, floor_dn: float, signal: Any) -> None:
    """(P - N) / (P + N): free of albedo and of light that is always there."""
    floor = np.float32(floor_dn)
    for x in range(signal.size):
        a = np.float32(pattern[x])
        b = np.float32(inverse[x])
        signal[x] = (a - b) / (a + b + floor)


@njit(cache=True, nogil=True, error_model="numpy")
def single_signal(image: Any, p: PixelRow, floor_dn: float, signal: Any) -> None:
    """(I - T) / (B - D) with the dynamic threshold; zero where it is unknown."""
    floor = np.float32(floor_dn)
    threshold, light = p.threshold, p.light
    for x in range(signal.size):
        a = light[x]
        q = (np.float32(image[x]) - threshold[x]) / (a if a > floor else floor)
        signal[x] = q if q == q else np.float32(0)


@njit(cache=True, nogil=True, error_model="numpy")
def smooth(signal: Any, taps: Any, out: Any) -> None:
    """Convolve with a symmetric kernel; samples that it does not cover keep the raw signal."""
    n, radius = signal.size, taps.size - 1
    for x in range(radius):
        out[x] = signal[x]
        out[n - 1 - x] = signal[n - 1 - x]
    inner, mid = out[radius : n - radius], signal[radius : n - radius]
    done = min(4, radius)
    if done == 4:  # one pass for the usual kernels
        _smooth_nine(signal[radius - 4 : n - radius + 4], taps, inner)
    else:
        done = 0
        for x in range(inner.size):
            inner[x] = taps[0] * mid[x]
    for j in range(done + 1, radius + 1):
        left, right = signal[radius - j : n - radius - j], signal[radius + j : n - radius + j]
        w = taps[j]
        for x in range(inner.size):
            inner[x] += w * (left[x] + right[x])


@njit(cache=True, nogil=True, error_model="numpy")
def _smooth_nine(s: Any, taps: Any, out: Any) -> None:
    a, b, c, d, e = taps[0], taps[1], taps[2], taps[3], taps[4]
    n = out.size
    s1, s2, s3, s4, s5 = s[1:], s[2:], s[3:], s[4:], s[5:]
    s6, s7, s8 = s[6:], s[7:], s[8:]
    for x in range(n):
        near = a * s4[x] + b * (s3[x] + s5[x]) + c * (s2[x] + s6[x])
        out[x] = near + d * (s1[x] + s7[x]) + e * (s[x] + s8[x])


@njit(cache=True, nogil=True, error_model="numpy")
def bar_centres(signal: Any, out: Any) -> None:
    """BR8, Eq. (6): the four samples on the left minus the four on the right."""
    n = signal.size
    for x in range(n):
        out[x] = 0
    inner = out[4 : n - 4]
    for j in range(1, 5):
        left, right = signal[4 - j : n - 4 - j], signal[4 + j : n - 4 + j]
        for x in range(inner.size):
            inner[x] += left[x] - right[x]


@njit(cache=True, nogil=True, error_model="numpy")
def find_crossings(lit: Any, r: SourceRow, first: int, last: int) -> int:
    """List where the signal changes sign between a pixel and the next, and either is lit.

    Returns their number; only pixels ``first <= x < last`` are listed.
    """
    filtered, marks, words, at = r.filtered, r.marks, r.words, r.at
    n = filtered.size
    for x in range(n - 1):
        turn = (filtered[x] >= 0) != (filtered[x + 1] >= 0)
        marks[x] = np.uint8(turn) & (lit[x] | lit[x + 1])
    for x in range(first):
        marks[x] = 0
    for x in range(last, n):
        marks[x] = 0
    found = 0
    for word in range(words.size):
        if words[word]:
            for x in range(8 * word, 8 * word + 8):
                at[found] = x
                found += marks[x]
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def find_zeros(filtered: Any, at: Any, count: int, fraction: Any, slope: Any) -> None:
    """Zero of the cubic through four samples about each crossing, and the slope there.

    A secant between the two middle samples, and one Newton step: the filtered signal is nearly
    straight, and 1e-5 px are left. Where the cubic has no zero there, the fraction leaves [0, 1].
    """
    half, third, sixth = np.float32(1 / 2), np.float32(1 / 3), np.float32(1 / 6)
    two, three = np.float32(2), np.float32(3)
    for i in range(count):
        x = at[i]
        a, b, c, d = filtered[x - 1], filtered[x], filtered[x + 1], filtered[x + 2]
        c1 = c - third * a - half * b - sixth * d
        c2 = half * (a + c) - b
        c3 = sixth * (d - a) + half * (b - c)
        t = b / (b - c)
        value = b + t * (c1 + t * (c2 + t * c3))
        t -= value / (c1 + t * (two * c2 + t * three * c3))
        fraction[i] = t
        slope[i] = abs(c1 + t * (two * c2 + t * three * c3))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def light_fails(left: float, under: float, right: float, t: Tuning) -> int:
    """Reason why the light left of, under and right of an edge does not do, or 0."""
    sides, most = min(left, right), max(left, right)
    least = min(under, sides)
    if max(most, under) < t.contrast_dn:
        return CONTRAST
    if least < t.min_light * most or under < DIP * sides:
        return SHADOW
    return CONTRAST if least < t.contrast_dn else 0


@njit(cache=True, nogil=True, error_model="numpy")
def check_light(light: Any, clipped: Any, at: Any, count: int, t: Tuning, why: Any) -> None:
    """Write for each crossing why the light under it does not do, or 0."""
    last = light.size - 1
    for i in range(count):
        x = np.int64(at[i])
        a, b = max(0, x - t.reach_px), min(last, x + 1 + t.reach_px)
        reason = light_fails(light[a], min(light[x], light[x + 1]), light[b], t)
        full = clipped[a] | clipped[x] | clipped[x + 1] | clipped[b]
        why[i] = SATURATION if full and reason != CONTRAST else reason


@njit(cache=True, nogil=True, error_model="numpy")
def identify(
    code: Any, r: SourceRow, count: int, rising_px: int, half: int, flip: bool, t: Tuning
) -> None:
    """Name the boundary k of each crossing, and whether the evidence agrees.

    The edge's pattern and polarity say k modulo 4 D; the Gray code on either side says where.
    Where they disagree, the pattern's edge next to the code's place is named. k is 0 where there
    is none on the DMD. ``flip`` exchanges the polarities.
    """
    at, ks, agreed, filtered = r.at, r.k, r.agreed, r.filtered
    period, tolerance = 4.0 * half, max(0.5 * t.division_px + 1.5, min(0.9 * half, MISREAD_PX))
    most = 2.5 * (2 * t.reach_px + 1) / t.scale + t.division_px
    last, turn = code.size - 1, flip != (t.direction < 0)
    for i in range(count):
        x = np.int64(at[i])
        a = np.int64(code[max(0, x - t.reach_px)])
        b = np.int64(code[min(last, x + 1 + t.reach_px)])
        ahead = (b - a) * t.direction * t.division_px
        middle = 0.5 * (a + b + 1) * t.division_px
        falling = (filtered[x] < 0) == turn
        first = rising_px + 2.0 * half * falling
        k = first + period * np.floor((middle - first) * (1.0 / period) + 0.5)
        near = abs(k - middle) <= tolerance
        if not near:
            k = rising_px + 0.5 * period * np.floor((middle - rising_px) * (2.0 / period) + 0.5)
        inside = (k > 0) & (k < t.size_px)
        ks[i] = np.int32(k) if inside else np.int32(0)
        agreed[i] = np.uint8(near & inside & (ahead >= -t.division_px) & (ahead <= most))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def pair_variance(
    total: float, gain: float, profile_gain: float, plateau: float, t: Tuning
) -> float:
    """Variance of a pair's filtered signal times total^2, DN^2; total = P + N at the edge.

    var((P - N)/(P + N)) = [2 a (1 + q^2) + b S (1 - q^2)] / S^2 for pixel noise a + b * level.
    """
    q2 = profile_gain * plateau * plateau
    return 2 * t.noise_dn2 * (gain + q2) + t.noise_dn * total * (gain - q2)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def single_variance(
    threshold_dn: float, light_dn: float, bright: int, dark: int, level_dn: float, t: Tuning
) -> Any:
    """Variance of a single image's samples about ``level_dn``, and of their threshold, DN^2.

    The threshold is the middle between the means of so many bright and dark samples.
    """
    high = t.noise_dn2 + t.noise_dn * (threshold_dn + 0.5 * light_dn)
    low = t.noise_dn2 + t.noise_dn * (threshold_dn - 0.5 * light_dn)
    own = t.noise_dn2 + t.noise_dn * level_dn
    return own + 0.25 * (high * dark + low * bright) / (bright * dark)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def phase_of(fraction: float) -> int:
    """Row of the gain table for a sub-pixel phase."""
    return min(PHASES, max(0, int(fraction * PHASES + 0.5)))


@njit(cache=True, nogil=True, error_model="numpy")
def weigh_pairs(
    pattern: Any, inverse: Any, light: Any, gain: Any, full_slope: float, t: Tuning,
    r: SourceRow, count: int,
) -> None:  # fmt: skip
    """Write sigma of each crossing of a pair, and how wide it is against what is expected."""
    at, fraction, slope, sigma, width = r.at, r.fraction, r.slope, r.sigma, r.width
    for i in range(count):
        x = at[i]
        whole = np.float64(pattern[x]) + np.float64(inverse[x]) + t.floor_dn
        row = phase_of(fraction[i])
        variance = pair_variance(whole, gain[row, 0], gain[row, 1], light[x] / whole, t)
        steep = slope[i] * whole
        inverse_steep = np.float32(1) / np.float32(steep)
        sigma[i] = np.sqrt(np.float32(variance)) * inverse_steep
        width[i] = np.float32(2) * light[x] * np.float32(full_slope) * inverse_steep


@njit(cache=True, nogil=True, error_model="numpy")
def weigh_singles(
    p: PixelRow, gain: Any, full_slope: float, centre: bool, t: Tuning, r: SourceRow, count: int
) -> None:
    """Write sigma and width of each crossing of a single image, or of BR8 on it.

    An edge's samples lie about the threshold, those of a centre are all bright or all dark.
    """
    at, fraction, slope, sigma, width = r.at, r.fraction, r.slope, r.sigma, r.width
    threshold, light, bright, dark, filtered = p.threshold, p.light, p.bright, p.dark, r.filtered
    shift = count_shift(bright.itemsize)
    for i in range(count):
        x = at[i]
        level = np.float64(threshold[x])
        if centre:
            level += 0.5 * light[x] if filtered[x] < 0 else -0.5 * light[x]
        b, d = max(1, bright[x] >> shift), max(1, dark[x] >> shift)
        variance = single_variance(threshold[x], light[x], b, d, level, t)
        variance *= gain[phase_of(fraction[i]), 0]
        sigma[i] = np.sqrt(np.float32(variance)) / (light[x] * slope[i])
        width[i] = np.float32(full_slope) / slope[i]
