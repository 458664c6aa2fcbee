"""Sub-pixel edges and centres along one camera row, and which boundary each is.

The signal of a pair is (P - N)/(P + N), of a single image (I - T)/(B - D): both cross zero at
the edge whatever the albedo. "matched" takes the zero crossing of the signal after a matched
filter, which is the maximum-likelihood position of a blurred step in white noise; "cubic" fits
a third-order curve to the samples around the crossing and finds its zero by secants (section
4.1 of the paper).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_common.kernel_cache import kernel
from sl_reconstruct.cloud.refusals import Reason
from sl_reconstruct.decode.bit_words import WORD, bits_from, lowest_bit, padded
from sl_reconstruct.decode.gray_code import PixelRow, count_shift
from sl_reconstruct.decode.types import Bytes, Floats, Noise, Pixels

#: Sub-pixel phases at which the noise gain of the estimator is tabulated.
PHASES = 16
#: Where a pattern's edges are far apart, the code beside an edge may be off by this many DMD px.
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

    Parameters
    ----------
    taps : ndarray, (sources, 1 + radius)
        Half of the symmetric smoothing kernel.
    gain : ndarray, (sources + 1, PHASES + 1, 2)
        Sum of squared weights, alone and times the squared profile of a blurred step. The last
        row is that of BR8.
    slope : ndarray, (sources + 1,)
        Expected slope of a unit step; the last is that of BR8.
    """

    taps: Floats
    gain: Floats
    slope: Floats


class Tuning(NamedTuple):
    """What the settings and a look at the stack say, in pixels, DMD pixels and DN.

    Parameters
    ----------
    direction : int
        +1 where k grows with u, -1 where it falls.
    reach_px : int
        Beyond it an edge's blur does not matter.
    around_px : int
        Half the width of a fine stripe.
    scale : float
        Camera pixels per DMD pixel.
    division_px, size_px : int
        Width of the code's divisions and of the DMD, DMD pixels.
    floor_dn : float
        Keeps quotients finite.
    lit_dn, contrast_dn : float
        Least light of a pixel that counts as lit, and of an edge.
    saturation : int
        Pixels are saturated from here on, DN.
    least_width, most_width : float
        Of an edge, over what is expected.
    min_light : float
        Least light under an edge over that on its brighter side.
    noise : Noise
        Of a pixel.
    jump_px : float
        A centre may lie this far from where the edges on a side lead.
    blur_px : float
        Standard deviation of an edge's blur.
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
    noise: Noise
    jump_px: float
    blur_px: float


class SourceRow(NamedTuple):
    """Scratch for one source in one row.

    Parameters
    ----------
    signal, filtered : ndarray, (width,)
        Signal of the source, raw and filtered.
    at : ndarray, (width,)
        Pixels left of the crossings.
    tile : ndarray, (LINES * TILE,)
        Numbers of up to TILE crossings, line by line.
    """

    signal: Floats
    filtered: Floats
    at: NDArray[np.uint32]
    tile: Floats


#: For kernels that look at pixels only.
NO_FILTER = Filter(
    np.zeros((0, 1), np.float32), np.zeros((0, PHASES + 1, 2), np.float32), np.zeros(0, np.float32)
)


def source_row(width: int) -> SourceRow:
    """Return scratch for rows of ``width`` pixels."""
    signal, filtered = np.zeros(width, np.float32), padded(width, np.float32)
    return SourceRow(
        signal, filtered, np.zeros(width, np.uint32), np.zeros(LINES * TILE, np.float32)
    )


@kernel(forceinline=True)
def find_crossings(
    lit: Bytes, filtered: Floats, at: NDArray[np.uint32], first: int, last: int
) -> int:
    """List where the signal changes sign between a pixel and the next, and either is lit.

    Parameters
    ----------
    lit, filtered : ndarray, (width,)
        Which pixels are lit, and the signal; both `padded`.
    at : ndarray, (width,)
        The left pixels of the crossings are written to its beginning.
    first, last : int
        Only pixels ``first <= x < last`` are listed.

    Returns
    -------
    int
        Number of crossings.
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
    """Put what lies about some crossings into the tile.

    Parameters
    ----------
    p : PixelRow
        Light, code and saturation of the row.
    r : SourceRow
        Has the crossings and the tile.
    first, n : int
        The crossings ``first:first + n``.
    t : Tuning
        Says how far from an edge its light is taken.
    """
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
def gather_pair(pattern: Pixels, inverse: Pixels, r: SourceRow, first: int, n: int) -> None:
    """Put P + N at the crossings of a pair into the tile; parameters as in `gather`.

    Parameters
    ----------
    pattern, inverse : ndarray, (W,)
        Row of the pattern and of its inverse, DN.
    r : SourceRow
        Crossings of the row; its tile is filled.
    first, n : int
        First crossing of the tile, and their number.
    """
    at, tile = r.at[first : first + n], r.tile
    for i in range(n):
        x = np.uint64(at[i])
        tile[LEVEL + i] = np.float32(pattern[x]) + np.float32(inverse[x])


