"""The pattern sequence as data: projection, decoding and simulation derive from the same object.

A pattern is a function of one DMD coordinate, so it is described by a handful of numbers and
rendered on demand. Column boundary ``k`` lies between DMD columns ``k - 1`` and ``k``, at
``u = k - 0.5`` (pixel (0, 0) is centred on u = 0).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import SequenceError

Kind = Literal["gray", "white", "black"]
Axis = Literal["column", "row"]

KINDS: tuple[Kind, ...] = ("gray", "white", "black")
AXES: tuple[Axis, ...] = ("column", "row")

DEFAULT_DMD_SIZE = (1024, 768)
DEFAULT_DIVISION_PX = 4
MAX_DMD_SIDE_PX = 8192


def gray_bits(size_px: int, division_px: int) -> int:
    """Number of Gray bits that tell all divisions of an axis apart (at least one).

    Parameters
    ----------
    size_px, division_px : int
        Size of the axis and of a division, DMD pixels.
    """
    return max(1, math.ceil(math.log2(math.ceil(size_px / division_px))))


@dataclass(frozen=True)
class Pattern:
    """One binary pattern.

    Parameters
    ----------
    kind : {"gray", "white", "black"}
        A bit plane of a Gray code, everything on, everything off.
    axis : {"column", "row"}
        The DMD coordinate that a Gray pattern encodes: "column" gives vertical stripes.
    bit : int
        Gray bit, 0 is the coarsest.
    bits : int
        Gray bits of the whole code on this axis.
    division_px : int
        DMD pixels per division of the code.
    shift_px : int
        The stripes are moved by so many DMD pixels towards larger coordinates (line shift);
        the code is continued periodically at the border.
    inverted : bool
        Bright and dark exchanged.
    """

    kind: Kind
    axis: Axis = "column"
    bit: int = 0
    bits: int = 1
    division_px: int = 1
    shift_px: int = 0
    inverted: bool = False

    def __post_init__(self) -> None:
        if self.kind not in KINDS or self.axis not in AXES:
            raise SequenceError(
                f"pattern kind={self.kind!r}, axis={self.axis!r}; expected kind in {KINDS} "
                f"and axis in {AXES}"
            )
        if self.kind == "gray" and not (0 <= self.bit < self.bits <= 16):
            raise SequenceError(
                f"pattern bit={self.bit} of bits={self.bits}; expected 0 <= bit < bits <= 16"
            )
        if self.division_px < 1 or not 0 <= self.shift_px < 4 * self.half_period_px:
            raise SequenceError(
                f"pattern division_px={self.division_px}, shift_px={self.shift_px}; expected "
                f"division_px >= 1 and 0 <= shift_px < one period ({4 * self.half_period_px})"
            )

    @property
    def half_period_px(self) -> int:
        """Distance D from a Gray bit's origin to its first edge, DMD pixels.

        Unshifted, the pattern rises at ``k = D (mod 4 D)`` and falls at ``k = 3 D (mod 4 D)``:
        stripes are 2 D wide. ``shift_px`` adds to both; ``inverted`` exchanges them.
        """
        return self.division_px << (self.bits - 1 - self.bit)

    def profile(self, size_px: int) -> NDArray[np.bool_]:
        """Mirror states along the pattern's own axis, shape (size_px,), True is bright."""
        if self.kind != "gray":
            return np.full(size_px, (self.kind == "white") != self.inverted)
        division = (np.arange(size_px) - self.shift_px) // self.division_px
        division %= 1 << self.bits
        lit = ((division ^ (division >> 1)) >> (self.bits - 1 - self.bit)) & 1
        return np.asarray(lit.astype(bool) ^ self.inverted)

    def frame(self, dmd_size: tuple[int, int]) -> NDArray[np.uint8]:
        """Render the pattern: shape (rows, columns), 255 where the mirror is on, else 0."""
        columns, rows = dmd_size
        if self.axis == "column":
            line = self.profile(columns)[np.newaxis, :]
        else:
            line = self.profile(rows)[:, np.newaxis]
        return np.ascontiguousarray(
            np.broadcast_to(np.where(line, np.uint8(255), np.uint8(0)), (rows, columns))
        )

    def inverse(self) -> Pattern:
        """Return the same pattern with bright and dark exchanged."""
        return Pattern(
            self.kind, self.axis, self.bit, self.bits, self.division_px, self.shift_px,
            not self.inverted,
        )  # fmt: skip


