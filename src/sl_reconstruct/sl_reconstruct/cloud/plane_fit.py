"""The plane through a cloud, by orthogonal least squares, with outliers set aside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Points further off than this many robust standard deviations are set aside.
TRIM_SD = 5.0
ROUNDS = 4
#: Median of |N(0, 1)|: turns a median of residuals into a standard deviation.
MEDIAN_ABS_NORMAL = 0.6744897501960817


@dataclass(frozen=True)
class Plane:
    """A plane ``normal . (p - point_m) = 0`` and how well points lie on it.

    Parameters
    ----------
    point_m, normal : ndarray, (3,)
        A point on it, metres; unit normal with z > 0.
    rms_m : float
        Root mean square distance of the points that were used, metres.
    used, set_aside : int
        Points fitted, and points that were too far off.
    """

    point_m: Array
    normal: Array
    rms_m: float
    used: int
    set_aside: int

    def distances_m(self, xyz_m: Array) -> Array:
        """Signed distances (...,) of points (..., 3), positive on the side of the normal."""
        return np.asarray((xyz_m - self.point_m) @ self.normal)


def fit_plane(xyz_m: Array, rounds: int = ROUNDS) -> Plane | None:
    """Fit a plane to points.

    Parameters
    ----------
    xyz_m : ndarray, (n, 3)
        Points, metres; those with NaN are left out.
    rounds : int
        Fits at the most, each without the outliers of the one before; 1: to all points.

    Returns
    -------
    Plane or None
        None when fewer than three points are there, or they lie on a line.
    """
    points = np.asarray(xyz_m, dtype=np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    kept = points
    for _ in range(rounds):
        plane = _fit(kept, len(points))
        if plane is None:
            return None
        distance = plane.distances_m(points)
        inside = points[np.abs(distance) <= TRIM_SD * robust_sd(distance)]
        if len(inside) == len(kept) or len(inside) < 3:
            break
        kept = inside
    return plane


def robust_sd(residual: Array) -> float:
    """Standard deviation of normal residuals from the median of their sizes."""
    return float(np.median(np.abs(residual))) / MEDIAN_ABS_NORMAL


def _fit(points: Array, total: int) -> Plane | None:
    if len(points) < 3:
        return None
    centre = points.mean(axis=0)
    centred = points - centre
    values, vectors = np.linalg.eigh(centred.T @ centred)
    if values[1] <= 1e-12 * values[2]:
        return None
    normal = vectors[:, 0] * (1.0 if vectors[2, 0] >= 0 else -1.0)
    # From the distances, not from the eigenvalue: that one drowns in the rounding of the others.
    rms = float(np.sqrt(np.mean((centred @ normal) ** 2)))
    return Plane(centre, normal, rms, len(points), total - len(points))
