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
from numpy.typing import NDArray

from sl_common.kernel_cache import kernel
from sl_reconstruct.cloud.refusals import Reason
from sl_reconstruct.decode.bit_words import WORD, bits_from, lowest_bit, padded
from sl_reconstruct.decode.gray_code import PixelRow, count_shift

#: Sub-pixel phases at which the noise gain of the estimator is tabulated.
PHASES = 16
#: Where a pattern's edges are far apart, the code beside an edge may be off by so many DMD px.
MISREAD_PX = 6.0
#: A narrow shadow under an edge leaves less than this part of the light beside it.
DIP = 0.6
SQRT_2PI = float(np.sqrt(2 * np.pi))

#: Crossings that are worked on together. Their numbers lie in the lines of a tile: a constant
#: distance apart, so that the compiler knows that they do not overlap and works on eight at once.
TILE = 192
#: Four filtered samples about the crossing; light a reach to the left, under it on either side,
#: and a reach to the right; the code at those ends; whether anything there is saturated.
A, B, C, D, LEFT, UNDER, BESIDE, RIGHT, CODE_A, CODE_B, FULL = range(0, 11 * TILE, TILE)
#: P + N or threshold, and how many bright and dark samples the threshold has.
LEVEL, BRIGHT, DARK = range(11 * TILE, 14 * TILE, TILE)
#: What is found: the zero and its slope there, noise gain, sigma and width, k, and whether the
#: evidence agrees with it, why it is refused or 0.
FRACTION, SLOPE, PHASE, GAIN, PROFILE, SIGMA, WIDTH, K, AGREED, WHY = range(
    14 * TILE, 24 * TILE, TILE
)
LINES = 24
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
    ``jump_px``: a centre may lie so far from where the edges on a side lead. ``blur_px``: the
    standard deviation of an edge's blur.
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
    blur_px: float


class SourceRow(NamedTuple):
    """Scratch for one source in one row: signal, filtered signal, crossings.

    ``at`` lists the crossings; ``tile`` holds the numbers of up to TILE of them, line by line.
    """

    signal: NDArray[np.float32]
    filtered: NDArray[np.float32]
    at: NDArray[np.uint32]
    tile: NDArray[np.float32]


class Found(NamedTuple):
    """What a row's edges are written to, one entry for each boundary."""

    u_px: NDArray[np.float32]
    sigma_px: NDArray[np.float32]
    width_px: NDArray[np.float32]
    level_dn: NDArray[np.float32]
    reason: NDArray[np.uint8]


def source_row(width: int) -> SourceRow:
    """Return scratch for rows of ``width`` pixels."""
    return SourceRow(
        np.zeros(width, np.float32), padded(width, np.float32),
        np.zeros(width, np.uint32), np.zeros(LINES * TILE, np.float32),
    )  # fmt: skip


@kernel()
def pair_signal(pattern: Any, inverse: Any, floor_dn: float, signal: Any) -> None:
    """(P - N) / (P + N): free of albedo and of light that is always there."""
    floor = np.float32(floor_dn)
    for x in range(signal.size):
        a = np.float32(pattern[x])
        b = np.float32(inverse[x])
        signal[x] = (a - b) / (a + b + floor)


@kernel()
def single_signal(image: Any, p: PixelRow, floor_dn: float, signal: Any) -> None:
    """(I - T) / (B - D) with the dynamic threshold; zero where it is unknown."""
    floor = np.float32(floor_dn)
    threshold, light = p.threshold, p.light
    for x in range(signal.size):
        a = light[x]
        q = (np.float32(image[x]) - threshold[x]) / (a if a > floor else floor)
        signal[x] = q if q == q else np.float32(0)


@kernel()
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


