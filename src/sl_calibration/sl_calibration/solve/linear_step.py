"""The paper's linear step (Fig. 4a): R, T, f and kappa for a given image centre.

Tsai's radial alignment constraint on non-coplanar points: the image point, seen from the image
centre, lies in the direction of the point's lateral position in the device, whatever focal
length and radial distortion are. That gives R, t_x, t_y; then f, t_z and kappa are linear.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import CalibrationError
from sl_reconstruct.model.rig import Device, Division

Array = NDArray[np.float64]

#: kappa multiplies the depth, which holds t_z: solved with the last depth, a few times over.
_ROUNDS = 5


class Sensor(NamedTuple):
    """What is known of a device: (width, height) in pixels, pixel pitch in metres."""

    image_size: tuple[int, int]
    pixel_pitch_m: float


def linear_step(points_m: Array, pixels: Array, centre_px: Array, sensor: Sensor) -> Device:
    """Solve a device for a given image centre; the division model, square pixels.

    Parameters
    ----------
    points_m : ndarray, (N, 3)
        World points, metres; not all in one plane.
    pixels : ndarray, (N, 2)
        Their observed images, pixels.
    centre_px : ndarray, (2,)
        Image centre C; may lie anywhere.
    sensor : Sensor
        Image size and pixel pitch.

    Raises
    ------
    CalibrationError
        When no device in front of the points fits, as with coplanar points.
    """
    middle = points_m.mean(axis=0)
    offset = pixels - centre_px
    rotation, lateral = _alignment(points_m - middle, offset)
    focal_px, depth_m, kappa = _focal(points_m - middle, offset, rotation, lateral)
    if not (focal_px > 0 and depth_m > 0):
        raise CalibrationError(
            f"the linear step gives f = {focal_px:.4g} px at t_z = {depth_m:.4g} m; expected both "
            "positive: do the points lie in one plane, or is the sign of the heights wrong?"
        )
    translation = np.array([*lateral, depth_m]) - rotation @ middle
    u, v = map(float, centre_px)
    return Device(
        sensor.image_size,
        (focal_px, focal_px),
        (u, v),
        sensor.pixel_pitch_m,
        rotation,
        translation,
        Division(kappa),
    )


def _alignment(points: Array, offset: Array) -> tuple[Array, Array]:
    """R and (t_x, t_y) from ``X_d (r2.P + t_y) = Y_d (r1.P + t_x)``, points about their middle.

    Homogeneous in all eight unknowns, since t_y, by which Tsai divides, may be zero. Rows are
    divided by |Q_d|, which makes their noise the same everywhere.
    """
    scale = np.sqrt(np.mean(points**2))
    weight = 1.0 / np.maximum(np.hypot(*offset.T), 1.0)[:, np.newaxis]
    columns = np.concatenate([points / scale, np.ones((len(points), 1))], axis=1) * weight
    rows = np.concatenate([-offset[:, 1:] * columns, offset[:, :1] * columns], axis=1)
    solution = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(2, 4)
    left, size, right = np.linalg.svd(solution[:, :3])
    if not size[1] > 1e-9:
        raise CalibrationError("the radial alignment has no solution; expected points in space")
    r12 = left @ right[:2]
    lateral = solution[:, 3] * scale / size.mean()
    # the sign: a point is imaged on the side on which it lies
    sides = np.sum(offset * (points @ r12.T + lateral))
    sign = 1.0 if sides > 0 else -1.0
    rotation = np.stack([sign * r12[0], sign * r12[1], np.cross(r12[0], r12[1])])
    return rotation, _lateral(points, offset, rotation, weight)


def _lateral(points: Array, offset: Array, rotation: Array, weight: Array) -> Array:
    """(t_x, t_y) again, for the rotation that was made orthonormal."""
    x, y = (points @ rotation[:2].T).T
    rows = np.stack([-offset[:, 1], offset[:, 0]], axis=1) * weight
    right = (offset[:, 1] * x - offset[:, 0] * y) * weight[:, 0]
    return np.asarray(np.linalg.lstsq(rows, right, rcond=None)[0])


def _focal(
    points: Array, offset: Array, rotation: Array, lateral: Array
) -> tuple[float, float, float]:
    """f, t_z and kappa from ``Q_d (1 + kappa r^2)(r3.P + t_z) = f (r1.P + t_x, r2.P + t_y)``."""
    side = points @ rotation[:2].T + lateral
    rise = (points @ rotation[2])[:, np.newaxis]
    r2 = np.sum(offset**2, axis=1, keepdims=True)
    size = r2.max()
    depth_m, kappa, focal = 0.0, 0.0, 0.0
    for turn in range(_ROUNDS):
        columns = [side, -offset, -offset * (r2 / size) * (rise + depth_m)][: 2 + (turn > 0)]
        rows = np.stack([column.ravel() for column in columns], axis=1)
        right = (offset * rise).ravel()
        focal, depth_m, *rest = np.linalg.lstsq(rows, right, rcond=None)[0]
        kappa = rest[0] / size if rest else 0.0
    return float(focal), float(depth_m), float(kappa)


def cost_px2(device: Device, points_m: Array, pixels: Array) -> float:
    """Return the paper's J: sum of squared distances of observed and mapped-back points, px^2.

    Parameters
    ----------
    device : Device
        Maps the points back.
    points_m, pixels : ndarray, (N, 3) and (N, 2)
        World points, metres, and where they were observed.
    """
    return float(np.sum((device.project(points_m) - pixels) ** 2))
