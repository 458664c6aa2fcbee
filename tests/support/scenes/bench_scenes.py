"""Small worlds for the tests of the bench: a window of the reference rig's camera."""

from dataclasses import replace

import numpy as np

from sl_bench.world.optics import Optics
from sl_bench.world.reference_rig import reference_rig
from sl_bench.world.surfaces import make_surface
from sl_bench.world.world import World
from sl_reconstruct.model.rig import Device, Rig

#: Window (left, top, width, height) about the middle of the reference camera's image.
WINDOW = (600, 500, 400, 200)
NOMINAL_S = 1.0 / 30.0
#: No falloff of light over the field, no ambient light: what closed forms assume.
PLAIN = Optics(uneven_light=0.0, vignetting=0.0, ambient=0.0)


def windowed(camera: Device, window: tuple[int, int, int, int] = WINDOW) -> Device:
    """The same camera, reading out a window of its image only."""
    left, top, width, height = window
    u, v = camera.image_centre_px
    return replace(camera, image_size=(width, height), image_centre_px=(u - left, v - top))


def small_rig(window: tuple[int, int, int, int] = WINDOW) -> Rig:
    rig = reference_rig()
    return Rig(windowed(rig.camera, window), rig.projector)


def small_world(name: str = "flat", optics: Optics = PLAIN, window=WINDOW, finish="matt", **params):
    return World(small_rig(window), make_surface(name, **params), optics, finish)


def pixel_grid(world: World, step: int = 7) -> np.ndarray:
    """Sub-pixels (N, 2) over the whole image."""
    width, height = world.rig.camera.image_size
    u, v = np.meshgrid(np.arange(0.3, width - 1, step), np.arange(0.7, height - 1, step))
    return np.stack([u.ravel(), v.ravel()], axis=1)


def tilt(x_deg: float, y_deg: float) -> np.ndarray:
    """Rotation about x, then about y."""
    a, b = np.deg2rad([x_deg, y_deg])
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return about_y @ about_x
