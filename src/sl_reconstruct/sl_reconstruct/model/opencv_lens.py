"""The lens of a device in OpenCV's five coefficients, for tools that know no other model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sl_reconstruct.model.rig import BrownConrady, Device

_GRID = 41


def plumb_bob(device: Device) -> tuple[BrownConrady, float]:
    """Return OpenCV's model of a device's lens, and how far off it is at worst.

    The paper's division model has no equivalent there, so k1, k2, k3 are fitted by least squares
    over a grid of observed pixels that spans the image (p1 = p2 = 0).

    Returns
    -------
    lens : BrownConrady
        The model; the device's own where it is one.
    worst_px : float
        Largest distance between the two models on the grid, pixels.
    """
    if isinstance(device.lens, BrownConrady):
        return device.lens, 0.0
    observed = _grid(device.image_size)
    ideal = device.lens.undistort(observed, device.focal_px, device.centre_px)
    slope = (ideal - device.centre_px) / device.focal_px
    r2 = np.sum(slope**2, axis=1)
    scale = float(r2.max())
    # q_d - C = f slope (1 + k1 r^2 + k2 r^4 + k3 r^6): linear in the k. r is scaled to 1 at the
    # farthest corner, because r^6 of a tele lens would not stand beside r^2 in double precision.
    columns = [
        (device.focal_px * slope * (r2 / scale)[:, np.newaxis] ** n).ravel() for n in (1, 2, 3)
    ]
    offset = (observed - device.centre_px - device.focal_px * slope).ravel()
    k = np.linalg.lstsq(np.stack(columns, axis=1), offset, rcond=None)[0]
    k1, k2, k3 = (float(k[n - 1]) / scale**n for n in (1, 2, 3))
    lens = BrownConrady((k1, k2, 0.0, 0.0, k3))
    fitted = lens.distort(ideal, device.focal_px, device.centre_px)
    return lens, float(np.linalg.norm(fitted - observed, axis=1).max())


def _grid(size: tuple[int, int]) -> NDArray[np.float64]:
    """Observed pixels that span the image, (n, 2)."""
    u, v = (np.linspace(-0.5, side - 0.5, _GRID) for side in size)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
