"""What a sequence lets one decode: which image carries which code bit and which boundaries.

Everything the decoder knows about the patterns is derived here from the sequence as data.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import SequenceError
from sl_projector.sequence.pattern_sequence import Axis, Pattern, PatternSequence
from sl_reconstruct.decode.types import Layout

#: Light must be known this far on either side of an edge, DMD pixels.
MARGIN_PX = 2


@dataclass(frozen=True)
class Source:
    """An image, or a pattern and its inverse, whose edges or centres are wanted boundaries.

    Parameters
    ----------
    image, inverse : int
        Indices into the stack; ``inverse`` is -1 for a single image.
    half_period_px : int
        D, DMD pixels: stripes are 2 D wide.
    rising_px : int
        Boundaries where the image turns bright with growing k are ``rising_px (mod 4 D)``.
    edges, centres : bool
        Which features this source is asked for.
    """

    image: int
    inverse: int
    half_period_px: int
    rising_px: int
    edges: bool
    centres: bool

    @property
    def paired(self) -> bool:
        """Whether the source has an inverse."""
        return self.inverse >= 0

    def edge_at(self, boundaries: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of the boundaries are edges of this source."""
        return np.asarray((boundaries - self.rising_px) % (2 * self.half_period_px) == 0)

    def centre_at(self, boundaries: NDArray[np.int64], size_px: int) -> NDArray[np.bool_]:
        """Which of the boundaries are centres of stripes whose both edges are on the DMD.

        Parameters
        ----------
        boundaries : ndarray
            Numbers k of boundaries.
        size_px : int
            DMD pixels along the axis.
        """
        d = self.half_period_px
        inside = (boundaries - d > 0) & (boundaries + d < size_px)
        return inside & self.edge_at(boundaries + d)


@dataclass(frozen=True)
class CodeBit:
    """One bit of the Gray code: bright in ``image`` (dark in ``inverse``) is 1, or 0 if flipped."""

    image: int
    inverse: int
    flipped: bool


