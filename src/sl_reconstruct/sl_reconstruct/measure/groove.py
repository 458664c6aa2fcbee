"""The V-groove of a cloud: its two flanks, found by their slopes, and the angle between them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sl_common.errors import StackError
from sl_reconstruct.measure.plane_angle import AngleMeasurement, measure_angle
from sl_reconstruct.measure.region import select

#: The slope at a point is taken from points this many column boundaries away on either side.
REACH = 16
#: A flank holds at least this part of the points; slopes beyond are taken as its own.
LEAST_PART = 0.05
#: Flanks whose slopes differ by less are no groove.
LEAST_SLOPE_DIFFERENCE = 0.02
#: A slope belongs to a flank when it is so near to the flank's, as a part of their difference.
NEAR = 0.25
#: Points so near to where the slope changes, in column boundaries, do not count: the light's blur
#: rounds the bend (on the reference bench by 0.4 um, over 4 boundaries on either side).
AWAY = 16


def measure_groove(points: NDArray[Any]) -> AngleMeasurement:
    """Find the flanks by their slope along the cloud's rows, and the angle of their planes.

    Parameters
    ----------
    points : ndarray, (H, K), structured
        Organised cloud with x, y, z in metres, NaN where there is no point; the groove runs
        roughly along its columns.

    Returns
    -------
    AngleMeasurement
        ``first`` is the flank that falls towards larger x, ``second`` the one that rises.

    Raises
    ------
    StackError
        When the cloud is not organised, or has no two flanks.

    Examples
    --------
    >>> cloud = np.zeros((50, 400), [("x", "f4"), ("y", "f4"), ("z", "f4")])
    >>> cloud["x"], cloud["y"] = np.linspace(-6e-3, 6e-3, 400), np.linspace(0, 4e-3, 50)[:, None]
    >>> cloud["z"] = np.minimum(0.0, 0.2 * np.abs(cloud["x"]) - 6e-4)
    >>> round(measure_groove(cloud).value, 2)  # 2 atan(5)
    157.38
    """
    if points.ndim != 2:
        raise StackError("a groove needs an organised cloud; expected cloud.pcd or height.tiff")
    slope = _slopes(points)
    there = slope[np.isfinite(slope)]
    enough = there.size >= 2 * REACH
    falling, rising = np.quantile(there, [LEAST_PART, 1.0 - LEAST_PART]) if enough else (0.0, 0.0)
    near = NEAR * (rising - falling)
    try:
        if rising - falling < LEAST_SLOPE_DIFFERENCE:
            raise StackError("the slopes along its rows are all alike")
        flanks = [select(points, mask=_flank(slope, s, near)) for s in (falling, rising)]
        return measure_angle(*flanks)
    except StackError as error:
        raise StackError(
            f"no groove found: {error}; expected two flanks of different slope"
        ) from None


def _flank(slope: NDArray[np.float32], wanted: float, near: float) -> NDArray[np.bool_]:
    """Points whose slope is the flank's, as that of all about them that are there."""
    other = np.isfinite(slope) & ~(np.abs(slope - wanted) < near)
    bend = ndimage.maximum_filter1d(other, 2 * AWAY + 1, axis=1)
    return np.asarray(np.isfinite(slope) & ~bend)


def _slopes(points: NDArray[Any]) -> NDArray[np.float32]:
    """Slope dz/dx along the rows at every point, (H, K); NaN where a neighbour is missing."""
    slope = np.full(points.shape, np.nan, np.float32)
    left, right = points[:, : -2 * REACH], points[:, 2 * REACH :]
    slope[:, REACH:-REACH] = (right["z"] - left["z"]) / (right["x"] - left["x"])
    return slope
