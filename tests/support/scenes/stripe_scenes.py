"""Stripes on planes, rendered from closed forms: an edge is a Gaussian's distribution function.

Shares no code with the bench nor with the decoder: ray meets plane, the plane's point is projected
into the DMD, and every edge of a pattern adds ``Phi((x_k - x) / s)`` along the camera row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence
from sl_reconstruct.model.rig import Rig

#: White, ambient part, read noise and electrons per DN of the reference bench (design.md).
WHITE_DN, AMBIENT, READ_DN, E_PER_DN = 190.0, 0.03, 0.5, 20000 / 255
BLUR_PX = 1.14


@dataclass
class Plane:
    """The plane z = offset + slope_x x + slope_y y, seen by a rig."""

    rig: Rig
    offset_m: float = 0.0
    slope_x: float = 0.0
    slope_y: float = 0.0

    def points_m(self, q_px: np.ndarray) -> np.ndarray:
        """World points of camera pixels (..., 2)."""
        camera = self.rig.camera
        o, d = camera.position_m, camera.rays(q_px)
        above = self.offset_m + self.slope_x * o[0] + self.slope_y * o[1] - o[2]
        t = above / (d[..., 2] - self.slope_x * d[..., 0] - self.slope_y * d[..., 1])
        return o + t[..., None] * d

    def dmd_px(self, q_px: np.ndarray) -> np.ndarray:
        """DMD coordinates of camera pixels (..., 2)."""
        return self.rig.projector.project(self.points_m(q_px))

    def grid(self) -> np.ndarray:
        """DMD coordinates of all pixels, (H, W, 2)."""
        width, height = self.rig.camera.image_size
        u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
        return self.dmd_px(np.stack([u, v], axis=-1))

    def edges_px(self, columns: int) -> np.ndarray:
        """True camera column of every boundary, (H, K); NaN outside the image."""
        width, height = self.rig.camera.image_size
        k = np.arange(columns) - 0.5
        out = np.empty((height, columns))
        for y, u_row in enumerate(self.grid()[..., 0]):
            forward = u_row[-1] > u_row[0]
            x = np.arange(width) if forward else np.arange(width)[::-1]
            guess = np.interp(k, np.sort(u_row), x, left=np.nan, right=np.nan)
            for _ in range(3):  # Newton: u(x) is nearly straight
                q = np.stack([guess, np.full(columns, float(y))], axis=-1)
                ahead = q + np.array([0.01, 0.0])
                slope = (self.dmd_px(ahead)[:, 0] - self.dmd_px(q)[:, 0]) / 0.01
                guess = guess - (self.dmd_px(q)[:, 0] - k) / slope
            out[y] = guess
        return out


def light(
    pattern: Pattern, size: int, coordinate: np.ndarray, blur_px: np.ndarray | float
) -> np.ndarray:
    """Part of full light at DMD coordinates, for a blur in DMD pixels."""
    profile = pattern.profile(size).astype(float)
    step = np.diff(np.concatenate([[0.0], profile, [0.0]]))
    out = np.zeros_like(coordinate)
    for k in np.flatnonzero(step):
        out += step[k] * ndtr((coordinate - (k - 0.5)) / blur_px)
    return out


def noiseless(
    scene: Plane, sequence: PatternSequence, blur_px: float = BLUR_PX,
    albedo: Callable[[np.ndarray], np.ndarray] | None = None,
) -> np.ndarray:  # fmt: skip
    """Mean DN of every image, (N, H, W) float."""
    grid = scene.grid()
    pace = {
        "column": np.abs(np.gradient(grid[..., 0], axis=1)),
        "row": np.abs(np.gradient(grid[..., 1], axis=0)),
    }
    columns, rows = sequence.dmd_size
    u, v = grid[..., 0], grid[..., 1]
    field = (u > -0.5) & (u < columns - 0.5) & (v > -0.5) & (v < rows - 0.5)
    shade = 1.0 if albedo is None else albedo(grid)
    images = []
    for p in sequence.patterns:
        c, size = (u, columns) if p.axis == "column" else (v, rows)
        part = light(p, size, c, blur_px * pace[p.axis]) * field
        images.append(WHITE_DN * shade * (AMBIENT + (1 - AMBIENT) * part))
    return np.stack(images)


def expose(mean_dn: np.ndarray, seed: int | None, full_scale: int = 255) -> np.ndarray:
    """Images with shot and read noise (none without a seed), clipped and rounded."""
    scale = full_scale / 255
    dn = mean_dn
    if seed is not None:
        rng = np.random.default_rng(seed)
        dn = rng.poisson(mean_dn * E_PER_DN) / E_PER_DN + rng.normal(0, READ_DN, mean_dn.shape)
    dtype = np.uint8 if full_scale == 255 else np.uint16
    return np.clip(np.rint(dn * scale), 0, full_scale).astype(dtype)