@kernel()
def _smooth_nine(s: Any, taps: Any, out: Any) -> None:
    a, b, c, d, e = taps[0], taps[1], taps[2], taps[3], taps[4]
    n = out.size
    s1, s2, s3, s4, s5 = s[1:], s[2:], s[3:], s[4:], s[5:]
    s6, s7, s8 = s[6:], s[7:], s[8:]
    for x in range(n):
        near = a * s4[x] + b * (s3[x] + s5[x]) + c * (s2[x] + s6[x])
        out[x] = near + d * (s1[x] + s7[x]) + e * (s[x] + s8[x])


@kernel()
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


@kernel(forceinline=True)
def find_crossings(lit: Any, filtered: Any, at: Any, first: int, last: int) -> int:
    """List where the signal changes sign between a pixel and the next, and either is lit.

    Returns their number; only pixels ``first <= x < last`` are listed.
    """
    found, one, every = 0, np.uint64(1), ~np.uint64(0)
    for x in range(first - first % WORD, last, WORD):
        turn = bits_from(filtered, x) ^ bits_from(filtered, x + 1)
        turn &= bits_from(lit, x) | bits_from(lit, x + 1)
        if x < first:
            turn &= every << np.uint64(first - x)
        if last - x < WORD:
            turn &= ~(every << np.uint64(last - x))
        while turn:
            at[found] = np.uint64(x) + lowest_bit(turn)
            found += 1
            turn &= turn - one
    return found


@kernel(forceinline=True)
def gather(p: PixelRow, r: SourceRow, first: int, n: int, t: Tuning) -> None:
    """Put what lies about n crossings from ``first`` on into the tile."""
    at, tile, filtered = r.at[first : first + n], r.tile, r.filtered
    light, code, clipped = p.light, p.code, p.clipped
    one, two, reach = np.uint64(1), np.uint64(2), np.uint64(t.reach_px)
    for i in range(n):
        x = np.uint64(at[i])
        a, b = x - reach, x + one + reach
        tile[A + i], tile[B + i] = filtered[x - one], filtered[x]
        tile[C + i], tile[D + i] = filtered[x + one], filtered[x + two]
        tile[LEFT + i], tile[UNDER + i] = light[a], light[x]
        tile[BESIDE + i], tile[RIGHT + i] = light[x + one], light[b]
        tile[CODE_A + i], tile[CODE_B + i] = code[a], code[b]
    if not p.any_clipped[0]:
        tile[FULL : FULL + n] = np.float32(0)
        return
    for i in range(n):
        x = np.uint64(at[i])
        here = clipped[x] | clipped[x + one]
        tile[FULL + i] = clipped[x - reach] | here | clipped[x + one + reach]


@kernel(forceinline=True)
def gather_pair(pattern: Any, inverse: Any, r: SourceRow, first: int, n: int) -> None:
    """Put the light of a pair at its crossings into the tile."""
    at, tile = r.at[first : first + n], r.tile
    for i in range(n):
        x = np.uint64(at[i])
        tile[LEVEL + i] = np.float32(pattern[x]) + np.float32(inverse[x])


@kernel(forceinline=True)
def gather_single(p: PixelRow, r: SourceRow, first: int, n: int) -> None:
    """Put the threshold at a single image's crossings, and what it rests on, into the tile."""
    at, tile = r.at[first : first + n], r.tile
    threshold, bright, dark = p.threshold, p.bright, p.dark
    shift = count_shift(bright.itemsize)
    for i in range(n):
        x = np.uint64(at[i])
        tile[LEVEL + i] = threshold[x]
        tile[BRIGHT + i], tile[DARK + i] = bright[x] >> shift, dark[x] >> shift


