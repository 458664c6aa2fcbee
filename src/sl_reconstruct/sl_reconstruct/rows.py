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
    find_crossings,
    light_fails,
    pair_signal,
    pair_variance,
    phase_of,
    single_signal,
    single_variance,
    smooth,
    source_row,
)
from sl_reconstruct.pixels import (
    PixelRow,
    pixel_row,
    sample_count,
    set_code,
    set_levels,
    set_masks,
    set_middle,
    set_threshold,
)
from sl_reconstruct.reasons import Reason

ORDER = int(Reason.ORDER)
STEP = int(Reason.STEP)
MISSING = int(Reason.MISSING)


class Layout(NamedTuple):
    """The plan of one axis as arrays.

    ``sources``: (n, 6) image, inverse, half period, rising, edges, centres. ``edge_owner``,
    ``centre_owner``: which source gives each boundary, -1 for none. ``bits``: (m, 3) image,
    inverse, flipped. ``images``: all images of the axis. ``dynamic``: some source
    is a single image; ``centres``: some source gives centres.
    """

    sources: NDArray[np.int64]
    edge_owner: NDArray[np.int64]
    centre_owner: NDArray[np.int64]
    bits: NDArray[np.int64]
    images: NDArray[np.int64]
    white: int
    black: int
    dynamic: bool
    centres: bool


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
    if plan.dynamic:
        set_middle(t.around_px, p)
    set_code(stack, y, plan.bits, p)
    if plan.dynamic:
        set_threshold(stack, y, plan.images, t.reach_px, p)
    set_masks(p, t.lit_dn, t.saturation)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _write(
    u_px: Any, sigma_px: Any, width_px: Any, reason: Any, k: int, u: float, sigma: float,
    width: float,
) -> None:  # fmt: skip
    """Write a found boundary; one that was there already is in doubt, and refused."""
    if reason[k] == PRESENT or reason[k] == ORDER:
        reason[k] = ORDER
        u_px[k] = np.nan
        return
    reason[k] = PRESENT
    u_px[k] = u
    sigma_px[k] = sigma
    width_px[k] = width


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _refuse(reason: Any, k: int, why: int) -> None:
    if k > 0 and reason[k] != PRESENT and reason[k] != ORDER:
        reason[k] = why


@njit(cache=True, nogil=True, error_model="numpy")
def _edges(
    s: int, pattern: Any, inverse: Any, plan: Layout, f: Filter, t: Tuning, p: PixelRow,
    r: SourceRow, out: Found, tally: Any, average: bool,
) -> None:  # fmt: skip
    """Find and identify the edges of one source; with ``average``, centres between them."""
    # fields are taken out of their tuples here: in the loop that would count references
    half, rising_px, paired = plan.sources[s, 2], plan.sources[s, 3], plan.sources[s, 1] >= 0
    edge_owner, centre_owner = plan.edge_owner, plan.centre_owner
    gain, full_slope, fit, offset = f.gain[s], f.slope[s], f.fit, f.offset
    code, light, clipped, threshold = p.code, p.light, p.clipped, p.threshold
    bright, dark, filtered, at = p.bright, p.dark, r.filtered, r.at
    u_px, sigma_px, width_px, reasons = out.u_px, out.sigma_px, out.width_px, out.reason
    last_k, last_u, last_sigma = 0, 0.0, 0.0
    accepted = confused = 0
    count = find_crossings(p.lit, r, offset, filtered.size - fit.shape[1] + offset + 1)
    for i in range(count):
        x = np.int64(at[i])
        k, agreed = boundary_of(code, x, filtered[x] < 0, rising_px, half, t)
        reason = light_fails(light, clipped, x, t)
        fraction, slope = cubic_zero(filtered, x, fit, offset)
        phase = phase_of(fraction)
        if paired:
            whole = np.float64(pattern[x]) + np.float64(inverse[x]) + t.floor_dn
            variance = pair_variance(whole, gain, phase, light[x] / whole, t)
            full = 2 * light[x] * full_slope
        else:
            whole = np.float64(light[x])
            middle, b, d = threshold[x], sample_count(bright, x), sample_count(dark, x)
            variance = gain[phase, 0] * single_variance(middle, whole, b, d, middle, t)
            full = whole * full_slope
        steep = abs(slope) * whole
        good = t.min_slope * full <= steep <= t.max_slope * full and -0.5 <= fraction <= 1.5
        if reason == 0 and not good:
            reason = SHAPE
        if reason == 0 and not agreed:
            reason = IDENTITY
            confused += 1
        if reason != 0:
            if k > 0 and edge_owner[k] == s:
                _refuse(reasons, k, reason)
            last_k = 0
            continue
        accepted += 1
        u, sigma, width = x + fraction, np.sqrt(variance) / steep, full / steep
        if edge_owner[k] == s:
            _write(u_px, sigma_px, width_px, reasons, k, u, sigma, width)
        if average and abs(k - last_k) == 2 * half and last_k > 0:
            centre = (k + last_k) // 2
            if centre_owner[centre] == s:
                spread = 0.5 * np.sqrt(sigma * sigma + last_sigma * last_sigma)
                _write(
                    u_px, sigma_px, width_px, reasons, centre, 0.5 * (u + last_u), spread, width
                )
        last_k, last_u, last_sigma = k, u, sigma
    tally[0] = accepted
    tally[1] = confused


