"""Regions of the x-y plane, and the points of a cloud that lie in one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import ConfigError, StackError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Region:
    """A polygon in x, y.

    Parameters
    ----------
    corners_m : tuple of (x, y)
        Metres, at least three, in order; the last is joined to the first.
    """

    corners_m: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        corners = np.asarray(self.corners_m, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1:] != (2,) or len(corners) < 3:
            raise ConfigError(f"region {self.corners_m}; expected at least three (x, y)")
        x, y = corners.T
        area = 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
        if not area > 0.0:
            raise ConfigError(f"region {self.corners_m} has no area; expected a polygon, metres")

    @classmethod
    def rectangle(cls, x0_m: float, y0_m: float, x1_m: float, y1_m: float) -> Region:
        """Rectangle between two opposite corners.

        Parameters
        ----------
        x0_m, y0_m, x1_m, y1_m : float
            Corners, metres, in any order.
        """
        return cls(((x0_m, y0_m), (x1_m, y0_m), (x1_m, y1_m), (x0_m, y1_m)))

    @classmethod
    def of(cls, numbers_m: Sequence[float]) -> Region:
        """Region of a flat list: four numbers are a rectangle, six and more a polygon.

        Raises
        ------
        ConfigError
            When the numbers are of another count, or have no area.

        Examples
        --------
        >>> Region.of([0, 0, 2e-3, 1e-3]) == Region.rectangle(0, 0, 2e-3, 1e-3)
        True
        """
        if len(numbers_m) == 4:
            return cls.rectangle(*numbers_m)
        if len(numbers_m) < 6 or len(numbers_m) % 2:
            raise ConfigError(
                f"a region of {len(numbers_m)} numbers; expected x0, y0, x1, y1 or the corners of "
                "a polygon"
            )
        return cls(tuple(zip(numbers_m[::2], numbers_m[1::2], strict=True)))

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """(left, bottom, right, top), metres."""
        corners = np.asarray(self.corners_m)
        (left, bottom), (right, top) = corners.min(axis=0), corners.max(axis=0)
        return float(left), float(bottom), float(right), float(top)

    def contains(self, x_m: NDArray[Any], y_m: NDArray[Any]) -> NDArray[np.bool_]:
        """Whether points lie inside, same shape as x and y; NaN does not (even-odd rule).

        Parameters
        ----------
        x_m, y_m : ndarray
            Coordinates, metres, of one shape.
        """
        left, bottom, right, top = self.bounds_m
        inside = (x_m >= left) & (x_m <= right) & (y_m >= bottom) & (y_m <= top)
        if self == Region.rectangle(left, bottom, right, top):
            return np.asarray(inside)
        x, y = np.asarray(x_m, np.float64)[inside], np.asarray(y_m, np.float64)[inside]
        odd = np.zeros(x.shape, dtype=np.bool_)
        corners = self.corners_m
        for (xa, ya), (xb, yb) in zip(corners, (*corners[1:], corners[0]), strict=True):
            if ya != yb:
                odd ^= ((y < ya) != (y < yb)) & (x < xa + (y - ya) * (xb - xa) / (yb - ya))
        inside[inside] = odd
        return np.asarray(inside)


@dataclass(frozen=True)
class Selection:
    """The points that a measurement uses.

    Parameters
    ----------
    xyz_m : ndarray, (n, 3)
        Coordinates, metres, all finite.
    sigma_m : ndarray, (n,)
        Stated standard deviation of z, metres; 0 where none is known.
    region : Region or None
        Where they were taken from; None is everywhere.
    """

    xyz_m: Array
    sigma_m: Array
    region: Region | None = None

    def __len__(self) -> int:
        return len(self.xyz_m)

    def at(self, mask: NDArray[np.bool_]) -> Selection:
        """Those where the mask (n,) is set."""
        return Selection(self.xyz_m[mask], self.sigma_m[mask], self.region)


def select(
    points: NDArray[Any], region: Region | None = None, mask: NDArray[np.bool_] | None = None
) -> Selection:
    """Take the points of a cloud that are there, in a region and under a mask.

    Parameters
    ----------
    points : ndarray, structured, any shape
        ``x, y, z`` in metres, NaN where there is no point; ``sigma`` (metres) where known.
    region : Region, optional
        Everywhere when left out.
    mask : ndarray of bool, optional
        Shape of the points.

    Raises
    ------
    StackError
        When no point is left.
    """
    there = np.isfinite(points["z"])
    if region is not None:
        there &= region.contains(points["x"], points["y"])
    if mask is not None:
        there &= mask
    chosen = points[there]
    if not chosen.size:
        where = "the cloud" if region is None else f"the region {region.bounds_m} m"
        raise StackError(f"no points in {where}; expected some")
    xyz = np.stack([chosen[name].astype(np.float64) for name in "xyz"], axis=-1)
    known = "sigma" in (points.dtype.names or ())
    sigma = chosen["sigma"].astype(np.float64) if known else np.zeros(len(chosen))
    return Selection(xyz, np.where(np.isfinite(sigma), sigma, 0.0), region)