@kernel(forceinline=True)
def gather_single(p: PixelRow, r: SourceRow, first: int, n: int) -> None:
    """Put a single image's threshold and its numbers of samples into the tile, as `gather`.

    Parameters
    ----------
    p : PixelRow
        Threshold and samples of each pixel.
    r : SourceRow
        Crossings of the row; its tile is filled.
    first, n : int
        First crossing of the tile, and their number.
    """
    at, tile = r.at[first : first + n], r.tile
    threshold, bright, dark = p.threshold, p.bright, p.dark
    shift = count_shift(bright.itemsize)
    for i in range(n):
        x = np.uint64(at[i])
        tile[LEVEL + i] = threshold[x]
        tile[BRIGHT + i], tile[DARK + i] = bright[x] >> shift, dark[x] >> shift


@kernel()
def find_zeros(tile: Floats, n: int) -> None:
    """Zero of the cubic through four samples about each of n crossings, and the slope there.

    A secant between the two middle samples, and one Newton step: the filtered signal is nearly
    straight, and 1e-5 px are left. Where the cubic has no zero there, the fraction leaves [0, 1].

    Parameters
    ----------
    tile : ndarray
        Filled by `gather`; the zeros are written into it.
    n : int
        Number of crossings.
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
def refuse_dim_edges(tile: Floats, n: int, t: Tuning) -> None:
    """Write for each of n crossings why the light under it does not do, or 0.

    Parameters
    ----------
    tile : ndarray
        Filled by `gather`; the reasons are written into it.
    n : int
        Number of crossings.
    t : Tuning
        Least light and saturation.
    """
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
def identify(tile: Floats, n: int, rising_px: int, half: int, flip: bool, t: Tuning) -> None:
    """Name the boundary k of each crossing, and whether the evidence agrees.

    The edge's pattern and polarity say k modulo 4 D; the Gray code on either side says where.
    Where they disagree, the pattern's edge next to the code's place is named. k is 0 where there
    is none on the DMD.

    Parameters
    ----------
    tile : ndarray
        Has the crossings; their K and AGREED are written.
    n : int
        Number of crossings.
    rising_px, half : int
        A boundary where the pattern turns bright, and D, DMD pixels.
    flip : bool
        Exchange the polarities.
    t : Tuning
        Direction, scale and size of code and DMD.
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
def look_up_gain(tile: Floats, n: int, gain: Floats) -> None:
    """Noise gain, (PHASES + 1, 2), of the estimator at the sub-pixel phase of n crossings.

    Parameters
    ----------
    tile : ndarray
        Has the zeros; the gains are written into it.
    n : int
        Number of crossings.
    gain : ndarray, (PHASES + 1, 2)
        From `edge_filters.noise_gain`.
    """
    phases, half, none = np.float32(PHASES), np.float32(0.5), np.float32(0)
    for i in range(n):
        phase = np.floor(tile[FRACTION + i] * phases + half)
        phase = phase if phase > none else none
        tile[PHASE + i] = phase if phase < phases else phases
    for i in range(n):
        row = np.uint64(tile[PHASE + i])
        tile[GAIN + i], tile[PROFILE + i] = gain[row, 0], gain[row, 1]