@kernel()
def find_zeros(tile: Any, n: int) -> None:
    """Zero of the cubic through four samples about each crossing, and the slope there.

    A secant between the two middle samples, and one Newton step: the filtered signal is nearly
    straight, and 1e-5 px are left. Where the cubic has no zero there, the fraction leaves [0, 1].
    """
    half, third, sixth = np.float32(1 / 2), np.float32(1 / 3), np.float32(1 / 6)
    two, three = np.float32(2), np.float32(3)
    for i in range(n):
        a, b, c, d = tile[A + i], tile[B + i], tile[C + i], tile[D + i]
        c1 = c - third * a - half * b - sixth * d
        c2 = half * (a + c) - b
        c3 = sixth * (d - a) + half * (b - c)
        t = b / (b - c)
        value = b + t * (c1 + t * (c2 + t * c3))
        t -= value / (c1 + t * (two * c2 + t * three * c3))
        tile[FRACTION + i] = t
        tile[SLOPE + i] = abs(c1 + t * (two * c2 + t * three * c3))


@kernel()
def refuse_dim_edges(tile: Any, n: int, t: Tuning) -> None:
    """Write for each crossing why the light under it does not do, or 0."""
    contrast, saturation, shadow = np.float32(CONTRAST), np.float32(SATURATION), np.float32(SHADOW)
    none = np.float32(0)
    for i in range(n):
        left, right = tile[LEFT + i], tile[RIGHT + i]
        under, beside = tile[UNDER + i], tile[BESIDE + i]
        under = beside if beside < under else under
        sides, most = (left, right) if left < right else (right, left)
        least = under if under < sides else sides
        faint = (most < t.contrast_dn) & (under < t.contrast_dn)
        dark = (least < t.min_light * most) | (under < DIP * sides)
        why = shadow if dark else (contrast if least < t.contrast_dn else none)
        why = contrast if faint else why
        full = (tile[FULL + i] != none) & (why != contrast)
        tile[WHY + i] = saturation if full else why


@kernel()
def identify(tile: Any, n: int, rising_px: int, half: int, flip: bool, t: Tuning) -> None:
    """Name the boundary k of each crossing, and whether the evidence agrees.

    The edge's pattern and polarity say k modulo 4 D; the Gray code on either side says where.
    Where they disagree, the pattern's edge next to the code's place is named. k is 0 where there
    is none on the DMD. ``flip`` exchanges the polarities.
    """
    f, stripe = np.float32, np.float32(2 * half)
    near_px = f(max(0.5 * t.division_px + 1.5, min(0.9 * half, MISREAD_PX)))
    most = f(2.5 * (2 * t.reach_px + 1) / t.scale + t.division_px)
    rising = f(rising_px)
    turn = flip != (t.direction < 0)
    after_dark, after_bright = rising + stripe * f(turn), rising + stripe * f(not turn)
    division, forward = f(t.division_px), f(t.direction * t.division_px)
    period, per_period, per_stripe = f(4 * half), f(0.25 / half), f(0.5 / half)
    size, half_px, one, none = f(t.size_px), f(0.5), f(1), f(0)
    for i in range(n):
        a, b = tile[CODE_A + i], tile[CODE_B + i]
        ahead = (b - a) * forward
        middle = half_px * (a + b + one) * division
        first = after_dark if tile[B + i] < none else after_bright
        k = first + period * np.floor((middle - first) * per_period + half_px)
        near = abs(k - middle) <= near_px
        k = k if near else rising + stripe * np.floor((middle - rising) * per_stripe + half_px)
        inside = (k > none) & (k < size)
        tile[K + i] = k if inside else none
        tile[AGREED + i] = near & inside & (ahead >= -division) & (ahead <= most)


@kernel(forceinline=True)
def pair_variance(
    total: float, gain: float, profile_gain: float, plateau: float, read: float, shot: float
) -> Any:
    """Variance of a pair's filtered signal times total^2, DN^2; total = P + N at the edge.

    var((P - N)/(P + N)) = [2 a (1 + q^2) + b S (1 - q^2)] / S^2 for pixel noise a + b * level.
    """
    q2 = profile_gain * plateau * plateau
    return (read + read) * (gain + q2) + shot * total * (gain - q2)


