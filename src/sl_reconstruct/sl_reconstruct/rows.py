"""Decode whole rows: pixels, then every source's edges and centres, into one line per row."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sl_reconstruct.edges import (
    CONTRAST,
    IDENTITY,
    PRESENT,
    SATURATION,
    SHADOW,
    SHAPE,
    UNLIT,
    Filter,
    Found,
    SourceRow,
    Tuning,
    bar_centres,
    boundary_of,
    cubic_zero,
    light_fails,
    mark_crossings,
    noise_gain,
    pair_signal,
    pair_variance,
    single_signal,
    single_variance,
    smooth,
    source_row,
)
from sl_reconstruct.pixels import (
    PixelRow,
    pixel_row,
    set_code,
    set_levels,
    set_masks,
    set_threshold,
)
from sl_reconstruct.reasons import Reason

ORDER = int(Reason.ORDER)
MISSING = int(Reason.MISSING)


class Layout(NamedTuple):
    """The plan of one axis as arrays.

    ``sources``: (n, 6) image, inverse, half period, rising, edges, centres. ``edge_owner``,
    ``centre_owner``: which source gives each boundary, -1 for none. ``bits``: (m, 3) image,
    inverse, flipped. ``images``: all images of the axis. ``sums``: an array of the type in
    which samples are summed.
    """

    sources: NDArray[np.int64]
    edge_owner: NDArray[np.int64]
    centre_owner: NDArray[np.int64]
    bits: NDArray[np.int64]
    images: NDArray[np.int64]
    white: int
    black: int
    dynamic: bool
    sums: NDArray[Any]


class Lines(NamedTuple):
    """Results for all rows: shape (rows, boundaries), and counts (rows, sources, 2).

    ``tally`` counts the crossings that were accepted and those whose identity did not agree.
    """

    u_px: NDArray[np.float32]
    sigma_px: NDArray[np.float32]
    width_px: NDArray[np.float32]
    level_dn: NDArray[np.float32]
    reason: NDArray[np.uint8]
    tally: NDArray[np.int32]


@njit(cache=True, nogil=True, error_model="numpy")
def decode_pixels(stack: Any, y: int, plan: Layout, t: Tuning, p: PixelRow) -> None:
    """Fill everything that a row's pixels say by themselves."""
    set_levels(stack, y, plan.white, plan.black, plan.images, p)
    set_code(stack, y, plan.bits, p)
    if plan.dynamic:
        set_threshold(stack, y, plan.images, t.reach_px, p)
    set_masks(p, t.lit_dn, t.saturation)


@njit(cache=True, nogil=True, error_model="numpy")
def _write(f: Found, k: int, u: float, sigma: float, width: float, level: float) -> None:
    """Write a found boundary; one that was there already is in doubt, and refused."""
    if f.reason[k] == PRESENT or f.reason[k] == ORDER:
        f.reason[k] = ORDER
        f.u_px[k] = np.nan
        return
    f.reason[k] = PRESENT
    f.u_px[k] = u
    f.sigma_px[k] = sigma
    f.width_px[k] = width
    f.level_dn[k] = level


@njit(cache=True, nogil=True, error_model="numpy")
def _refuse(f: Found, k: int, reason: int) -> None:
    if k > 0 and f.reason[k] != PRESENT and f.reason[k] != ORDER:
        f.reason[k] = reason


@njit(cache=True, nogil=True, error_model="numpy")
def _level(p: PixelRow, x: int, dynamic: bool) -> float:
    """Bright level at a pixel, DN."""
    return p.threshold[x] + 0.5 * p.light[x] if dynamic else np.float64(p.high[x])


@njit(cache=True, nogil=True, error_model="numpy")
def _edge(
    stack: Any, y: int, x: int, s: int, plan: Layout, f: Filter, t: Tuning, p: PixelRow, r: Any
) -> tuple[float, float, float, int]:
    """Position, sigma, width of the edge between x and x + 1, and a reason or 0."""
    source = plan.sources[s]
    fraction, slope = cubic_zero(r.filtered, x, f.fit, f.offset)
    gain = noise_gain(f.gain[s], fraction)
    slope = abs(slope)
    if source[1] >= 0:
        total = t.floor_dn
        total += stack[source[0], y, x] * 1.0 + stack[source[1], y, x] * 1.0
        plateau = p.light[x] / total
        variance = pair_variance(total, gain, plateau, t)
    else:
        plateau = 0.5
        variance = single_variance(p, x, gain, p.threshold[x], t)
    ratio = slope / (2 * plateau * f.slope[s])
    bad = not t.min_slope <= ratio <= t.max_slope
    return x + fraction, np.sqrt(variance) / slope, 1 / ratio, SHAPE if bad else 0