@njit(cache=True, nogil=True, error_model="numpy")
def _bars(
    s: int, plan: Layout, f: Filter, t: Tuning, p: PixelRow, r: SourceRow, out: Found,
    expected: float,
) -> None:  # fmt: skip
    """Find and identify the centres of one source by BR8's zero crossings, Eq. (6)."""
    half, rising_px, centre_owner = plan.sources[s, 2], plan.sources[s, 3], plan.centre_owner
    gain, fit, offset = f.gain[f.gain.shape[0] - 1], f.fit, f.offset
    code, light, clipped, threshold = p.code, p.light, p.clipped, p.threshold
    bright, dark, filtered, at = p.bright, p.dark, r.filtered, r.at
    u_px, sigma_px, width_px, reasons = out.u_px, out.sigma_px, out.width_px, out.reason
    last = filtered.size - fit.shape[1] + offset - 4
    for i in range(find_crossings(p.lit, r, offset + 4, last)):
        x = np.int64(at[i])
        lit = filtered[x] < 0  # left of a bright centre the left samples are darker
        k, agreed = boundary_of(code, x, lit == (t.direction > 0), rising_px + half, half, t)
        if k == 0 or centre_owner[k] != s:
            continue
        fraction, slope = cubic_zero(filtered, x, fit, offset)
        ratio = abs(slope) / expected
        reason = light_fails(light, clipped, x, t)
        if reason == 0 and not t.min_slope <= ratio <= 2 * t.max_slope:
            reason = SHAPE
        if reason == 0 and not agreed:
            reason = IDENTITY
        if reason != 0:
            _refuse(reasons, k, reason)
            continue
        level = threshold[x] + (0.5 if lit else -0.5) * light[x]
        b, d = sample_count(bright, x), sample_count(dark, x)
        variance = single_variance(threshold[x], light[x], b, d, level, t)
        sigma = np.sqrt(gain[phase_of(fraction), 0] * variance) / (light[x] * abs(slope))
        _write(u_px, sigma_px, width_px, reasons, k, x + fraction, sigma, 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _source(
    stack: Any, y: int, s: int, plan: Layout, f: Filter, t: Tuning, p: PixelRow, r: SourceRow,
    out: Found, tally: Any, bar_slope: float,
) -> None:  # fmt: skip
    """Everything that one source gives in one row."""
    pattern = stack[plan.sources[s, 0], y]
    inverse = stack[max(0, plan.sources[s, 1]), y]
    if plan.sources[s, 1] >= 0:
        pair_signal(pattern, inverse, t.floor_dn, r.signal)
    else:
        single_signal(pattern, p, t.floor_dn, r.signal)
    smooth(r.signal, f.taps[s], r.filtered)
    centres = plan.sources[s, 5] != 0
    _edges(s, pattern, inverse, plan, f, t, p, r, out, tally, centres and bar_slope <= 0)
    if centres and bar_slope > 0:
        bar_centres(r.signal, r.filtered)
        _bars(s, plan, f, t, p, r, out, bar_slope)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _lead(
    u_px: Any, reason: Any, owner: Any, start: int, step: int, count: int
) -> tuple[int, float, float]:
    """Nearest edge from ``start`` on, its column, and the pace from it to the farthest one.

    Looks at ``count`` boundaries; the pace is NaN where there are fewer than two edges.
    """
    near, pace = -1, np.nan
    at = 0.0
    for i in range(count):
        k = start + step * i
        if 0 <= k < owner.size and owner[k] >= 0 and reason[k] == PRESENT:
            if near < 0:
                near, at = k, np.float64(u_px[k])
            else:
                pace = (u_px[k] - at) / (k - near)
    return near, at, pace


@njit(cache=True, nogil=True, error_model="numpy")
def _check_centres(plan: Layout, t: Tuning, out: Found) -> None:
    """Refuse centres to which the edges on both sides do not lead.

    A centre is taken from edges D away, so a depth step or a kink between them goes unseen.
    """
    edge_owner, centre_owner, u_px, reason = (
        plan.edge_owner, plan.centre_owner, out.u_px, out.reason,
    )  # fmt: skip
    k, n = 0, reason.size
    while k < n:
        if centre_owner[k] < 0:
            k += 1
            continue
        first, half = k, plan.sources[centre_owner[k], 2]
        while k < n and centre_owner[k] >= 0:
            k += 1
        a, u_a, pace_a = _lead(u_px, reason, edge_owner, first - 1, -1, half)
        b, u_b, pace_b = _lead(u_px, reason, edge_owner, k, 1, half)
        for i in range(first, k):
            left = abs(u_px[i] - u_a - pace_a * (i - a))
            right = abs(u_px[i] - u_b - pace_b * (i - b))
            if reason[i] == PRESENT and not (left <= t.jump_px and right <= t.jump_px):
                reason[i] = STEP
                u_px[i] = np.nan


@njit(cache=True, nogil=True, error_model="numpy")
def _levels(p: PixelRow, dynamic: bool, out: Found) -> None:
    """Bright level at every found boundary, DN."""
    u_px, level_dn, threshold, light, high = out.u_px, out.level_dn, p.threshold, p.light, p.high
    for k in range(u_px.size):
        if u_px[k] == u_px[k]:
            x = int(u_px[k] + np.float32(0.5))
            level_dn[k] = threshold[x] + np.float32(0.5) * light[x] if dynamic else high[x]


@njit(cache=True, nogil=True, error_model="numpy")
def _see(p: PixelRow, seen: Any, blind: Any) -> None:
    """Count the lit pixels of each division, and mark divisions lost in saturation."""
    seen[:] = 0
    blind[:] = 0
    last, gap = -1, 0
    code, lit, clipped = p.code, p.lit, p.clipped
    for x in range(code.size):
        if not lit[x]:
            gap += clipped[x]
            continue
        q = np.int64(code[x])
        if q >= seen.size:
            continue
        seen[q] += 1
        if gap and last >= 0:
            for i in range(min(last, q) + 1, max(last, q)):
                blind[i] = 1
        last, gap = q, 0


@njit(cache=True, nogil=True, error_model="numpy")
def _account(plan: Layout, seen: Any, blind: Any, division_px: int, reason: Any) -> None:
    """Name the boundaries that should be there, but were not found."""
    edge_owner, centre_owner = plan.edge_owner, plan.centre_owner
    for k in range(reason.size):
        if reason[k] != UNLIT or (edge_owner[k] < 0 and centre_owner[k] < 0):
            continue
        if seen[k // division_px] > 1:
            reason[k] = MISSING
        elif blind[k // division_px]:
            reason[k] = SATURATION


@njit(cache=True, nogil=True, error_model="numpy")
def _row(
    stack: Any, y: int, i: int, plan: Layout, f: Filter, t: Tuning, bar_slope: float,
    scratch: RowScratch, lines: Lines,
) -> None:  # fmt: skip
    p, r, seen, blind = scratch.pixels, scratch.source, scratch.seen, scratch.blind
    found = Found(
        lines.u_px[i], lines.sigma_px[i], lines.width_px[i], lines.level_dn[i], lines.reason[i]
    )
    found.u_px[:] = np.nan
    found.reason[:] = UNLIT
    decode_pixels(stack, y, plan, t, p)
    for s in range(plan.sources.shape[0]):
        _source(stack, y, s, plan, f, t, p, r, found, lines.tally[i, s], bar_slope)
    if plan.centres:
        _check_centres(plan, t, found)
    _levels(p, plan.dynamic, found)
    _see(p, seen, blind)
    _account(plan, seen, blind, t.division_px, found.reason)


class RowScratch(NamedTuple):
    """Scratch of one thread: pixels, one source, and the divisions seen or lost in a row."""

    pixels: PixelRow
    source: SourceRow
    seen: NDArray[np.int32]
    blind: NDArray[np.uint8]


def row_scratch(width: int, dtype: Any, divisions: int) -> RowScratch:
    """Return scratch for rows of ``width`` pixels and a code of so many divisions."""
    return RowScratch(
        pixel_row(width, dtype), source_row(width),
        np.zeros(divisions, np.int32), np.zeros(divisions, np.uint8),
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def decode_rows(
    ys: Any, first: int, last: int, stack: Any, plan: Layout, f: Filter, t: Tuning,
    bar_slope: float, lines: Lines, scratch: RowScratch,
) -> None:  # fmt: skip
    """Decode the stack's rows ``ys[first:last]`` into the lines of the same numbers."""
    for i in range(first, last):
        _row(stack, ys[i], i, plan, f, t, bar_slope, scratch, lines)
