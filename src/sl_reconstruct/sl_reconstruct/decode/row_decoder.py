"""Decode whole rows: pixels, then every source's edges and centres, into one line per row."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sl_common.kernel_cache import kernel
from sl_reconstruct.cloud.refusals import Reason
from sl_reconstruct.decode.edge_signals import bar_centres, pair_signal, single_signal, smooth
from sl_reconstruct.decode.edge_uncertainty import find_centres
from sl_reconstruct.decode.edges import (
    FRACTION,
    PRESENT,
    SATURATION,
    SIGMA,
    TILE,
    UNLIT,
    WHY,
    WIDTH,
    Filter,
    K,
    SourceRow,
    Tuning,
    find_crossings,
    find_zeros,
    gather,
    gather_pair,
    gather_single,
    identify,
    judge,
    look_up_gain,
    refuse_dim_edges,
    source_row,
    weigh_pairs,
    weigh_singles,
)
from sl_reconstruct.decode.gray_code import (
    PixelRow,
    pixel_row,
    set_code,
    set_levels,
    set_masks,
    set_middle,
    set_threshold,
)
from sl_reconstruct.decode.types import (
    CENTRES,
    HALF_PERIOD,
    IMAGE,
    INVERSE,
    RISING,
    Bytes,
    Integers,
    Layout,
    Lines,
    Pixels,
    line_at,
)

#: BR8's slope depends on the stripe's width and blur more than an edge's does.
BAR_LATITUDE = 3.0
#: Up to this number, boundaries that are not found are looked for one by one.
FEW = 12

ORDER = int(Reason.ORDER)
MISSING = int(Reason.MISSING)


class Decoding(NamedTuple):
    """What the rows of a stack are decoded with.

    Parameters
    ----------
    stack : ndarray, (N, H, W)
        Images in pattern order.
    plan : Layout
        What they show.
    tuning : Tuning
        What is known of them.
    filters : Filter
        How their edges are found; not used by `decode_pixels`.
    bars : bool
        Whether centres are found by BR8.
    """

    stack: Pixels
    plan: Layout
    tuning: Tuning
    filters: Filter
    bars: bool


class RowScratch(NamedTuple):
    """Scratch of one thread: pixels, one source, and the divisions seen or lost in a row."""

    pixels: PixelRow
    source: SourceRow
    seen: Bytes
    blind: Bytes


def row_scratch(d: Decoding) -> RowScratch:
    """Return scratch for the rows of a stack."""
    width, divisions = d.stack.shape[2], -(-d.tuning.size_px // d.tuning.division_px)
    seen, blind = np.zeros((2, divisions), np.uint8)
    return RowScratch(pixel_row(width, d.stack.dtype), source_row(width), seen, blind)


@kernel()
def decode_pixels(d: Decoding, y: int, p: PixelRow) -> None:
    """Fill everything that a row's pixels say by themselves.

    Parameters
    ----------
    d : Decoding
        The stack, its plan and tuning.
    y : int
        The row.
    p : PixelRow
        Written to.
    """
    plan, t = d.plan, d.tuning
    set_levels(d.stack, y, plan, p)
    if plan.dynamic:
        set_middle(t.around_px, p)
    set_code(d.stack, y, plan, p)
    if plan.dynamic:
        set_threshold(d.stack, y, plan.images, t.reach_px, p)
    set_masks(p, t.lit_dn, t.saturation)


@kernel(forceinline=True)
def _settle(owner: Integers, s: int, r: SourceRow, first: int, n: int, out: Lines) -> None:
    """Write each crossing where it belongs; a boundary found twice is in doubt, and refused."""
    at, tile = r.at[first : first + n], r.tile
    u_px, sigma_px, width_px, reasons = out.u_px, out.sigma_px, out.width_px, out.reason
    for i in range(n):
        k, why = np.uint64(tile[K + i]), np.uint8(tile[WHY + i])
        if k == 0 or owner[k] != s:
            continue
        before = reasons[k]
        if before in (PRESENT, ORDER):
            if why == 0:
                reasons[k] = ORDER
                u_px[k] = np.nan
            continue
        reasons[k] = why
        if why == 0:
            u_px[k] = np.int64(at[i]) + tile[FRACTION + i]
            sigma_px[k] = tile[SIGMA + i]
            width_px[k] = tile[WIDTH + i]


@kernel(forceinline=True)
def _bars(d: Decoding, s: int, scratch: RowScratch, out: Lines) -> None:
    """Find and identify the centres of one source by BR8's zero crossings, Eq. (6)."""
    p, r, t, f, source = scratch.pixels, scratch.source, d.tuning, d.filters, d.plan.sources[s]
    margin = 5 + t.reach_px
    count = find_crossings(p.lit, r.filtered, r.at, margin, r.filtered.size - margin - 1)
    half, last, tile = source[HALF_PERIOD], f.slope.size - 1, r.tile
    for first in range(0, count, TILE):
        n = min(TILE, count - first)
        gather(p, r, first, n, t)
        find_zeros(tile, n)
        # left of a bright centre the left samples are the darker ones, whichever way k grows
        identify(tile, n, source[RISING] + half, half, t.direction < 0, t)
        refuse_dim_edges(tile, n, t)
        look_up_gain(tile, n, f.gain[last])
        gather_single(p, r, first, n)
        weigh_singles(tile, n, f.slope[last], True, t)
        judge(tile, n, t.least_width / BAR_LATITUDE, BAR_LATITUDE * t.most_width, out.tally[s])
        _settle(d.plan.centre_owner, s, r, first, n, out)


