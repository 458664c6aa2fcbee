"""Camera frames of a plane under the tiny rig, rendered from the model's equations alone.

Nothing of the bench and nothing of the reconstruction is used: camera pixel -> ray -> plane ->
DMD coordinate -> how much of the pixel's neighbourhood is lit.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from sl_projector.sequence.pattern_sequence import PatternSequence, named
from support.scenes.rigs import DMD_SIZE, tiny_rig
from support.scenes.stripe_scenes import Plane, light

#: The plane z = HEIGHT_M + SLOPE x that is scanned.
HEIGHT_M, SLOPE = 2e-4, 0.03
BLUR_DMD_PX = 0.6
DARK_DN, WHITE_DN = 8.0, 190.0


def tiny_sequence(name: str = "precise-rows") -> PatternSequence:
    """A built-in sequence for the small DMD."""
    return named(name, DMD_SIZE)


def render(sequence: PatternSequence, seed: int = 1) -> np.ndarray:
    """Frames (N, H, W), uint8: the plane under each pattern, with pixel noise of 0.5 DN."""
    rng = np.random.default_rng(seed)
    q = Plane(tiny_rig(), HEIGHT_M, SLOPE).grid()
    inside = ((q > -0.5) & (q < np.array(DMD_SIZE) - 0.5)).all(axis=-1)
    frames = []
    for pattern in sequence.patterns:
        axis = int(pattern.axis == "row")
        lit = inside * light(pattern, DMD_SIZE[axis], q[..., axis], BLUR_DMD_PX)
        noisy = DARK_DN + (WHITE_DN - DARK_DN) * lit + rng.normal(0, 0.5, lit.shape)
        frames.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    return np.array(frames)


def write_images(folder: Path, frames: np.ndarray, name: str = "shot_{}.png") -> None:
    """Write frames as PNG files whose names do not sort alphabetically (no leading zeros)."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, frame in enumerate(frames):
        cv2.imwrite(str(folder / name.format(i)), frame)
