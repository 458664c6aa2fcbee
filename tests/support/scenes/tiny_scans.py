"""A small rig and camera frames of a plane, rendered here from the model's equations alone.

Nothing of the bench and nothing of the reconstruction is used: camera pixel -> ray -> plane ->
DMD coordinate -> how much of the pixel's neighbourhood is lit.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.special import erf

from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence, named
from sl_reconstruct.model.rig import Device, Division, Rig

CAMERA_SIZE = (320, 120)
DMD_SIZE = (128, 96)
#: The plane z = HEIGHT_M + SLOPE x that is scanned.
HEIGHT_M, SLOPE = 2e-4, 0.03
BLUR_DMD_PX = 0.6
DARK_DN, WHITE_DN = 8.0, 190.0


def tiny_rig() -> Rig:
    """Projector straight above the world's origin, camera beside it, looking at the same place."""
    down = np.diag([1.0, -1.0, -1.0])
    a = np.deg2rad(25.0)
    tilt = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    distance = np.array([0.0, 0.0, 0.1])
    projector = Device(
        DMD_SIZE, (1000.0, 1000.0), (63.5, 47.5), 1e-5, down, distance, Division(1e-7)
    )
    camera = Device(
        CAMERA_SIZE, (2400.0, 2400.0), (159.5, 59.5), 1e-5, down @ tilt, distance, Division(2e-8)
    )
    return Rig(camera, projector)


def tiny_sequence(name: str = "precise-rows") -> PatternSequence:
    """A built-in sequence for the small DMD."""
    return named(name, DMD_SIZE)


def dmd_coordinates(rig: Rig) -> np.ndarray:
    """DMD pixel (..., 2) that lights what each camera pixel sees."""
    columns, rows = CAMERA_SIZE
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    rays = rig.camera.rays(np.stack([u, v], axis=-1).astype(float))
    origin = rig.camera.position_m
    depth = (HEIGHT_M + SLOPE * origin[0] - origin[2]) / (rays[..., 2] - SLOPE * rays[..., 0])
    return rig.projector.project(origin + depth[..., np.newaxis] * rays)


def _lit(pattern: Pattern, coordinate: np.ndarray, size: int) -> np.ndarray:
    """Part of the light, 0 to 1: the stripes blurred by a Gaussian, edge by edge."""
    profile = pattern.profile(size).astype(float)
    lit = np.full(coordinate.shape, profile[0])
    for k in np.flatnonzero(np.diff(profile)) + 1:
        step = profile[k] - profile[k - 1]
        lit += step * 0.5 * (1 + erf((coordinate - (k - 0.5)) / (np.sqrt(2) * BLUR_DMD_PX)))
    return lit


def render(sequence: PatternSequence, seed: int = 1) -> np.ndarray:
    """Frames (N, H, W), uint8: the plane under each pattern, with pixel noise of 0.5 DN."""
    rng = np.random.default_rng(seed)
    q = dmd_coordinates(tiny_rig())
    inside = ((q > -0.5) & (q < np.array(DMD_SIZE) - 0.5)).all(axis=-1)
    frames = []
    for pattern in sequence.patterns:
        axis = int(pattern.axis == "row")
        light = np.where(inside, _lit(pattern, q[..., axis], DMD_SIZE[axis]), 0.0)
        noisy = DARK_DN + (WHITE_DN - DARK_DN) * light + rng.normal(0, 0.5, light.shape)
        frames.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    return np.array(frames)


def write_images(folder: Path, frames: np.ndarray, name: str = "shot_{}.png") -> None:
    """Write frames as PNG files whose names do not sort alphabetically (no leading zeros)."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, frame in enumerate(frames):
        cv2.imwrite(str(folder / name.format(i)), frame)
