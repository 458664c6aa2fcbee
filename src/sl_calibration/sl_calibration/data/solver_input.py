"""Observations as the solver wants them: one row per hole or target, all views joined.

The world is the plate as it lies when the stage reads zero: x and y in the plate, z along its
normal towards the devices. ``stage_m`` is where the stage says it stands, relative to that zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_calibration.data.observations import View, stage_positions

Array = NDArray[np.float64]


class Holes(NamedTuple):
    """All views of the plate, one row per hole.

    ``points_m`` (N, 3) on the plate, ``stage_m`` (N, 3), ``view`` (N,) indices, ``pixels`` (N, 2),
    ``sigma_px`` (N, 2).
    """

    points_m: Array
    stage_m: Array
    view: NDArray[np.intp]
    pixels: Array
    sigma_px: Array

    @property
    def nominal_m(self) -> Array:
        """World points (N, 3) as a faultless stage would have them."""
        return np.asarray(self.points_m + self.stage_m)

    def part(self, rows: NDArray[np.bool_]) -> Holes:
        """Only some rows."""
        return Holes._make(array[rows] for array in self)

    @classmethod
    def of(cls, views: Sequence[View]) -> Holes:
        """Join the holes of views."""
        points = np.pad(_join([v.plate_xy_m for v in views]), ((0, 0), (0, 1)))
        pixels = _join([v.centres_px for v in views])
        sigma = np.concatenate([np.empty(0), *(v.centres_sigma_px for v in views)])
        stage = _stage(views, [len(v.centres_px) for v in views])
        return cls(points, *stage, pixels, np.repeat(sigma[:, np.newaxis], 2, axis=1))


class Targets(NamedTuple):
    """All projected targets, one row each.

    ``camera_px`` (N, 2), ``stage_m`` (N, 3), ``view`` (N,) indices, ``pixels`` (N, 2) on the DMD,
    ``sigma_px`` (N, 2).
    """

    camera_px: Array
    stage_m: Array
    view: NDArray[np.intp]
    pixels: Array
    sigma_px: Array

    @classmethod
    def of(cls, views: Sequence[View]) -> Targets:
        """Join the targets of views."""
        camera_px, dmd_px, sigma_px = (
            _join([getattr(view, name) for view in views])
            for name in ("camera_px", "dmd_px", "dmd_sigma_px")
        )
        return cls(camera_px, *_stage(views, [len(v.dmd_px) for v in views]), dmd_px, sigma_px)


def _join(parts: Sequence[Array]) -> Array:
    return np.concatenate([np.empty((0, 2)), *parts])


def _stage(views: Sequence[View], counts: Sequence[int]) -> tuple[Array, NDArray[np.intp]]:
    """Stage position (N, 3) and view index (N,) of every row."""
    index = np.repeat(np.arange(len(views)), counts)
    return np.repeat(stage_positions(views), counts, axis=0), index