@dataclass(frozen=True)
class AxisPlan:
    """How one DMD coordinate is decoded.

    Parameters
    ----------
    axis : {"column", "row"}
        The coordinate.
    size_px : int
        DMD pixels along it; boundaries are 0 .. size_px - 1.
    bits : tuple of CodeBit
        The Gray code, coarsest first.
    division_px : int
        Width of the code's divisions, DMD pixels.
    images : tuple of int
        Every image that is constant or striped along this axis.
    sources : tuple of Source
        Where the boundaries come from.
    unlit : tuple of int
        Boundaries about which no image is bright, so that the full light there is not known to a
        dynamic threshold (the code's first division).
    white, black : int
        Index of the fully lit and the dark image, -1 where there is none.
    """

    axis: Axis
    size_px: int
    bits: tuple[CodeBit, ...]
    division_px: int
    images: tuple[int, ...]
    sources: tuple[Source, ...]
    unlit: tuple[int, ...]
    white: int
    black: int

    @property
    def dynamic(self) -> bool:
        """Whether some source is a single image, which needs a threshold per pixel."""
        return any(not s.paired for s in self.sources)

    def owners(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Source that gives each boundary by an edge, and by a centre; -1 where none does."""
        k = np.arange(self.size_px)
        edge, centre = np.full(self.size_px, -1), np.full(self.size_px, -1)
        free = k > 0
        known = ~np.isin(k, self.unlit)
        for i, s in enumerate(self.sources):
            mine = free & s.edge_at(k) & s.edges & (s.paired | known)
            edge[mine] = i
            free &= ~mine
        for i, s in enumerate(self.sources):
            mine = free & s.centre_at(k, self.size_px) & s.centres & known
            centre[mine] = i
            free &= ~mine
        return edge, centre

    def boundaries(self) -> NDArray[np.bool_]:
        """Which boundaries some source can give, shape (size_px,)."""
        edge, centre = self.owners()
        return np.asarray((edge >= 0) | (centre >= 0))

    def alone(self) -> AxisPlan:
        """The same for a stack of this axis's images only."""
        at = {image: i for i, image in enumerate(self.images)} | {-1: -1}
        return replace(
            self,
            images=tuple(range(len(self.images))),
            bits=tuple(replace(b, image=at[b.image], inverse=at[b.inverse]) for b in self.bits),
            sources=tuple(
                replace(s, image=at[s.image], inverse=at[s.inverse]) for s in self.sources
            ),
            white=at[self.white],
            black=at[self.black],
        )


@functools.lru_cache(maxsize=8)
def make_layout(plan: AxisPlan) -> Layout:
    """Write an axis's plan as arrays for the kernels."""
    edge_owner, centre_owner = plan.owners()
    sources = [
        (s.image, s.inverse, s.half_period_px, s.rising_px, s.edges, s.centres)
        for s in plan.sources
    ]
    bits = [(b.image, b.inverse, b.flipped) for b in plan.bits]
    turns = np.flatnonzero(np.diff(centre_owner >= 0, prepend=False, append=False))
    centres = [
        (first, stop, plan.sources[centre_owner[first]].half_period_px)
        for first, stop in turns.reshape(-1, 2).tolist()
    ]
    return Layout(
        sources=np.array(sources, np.int64),
        edge_owner=edge_owner,
        centre_owner=centre_owner,
        bits=np.array(bits, np.int64),
        images=np.array(plan.images, np.int64),
        white=plan.white,
        black=plan.black,
        dynamic=plan.dynamic,
        centres=np.array(centres, np.int64).reshape(-1, 3),
    )


@dataclass(frozen=True)
class DecodePlan:
    """How a stack of a sequence is decoded.

    Parameters
    ----------
    count : int
        Images in the stack.
    column, row : AxisPlan
        One plan for each coordinate; ``row`` is None where the sequence has no row patterns.
    """

    count: int
    column: AxisPlan
    row: AxisPlan | None

    @classmethod
    def of(cls, sequence: PatternSequence) -> DecodePlan:
        """Derive the plan from the sequence.

        Raises
        ------
        SequenceError
            When the sequence has no column code, or one that does not begin at bit 0.
        """
        if "column" not in sequence.axes():
            raise SequenceError(
                f"sequence {sequence.name!r} has no column patterns; expected a Gray code"
            )
        row = _axis_plan(sequence, "row") if "row" in sequence.axes() else None
        return cls(len(sequence), _axis_plan(sequence, "column"), row)


def _full(sequence: PatternSequence, lit: bool) -> int:
    for i, p in enumerate(sequence.patterns):
        if p.kind != "gray" and ((p.kind == "white") != p.inverted) == lit:
            return i
    return -1


def _paired(sequence: PatternSequence, axis: Axis) -> list[tuple[Pattern, int, int]]:
    """Gray patterns of an axis with the index of their image and of their inverse or -1."""
    index: dict[Pattern, int] = {}
    for i, p in enumerate(sequence.patterns):
        if p.kind == "gray" and p.axis == axis:
            index.setdefault(p, i)
    found: list[tuple[Pattern, int, int]] = []
    used: set[Pattern] = set()
    for p, i in index.items():
        if p in used:
            continue
        partner = p.inverse()
        found.append((p, i, index.get(partner, -1)))
        used.update((p, partner))
    return found


def _code_bits(patterns: list[tuple[Pattern, int, int]], name: str) -> tuple[list[CodeBit], int]:
    """The unshifted bits from the coarsest on, and the width of their divisions."""
    by_bit = {p.bit: (p, i, n) for p, i, n in patterns if p.shift_px == 0}
    bits: list[CodeBit] = []
    division_px = 0
    while len(bits) in by_bit:
        p, i, n = by_bit[len(bits)]
        bits.append(CodeBit(i, n, p.inverted))
        division_px = p.half_period_px
    if not bits:
        raise SequenceError(f"sequence {name!r} has no Gray bit 0; expected the code's first bit")
    return bits, division_px


def _source(p: Pattern, image: int, inverse: int, edges: bool, centres: bool) -> Source:
    d = p.half_period_px
    rising = (d + p.shift_px + (2 * d if p.inverted else 0)) % (4 * d)
    return Source(image, inverse, d, rising, edges, centres)


def _sources(patterns: list[tuple[Pattern, int, int]], size_px: int) -> list[Source]:
    """Choose for each boundary the finest source: edges of pairs, of single images, centres.

    Centres serve where the finest patterns are single images (the paper's I8-I11); they come
    before the edges of coarser single images, as in the paper.
    """
    k = np.arange(1, size_px)
    covered = np.zeros(size_px - 1, bool)
    candidates = [_source(p, i, n, True, False) for p, i, n in patterns]
    candidates.sort(key=lambda s: (not s.paired, s.half_period_px))
    chosen: list[Source] = []
    finest = min(s.half_period_px for s in candidates)
    for i, s in enumerate(candidates):
        edges = bool(np.any(s.edge_at(k) & ~covered))
        if not edges:
            continue
        covered |= s.edge_at(k)
        chosen.append(s)
        last_single = (
            not s.paired
            and s.half_period_px == finest
            and (i + 1 == len(candidates) or candidates[i + 1].half_period_px > finest)
        )
        if last_single:
            chosen = _with_centres(chosen, covered, k, size_px, finest)
    return chosen


def _with_centres(
    chosen: list[Source],
    covered: NDArray[np.bool_],
    k: NDArray[np.int64],
    size_px: int,
    finest: int,
) -> list[Source]:
    out = []
    for s in chosen:
        wanted = s.centre_at(k, size_px) & ~covered
        centres = not s.paired and s.half_period_px == finest and bool(wanted.any())
        if centres:
            covered |= wanted
        out.append(Source(s.image, s.inverse, s.half_period_px, s.rising_px, True, centres))
    return out


def _axis_plan(sequence: PatternSequence, axis: Axis) -> AxisPlan:
    size_px = sequence.dmd_size[0 if axis == "column" else 1]
    patterns = _paired(sequence, axis)
    bits, division_px = _code_bits(patterns, sequence.name)
    images = tuple(i for i, p in enumerate(sequence.patterns) if p.kind != "gray" or p.axis == axis)
    sources = tuple(_sources(patterns, size_px))
    unlit = _unlit([sequence.patterns[i] for i in images], size_px)
    full = _full(sequence, True), _full(sequence, False)
    return AxisPlan(axis, size_px, tuple(bits), division_px, images, sources, unlit, *full)


def _unlit(patterns: list[Pattern], size_px: int) -> tuple[int, ...]:
    """Boundaries with no image that is bright for ``MARGIN_PX`` on both sides."""
    out = np.ones(size_px, bool)
    for p in patterns:
        padded = np.pad(p.profile(size_px), MARGIN_PX)
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * MARGIN_PX)
        out &= ~np.asarray(windows.all(axis=1))[:size_px]
    return tuple(int(k) for k in np.flatnonzero(out))