@kernel(forceinline=True)
def _source(d: Decoding, y: int, s: int, scratch: RowScratch, out: Lines) -> None:
    """Find and identify the edges of one source in one row, and its centres by BR8."""
    p, r, t, f, source = scratch.pixels, scratch.source, d.tuning, d.filters, d.plan.sources[s]
    pattern, inverse = d.stack[source[IMAGE], y], d.stack[max(0, source[INVERSE]), y]
    pair, tile, tally = source[INVERSE] >= 0, r.tile, out.tally[s]
    if pair:
        pair_signal(pattern, inverse, t.floor_dn, r.signal)
    else:
        single_signal(pattern, p, t.floor_dn, r.signal)
    smooth(r.signal, f.taps[s], r.filtered)
    tally[:] = 0
    margin = f.taps.shape[1] + t.reach_px  # neither filter nor threshold reach beyond the image
    count = find_crossings(p.lit, r.filtered, r.at, margin, r.filtered.size - margin - 1)
    for first in range(0, count, TILE):
        n = min(TILE, count - first)
        gather(p, r, first, n, t)
        find_zeros(tile, n)
        identify(tile, n, source[RISING], source[HALF_PERIOD], False, t)
        refuse_dim_edges(tile, n, t)
        look_up_gain(tile, n, f.gain[s])
        if pair:
            gather_pair(pattern, inverse, r, first, n)
            weigh_pairs(tile, n, f.slope[s], t)
        else:
            gather_single(p, r, first, n)
            weigh_singles(tile, n, f.slope[s], False, t)
        judge(tile, n, t.least_width, t.most_width, tally)
        _settle(d.plan.edge_owner, s, r, first, n, out)
    if d.bars and source[CENTRES]:
        bar_centres(r.signal, r.filtered)
        _bars(d, s, scratch, out)


@kernel()
def _levels(p: PixelRow, dynamic: bool, out: Lines) -> None:
    """Bright level at every found boundary, DN."""
    u_px, level_dn, threshold, light, high = out.u_px, out.level_dn, p.threshold, p.light, p.high
    for k in range(u_px.size):
        if u_px[k] == u_px[k]:
            x = np.uint64(u_px[k] + np.float32(0.5))
            level_dn[k] = threshold[x] + np.float32(0.5) * light[x] if dynamic else high[x]


