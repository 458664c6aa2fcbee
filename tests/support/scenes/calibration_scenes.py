"""Exact observations of the reference rig, with noise and faults added; no images."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sl_bench.world.mounting import Mounting
from sl_bench.world.reference_rig import reference_rig
from sl_calibration.data.observations import View
from sl_calibration.solve.linear_step import Sensor
from sl_reconstruct.model.rig import Device, Rig

Array = NDArray[np.float64]

RIG = reference_rig()
CAMERA = Sensor(RIG.camera.image_size, RIG.camera.pixel_pitch_m)
PROJECTOR = Sensor(RIG.projector.image_size, RIG.projector.pixel_pitch_m)
SENSORS = (CAMERA, PROJECTOR)
HEIGHTS_M = np.linspace(-1e-3, 1e-3, 5)


def grid(width_m: float, height_m: float, columns: int, rows: int) -> Array:
    """Points (N, 2) that span a field about the origin."""
    x, y = np.linspace(-0.5, 0.5, columns) * width_m, np.linspace(-0.5, 0.5, rows) * height_m
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


PLATE_XY_M = grid(10e-3, 8e-3, 10, 10)
HOLE_IDS = np.stack(np.meshgrid(range(10), range(10)), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class Scene:
    """A plate on a stage under the reference rig, in the bench's terms."""

    mounting: Mounting = field(default_factory=Mounting)
    hole_noise_px: float = 0.01
    target_noise_px: float = 0.01
    targets: tuple[int, int] = (12, 9)
    flat: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def axes(self) -> Array:
        """The stage's axes as the plate sees them."""
        return self.mounting.rotation.T @ self.mounting.axes

    @property
    def rig(self) -> Rig:
        """The true rig in the plate's world."""
        return Rig(self._placed(RIG.camera), self._placed(RIG.projector))

    def _placed(self, device: Device) -> Device:
        rotation, offset = self.mounting.pose((0.0, 0.0, 0.0))
        return replace(
            device, rotation=device.rotation @ rotation,
            translation_m=device.rotation @ offset + device.translation_m,
        )  # fmt: skip

    def holes(self, rng: np.random.Generator, stage_m: Array) -> Array:
        """Images (100, 2) of the plate's holes."""
        points = np.pad(PLATE_XY_M, ((0, 0), (0, 1))) + self.axes @ stage_m
        noise = self.hole_noise_px * rng.standard_normal((len(points), 2))
        return self.rig.camera.project(points) + noise

    def thrown(self, rng: np.random.Generator, stage_m: Array) -> tuple[Array, Array]:
        """Camera pixels (N, 2) of targets, and their DMD coordinates (N, 2)."""
        offset, slope_x, slope_y = self.flat
        xy = grid(11e-3, 8.5e-3, *self.targets)
        height = offset + xy @ [slope_x, slope_y]
        points = np.column_stack([xy, height]) + self.axes @ stage_m
        noise = self.target_noise_px * rng.standard_normal(xy.shape)
        return self.rig.camera.project(points), self.rig.projector.project(points) + noise

    def view(self, stage_m: Array, holes_px: Array, thrown: tuple[Array, Array]) -> View:
        """Make a view of what `holes` and `thrown` gave."""
        camera_px, dmd_px = thrown
        return View(
            float(stage_m[2]),
            HOLE_IDS,
            PLATE_XY_M,
            holes_px,
            np.full(len(holes_px), max(self.hole_noise_px, 1e-6)),
            camera_px,
            dmd_px,
            np.full(dmd_px.shape, max(self.target_noise_px, 1e-6)),
            edge_sigma_px=0.02,
            xy_m=(float(stage_m[0]), float(stage_m[1])),
        )

    def views(self, seed: int, stage_m: Array | None = None) -> list[View]:
        rng = np.random.default_rng(seed)
        if stage_m is None:
            stage_m = np.column_stack([np.zeros((5, 2)), HEIGHTS_M])
        holes = [self.holes(rng, s) for s in stage_m]
        thrown = [self.thrown(rng, s) for s in stage_m]
        return [self.view(*view) for view in zip(stage_m, holes, thrown, strict=True)]


def spoil(pixels: Array, part: float, size_px: float, rng: np.random.Generator) -> Array:
    """Move a part of the pixels somewhere else, in place; returns which, (N,)."""
    bad = rng.random(len(pixels)) < part
    angle = rng.uniform(0, 2 * np.pi, int(bad.sum()))
    length = size_px * rng.uniform(1, 3, int(bad.sum()))
    pixels[bad] += np.stack([np.cos(angle), np.sin(angle)], axis=1) * length[:, np.newaxis]
    return bad


def triangulate(rig: Rig, camera_px: Array, column_px: Array, start_m: Array) -> Array:
    """Points (N, 3) that camera pixels and DMD columns stand for: Newton on numeric slopes."""
    points = start_m.copy()

    def seen(p: Array) -> Array:
        return np.column_stack([rig.camera.project(p), rig.projector.project(p)[:, 0]])

    for _ in range(6):
        slopes = np.stack(
            [(seen(points + step) - seen(points - step)) / 2e-6 for step in 1e-6 * np.eye(3)],
            axis=-1,
        )
        off = np.column_stack([camera_px, column_px]) - seen(points)
        points = points + np.linalg.solve(slopes, off[..., np.newaxis])[..., 0]
    return points
