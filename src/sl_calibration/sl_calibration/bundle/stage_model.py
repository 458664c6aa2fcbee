"""What the stage's axes really do, as the plate sees it, and what is known of them before.

A stage reading s moves the plate by ``A s`` (+ a small error of each position); the columns of A
are the true directions and scales of the axes in the plate's frame. Lengths on the plate are the
reference for everything, so A is measured against the plate and never the other way round.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import CalibrationError

Array = NDArray[np.float64]

#: Readings of an axis that differ by less than this are one and the same, metres.
SAME_PLACE_M = 1e-9
_Z = 2


@dataclass(frozen=True)
class StagePrior:
    """How well the stage is known before the calibration, 1-sigma each; 0 holds the value.

    Parameters
    ----------
    scale_sigma : float
        Relative error of the travel.
    direction_sigma_rad : float
        Lean of z travel against the plate's normal (the plate's tilt included), and of x and y
        travel out of the plate's plane, radians. The turn of x and y within it is free.
    position_sigma_m : float
        Error of each single position, metres.
    """

    scale_sigma: float = 0.005
    direction_sigma_rad: float = 0.05
    position_sigma_m: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.scale_sigma, self.direction_sigma_rad, self.position_sigma_m)
        if not (np.all(np.isfinite(numbers)) and min(numbers) >= 0):
            raise CalibrationError(f"stage prior {numbers}; expected sigmas of 0 or more")

    @property
    def held(self) -> bool:
        """Whether the axes are taken as they read: both sigmas zero."""
        return self.scale_sigma == 0 and self.direction_sigma_rad == 0


#: The paper's assumption: travel along the plate's normal, as long as it reads.
FAULTLESS = StagePrior(0.0, 0.0, 0.0)


def moving_axes(stage_m: Array) -> tuple[int, ...]:
    """Axes (0, 1, 2) that differ from zero anywhere in readings (N, 3)."""
    return tuple(int(i) for i in np.flatnonzero(np.abs(stage_m).max(axis=0) > SAME_PLACE_M))


def axis_priors(axes: Array, axis: int, prior: StagePrior) -> tuple[Array, Array]:
    """Residuals in sigmas (K,) of one axis, derivatives (K, 3) by its column of A.

    Parameters
    ----------
    axes : ndarray, (3, 3)
        A.
    axis : {0, 1, 2}
        x, y or z.
    prior : StagePrior
        What is known of the stage.
    """
    column = axes[:, axis]
    length = float(np.linalg.norm(column))
    # A sigma of zero holds the value: a millionth of what matters stands for it.
    scale = max(prior.scale_sigma, 1e-9)
    lean = max(prior.direction_sigma_rad, 1e-9)
    across = [0, 1] if axis == _Z else [_Z]
    residuals = np.array([(length - 1) / scale, *(column[across] / lean)])
    return residuals, np.concatenate([[column / length / scale], np.eye(3)[across] / lean])


@dataclass(frozen=True)
class StageReport:
    """The stage as calibrated; NaN for axes that did not move.

    Parameters
    ----------
    scale, scale_sigma : ndarray, (3,)
        True travel per metre read, of x, y, z; 1-sigma.
    z_lean_rad, z_lean_sigma_rad : ndarray, (2,)
        Lean of z travel against the plate's normal, towards the plate's x and y; the tilt of the
        plate and the stage's own squareness both make it up.
    squareness_rad, squareness_sigma_rad : ndarray, (3,)
        Angles less than 90 degrees between x and y, x and z, y and z travel: the stage's own,
        whatever the plate's tilt; known only where both axes moved.
    """

    scale: Array
    scale_sigma: Array
    z_lean_rad: Array
    z_lean_sigma_rad: Array
    squareness_rad: Array
    squareness_sigma_rad: Array


_PAIRS = ((0, 1), (0, 2), (1, 2))


def stage_report(axes: Array, covariance: Array, moving: tuple[int, ...]) -> StageReport:
    """Describe the axes.

    Parameters
    ----------
    axes : ndarray, (3, 3)
        A, one axis a column.
    covariance : ndarray, (9, 9)
        Of A's columns one after the other; zero for axes that did not move.
    moving : tuple of int
        Axes that moved.
    """
    length = np.linalg.norm(axes, axis=0)
    unit = axes / length
    lean = axes[:2, _Z] / axes[_Z, _Z]
    square = np.array([unit[:, i] @ unit[:, j] for i, j in _PAIRS])
    by_scale, by_lean, by_square = np.zeros((3, 9)), np.zeros((2, 9)), np.zeros((3, 9))
    for i in range(3):
        by_scale[i, 3 * i : 3 * i + 3] = unit[:, i]
    by_lean[:, 6:8] = np.eye(2) / axes[_Z, _Z]
    by_lean[:, 8] = -axes[:2, _Z] / axes[_Z, _Z] ** 2
    for row, cosine, (i, j) in zip(by_square, square, _PAIRS, strict=True):
        row[3 * i : 3 * i + 3] = (unit[:, j] - unit[:, i] * cosine) / length[i]
        row[3 * j : 3 * j + 3] = (unit[:, i] - unit[:, j] * cosine) / length[j]
    known = np.array([i in moving for i in range(3)])
    both = np.array([known[i] and known[j] for i, j in _PAIRS])
    quantities = (
        (length, by_scale, known),
        (np.arctan(lean), by_lean, known[_Z]),
        (np.arcsin(square), by_square, both),
    )
    found = []
    for value, rows, sure in quantities:
        sigma = np.sqrt(np.diag(rows @ covariance @ rows.T))
        found += [np.where(sure, value, np.nan), np.where(sure, sigma, np.nan)]
    return StageReport(*found)
