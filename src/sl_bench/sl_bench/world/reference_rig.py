"""The reference rig: Tsai & Hung's set-up (Table 1), the bench's default.

Table 1's scanned matrices are not orthonormal, so the rotations are made from the angles they
stand for: the projector leans 4.3 degrees and the camera 28.3 degrees, to opposite sides, off
the normal of the reference plane, both in the x-z plane of the world.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sl_reconstruct.model.rig import Device, Division, Rig

PROJECTOR_SIZE = (1024, 768)
PROJECTOR_PITCH_M = 13.68e-6
PROJECTOR_FOCAL_M = 95.665e-3
PROJECTOR_CENTRE_PX = (28.93, 479.42)
PROJECTOR_KAPPA = 3.76e-8
PROJECTOR_TILT_DEG = 4.3
FIELD_WIDTH_M = 12e-3

CAMERA_SIZE = (1600, 1200)
CAMERA_FOCAL_M = 192.792e-3
#: The paper does not name the camera chip; this pitch gives a field a little wider than the DMD's.
CAMERA_PITCH_M = 11.4e-6
CAMERA_CENTRE_PX = (831.0, 420.2)
CAMERA_KAPPA = 1.2e-8
CAMERA_TILT_DEG = -28.3
CAMERA_DISTANCE_M = 137.5e-3


def looking_down(tilt_deg: float) -> NDArray[np.float64]:
    """device_from_world of a device that looks down on the world's plane, (3, 3).

    Image right is world +x and image down is world -y; a positive tilt moves the device towards
    -x, leaning about the world's y axis.
    """
    a = np.deg2rad(tilt_deg)
    c, s = np.cos(a), np.sin(a)
    return np.array([[c, 0.0, s], [0.0, -1.0, 0.0], [s, 0.0, -c]])


def _aimed(
    size: tuple[int, int],
    focal_px: float,
    centre_px: tuple[float, float],
    pitch_m: float,
    tilt_deg: float,
    kappa: float,
    depth_m: float,
) -> Device:
    """Put a device so that its middle pixel sees the world's origin at the given depth."""
    rotation = looking_down(tilt_deg)
    focal = (focal_px, focal_px)
    at_origin = Device(size, focal, centre_px, pitch_m, rotation, np.zeros(3), Division(kappa))
    middle = np.array([(size[0] - 1) / 2, (size[1] - 1) / 2])
    return Device(
        size, focal, centre_px, pitch_m, rotation,
        rotation @ at_origin.rays(middle) * depth_m, Division(kappa),
    )  # fmt: skip


def reference_rig() -> Rig:
    """Return the paper's rig with a field of 12 x 9 mm on the world's plane z = 0."""
    focal_px = PROJECTOR_FOCAL_M / PROJECTOR_PITCH_M
    depth_m = FIELD_WIDTH_M / PROJECTOR_SIZE[0] * focal_px
    projector = _aimed(
        PROJECTOR_SIZE, focal_px, PROJECTOR_CENTRE_PX, PROJECTOR_PITCH_M,
        PROJECTOR_TILT_DEG, PROJECTOR_KAPPA, depth_m,
    )  # fmt: skip
    camera = _aimed(
        CAMERA_SIZE, CAMERA_FOCAL_M / CAMERA_PITCH_M, CAMERA_CENTRE_PX, CAMERA_PITCH_M,
        CAMERA_TILT_DEG, CAMERA_KAPPA, CAMERA_DISTANCE_M,
    )  # fmt: skip
    return Rig(camera, projector)
