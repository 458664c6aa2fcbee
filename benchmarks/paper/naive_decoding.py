"""Decoding as in the lower part of the paper's Fig. 10: no sub-pixel edges, no line shift."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_reconstruct.cloud.cloud import CLOUD_DTYPE
from sl_reconstruct.model.rig import Rig

Array = NDArray[np.float64]

#: Gray code alone: I1-I8, 256 divisions of 4 DMD columns.
GRAY_BITS, DIVISION_PX = 8, 4
NEWTON_STEPS = 6


def naive(rig: Rig, stack: NDArray[Any]) -> NDArray[Any]:
    """Decode a `paper` stack to one point per division border and row.

    Parameters
    ----------
    rig : Rig
        Camera and projector.
    stack : ndarray, (N, H, W)
        Images of the sequence `paper`; only I1 to I8 are used.

    Returns
    -------
    ndarray, (H, 255), structured
        A point per division border and row, at the border of two pixels.
    """
    gray = stack[:GRAY_BITS]
    high, low = gray.max(axis=0), gray.min(axis=0)
    lit = high.astype(int) - low > 30
    threshold = 0.5 * (high.astype(np.float32) + low)
    number = np.zeros(lit.shape, dtype=np.int64)
    bit = np.zeros(lit.shape, dtype=np.int64)
    for image in gray:
        bit ^= image > threshold
        number = 2 * number + bit
    edge = (np.abs(np.diff(number, axis=1)) == 1) & lit[:, 1:] & lit[:, :-1]
    row, column = np.nonzero(edge)
    border = np.maximum(number[row, column], number[row, column + 1])
    points = np.full((len(number), 2**GRAY_BITS - 1), np.nan, dtype=CLOUD_DTYPE)
    xyz = _meet(rig, np.stack([column + 0.5, row], axis=1), DIVISION_PX * border - 0.5)
    for index, axis in enumerate("xyz"):
        points[axis][row, border - 1] = xyz[:, index]
    return points


def _meet(rig: Rig, q_px: Array, u_px: Array) -> Array:
    """Points (n, 3) where camera rays meet projector columns, by Newton's method along the ray."""
    rays, origin = rig.camera.rays(q_px), rig.camera.position_m
    depth, step = np.full(len(q_px), float(np.linalg.norm(origin))), 1e-6

    def miss(t: Array) -> Array:
        return np.asarray(rig.projector.project(origin + t[:, None] * rays)[:, 0] - u_px)

    for _ in range(NEWTON_STEPS):
        error = miss(depth)
        depth = depth - error * step / (miss(depth + step) - error)
    return np.asarray(origin + depth[:, None] * rays)
