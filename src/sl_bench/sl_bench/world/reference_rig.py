"""The reference rig: Tsai & Hung's set-up (Table 1), the bench's default.

Table 1's scanned matrices are not orthonormal, so the rotations are made from the angles they
stand for: the projector leans 4.3 degrees and the camera 28.3 degrees, to opposite sides, off
the normal of the reference plane, both in the x-z plane of the world.
"""

from __future__ import annotations

from dataclasses import replace

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


def _aimed(device: Device, depth_m: float) -> Device:
    """Put a device so that its middle pixel sees the world's origin at a depth."""
    middle = (np.array(device.image_size) - 1) / 2
    return replace(device, translation_m=device.rotation @ device.rays(middle) * depth_m)


def reference_rig() -> Rig:
    """Return the paper's rig with a field of 12 x 9 mm on the world's plane z = 0."""
    projector_px = PROJECTOR_FOCAL_M / PROJECTOR_PITCH_M
    projector = Device(
        PROJECTOR_SIZE,
        (projector_px, projector_px),
        PROJECTOR_CENTRE_PX,
        PROJECTOR_PITCH_M,
        looking_down(PROJECTOR_TILT_DEG),
        np.zeros(3),
        Division(PROJECTOR_KAPPA),
    )
    camera_px = CAMERA_FOCAL_M / CAMERA_PITCH_M
    camera = Device(
        CAMERA_SIZE,
        (camera_px, camera_px),
        CAMERA_CENTRE_PX,
        CAMERA_PITCH_M,
        looking_down(CAMERA_TILT_DEG),
        np.zeros(3),
        Division(CAMERA_KAPPA),
    )
    depth_m = FIELD_WIDTH_M / PROJECTOR_SIZE[0] * projector_px
    return Rig(_aimed(camera, CAMERA_DISTANCE_M), _aimed(projector, depth_m))
