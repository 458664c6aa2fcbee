"""The hole plate as data, and one view of it as observations.

Plate frame: x along a row of holes, y along a column, origin in the middle of the lattice, metres.
Hole (column 0, row 0) lies at the smallest x and y.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import CalibrationError

Array = NDArray[np.float64]
Ids = NDArray[np.int64]


class HoleFlag(IntFlag):
    """Why a hole is not to be trusted as the others are; 0 is a good hole."""

    GOOD = 0
    #: The centre lies off the smooth map that all the other holes follow. Not for fitting.
    OUTLIER = 1
    #: The edge is not that of a round hole: damaged, dirty, partly covered. Not for fitting.
    POOR_EDGE = 2
    #: Plate beside the hole is at the top of the sensor's scale; its sigma says what that costs.
    SATURATED = 4


@dataclass(frozen=True)
class Plate:
    """A plate with round holes (or dots) on a square lattice.

    Parameters
    ----------
    columns, rows : int
        Holes along x and y.
    pitch_m : float
        Distance of neighbours.
    diameter_m : float
        Of a hole; at the bottom of the chamfer where there is one.
    dark_holes : bool
        True for dark holes in a bright plate, False for bright dots on a dark one.
    origin_diameter_m : float, optional
        Diameter of the one hole that marks the origin; None where there is no mark: a plate turned
        over is then not noticed.
    origin_id : tuple of int
        (column, row) of the mark. On a plate with as many columns as rows it must not lie on a
        diagonal (so not in a corner), and never on a middle line: such a plate turned over looks
        as it did before.
    chamfer_m : float
        Width and depth of a 45 degree chamfer around each hole, 0 for none. The holes' edges then
        lie that much below the plate's face.

    Raises
    ------
    CalibrationError
        When a number does not make a plate.
    """

    columns: int = 10
    rows: int = 10
    pitch_m: float = 0.9e-3
    diameter_m: float = 0.45e-3
    dark_holes: bool = True
    origin_diameter_m: float | None = None
    origin_id: tuple[int, int] = (0, 0)
    chamfer_m: float = 0.0

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise CalibrationError(
                f"plate of {self.columns} x {self.rows} holes; expected at least 3 x 3"
            )
        widest = max(self.diameter_m, self.origin_diameter_m or 0.0) + 2 * self.chamfer_m
        if not (self.diameter_m > 0 and self.chamfer_m >= 0 and widest < 1.5 * self.pitch_m):
            raise CalibrationError(
                f"diameter_m={self.diameter_m}, origin_diameter_m={self.origin_diameter_m}, "
                f"chamfer_m={self.chamfer_m}; expected holes narrower than pitch_m={self.pitch_m}"
            )
        self._check_mark()

    def _check_mark(self) -> None:
        column, row = self.origin_id
        if not (0 <= column < self.columns and 0 <= row < self.rows):
            raise CalibrationError(
                f"origin_id={self.origin_id}; expected a hole of {self.columns} x {self.rows}"
            )
        if self.origin_diameter_m and abs(np.log(self.origin_diameter_m / self.diameter_m)) < 0.15:
            raise CalibrationError(
                f"origin_diameter_m={self.origin_diameter_m} beside diameter_m={self.diameter_m}; "
                f"expected a mark that differs by at least 16 %"
            )

    @property
    def tells_its_back(self) -> bool:
        """Whether the mark shows a plate that is turned over."""
        column, row = (2 * np.array(self.origin_id) - (self.columns - 1, self.rows - 1)).tolist()
        diagonal = self.columns == self.rows and abs(column) == abs(row)
        return self.origin_diameter_m is not None and not (diagonal or 0 in (column, row))

    @property
    def hole_count(self) -> int:
        """Holes of the whole plate."""
        return self.columns * self.rows

    def xy_m(self, ids: Ids) -> Array:
        """Centres (N, 2) in the plate frame of holes (N, 2) = (column, row)."""
        middle = 0.5 * np.array([self.columns - 1, self.rows - 1])
        return np.asarray((np.asarray(ids) - middle) * self.pitch_m)

    def radius_m(self, ids: Ids) -> Array:
        """Radii (N,) of holes (N, 2)."""
        marked = np.all(np.asarray(ids) == self.origin_id, axis=-1)
        origin = self.origin_diameter_m or self.diameter_m
        return np.where(marked, origin, self.diameter_m) / 2


#: The paper's plate with a mark that shows its face: what is assumed where nothing else is said. It
#: lies well within the plate, so that it stays in view and in the light where the border does not.
DEFAULT_PLATE = Plate(origin_diameter_m=0.6e-3, origin_id=(3, 2))


@dataclass(frozen=True)
class PlateView:
    """What one image says about the plate: N measured holes.

    Parameters
    ----------
    ids : ndarray, (N, 2) int
        (column, row).
    plate_xy_m : ndarray, (N, 2)
        Nominal centres in the plate frame, metres. With a chamfer the measured circles lie
        ``plate.chamfer_m`` below the plate's face.
    centres_px : ndarray, (N, 2)
        Images of the circles' centres (not the centres of their images), pixels.
    sigma_px : ndarray, (N,)
        1-sigma of a coordinate: root mean square over both axes.
    covariance_px2 : ndarray, (N, 2, 2)
        Of each centre, from the noise found in the image.
    flags : ndarray, (N,) uint8
        `HoleFlag` bits.
    missing : ndarray, (M, 2) int
        Holes that should be in view but were not found: blocked, or out of the light.
    bias_px : ndarray, (N, 2)
        Centre of the fitted ellipse minus ``centres_px``: what was corrected.
    """

    ids: Ids
    plate_xy_m: Array
    centres_px: Array
    sigma_px: Array
    covariance_px2: Array
    flags: NDArray[np.uint8]
    missing: Ids
    bias_px: Array

    @property
    def good(self) -> NDArray[np.bool_]:
        """Holes to fit, (N,): neither outliers nor poor edges."""
        return np.asarray((self.flags & (HoleFlag.OUTLIER | HoleFlag.POOR_EDGE)) == 0)

    def taken(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> PlateView:
        """Return a view of some of the holes (a mask or indices (K,)), in that order."""
        names = [name for name in self.__dataclass_fields__ if name != "missing"]
        return replace(self, **{name: getattr(self, name)[which] for name in names})
