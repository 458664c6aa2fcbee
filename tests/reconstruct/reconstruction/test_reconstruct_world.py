"""The reconstruction in the bench's world, whose truth knows nothing of it: issue 2's bounds."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sl_bench.world.optics import Optics
from sl_bench.world.surfaces import make_surface
from sl_bench.world.world import World
from sl_projector.sequence.pattern_sequence import named
from sl_reconstruct.cloud.cloud import Cloud
from sl_reconstruct.reconstruction.reconstructor import Reconstructor
from support.scenes.bench_scenes import NOMINAL_S, tilt
from support.scenes.rigs import small_rig

#: Windows of the camera (left, top, width, height) that hold what is to be measured.
WIDE, TALL = (500, 560, 640, 64), (700, 480, 300, 220)
SEQUENCES = ("paper", "precise")


def turn(deg: float) -> np.ndarray:
    c, s = np.cos(np.deg2rad(deg)), np.sin(np.deg2rad(deg))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


@cache
def measured(name: str, sequence: str, window=WIDE, turn_deg: float = 0.0) -> tuple[World, Cloud]:
    """A world at default noise, and its cloud."""
    surface, params = name, {}
    if name == "walls":
        surface, params = "steps", {"heights_m": (60e-6, 300e-6, -200e-6), "width_m": 0.7e-3}
    world = World(small_rig(window), make_surface(surface, **params), Optics())
    world.move(turn(turn_deg), np.zeros(3))
    patterns = named(sequence)
    frames = [
        world.expose([(patterns.frame(i), NOMINAL_S)], NOMINAL_S, i) for i in range(len(patterns))
    ]
    return world, Reconstructor(world.rig, patterns)(np.stack(frames))


def errors(world: World, cloud: Cloud) -> tuple[np.ndarray, np.ndarray]:
    """Error of z against what the pixel's ray truly meets, and its z-score."""
    known = np.isfinite(cloud.u_px)
    rows = np.broadcast_to(np.arange(known.shape[0], dtype=float)[:, None], known.shape)
    truth = world.truth_points(np.stack([cloud.u_px[known], rows[known]], axis=-1))
    error = cloud.points["z"][known] - truth[:, 2]
    return error, error / cloud.points["sigma"][known]


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_flat_plate(sequence: str) -> None:
    world, cloud = measured("flat", sequence)
    error, score = errors(world, cloud)
    print(f"{sequence}: z {error.std() * 1e6:.3f} um, edges {cloud.figures.bound_ratio:.3f} bound")
    assert error.std() < (0.2e-6 if sequence == "precise" else 1.0e-6)
    assert 0.9 < score.std() < 1.15
    assert abs(error.mean()) < 0.05e-6


@pytest.mark.parametrize(("sequence", "limit_deg"), [("precise", 0.01), ("paper", 0.05)])
def test_included_angle_of_the_groove(sequence: str, limit_deg: float) -> None:
    """The paper's 155.92 degrees; the planes are fitted 0.1 mm away from the kinks."""
    _, cloud = measured("groove", sequence)
    p = cloud.xyz_m[np.isfinite(cloud.points["z"])].astype(float)
    normals = []
    for side in (p[:, 0] < -1e-4, p[:, 0] > 1e-4):
        part = p[side & (np.abs(p[:, 0]) < 2.9e-3)]
        (a, b, _), *_ = np.linalg.lstsq(
            np.c_[part[:, :2], np.ones(len(part))], part[:, 2], rcond=None
        )
        normals.append(np.array([-a, -b, 1.0]) / np.sqrt(1 + a * a + b * b))
    angle = 180 - np.rad2deg(np.arccos(normals[0] @ normals[1]))
    assert angle == pytest.approx(155.92, abs=limit_deg)


@pytest.mark.parametrize("turn_deg", [0.0, 30.0, 90.0])
@pytest.mark.parametrize("name", ["walls", "coin"])
@pytest.mark.parametrize("sequence", SEQUENCES)
def test_nothing_is_far_off_beside_walls_and_shadows(
    sequence: str, name: str, turn_deg: float
) -> None:
    """No point is off by more than 20 micrometres; five in a million would be less than one."""
    window = TALL if turn_deg else WIDE
    error, _ = errors(*measured(name, sequence, window, turn_deg))
    assert error.size > 20000
    assert np.abs(error).max() < 20e-6


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_what_is_lit_and_seen_is_measured(sequence: str) -> None:
    """98 % of the truly lit edge positions of the groove, away from the window's border."""
    world, cloud = measured("groove", sequence)
    found = wanted = 0
    for y in range(4, 60, 8):
        u = world.truth_edges(np.arange(1024.0), float(y))
        inside = (u > 15) & (u < 624)
        lit = inside.copy()
        lit[inside] = world.truth_lit(np.stack([u[inside], np.full(inside.sum(), y)], axis=-1))
        wanted += lit.sum()
        found += np.isfinite(cloud.u_px[y, lit]).sum()
    assert wanted > 3000
    assert found / wanted >= 0.98


def test_a_tilted_plate_is_measured_where_it_stands() -> None:
    world = World(small_rig(TALL), make_surface("flat"), Optics())
    world.move(tilt(4.0, -6.0), np.array([0, 0, 1e-4]))
    patterns = named("precise")
    frames = [
        world.expose([(patterns.frame(i), NOMINAL_S)], NOMINAL_S, i) for i in range(len(patterns))
    ]
    error, score = errors(world, Reconstructor(world.rig, patterns)(np.stack(frames)))
    assert abs(error.mean()) < 0.02e-6 and 0.9 < score.std() < 1.15
