"""The rigs of the tests, one of each kind.

`small_rig` is a window of the reference rig's camera, `tiny_rig` a rig of its own for scans that
take milliseconds, `odd_rig` one without a round number in it.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from sl_bench.world.reference_rig import reference_rig
from sl_reconstruct.model.rig import BrownConrady, Device, Division, Lens, Rig

Window = tuple[int, int, int, int]

#: Windows (left, top, width, height) of the reference camera: all of it, about its middle, and a
#: strip of few rows.
FULL: Window = (0, 0, 1600, 1200)
MIDDLE: Window = (600, 500, 400, 200)
STRIP: Window = (450, 560, 700, 48)
#: Camera and DMD of the tiny rig.
CAMERA_SIZE, DMD_SIZE = (320, 120), (128, 96)


def small_rig(window: Window = MIDDLE) -> Rig:
    """The reference rig with a camera that reads out a window only."""
    rig = reference_rig()
    left, top, width, height = window
    u, v = rig.camera.image_centre_px
    size, centre = (width, height), (u - left, v - top)
    return replace(rig, camera=replace(rig.camera, image_size=size, image_centre_px=centre))


def tiny_rig() -> Rig:
    """Projector straight above the world's origin, camera beside it, looking at the same place."""
    down = np.diag([1.0, -1.0, -1.0])
    tilt = rotation(0.0, np.deg2rad(-25.0), 0.0)
    above = np.array([0.0, 0.0, 0.1])
    projector = Device(DMD_SIZE, (1e3, 1e3), (63.5, 47.5), 1e-5, down, above, Division(1e-7))
    camera = Device(
        CAMERA_SIZE, (2.4e3, 2.4e3), (159.5, 59.5), 1e-5, down @ tilt, above, Division(2e-8)
    )
    return Rig(camera, projector)


def odd_rig() -> Rig:
    """A rig in which every number differs from every other and none is short in decimal."""
    rig = reference_rig()
    camera = replace(
        rig.camera,
        focal_length_px=(16911.1 / 3, 16913.7 / 3),
        rotation=rotation(0.1, 0.01, -0.02) @ rig.camera.rotation,
        lens=BrownConrady((0.1 / 3, -0.2 / 3, 0.001 / 3, -0.002 / 3, 0.01 / 3)),
    )
    return Rig(camera, rig.projector)


def with_lenses(rig: Rig, camera: Lens, projector: Lens) -> Rig:
    """The same rig with other lenses."""
    return Rig(replace(rig.camera, lens=camera), replace(rig.projector, lens=projector))


def turned(device: Device, about: np.ndarray) -> Device:
    """The device turned where it stands, by a rotation (3, 3) in its own frame."""
    return replace(
        device, rotation=about @ device.rotation, translation_m=about @ device.translation_m
    )


def upside_down(camera: Device) -> Device:
    """The camera turned by 180 degrees about its axis: sees the same, upside down."""
    (width, height), (u, v) = camera.image_size, camera.image_centre_px
    centre = (width - 1 - u, height - 1 - v)
    return replace(turned(camera, np.diag([-1.0, -1.0, 1.0])), image_centre_px=centre)


def rotation(*vector_rad: float) -> np.ndarray:
    """Rotation (3, 3) about a vector, by its length."""
    return cv2.Rodrigues(np.array(vector_rad))[0]
