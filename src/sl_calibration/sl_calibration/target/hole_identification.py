"""Which hole of the plate is which: rotation, offset and side of a found lattice.

Every way to lay the plate's holes on the found lattice is scored by what it leaves unexplained:
holes that should lie in lit plate in view but are not there, and a mark where there should be none.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sl_calibration.target.plate import Plate
from sl_common.errors import CalibrationError

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: A mark missing where it should be, or found where none should be, weighs as many lost holes.
MARK_WEIGHT = 4
#: A place is lit where its surroundings have this share of the found holes'.
MIN_LIT = 0.3
#: Turning the plate over must explain this many holes more than leaving it.
SIDE_MARGIN = 2

_QUARTERS = ((1, 0), (0, 1), (-1, 0), (0, -1))
_ROTATIONS = [np.array([[c, -s], [s, c]]) for c, s in _QUARTERS]
_DIAGONALS = np.array([[0.5, 0.5], [0.5, -0.5], [-0.5, 0.5], [-0.5, -0.5]])
_MIRROR = np.diag([1, -1])


@dataclass(frozen=True)
class Placement:
    """(column, row) = turn @ (i, j) + shift, its score and whether the plate shows its back."""

    turn: Ids
    shift: Ids
    unexplained: int
    mirrored: bool

    def ids(self, lattice: Ids) -> Ids:
        """(column, row) of lattice points (N, 2)."""
        return np.asarray(lattice @ self.turn.T + self.shift)


@dataclass(frozen=True)
class FoundLattice:
    """A lattice in the image.

    Parameters
    ----------
    ij : ndarray, (N, 2) int
        Lattice points that were found.
    marks : ndarray, (N,) bool
        Those of the size of the origin mark.
    lattice_to_image : ndarray, (3, 3)
        Homography from (i, j) to pixels.
    image : ndarray, (H, W) float32
        Dark holes on a bright plate.
    margin_px : float
        A hole centred nearer than this to the image's border may be cut.
    """

    ij: Ids
    marks: NDArray[np.bool_]
    lattice_to_image: Array
    image: NDArray[np.float32]
    margin_px: float

    def pixels(self, ij: Array | Ids) -> Array:
        """Image points (N, 2) of lattice points (N, 2)."""
        local = self._local(ij)
        return np.asarray(local[..., :2] / local[..., 2:])

    def _local(self, ij: Array | Ids) -> Array:
        """Homogeneous pixels (N, 3)."""
        return np.asarray(ij @ self.lattice_to_image[:, :2].T + self.lattice_to_image[:, 2])

    def in_view(self, ij: Ids) -> NDArray[np.bool_]:
        """Whether holes at lattice points (N, 2) lie wholly in the image, in lit plate."""
        last = np.array(self.image.shape[::-1]) - 1 - self.margin_px
        q = self.pixels(ij)
        inside = np.all((q > self.margin_px) & (q < last), axis=-1)
        inside &= self._local(ij)[..., 2] * self.lattice_to_image[2, 2] > 0
        lit = self._surround(ij) > MIN_LIT * np.median(self._surround(self.ij))
        return np.asarray(inside & lit)

    def _surround(self, ij: Ids) -> Array:
        """Lowest level (N,) half-way to the four diagonal neighbours; inf where none is in view."""
        lowest = np.full(len(ij), np.inf)
        for step in _DIAGONALS:
            q = np.rint(self.pixels(ij + step))
            seen = np.all((q >= 0) & (q < self.image.shape[::-1]), axis=1)
            u, v = np.where(seen[:, None], q, 0).astype(int).T
            lowest = np.minimum(lowest, np.where(seen, self.image[v, u], np.inf))
        return lowest


def place(plate: Plate, found: FoundLattice) -> Placement:
    """Lay the plate on the lattice.

    Parameters
    ----------
    plate : Plate
        The plate.
    found : FoundLattice
        What is seen of it.

    Notes
    -----
    Without a mark, of the rotations that explain the image equally well the one is taken whose
    plate x is nearest to image right. A corner mark on a plate with as many columns as rows leaves
    the side in doubt; the front is taken.

    Raises
    ------
    CalibrationError
        When the lattice does not fit on the plate, more than one offset (with a mark: or rotation)
        explains it equally well, or the plate shows its back.
    """
    options = [option for turn in _turns(found) for option in _shifts(plate, found, *turn)]
    if not options:
        extent = np.ptp(found.ij, axis=0) + 1
        raise CalibrationError(
            f"found a lattice of {extent[0]} x {extent[1]} holes; "
            f"expected at most {plate.columns} x {plate.rows}"
        )
    front = min((o.unexplained for o in options if not o.mirrored), default=10**6)
    best = min(options, key=lambda o: o.unexplained)
    if best.mirrored and best.unexplained + SIDE_MARGIN <= front:
        raise CalibrationError(
            f"the plate is turned over: its mark lies where only the back shows it; "
            f"expected the front, with the mark at hole {plate.origin_id}"
        )
    if plate.origin_diameter_m and not found.marks.any():
        raise CalibrationError(
            f"none of {len(found.ij)} holes has the size of the origin mark; expected one of "
            f"{plate.origin_diameter_m * 1e3:g} mm among those of {plate.diameter_m * 1e3:g} mm, "
            f"hole {plate.origin_id}: is it covered or out of view? (for a plate without a mark, "
            "give 0 as its diameter)"
        )
    level = [o for o in options if not o.mirrored and o.unexplained == front]
    return _upright(found, level, plate.origin_diameter_m is not None)


def _turns(found: FoundLattice) -> list[tuple[Ids, bool]]:
    """Return the eight turns of a square, with whether each shows the plate's back.

    Plate y is up where image v is down: the front's map to the image has a negative determinant.
    """
    middle = found.ij.mean(axis=0)
    corner = found.pixels(middle + np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]]))
    d = corner[1:] - corner[0]
    flipped = d[0, 0] * d[1, 1] - d[0, 1] * d[1, 0] > 0
    turns = [(rotation, bool(flipped)) for rotation in _ROTATIONS]
    return turns + [(rotation @ _MIRROR, not flipped) for rotation in _ROTATIONS]


def _shifts(plate: Plate, found: FoundLattice, turn: Ids, mirrored: bool) -> list[Placement]:
    """Score all offsets of one turn that keep the lattice on the plate."""
    turned = found.ij @ turn.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    spare = np.array([plate.columns, plate.rows]) - (high - low + 1)
    if spare.min() < 0:
        return []
    offsets = itertools.product(range(spare[0] + 1), range(spare[1] + 1))
    shifts = [np.array(offset) - low for offset in offsets]
    return [Placement(turn, s, _unexplained(plate, found, turn, s), mirrored) for s in shifts]


def _unexplained(plate: Plate, found: FoundLattice, turn: Ids, shift: Ids) -> int:
    whole = np.stack(np.meshgrid(range(plate.columns), range(plate.rows)), axis=-1).reshape(-1, 2)
    ij = (whole - shift) @ turn  # the inverse of a turn is its transpose
    seen = {tuple(k) for k in found.ij.tolist()}
    there = np.array([tuple(k) in seen for k in ij.tolist()])
    lost = int(np.sum(found.in_view(ij) & ~there))
    if plate.origin_diameter_m is None:
        return lost
    at_origin = np.all(found.ij @ turn.T + shift == plate.origin_id, axis=1)
    return lost + MARK_WEIGHT * int(np.sum(at_origin != found.marks))


def _upright(found: FoundLattice, level: list[Placement], marked: bool) -> Placement:
    """Take the placement whose x is nearest to image right; refuse when more than that is open."""
    middle = found.ij.mean(axis=0)

    def right(option: Placement) -> float:
        step = found.pixels(middle + option.turn[0]) - found.pixels(middle)  # one column on
        return float(step[0] / np.hypot(*step))

    best = max(level, key=right)
    rivals = [o for o in level if marked or np.array_equal(o.turn, best.turn)]
    if len(rivals) > 1:
        raise CalibrationError(
            f"part of the plate is out of view and its holes fit at {len(rivals)} offsets or "
            f"rotations; expected the origin mark or two neighbouring sides of the plate in view"
        )
    return best
