"""Small worlds for the tests of the bench: a window of the reference rig's camera."""

import numpy as np

from sl_bench.world.optics import Optics
from sl_bench.world.surfaces import make_surface
from sl_bench.world.world import World
from support.scenes.rigs import MIDDLE, rotation, small_rig

NOMINAL_S = 1.0 / 30.0
#: No falloff of light over the field, no ambient light: what closed forms assume.
PLAIN = Optics(uneven_light=0.0, vignetting=0.0, ambient=0.0)


def small_world(name: str = "flat", optics: Optics = PLAIN, window=MIDDLE, finish="matt", **params):
    return World(small_rig(window), make_surface(name, **params), optics, finish)


def pixel_grid(world: World, step: int = 7) -> np.ndarray:
    """Sub-pixels (N, 2) over the whole image."""
    width, height = world.rig.camera.image_size
    u, v = np.meshgrid(np.arange(0.3, width - 1, step), np.arange(0.7, height - 1, step))
    return np.stack([u.ravel(), v.ravel()], axis=1)


def tilt(x_deg: float, y_deg: float) -> np.ndarray:
    """Rotation about x, then about y."""
    a, b = np.deg2rad([x_deg, y_deg])
    return rotation(0.0, b, 0.0) @ rotation(a, 0.0, 0.0)