@kernel()
def weigh_pairs(tile: Floats, n: int, full_slope: float, t: Tuning) -> None:
    """Write sigma of each crossing of a pair, and how wide it is against what is expected.

    For pixel noise a + b * level and S = P + N at the edge, where q is the plateau over S,
    var((P - N)/(P + N)) = [2 a (1 + q^2) + b S (1 - q^2)] / S^2.

    Parameters
    ----------
    tile : ndarray
        Has the crossings; their SIGMA and WIDTH are written.
    n : int
        Number of crossings.
    full_slope : float
        Expected slope of a unit step, per pixel.
    t : Tuning
        Has the pixel noise.
    """
    one, twice = np.float32(1), np.float32(2 * full_slope)
    read, shot = np.float32(t.noise.read_dn2), np.float32(t.noise.shot_dn)
    floor = np.float32(t.floor_dn)
    for i in range(n):
        light = tile[UNDER + i]
        whole = tile[LEVEL + i] + floor
        plateau = light / whole
        gain, q2 = tile[GAIN + i], tile[PROFILE + i] * plateau * plateau
        variance = (read + read) * (gain + q2) + shot * whole * (gain - q2)
        per_steep = one / (tile[SLOPE + i] * whole)
        tile[SIGMA + i] = np.sqrt(variance) * per_steep
        tile[WIDTH + i] = twice * light * per_steep


@kernel()
def weigh_singles(tile: Floats, n: int, full_slope: float, centre: bool, t: Tuning) -> None:
    """Write sigma and width of each crossing of a single image, or of BR8 on it.

    The threshold is the middle between the means of the pixel's bright and dark samples, so it
    adds a quarter of the variance of each mean. An edge's samples lie about the threshold, those
    of a centre are all bright or all dark.

    Parameters
    ----------
    tile, n, full_slope, t
        As in `weigh_pairs`.
    centre : bool
        Whether the crossings are those of BR8.
    """
    off, half = np.float32(0.5 if centre else 0.0), np.float32(0.5)
    quarter, one, none = np.float32(0.25), np.float32(1), np.float32(0)
    read, shot = np.float32(t.noise.read_dn2), np.float32(t.noise.shot_dn)
    expected = np.float32(full_slope)
    for i in range(n):
        light, threshold = tile[UNDER + i], tile[LEVEL + i]
        level = threshold + light * (off if tile[B + i] < none else -off)
        bright, dark = tile[BRIGHT + i], tile[DARK + i]
        bright, dark = bright if bright > one else one, dark if dark > one else one
        swing = half * light
        high, low = read + shot * (threshold + swing), read + shot * (threshold - swing)
        means = quarter * (high * dark + low * bright) / (bright * dark)
        variance = read + shot * level + means
        per_slope = one / tile[SLOPE + i]
        tile[SIGMA + i] = np.sqrt(variance * tile[GAIN + i]) * per_slope / light
        tile[WIDTH + i] = expected * per_slope


@kernel(forceinline=True)
def judge(tile: Floats, n: int, least: float, most: float, tally: NDArray[np.int32]) -> None:
    """Refuse crossings of another shape than the blur makes, or whose identity disagrees.

    Parameters
    ----------
    tile : ndarray
        Has the crossings; their WHY is written.
    n : int
        Number of crossings.
    least, most : float
        Bounds of an edge's width over the expected one.
    tally : ndarray, (2,)
        The accepted ones, and those of another identity, are added.
    """
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