@dataclass(frozen=True)
class PatternSequence:
    """Patterns in the order in which they are projected, and the DMD they are made for.

    Parameters
    ----------
    name : str
        What the user calls it.
    dmd_size : tuple of int
        (columns, rows), DMD pixels.
    patterns : tuple of Pattern
        In projection order; at least one.
    """

    name: str
    dmd_size: tuple[int, int]
    patterns: tuple[Pattern, ...]

    def __post_init__(self) -> None:
        if not all(8 <= side <= MAX_DMD_SIDE_PX for side in self.dmd_size):
            raise SequenceError(
                f"sequence {self.name!r}: dmd_size={self.dmd_size}; expected columns and rows "
                f"between 8 and {MAX_DMD_SIDE_PX}"
            )
        if not self.patterns:
            raise SequenceError(f"sequence {self.name!r} has no patterns; expected at least one")

    def __len__(self) -> int:
        return len(self.patterns)

    def frame(self, index: int) -> NDArray[np.uint8]:
        """Frame ``index``: shape (rows, columns), 0 or 255."""
        return self.patterns[index].frame(self.dmd_size)

    def axes(self) -> tuple[Axis, ...]:
        """Axes that the sequence encodes, columns first."""
        used = {p.axis for p in self.patterns if p.kind == "gray"}
        return tuple(a for a in AXES if a in used)


def _gray(axis: Axis, size_px: int, bit: int, shift_px: int = 0) -> Pattern:
    bits = gray_bits(size_px, DEFAULT_DIVISION_PX)
    return Pattern("gray", axis, bit, bits, DEFAULT_DIVISION_PX, shift_px)


def _paper_axis(axis: Axis, size_px: int) -> list[Pattern]:
    bits = gray_bits(size_px, DEFAULT_DIVISION_PX)
    codes = [_gray(axis, size_px, bit) for bit in range(bits)]
    return codes + [_gray(axis, size_px, bits - 1, shift) for shift in (1, 2, 3)]


def _precise_axis(axis: Axis, size_px: int) -> list[Pattern]:
    bits = gray_bits(size_px, DEFAULT_DIVISION_PX)
    coarse = [_gray(axis, size_px, bit) for bit in range(bits - 1)]
    fine = [_gray(axis, size_px, bits - 1, shift) for shift in range(2 * DEFAULT_DIVISION_PX)]
    return coarse + [p for f in fine for p in (f, f.inverse())]


def paper(dmd_size: tuple[int, int] = DEFAULT_DMD_SIZE, rows: bool = False) -> PatternSequence:
    """Return Tsai & Hung's sequence (section 4): I1-I8, the Gray code, and I9-I11, line shift.

    Divisions are 4 DMD columns wide whatever the DMD's size, so the number of Gray bits grows
    with it (8 for 1024 columns). Edges and centres of the last four patterns together are all
    column boundaries from 4 on. With ``rows`` the same follows for the rows.

    Parameters
    ----------
    dmd_size : tuple of int
        Columns and rows of the DMD.
    rows : bool
        Row patterns as well.
    """
    patterns = _paper_axis("column", dmd_size[0])
    if rows:
        patterns += _paper_axis("row", dmd_size[1])
    return PatternSequence("paper-rows" if rows else "paper", dmd_size, tuple(patterns))


def precise(dmd_size: tuple[int, int] = DEFAULT_DMD_SIZE, rows: bool = False) -> PatternSequence:
    """Return the default sequence: white, black, coarse Gray bits, fine patterns in pairs.

    The finest Gray bit is shown at all eight shifts of a stripe, each with its inverse, so every
    column boundary is an edge where pattern and inverse cross, whatever the albedo.

    Parameters
    ----------
    dmd_size : tuple of int
        Columns and rows of the DMD.
    rows : bool
        Row patterns as well.
    """
    patterns = [Pattern("white"), Pattern("black"), *_precise_axis("column", dmd_size[0])]
    if rows:
        patterns += _precise_axis("row", dmd_size[1])
    return PatternSequence("precise-rows" if rows else "precise", dmd_size, tuple(patterns))


NAMED = {
    "paper": lambda size: paper(size),
    "paper-rows": lambda size: paper(size, rows=True),
    "precise": lambda size: precise(size),
    "precise-rows": lambda size: precise(size, rows=True),
}


def named(name: str, dmd_size: tuple[int, int] = DEFAULT_DMD_SIZE) -> PatternSequence:
    """Return a built-in sequence by name.

    Parameters
    ----------
    name : str
        ``precise``, ``paper``, ``precise-rows`` or ``paper-rows``.
    dmd_size : tuple of int
        Columns and rows of the DMD.

    Raises
    ------
    SequenceError
        When there is no sequence of that name.

    Examples
    --------
    >>> len(named("paper")), len(named("precise"))
    (11, 25)
    """
    if name not in NAMED:
        raise SequenceError(f"no sequence is called {name!r}; expected one of {sorted(NAMED)}")
    return _made(name, tuple(dmd_size))


@functools.lru_cache(maxsize=16)
def _made(name: str, dmd_size: tuple[int, int]) -> PatternSequence:
    """Keep what was asked for: every trigger of a built-in sequence is compared with it."""
    return NAMED[name](dmd_size)