@kernel(forceinline=True)
def single_variance(
    threshold: float, swing: float, bright: float, dark: float, level: float,
    read: float, shot: float,
) -> Any:  # fmt: skip
    """Variance of a single image's samples about ``level``, and of their threshold, DN^2.

    The threshold is the middle between the means, ``swing`` off it, of so many bright and dark
    samples.
    """
    high = read + shot * (threshold + swing)
    low = read + shot * (threshold - swing)
    quarter = np.float32(0.25)
    return read + shot * level + quarter * (high * dark + low * bright) / (bright * dark)


@kernel(forceinline=True)
def look_up_gain(tile: Any, n: int, gain: Any) -> None:
    """Noise gain of the estimator at the sub-pixel phase of each crossing."""
    phases, half, none = np.float32(PHASES), np.float32(0.5), np.float32(0)
    for i in range(n):
        phase = np.floor(tile[FRACTION + i] * phases + half)
        phase = phase if phase > none else none
        tile[PHASE + i] = phase if phase < phases else phases
    for i in range(n):
        row = np.uint64(tile[PHASE + i])
        tile[GAIN + i], tile[PROFILE + i] = gain[row, 0], gain[row, 1]


@kernel()
def weigh_pairs(tile: Any, n: int, full_slope: float, t: Tuning) -> None:
    """Write sigma of each crossing of a pair, and how wide it is against what is expected."""
    one, twice = np.float32(1), np.float32(2 * full_slope)
    read, shot, floor = np.float32(t.noise_dn2), np.float32(t.noise_dn), np.float32(t.floor_dn)
    for i in range(n):
        light = tile[UNDER + i]
        whole = tile[LEVEL + i] + floor
        plateau = light / whole
        variance = pair_variance(whole, tile[GAIN + i], tile[PROFILE + i], plateau, read, shot)
        per_steep = one / (tile[SLOPE + i] * whole)
        tile[SIGMA + i] = np.sqrt(variance) * per_steep
        tile[WIDTH + i] = twice * light * per_steep


@kernel()
def weigh_singles(tile: Any, n: int, full_slope: float, centre: bool, t: Tuning) -> None:
    """Write sigma and width of each crossing of a single image, or of BR8 on it.

    An edge's samples lie about the threshold, those of a centre are all bright or all dark.
    """
    off, half = np.float32(0.5 if centre else 0.0), np.float32(0.5)
    read, shot = np.float32(t.noise_dn2), np.float32(t.noise_dn)
    expected, one, none = np.float32(full_slope), np.float32(1), np.float32(0)
    for i in range(n):
        light, threshold = tile[UNDER + i], tile[LEVEL + i]
        level = threshold + light * (off if tile[B + i] < none else -off)
        bright, dark = tile[BRIGHT + i], tile[DARK + i]
        bright, dark = bright if bright > one else one, dark if dark > one else one
        variance = single_variance(threshold, half * light, bright, dark, level, read, shot)
        per_slope = one / tile[SLOPE + i]
        tile[SIGMA + i] = np.sqrt(variance * tile[GAIN + i]) * per_slope / light
        tile[WIDTH + i] = expected * per_slope


@kernel(forceinline=True)
def judge(tile: Any, n: int, least: float, most: float, tally: Any) -> None:
    """Refuse crossings of another shape than the blur makes, or whose identity disagrees."""
    low, high = np.float32(least), np.float32(most)
    first, last = np.float32(-0.5), np.float32(1.5)
    none, shape, identity = np.float32(0), np.float32(SHAPE), np.float32(IDENTITY)
    accepted = confused = 0
    for i in range(n):
        width, fraction, why = tile[WIDTH + i], tile[FRACTION + i], tile[WHY + i]
        shaped = (width >= low) & (width <= high) & (fraction >= first) & (fraction <= last)
        why = why if (why != none) | shaped else shape
        doubt = (why == none) & (tile[AGREED + i] == none)
        why = identity if doubt else why
        tile[WHY + i] = why
        confused += doubt
        accepted += why == none
    tally[0] += accepted
    tally[1] += confused
