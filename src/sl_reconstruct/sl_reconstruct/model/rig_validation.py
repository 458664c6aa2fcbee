"""Whether a rig's numbers can belong to a real rig: catches metres for millimetres.

The limits are wide - from a microscope to a room - and a factor of a thousand does not fit
through any of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import CalibrationError, SlError
from sl_reconstruct.model.rig import ORTHONORMAL_TOLERANCE, Device, Division, Rig

Array = NDArray[np.float64]

PIXEL_PITCH_M = (3e-7, 2e-4)
#: Focal length over image width: a fish-eye's to a telescope's.
FOCAL_WIDTHS = (0.2, 300.0)
#: Image centre off the image's middle, in image widths (lens shift included).
MAX_CENTRE_WIDTHS = 10.0
MAX_DISTANCE_M = 20.0
BASELINE_M = (1e-3, 20.0)
#: Image points moved by the lens, as a part of the image's diagonal.
MAX_LENS_PART = 0.25
#: Depth at which the two middle rays come nearest to each other.
WORKING_DISTANCE_M = (5e-3, 20.0)
MIN_CONVERGENCE_RAD = np.deg2rad(1.0)
#: A rotation typed by hand with four digits is off orthonormal by no more than this; it is taken
#: to the nearest rotation. Anything worse is a mistake (the scan of the paper's Table 1: 0.02).
TYPED_ROTATION_TOLERANCE = 1e-4


def nearest_rotation(matrix: Array, where: str, error: type[SlError] = CalibrationError) -> Array:
    """Return the rotation that a nearly orthonormal (3, 3) matrix stands for.

    What is orthonormal as `Device` demands is returned untouched, so that files keep their bits;
    up to `TYPED_ROTATION_TOLERANCE` the nearest rotation (polar decomposition) is returned.

    Parameters
    ----------
    matrix : ndarray, (3, 3)
        As written, perhaps rounded.
    where : str
        Its place, for messages.
    error : type
        What is raised when it is no rotation.
    """
    deviation = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if deviation <= ORTHONORMAL_TOLERANCE and np.linalg.det(matrix) > 0:
        return matrix
    if deviation > TYPED_ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
        raise error(
            f"{where} is off orthonormal by {deviation:.2g} (det {np.linalg.det(matrix):+.3f}); "
            f"expected a rotation within {TYPED_ROTATION_TOLERANCE:g}"
        )
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def check_rig(rig: Rig, source: str) -> None:
    """Refuse a rig whose numbers cannot belong to a real one.

    Parameters
    ----------
    rig : Rig
        Camera and projector.
    source : str
        Where it comes from, for the message.

    Raises
    ------
    CalibrationError
        Naming the number, and the range in which it was expected.
    """
    for name, device in (("camera", rig.camera), ("projector", rig.projector)):
        _check_device(device, f"{source}.{name}")
    baseline_m = float(np.linalg.norm(rig.camera.position_m - rig.projector.position_m))
    _check_range(
        f"{source}: distance between camera and projector",
        baseline_m,
        BASELINE_M,
        "metres; are the translations in metres?",
    )
    _check_working_distance(rig, source)


def _check_range(what: str, value: float, limits: tuple[float, float], unit: str) -> None:
    if not limits[0] <= value <= limits[1]:
        raise CalibrationError(
            f"{what} is {value:.6g}; expected {limits[0]:g} to {limits[1]:g} {unit}"
        )


def _check_device(device: Device, where: str) -> None:
    _check_range(f"{where}.pixel_pitch_m", device.pixel_pitch_m, PIXEL_PITCH_M, "metres")
    width = device.image_size[0]
    for focal_px in device.focal_length_px:
        _check_range(
            f"{where}.focal_length_px",
            focal_px,
            (FOCAL_WIDTHS[0] * width, FOCAL_WIDTHS[1] * width),
            "pixels",
        )
    middle = np.array(device.image_size) / 2
    off_px = float(np.linalg.norm(device.centre_px - middle))
    if off_px > MAX_CENTRE_WIDTHS * width:
        raise CalibrationError(
            f"{where}.image_centre_px is {off_px:.0f} px off the image's middle; expected below "
            f"{MAX_CENTRE_WIDTHS * width:.0f} px"
        )
    distance_m = float(np.linalg.norm(device.translation_m))
    if distance_m > MAX_DISTANCE_M:
        raise CalibrationError(
            f"{where}.translation_m is {distance_m:.6g} long; expected at most "
            f"{MAX_DISTANCE_M:g} metres (is it in millimetres?)"
        )
    _check_lens(device, where)


def _check_lens(device: Device, where: str) -> None:
    """The lens moves the image's border by a small part of the image, and never folds it."""
    border = _border(device.image_size)
    with np.errstate(all="ignore"):
        ideal = device.lens.undistort(border, device.focal_px, device.centre_px)
        back = device.lens.distort(ideal, device.focal_px, device.centre_px)
    moved_px = np.linalg.norm(ideal - border, axis=-1).max()
    limit_px = MAX_LENS_PART * np.hypot(*device.image_size)
    unit = "kappa is in px^-2" if isinstance(device.lens, Division) else "OpenCV's coefficients"
    if not moved_px <= limit_px:
        raise CalibrationError(
            f"{where}: the lens moves the image's border by {moved_px:.4g} px; expected below "
            f"{limit_px:.0f} px ({unit})"
        )
    if not np.abs(back - border).max() < 0.01:
        raise CalibrationError(
            f"{where}: the lens model folds the image inside its border; expected one image point "
            f"for each direction ({unit})"
        )


def _border(size: tuple[int, int]) -> Array:
    u, v = np.linspace(-0.5, size[0] - 0.5, 9), np.linspace(-0.5, size[1] - 0.5, 9)
    grid = np.stack(np.meshgrid(u, v), axis=-1)
    return np.concatenate([grid[0], grid[-1], grid[:, 0], grid[:, -1]])


def _check_working_distance(rig: Rig, source: str) -> None:
    """The devices look at the same place, in front of both, at a distance that can be."""
    middles = [np.array(d.image_size) / 2 - 0.5 for d in (rig.camera, rig.projector)]
    a, b = rig.camera.rays(middles[0]), rig.projector.rays(middles[1])
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    if np.linalg.norm(np.cross(a, b)) < np.sin(MIN_CONVERGENCE_RAD):
        return  # parallel axes: they meet nowhere, and need not
    baseline = rig.projector.position_m - rig.camera.position_m
    distances_m, *_ = np.linalg.lstsq(np.stack([a, -b], axis=1), baseline, rcond=None)
    if distances_m.min() <= 0:
        raise CalibrationError(
            f"{source}: camera and projector look away from each other (their middle rays come "
            f"nearest {distances_m[0]:.4g} m before the camera, {distances_m[1]:.4g} m before the "
            "projector); expected a common field in front of both"
        )
    for name, distance_m in zip(("camera", "projector"), distances_m, strict=True):
        _check_range(
            f"{source}: working distance of the {name}",
            distance_m,
            WORKING_DISTANCE_M,
            "metres; are the translations in metres?",
        )