@njit(cache=True, nogil=True, error_model="numpy")
def _edges(
    stack: Any, y: int, s: int, plan: Layout, f: Filter, t: Tuning, p: PixelRow, r: SourceRow,
    out: Found, tally: Any, average: bool,
) -> None:  # fmt: skip
    """Find and identify the edges of one source; with ``average``, centres between them."""
    half, rising_px = plan.sources[s, 2], plan.sources[s, 3]
    n = r.filtered.size
    last_k, last_u, last_sigma, last_width = 0, 0.0, 0.0, 0.0
    for word in range(r.words.size):
        if r.words[word] == 0:
            continue
        for x in range(max(8 * word, f.offset), min(8 * word + 8, n - f.fit.shape[1] + f.offset)):
            if not r.marks[x]:
                continue
            rising = r.filtered[x] < 0
            k, agreed = boundary_of(p.code, x, rising, rising_px, half, t)
            reason = light_fails(p, x, t)
            if reason == 0 and not agreed:
                reason = IDENTITY
                tally[1] += 1
            u, sigma, width = 0.0, 0.0, 0.0
            if reason == 0:
                u, sigma, width, reason = _edge(stack, y, x, s, plan, f, t, p, r)
            if reason != 0:
                if k > 0 and plan.edge_owner[k] == s:
                    _refuse(out, k, reason)
                last_k = 0
                continue
            tally[0] += 1
            if plan.edge_owner[k] == s:
                _write(out, k, u, sigma, width, _level(p, x, plan.dynamic))
            if average and abs(k - last_k) == 2 * half and last_k > 0:
                _centre_between(plan, s, k, u, sigma, width, last_k, last_u, last_sigma, p, out)
            last_k, last_u, last_sigma, last_width = k, u, sigma, width


@njit(cache=True, nogil=True, error_model="numpy")
def _centre_between(
    plan: Layout, s: int, k: int, u: float, sigma: float, width: float,
    last_k: int, last_u: float, last_sigma: float, p: PixelRow, out: Found,
) -> None:  # fmt: skip
    """The centre of a stripe lies midway between its two edges."""
    middle = (k + last_k) // 2
    if plan.centre_owner[middle] == s:
        at = 0.5 * (u + last_u)
        spread = 0.5 * np.sqrt(sigma * sigma + last_sigma * last_sigma)
        _write(out, middle, at, spread, width, _level(p, int(at + 0.5), plan.dynamic))


@njit(cache=True, nogil=True, error_model="numpy")
def _bars(
    y: int, s: int, plan: Layout, f: Filter, t: Tuning, p: PixelRow, r: SourceRow, out: Found,
    expected: float,
) -> None:  # fmt: skip
    """Find and identify the centres of one source by BR8's zero crossings, Eq. (6)."""
    half = plan.sources[s, 2]
    for x in range(f.offset + 4, r.filtered.size - f.fit.shape[1] + f.offset - 4):
        if not r.marks[x]:
            continue
        bright = r.filtered[x] < 0  # left of a bright centre the left samples are darker
        k, agreed = boundary_of(
            p.code, x, bright == (t.direction > 0), plan.sources[s, 3] + half, half, t
        )
        if k == 0 or plan.centre_owner[k] != s:
            continue
        reason = light_fails(p, x, t)
        if reason == 0 and not agreed:
            reason = IDENTITY
        fraction, slope = cubic_zero(r.filtered, x, f.fit, f.offset)
        ratio = abs(slope) / expected
        if reason == 0 and not t.min_slope <= ratio <= 2 * t.max_slope:
            reason = SHAPE
        if reason != 0:
            _refuse(out, k, reason)
            continue
        level = p.threshold[x] + (0.5 if bright else -0.5) * p.light[x]
        gain = noise_gain(f.gain[f.gain.shape[0] - 1], fraction)
        sigma = np.sqrt(single_variance(p, x, gain, level, t)) / abs(slope)
        _write(out, k, x + fraction, sigma, 1.0, _level(p, x, plan.dynamic))