@kernel()
def _lit_divisions(p: PixelRow) -> tuple[int, int]:
    """First and last division among the lit pixels; the last is less where none is lit."""
    code, lit = p.code, p.lit
    low, high, most = np.uint16(0xFFFF), np.uint16(0), np.uint16(0xFFFF)
    for x in range(code.size):
        a = code[x] if lit[x] else most
        b = code[x] if lit[x] else np.uint16(0)
        low = a if a < low else low
        high = b if b > high else high
    return int(low), int(high)


@kernel()
def _lose(p: PixelRow, divisions: int, blind: Bytes) -> None:
    """Mark divisions lost in saturation: those between lit pixels with clipped ones between."""
    last, gap = -1, 0
    code, lit, clipped = p.code, p.lit, p.clipped
    for x in range(code.size):
        if not lit[x]:
            gap += clipped[x]
            continue
        q = int(code[x])
        if q >= divisions:
            continue
        if gap and last >= 0:
            for i in range(min(last, q) + 1, max(last, q)):
                blind[i] = 1
        last, gap = q, 0


@kernel()
def _see(p: PixelRow, seen: Bytes) -> None:
    """Mark divisions by their lit pixels: 1 where there is one, 3 where there are more."""
    code, lit = p.code, p.lit
    for x in range(code.size):
        q = np.uint64(code[x])
        if lit[x] and q < seen.size:
            seen[q] = 3 if seen[q] else 1


@kernel()
def _count_lit(p: PixelRow, division: int) -> int:
    """Number of lit pixels in a division."""
    code, lit, q, n = p.code, p.lit, np.uint16(division), np.int32(0)
    for x in range(code.size):
        n += np.int32(code[x] == q) & np.int32(lit[x])
    return int(n)


@kernel()
def _account(plan: Layout, scratch: RowScratch, division_px: int, reason: Bytes) -> None:
    """Name the boundaries that should be there, but were not found."""
    edge_owner, centre_owner = plan.edge_owner, plan.centre_owner
    p, seen, blind = scratch.pixels, scratch.seen, scratch.blind
    low, high = _lit_divisions(p)
    first, last = max(1, low * division_px), min(reason.size, (high + 1) * division_px)
    unfound = 0
    for k in range(first, last):
        unfound += reason[k] == UNLIT
    if not unfound:
        return
    seen[:] = 0
    blind[:] = 0
    if unfound > FEW:
        _see(p, seen)
    else:
        for k in range(first, last):
            if reason[k] == UNLIT:
                seen[k // division_px] = min(2, _count_lit(p, k // division_px))
    if p.any_clipped[0]:
        _lose(p, seen.size, blind)
    for k in range(first, last):
        if reason[k] != UNLIT or (edge_owner[k] < 0 and centre_owner[k] < 0):
            continue
        if seen[k // division_px] > 1:
            reason[k] = MISSING
        elif blind[k // division_px]:
            reason[k] = SATURATION


@kernel()
def _row(d: Decoding, y: int, out: Lines, scratch: RowScratch) -> None:
    out.u_px[:] = np.nan
    out.reason[:] = UNLIT
    decode_pixels(d, y, scratch.pixels)
    for s in range(d.plan.sources.shape[0]):
        _source(d, y, s, scratch, out)
    find_centres(d.plan, d.bars, d.tuning, out)
    _levels(scratch.pixels, d.plan.dynamic, out)
    _account(d.plan, scratch, d.tuning.division_px, out.reason)


@kernel()
def decode_rows(d: Decoding, ys: Integers, lines: Lines, scratch: RowScratch) -> None:
    """Decode some rows of a stack.

    Parameters
    ----------
    d : Decoding
        The stack, and what it is decoded with.
    ys : ndarray, (n,)
        The rows.
    lines : Lines
        Of n rows, written to; width and level only of boundaries that are found.
    scratch : RowScratch
        Made by `row_scratch`, one for each thread.
    """
    for i in range(ys.size):
        _row(d, ys[i], line_at(lines, i), scratch)
