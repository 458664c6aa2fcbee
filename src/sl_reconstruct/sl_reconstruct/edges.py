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

from sl_reconstruct.pixels import PixelRow
from sl_reconstruct.reasons import Reason

#: Sub-pixel phases at which the noise gain of the estimator is tabulated.
PHASES = 16
#: Where a pattern's edges are far apart, the code beside an edge may be off by so many DMD px.
MISREAD_PX = 6.0
#: A narrow shadow under an edge leaves less than this part of the light beside it.
DIP = 0.6
#: Secant steps; the third is below 1e-6 px, as the filtered signal is nearly straight.
SECANTS = 3
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

    ``taps``: (sources, 1 + radius) half of the symmetric smoothing kernel. ``fit``: (4, points)
    cubic coefficients of the samples from ``-offset`` on. ``gain``: (sources, PHASES + 1, 2) the
    sum of squared weights, alone and times the squared profile of a blurred step. ``slope``:
    (sources,) expected slope of a unit step.
    """

    taps: NDArray[np.float32]
    fit: NDArray[np.float32]
    offset: int
    gain: NDArray[np.float32]
    slope: NDArray[np.float32]


class Tuning(NamedTuple):
    """What survey and settings say, in pixels, DMD pixels and DN.

    ``direction``: +1 where k grows with u, -1 where it falls. ``reach_px``: beyond it an edge's
    blur does not matter. ``around_px``: a fine stripe's half width. ``scale``: camera pixels per DMD pixel. ``floor_dn``: keeps quotients
    finite. ``noise_dn2``, ``noise_dn``: variance = noise_dn2 + noise_dn * level.
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
    min_slope: float
    max_slope: float
    min_light: float
    noise_dn2: float
    noise_dn: float
    jump_px: float


class SourceRow(NamedTuple):
    """Scratch for one source in one row: signal, filtered signal, crossings.

    ``marks`` has a byte for each pixel, and is seen as ``words``; ``at`` lists the crossings.
    """

    signal: NDArray[np.float32]
    filtered: NDArray[np.float32]
    words: NDArray[np.uint64]
    marks: NDArray[np.uint8]
    at: NDArray[np.int32]


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
    return SourceRow(
        np.zeros(width, np.float32), np.zeros(width, np.float32),
        words, words.view(np.uint8), np.zeros(width + 8, np.int32),
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
    centre = taps[0]
    for x in range(n):
        out[x] = signal[x]
    if radius == 0:
        return
    inner = out[radius : n - radius]
    mid = signal[radius : n - radius]
    for x in range(inner.size):
        inner[x] = centre * mid[x]
    for j in range(1, radius + 1):
        left, right = signal[radius - j : n - radius - j], signal[radius + j : n - radius + j]
        w = taps[j]
        for x in range(inner.size):
            inner[x] += w * (left[x] + right[x])


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


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def cubic_zero(filtered: Any, x: int, fit: Any, offset: int) -> tuple[float, float]:
    """Zero of the fitted cubic between samples x and x + 1, and the slope there.

    Secants from the two samples' fitted values; where they do not lead to a zero next to the
    interval the position is outside [-0.5, 1.5].
    """
    c0 = c1 = c2 = c3 = np.float32(0)
    for j in range(fit.shape[1]):
        v = filtered[x - offset + j]
        c0 += fit[0, j] * v
        c1 += fit[1, j] * v
        c2 += fit[2, j] * v
        c3 += fit[3, j] * v
    one = np.float32(1)
    fb = c0 + c1 + c2 + c3
    a, fa, b = np.float32(0), c0, one
    for _ in range(SECANTS):
        step = fb - fa
        t = b - fb * (b - a) / (step if step != 0 else one)
        a, fa, b = b, fb, t
        fb = c0 + t * (c1 + t * (c2 + t * c3))
    return b, c1 + b * (c2 + c2 + np.float32(3) * c3 * b)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def light_fails(light: Any, clipped: Any, x: int, t: Tuning) -> int:
    """Reason why the light under the edge between x and x + 1 does not do, or 0."""
    first, last = x - t.reach_px, x + 1 + t.reach_px
    if first < 0 or last >= light.size:
        return SHADOW  # the image ends
    left, right = light[first], light[last]
    least = min(light[x], light[x + 1])
    sides, most = min(left, right), max(left, right)
    if max(most, least) < t.contrast_dn:
        return CONTRAST
    if clipped[first] | clipped[x] | clipped[x + 1] | clipped[last]:
        return SATURATION
    if min(least, sides) < t.min_light * most or least < DIP * sides:
        return SHADOW
    return CONTRAST if min(least, sides) < t.contrast_dn else 0


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def nearest(middle: float, residue: int, period: int) -> int:
    """Integer next to ``middle`` that is ``residue`` modulo ``period``."""
    return residue + period * int(np.floor((middle - residue) * (1.0 / period) + 0.5))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def boundary_of(
    code: Any, x: int, rising: bool, rising_px: int, half: int, t: Tuning
) -> tuple[int, bool]:
    """Boundary k of the edge between x and x + 1, and whether the evidence agrees.

    The edge's pattern and polarity say k modulo 4 D; the Gray code on either side says where.
    Where they disagree, the pattern's edge next to the code's place is returned. k is 0 where
    there is none on the DMD.
    """
    a = (code[max(0, x - t.reach_px)] + 0.5) * t.division_px
    b = (code[min(code.size - 1, x + 1 + t.reach_px)] + 0.5) * t.division_px
    ahead = (b - a) * t.direction
    middle = 0.5 * (a + b)
    turned = 0 if rising == (t.direction > 0) else 2 * half
    k = nearest(middle, rising_px + turned, 4 * half)
    span = (2 * t.reach_px + 1) / t.scale
    near = abs(k - middle) <= max(0.5 * t.division_px + 1.5, min(0.9 * half, MISREAD_PX))
    agreed = near and -t.division_px <= ahead <= 2.5 * span + t.division_px
    if not near:
        k = nearest(middle, rising_px, 2 * half)
    return (k, agreed) if 0 < k < t.size_px else (0, False)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def pair_variance(total: float, gain: Any, i: int, plateau: float, t: Tuning) -> float:
    """Variance of a pair's filtered signal times total^2, DN^2; total = P + N at the edge.

    var((P - N)/(P + N)) = [2 a (1 + q^2) + b S (1 - q^2)] / S^2 for pixel noise a + b * level.
    """
    q2 = gain[i, 1] * plateau * plateau
    return 2 * t.noise_dn2 * (gain[i, 0] + q2) + t.noise_dn * total * (gain[i, 0] - q2)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def single_variance(
    threshold_dn: float, light_dn: float, bright: int, dark: int, level_dn: float, t: Tuning
) -> float:
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
