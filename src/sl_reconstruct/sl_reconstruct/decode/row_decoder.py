"""Decode whole rows: pixels, then every source's edges and centres, into one line per row."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_common.kernel_cache import kernel
from sl_reconstruct.cloud.refusals import Reason
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
    Found,
    K,
    SourceRow,
    Tuning,
    bar_centres,
    find_crossings,
    find_zeros,
    gather,
    gather_pair,
    gather_single,
    identify,
    judge,
    look_up_gain,
    pair_signal,
    refuse_dim_edges,
    single_signal,
    smooth,
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
from sl_reconstruct.decode.types import Layout, Lines

#: BR8's slope depends on the stripe's width and blur more than an edge's does.
BAR_LATITUDE = 3.0
#: So many boundaries that are not found are looked for one by one.
FEW = 12

ORDER = int(Reason.ORDER)
MISSING = int(Reason.MISSING)


@kernel()
def decode_pixels(stack: Any, y: int, plan: Layout, t: Tuning, p: PixelRow) -> None:
    """Fill everything that a row's pixels say by themselves."""
    set_levels(stack, y, plan.white, plan.black, plan.images, p)
    if plan.dynamic:
        set_middle(t.around_px, p)
    set_code(stack, y, plan.bits, p)
    if plan.dynamic:
        set_threshold(stack, y, plan.images, t.reach_px, p)
    set_masks(p, t.lit_dn, t.saturation)


@kernel(forceinline=True)
def _settle(owner: Any, s: int, r: SourceRow, first: int, n: int, out: Found) -> None:
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
def _edges(
    s: int, pattern: Any, inverse: Any, plan: Layout, f: Filter, t: Tuning, p: PixelRow,
    r: SourceRow, out: Found, tally: Any,
) -> None:  # fmt: skip
    """Find and identify the edges of one source."""
    margin = f.taps.shape[1] + t.reach_px  # neither filter nor threshold reach beyond the image
    count = find_crossings(p.lit, r.filtered, r.at, margin, r.filtered.size - margin - 1)
    pair, tile = plan.sources[s, 1] >= 0, r.tile
    for first in range(0, count, TILE):
        n = min(TILE, count - first)
        gather(p, r, first, n, t)
        find_zeros(tile, n)
        identify(tile, n, plan.sources[s, 3], plan.sources[s, 2], False, t)
        refuse_dim_edges(tile, n, t)
        look_up_gain(tile, n, f.gain[s])
        if pair:
            gather_pair(pattern, inverse, r, first, n)
            weigh_pairs(tile, n, f.slope[s], t)
        else:
            gather_single(p, r, first, n)
            weigh_singles(tile, n, f.slope[s], False, t)
        judge(tile, n, t.least_width, t.most_width, tally)
        _settle(plan.edge_owner, s, r, first, n, out)


@kernel(forceinline=True)
def _bars(
    s: int, plan: Layout, f: Filter, t: Tuning, p: PixelRow, r: SourceRow, out: Found, tally: Any
) -> None:
    """Find and identify the centres of one source by BR8's zero crossings, Eq. (6)."""
    margin = 5 + t.reach_px
    count = find_crossings(p.lit, r.filtered, r.at, margin, r.filtered.size - margin - 1)
    half, last, tile = plan.sources[s, 2], f.slope.size - 1, r.tile
    for first in range(0, count, TILE):
        n = min(TILE, count - first)
        gather(p, r, first, n, t)
        find_zeros(tile, n)
        # left of a bright centre the left samples are the darker ones, whichever way k grows
        identify(tile, n, plan.sources[s, 3] + half, half, t.direction < 0, t)
        refuse_dim_edges(tile, n, t)
        look_up_gain(tile, n, f.gain[last])
        gather_single(p, r, first, n)
        weigh_singles(tile, n, f.slope[last], True, t)
        judge(tile, n, t.least_width / BAR_LATITUDE, BAR_LATITUDE * t.most_width, tally)
        _settle(plan.centre_owner, s, r, first, n, out)


@kernel(forceinline=True)
def _source(
    stack: Any, y: int, s: int, plan: Layout, f: Filter, t: Tuning, p: PixelRow, r: SourceRow,
    out: Found, tally: Any, bars: bool,
) -> None:  # fmt: skip
    """Everything that one source gives in one row."""
    pattern = stack[plan.sources[s, 0], y]
    inverse = stack[max(0, plan.sources[s, 1]), y]
    if plan.sources[s, 1] >= 0:
        pair_signal(pattern, inverse, t.floor_dn, r.signal)
    else:
        single_signal(pattern, p, t.floor_dn, r.signal)
    smooth(r.signal, f.taps[s], r.filtered)
    tally[0] = 0
    tally[1] = 0
    _edges(s, pattern, inverse, plan, f, t, p, r, out, tally)
    if bars and plan.sources[s, 5]:
        bar_centres(r.signal, r.filtered)
        _bars(s, plan, f, t, p, r, out, tally)


@kernel()
def _levels(p: PixelRow, dynamic: bool, out: Found) -> None:
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
def _lose(p: PixelRow, divisions: int, blind: Any) -> None:
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
def _see(p: PixelRow, seen: Any) -> None:
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
def _account(
    plan: Layout, p: PixelRow, seen: Any, blind: Any, division_px: int, reason: Any
) -> None:
    """Name the boundaries that should be there, but were not found."""
    edge_owner, centre_owner = plan.edge_owner, plan.centre_owner
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
def _row(
    stack: Any, y: int, i: int, plan: Layout, f: Filter, t: Tuning, bars: bool,
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
        _source(stack, y, s, plan, f, t, p, r, found, lines.tally[i, s], bars)
    find_centres(plan, bars, t, found)
    _levels(p, plan.dynamic, found)
    _account(plan, p, seen, blind, t.division_px, found.reason)


class RowScratch(NamedTuple):
    """Scratch of one thread: pixels, one source, and the divisions seen or lost in a row."""

    pixels: PixelRow
    source: SourceRow
    seen: NDArray[np.uint8]
    blind: NDArray[np.uint8]


def row_scratch(width: int, dtype: Any, divisions: int) -> RowScratch:
    """Return scratch for rows of ``width`` pixels and a code of so many divisions."""
    return RowScratch(
        pixel_row(width, dtype), source_row(width),
        np.zeros(divisions, np.uint8), np.zeros(divisions, np.uint8),
    )  # fmt: skip


@kernel()
def decode_rows(
    ys: Any, first: int, last: int, stack: Any, plan: Layout, f: Filter, t: Tuning,
    bars: bool, lines: Lines, scratch: RowScratch,
) -> None:  # fmt: skip
    """Decode the stack's rows ``ys[first:last]`` into the lines of the same numbers."""
    for i in range(first, last):
        _row(stack, ys[i], i, plan, f, t, bars, scratch, lines)
