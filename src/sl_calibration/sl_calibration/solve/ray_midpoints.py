"""Where camera and projector rays come nearest to each other, and by how much they miss."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sl_reconstruct.model.rig import Rig

Array = NDArray[np.float64]


def triangulate(rig: Rig, camera_px: Array, dmd_px: Array) -> tuple[Array, Array]:
    """Triangulate points of which camera pixel, DMD column and DMD row are known.

    Parameters
    ----------
    rig : Rig
        Camera and projector.
    camera_px, dmd_px : ndarray, (N, 2)
        Camera pixels (u, v), and DMD coordinates (column, row) there.

    Returns
    -------
    points_m : ndarray, (N, 3)
        Middles of the shortest lines between both rays, metres.
    gaps_m : ndarray, (N,)
        Lengths of these lines, metres.
    """
    a, b = rig.camera.rays(camera_px), rig.projector.rays(dmd_px)
    base = rig.projector.position_m - rig.camera.position_m
    aa, ab, bb = (np.sum(p * q, axis=1) for p, q in ((a, a), (a, b), (b, b)))
    ac, bc = a @ base, b @ base
    scale = aa * bb - ab * ab
    near_a = (ac * bb - ab * bc) / scale
    near_b = (ab * ac - aa * bc) / scale
    first = rig.camera.position_m + near_a[:, np.newaxis] * a
    second = rig.projector.position_m + near_b[:, np.newaxis] * b
    return 0.5 * (first + second), np.linalg.norm(first - second, axis=1)
