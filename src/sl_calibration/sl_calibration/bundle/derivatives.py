"""Projection and ray-plane intersection with their analytic derivatives.

A device has eleven parameters, in this order: fx, fy, Cu, Cv, kappa, three rotations (radians
about the device's axes, ``R <- exp([w]x) R``), three translations (metres). The lens is the
paper's, Eq. (1): with d = Q_d - C and s = Q_u - C, ``s = d (1 + kappa d.d)``; hence ds/dd = M =
``(1 + kappa d.d) I + 2 kappa d d^T``, and the observed point's derivatives are those of s with
M^-1 before them, which needs no derivative of the root that `Division.distort` finds.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_common.errors import CalibrationError
from sl_reconstruct.model.rig import Device, Division

Array = NDArray[np.float64]

#: Columns of a device's derivatives.
PARAMETERS = 11
FOCAL, CENTRE, KAPPA = slice(0, 2), slice(2, 4), 4
ROTATION, TRANSLATION = slice(5, 8), slice(8, 11)


class Projection(NamedTuple):
    """Pixels (N, 2), their derivatives by the device (N, 2, 11) and by the point (N, 2, 3)."""

    pixels: Array
    by_device: Array
    by_point: Array


class Hit(NamedTuple):
    """World points (N, 3) on a plane, and their derivatives.

    ``by_device`` (N, 3, 11); ``by_height`` (N, 3), by h in n.X = h; a change dn of the normal
    moves the point by ``-by_height * (dn . X)``.
    """

    points_m: Array
    by_device: Array
    by_height: Array


def kappa_of(device: Device) -> float:
    """Distortion factor of a device with the paper's lens, px^-2.

    Raises
    ------
    CalibrationError
        When the device has another lens.
    """
    if not isinstance(device.lens, Division):
        raise CalibrationError(
            f"the lens is a {type(device.lens).__name__}; expected the paper's model (division)"
        )
    return device.lens.kappa


def _cross_matrix(v: Array) -> Array:
    """Matrices [v]x (..., 3, 3) with ``[v]x w = v x w``."""
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    rows = [[o, -z, y], [z, o, -x], [-y, x, o]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def moved(device: Device, step: Array) -> Device:
    """Add a step to a device's parameters.

    Parameters
    ----------
    device : Device
        With the paper's lens.
    step : ndarray, (11,)
        In the order that the module's docstring states.

    Raises
    ------
    CalibrationError
        When the step leads to a device that cannot be, such as one of negative focal length.
    """
    turn = cv2.Rodrigues(np.ascontiguousarray(step[ROTATION]))[0]
    left, _, right = np.linalg.svd(turn @ device.rotation)
    fx, fy = device.focal_px + step[FOCAL]
    u, v = device.centre_px + step[CENTRE]
    return replace(
        device,
        focal_length_px=(float(fx), float(fy)),
        image_centre_px=(float(u), float(v)),
        rotation=left @ right,
        translation_m=device.translation_m + step[TRANSLATION],
        lens=Division(kappa_of(device) + float(step[KAPPA])),
    )


def _lens_matrix(offset_px: Array, kappa: float) -> Array:
    """M = ds/dd (N, 2, 2) of observed offsets d (N, 2)."""
    x, y = offset_px.T
    r2 = x * x + y * y
    mixed = 2 * kappa * x * y
    matrix = np.array(
        [[1 + kappa * (r2 + 2 * x * x), mixed], [mixed, 1 + kappa * (r2 + 2 * y * y)]]
    )
    return np.asarray(np.moveaxis(matrix, 2, 0))


def _inverse(matrix: Array) -> Array:
    """Inverses of symmetric matrices (N, 2, 2)."""
    a, b, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    adjugate = np.array([[d, -b], [-b, a]]) / (a * d - b * b)
    return np.moveaxis(adjugate, 2, 0)


def project(device: Device, points_m: Array) -> Projection:
    """Observed pixels of world points with derivatives; NaN behind the device.

    Parameters
    ----------
    device : Device
        With the paper's lens.
    points_m : ndarray, (N, 3)
        World points, metres.
    """
    kappa = kappa_of(device)
    pixels = device.project(points_m)
    offset = pixels - device.centre_px
    inverse = _inverse(_lens_matrix(offset, kappa))
    turned = points_m @ device.rotation.T
    local = turned + device.translation_m
    slope = local[:, :2] / local[:, 2:]
    by_local = np.zeros((len(points_m), 2, 3))
    by_local[:, [0, 1], [0, 1]] = device.focal_px / local[:, 2:]
    by_local[:, :, 2] = -device.focal_px * slope / local[:, 2:]
    ideal = np.zeros((len(points_m), 2, PARAMETERS))
    ideal[:, [0, 1], [0, 1]] = slope
    ideal[:, :, KAPPA] = -offset * np.sum(offset**2, axis=1, keepdims=True)
    ideal[:, :, ROTATION] = np.cross(turned[:, np.newaxis], by_local)
    ideal[:, :, TRANSLATION] = by_local
    by_device = inverse @ ideal
    by_device[:, :, CENTRE] = np.eye(2)
    return Projection(pixels, by_device, inverse @ by_local @ device.rotation)


def meet(device: Device, pixels: Array, normal: Array, height_m: Array) -> Array:
    """World points (N, 3) where rays meet planes, without derivatives.

    Parameters
    ----------
    device, pixels, normal, height_m
        As in `intersect`; any lens.
    """
    origin, rays = device.position_m, device.rays(pixels)
    return np.asarray(origin + rays * ((height_m - normal @ origin) / (rays @ normal))[:, None])


def intersect(device: Device, pixels: Array, normal: Array, height_m: Array) -> Hit:
    """World points where the rays of observed pixels meet planes n.X = h, with derivatives.

    Parameters
    ----------
    device : Device
        The calibrated camera, with the paper's lens.
    pixels : ndarray, (N, 2)
        Observed pixels.
    normal : ndarray, (3,)
        Normal n of the planes, of any length.
    height_m : ndarray, (N,)
        h of each pixel's plane, metres times the normal's length.
    """
    offset = pixels - device.centre_px
    r2 = np.sum(offset**2, axis=1, keepdims=True)
    kappa = kappa_of(device)
    slope = offset * (1 + kappa * r2) / device.focal_px
    ray = np.concatenate([slope, np.ones((len(pixels), 1))], axis=1)
    local_normal = device.rotation @ normal
    facing = (ray @ local_normal)[:, np.newaxis]
    depth = (height_m + local_normal @ device.translation_m)[:, np.newaxis] / facing
    arm = depth * ray - device.translation_m
    by_ray = np.zeros((len(pixels), 3, PARAMETERS))
    by_ray[:, [0, 1], [0, 1]] = -slope / device.focal_px
    by_ray[:, :2, CENTRE] = -_lens_matrix(offset, kappa) / device.focal_px[:, np.newaxis]
    by_ray[:, :2, KAPPA] = offset * r2 / device.focal_px
    # d(depth): through the ray, through the turn of the plane as the device sees it, through T
    by_depth = -depth * np.einsum("i,nij->nj", local_normal, by_ray)
    by_depth[:, ROTATION] = -np.cross(local_normal, arm)
    by_depth[:, TRANSLATION] = local_normal
    by_depth /= facing
    local = by_depth[:, np.newaxis, :] * ray[:, :, np.newaxis]
    local += depth[:, :, np.newaxis] * by_ray
    local[:, :, ROTATION] += _cross_matrix(arm)
    local[:, :, TRANSLATION] -= np.eye(3)
    return Hit(arm @ device.rotation, device.rotation.T @ local, ray / facing @ device.rotation)
