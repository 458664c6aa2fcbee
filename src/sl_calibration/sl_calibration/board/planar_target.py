"""Devices from a flat target in free poses, OpenCV's way: the lens model of Brown and Conrady.

For rigs without a stage: a board or dot plate in three or more different poses. The paper's model
and the stage's knowledge are in `sl_calibration.solve.solution`; here OpenCV does the work.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_calibration.solve.linear_step import Sensor
from sl_common.errors import CalibrationError
from sl_reconstruct.model.rig import BrownConrady, Device, Rig

Array = NDArray[np.float64]

MIN_VIEWS = 3
MIN_POINTS = 6
#: OpenCV's flags by the number of a lens's coefficients: none; k1, k2; with p1, p2; with k3.
_FIX_K12 = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2
LENSES = {
    0: _FIX_K12 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
    2: cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
    4: cv2.CALIB_FIX_K3,
    5: 0,
}
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-10)
_NAMES = [f"{name}.{i}" for name in ("focal_length_px", "image_centre_px") for i in (0, 1)]
_NAMES += ["k1", "k2", "p1", "p2", "k3"]


@dataclass(frozen=True)
class FreeSolution:
    """A device from free poses.

    Parameters
    ----------
    device : Device
        World and device frame are one.
    rms_px : float
        Root mean square of the residual vectors' lengths, as OpenCV states it.
    view_rms_px : ndarray, (V,)
        The same of each view.
    sigmas : dict
        1-sigma of fx, fy, image centre and coefficients, by name, from the residuals.
    """

    device: Device
    rms_px: float
    view_rms_px: Array
    sigmas: dict[str, float]


@dataclass(frozen=True)
class FreePair:
    """Camera and projector from free poses.

    Parameters
    ----------
    camera, projector : FreeSolution
        Each on its own.
    rig : Rig
        Both in the camera's frame.
    rms_px : float
        Root mean square of both devices' residuals with one pose for both.
    """

    camera: FreeSolution
    projector: FreeSolution
    rig: Rig
    rms_px: float


def solve_free(
    points_m: Sequence[Array], pixels: Sequence[Array], sensor: Sensor, coefficients: int = 2
) -> FreeSolution:
    """Calibrate one device on a flat target in free poses.

    Parameters
    ----------
    points_m : sequence of ndarray, (N, 2)
        Points on the target, metres, one array a view.
    pixels : sequence of ndarray, (N, 2)
        Their images.
    sensor : Sensor
        Image size and pixel pitch.
    coefficients : {0, 2, 4, 5}
        Of the lens: none; k1, k2; with p1, p2; with k3.

    Raises
    ------
    CalibrationError
        When there are too few views or points, or OpenCV finds no solution.
    """
    flags = _flags(coefficients)
    points = (*_checked(points_m, pixels), sensor.image_size, None, None)
    found = _opencv(cv2.calibrateCameraExtended, *points, flags=flags, criteria=_STOP)
    rms_px, matrix, distortion, _, _, sigma, _, per_view = found
    device = _device(matrix, distortion, sensor)
    sigmas = dict(zip(_NAMES, map(float, np.ravel(sigma)), strict=False))
    return FreeSolution(device, float(rms_px), np.ravel(per_view).astype(np.float64), sigmas)


def solve_free_pair(
    points_m: Sequence[Array],
    camera_px: Sequence[Array],
    projector_px: Sequence[Array],
    sensors: tuple[Sensor, Sensor],
    coefficients: int = 2,
) -> FreePair:
    """Calibrate a camera and a projector whose DMD coordinates were decoded at the same points.

    Parameters
    ----------
    points_m, camera_px, projector_px : sequence of ndarray, (N, 2)
        Points on the target in metres, their camera pixels and their DMD coordinates.
    sensors : tuple of Sensor
        Camera's and projector's.
    coefficients : {0, 2, 4, 5}
        Of each lens, as in `solve_free`.

    Raises
    ------
    CalibrationError
        As `solve_free`.
    """
    camera = solve_free(points_m, camera_px, sensors[0], coefficients)
    projector = solve_free(points_m, projector_px, sensors[1], coefficients)
    flat, seen = _checked(points_m, camera_px)
    _, lit = _checked(points_m, projector_px)
    lenses = (*opencv_lens(camera.device), *opencv_lens(projector.device), sensors[0].image_size)
    flags = _flags(coefficients) | cv2.CALIB_USE_INTRINSIC_GUESS
    points = (flat, seen, lit)
    found = _opencv(cv2.stereoCalibrate, *points, *lenses, flags=flags, criteria=_STOP)
    rms_px, k1, d1, k2, d2, rotation, translation, *_ = found
    projected = _device(k2, d2, sensors[1])
    projected = replace(projected, rotation=rotation, translation_m=np.ravel(translation))
    return FreePair(camera, projector, Rig(_device(k1, d1, sensors[0]), projected), float(rms_px))


def _flags(coefficients: int) -> int:
    if coefficients not in LENSES:
        raise CalibrationError(f"coefficients={coefficients}; expected one of {list(LENSES)}")
    return int(LENSES[coefficients])


def _checked(
    points_m: Sequence[Array], pixels: Sequence[Array]
) -> tuple[list[NDArray[np.float32]], list[NDArray[np.float32]]]:
    """Points with z = 0 and pixels, as OpenCV wants them."""
    shapes = [(np.shape(p), np.shape(q)) for p, q in zip(points_m, pixels, strict=False)]
    if len(points_m) != len(pixels) or any(p != q or p[1:] != (2,) for p, q in shapes):
        raise CalibrationError(f"points and pixels have the shapes {shapes}; expected (N, 2) twice")
    if len(shapes) < MIN_VIEWS or min(p[0] for p, _ in shapes) < MIN_POINTS:
        raise CalibrationError(
            f"{[p[0] for p, _ in shapes]} points in {len(shapes)} views; expected at least "
            f"{MIN_POINTS} in each of {MIN_VIEWS} views of the target in different poses"
        )
    flat = [np.pad(np.asarray(p), ((0, 0), (0, 1))).astype(np.float32) for p in points_m]
    return flat, [np.asarray(q).astype(np.float32) for q in pixels]


def _opencv(function: Any, *arguments: Any, **options: Any) -> Any:
    try:
        found = function(*arguments, **options)
    except cv2.error as error:
        raise CalibrationError(
            f"OpenCV finds no solution ({str(error).strip().splitlines()[-1]}); expected a flat "
            "target in different poses"
        ) from None
    if not np.isfinite(found[0]):
        raise CalibrationError("OpenCV's solution is not finite; expected different poses")
    return found


def opencv_lens(device: Device) -> tuple[Array, Array]:
    """Camera matrix (3, 3) and distortion (5,) of a device with OpenCV's lens."""
    assert isinstance(device.lens, BrownConrady)
    return device.camera_matrix, np.array(device.lens.coefficients)


def _device(matrix: Array, distortion: Array, sensor: Sensor) -> Device:
    """Device in a frame of its own."""
    k1, k2, p1, p2, k3 = (float(c) for c in np.ravel(distortion)[:5])
    (fx, _, cu), (_, fy, cv), _ = matrix.tolist()
    lens = BrownConrady((k1, k2, p1, p2, k3))
    size, pitch_m = sensor
    return Device(size, (fx, fy), (cu, cv), pitch_m, np.eye(3), np.zeros(3), lens)