@njit(cache=True, nogil=True, error_model="numpy")
def _source(
    stack: Any, y: int, s: int, plan: Layout, f: Filter, t: Tuning, p: PixelRow, r: SourceRow,
    out: Found, tally: Any, bar_slope: float,
) -> None:  # fmt: skip
    """Everything that one source gives in one row."""
    image, inverse = plan.sources[s, 0], plan.sources[s, 1]
    if inverse >= 0:
        pair_signal(stack[image, y], stack[inverse, y], t.floor_dn, r.signal)
    else:
        single_signal(stack[image, y], p, t.floor_dn, r.signal)
    smooth(r.signal, f.taps[s], r.filtered)
    mark_crossings(r.filtered, p.lit, r.marks)
    centres = plan.sources[s, 5] != 0
    _edges(stack, y, s, plan, f, t, p, r, out, tally, centres and bar_slope <= 0)
    if centres and bar_slope > 0:
        bar_centres(r.signal, r.filtered)
        mark_crossings(r.filtered, p.lit, r.marks)
        _bars(y, s, plan, f, t, p, r, out, bar_slope)


@njit(cache=True, nogil=True, error_model="numpy")
def _see(p: PixelRow, seen: Any, blind: Any) -> None:
    """Count the lit pixels of each division, and mark divisions lost in saturation."""
    for q in range(seen.size):
        seen[q] = 0
        blind[q] = 0
    last, clipped = -1, 0
    for x in range(p.code.size):
        if not p.lit[x]:
            clipped += p.clipped[x]
            continue
        q = p.code[x]
        if q >= seen.size:
            continue
        seen[q] += 1
        if clipped and last >= 0:
            for i in range(min(last, q) + 1, max(last, q)):
                blind[i] = 1
        last, clipped = q, 0


@njit(cache=True, nogil=True, error_model="numpy")
def _account(plan: Layout, seen: Any, blind: Any, division_px: int, reason: Any) -> None:
    """Name the boundaries that should be there, but were not found."""
    for k in range(reason.size):
        if plan.edge_owner[k] < 0 and plan.centre_owner[k] < 0:
            continue
        if reason[k] == UNLIT:
            if seen[k // division_px] > 1:
                reason[k] = MISSING
            elif blind[k // division_px]:
                reason[k] = SATURATION


@njit(cache=True, nogil=True, error_model="numpy")
def _row(
    stack: Any, y: int, i: int, plan: Layout, f: Filter, t: Tuning, bar_slope: float,
    p: PixelRow, r: SourceRow, seen: Any, blind: Any, lines: Lines,
) -> None:  # fmt: skip
    found = Found(
        lines.u_px[i], lines.sigma_px[i], lines.width_px[i], lines.level_dn[i], lines.reason[i]
    )
    for k in range(found.u_px.size):
        found.u_px[k] = np.nan
        found.reason[k] = UNLIT
    decode_pixels(stack, y, plan, t, p)
    for s in range(plan.sources.shape[0]):
        lines.tally[i, s, 0] = 0
        lines.tally[i, s, 1] = 0
        _source(stack, y, s, plan, f, t, p, r, found, lines.tally[i, s], bar_slope)
    _see(p, seen, blind)
    _account(plan, seen, blind, t.division_px, found.reason)


@njit(cache=True, nogil=True, error_model="numpy")
def decode_rows(
    ys: Any, first: int, last: int, stack: Any, plan: Layout, f: Filter, t: Tuning,
    bar_slope: float, lines: Lines,
) -> None:  # fmt: skip
    """Decode the stack's rows ``ys[first:last]`` into the lines of the same numbers."""
    divisions = (t.size_px + t.division_px - 1) // t.division_px
    p = pixel_row(stack.shape[2], stack[0, 0], plan.sums)
    r = source_row(stack.shape[2])
    seen, blind = np.zeros(divisions, np.int32), np.zeros(divisions, np.uint8)
    for i in range(first, last):
        _row(stack, ys[i], i, plan, f, t, bar_slope, p, r, seen, blind, lines)
