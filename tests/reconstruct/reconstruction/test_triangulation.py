"""Triangulation kernels against the rig model's projection, and closed forms of skew lines."""

from __future__ import annotations

import numpy as np
import pytest

from sl_bench.world.reference_rig import reference_rig
from sl_reconstruct.model.geometry import (
    DEPTH,
    DZ,
    PX,
    PY,
    PZ,
    camera_rays,
    geometry,
    ray_tile,
    solve_points,
    solve_slopes,
)
from sl_reconstruct.model.rig import BrownConrady, Division, Rig
from sl_reconstruct.reconstruction.four_equation import Sight, miss_m, solve_four
from support.scenes.rigs import with_lenses

LENSES = {
    "paper": (Division(1.2e-8), Division(3.76e-8)),
    "none": (Division(0.0), Division(0.0)),
    "strong": (Division(-2e-8), Division(2e-7)),
    "opencv": (
        BrownConrady((-0.25, 0.24, 1e-3, -5e-4, 0.1)),
        BrownConrady((-0.15, 0.21, -1e-3, 8e-4, 0.0)),
    ),
    "mixed": (BrownConrady((-0.25, 0.24, 1e-3, -5e-4, 0.1)), Division(3.76e-8)),
}


def rig_with(lenses: str) -> Rig:
    return with_lenses(reference_rig(), *LENSES[lenses])


def volume(n: int = 300) -> np.ndarray:
    """World points in the rig's measuring volume."""
    return np.random.default_rng(2).uniform([-5e-3, -4e-3, -1e-3], [5e-3, 4e-3, 1e-3], (n, 3))


@pytest.mark.parametrize("lenses", LENSES)
def test_three_equations_invert_the_projection(lenses: str) -> None:
    """A point projected into both devices comes back within 1e-10 m."""
    rig, points = rig_with(lenses), volume()
    q, d = rig.camera.project(points), rig.projector.project(points)
    r = ray_tile()
    for (u, v), (column, _), p in zip(q, d, points, strict=True):
        camera_rays(geometry(rig), np.array([u]), v, r)
        solve_slopes(geometry(rig), np.array([column]), r)
        solve_points(geometry(rig), 1, r)
        assert np.abs(r[[PX, PY, PZ]] - p).max() < 1e-10
        assert r[DEPTH] > 0


@pytest.mark.parametrize("lenses", LENSES)
def test_dz_du_is_the_numeric_derivative(lenses: str) -> None:
    """Within 1 %: how the lens changes along the ray is left out."""
    rig, h = rig_with(lenses), 1e-3
    g, (q, d) = geometry(rig), (rig.camera.project(volume(20)), rig.projector.project(volume(20)))
    r = ray_tile()
    for (u, v), (column, _) in zip(q, d, strict=True):
        camera_rays(g, np.array([u - h, u, u + h]), v, r)
        solve_slopes(g, np.full(3, column), r)
        solve_points(g, 3, r)
        assert r[DZ + 1] == pytest.approx((r[PZ + 2] - r[PZ]) / (2 * h), rel=1e-2)


def test_points_behind_a_device_have_no_depth() -> None:
    """A column far to the wrong side lets the rays diverge."""
    g, r = geometry(reference_rig()), ray_tile()
    camera_rays(g, np.array([800.0]), 600.0, r)
    solve_slopes(g, np.array([-9000.0]), r)
    solve_points(g, 1, r)
    assert not r[DEPTH] > 0


@pytest.mark.parametrize("lenses", LENSES)
def test_four_equations_agree_with_three_where_rays_meet(lenses: str) -> None:
    rig, points = rig_with(lenses), volume(50)
    g, out = geometry(rig), np.zeros(6)
    for p in points:
        slopes = []
        for device in (rig.camera, rig.projector):
            local = device.rotation @ p + device.translation_m
            slopes += [local[0] / local[2], local[1] / local[2]]
        assert solve_four(g, Sight(*slopes, 0.01, 0.01), out)
        assert np.abs(out[:3] - p).max() < 1e-10
        assert out[4] < 1e-12 and out[5] < 1e-6


def test_miss_of_skew_lines() -> None:
    """Lines along x and y, 3 apart along z; parallel shift along them changes nothing."""
    miss = miss_m(np.array([5.0, -7.0, 3.0]), np.array([2.0, 0, 0]), np.array([0, 4.0, 0]))
    assert miss == pytest.approx(3.0, abs=1e-12)


def test_sigma_of_four_equations_is_the_spread() -> None:
    """Monte Carlo over both coordinates' noise; 2000 draws know a spread to 1.6 % (4 sigma 7 %)."""
    rig = reference_rig()
    g, out, rng = geometry(rig), np.zeros(6), np.random.default_rng(3)
    p = np.array([1e-3, -2e-3, 2e-4])
    q, d = rig.camera.project(p), rig.projector.project(p)
    sigma_u, sigma_v, z = 0.02, 0.05, []
    for du, dv in rng.normal(0, 1, (2000, 2)) * [sigma_u, sigma_v]:
        slopes = []
        for device, point in (
            (rig.camera, q + np.array([du, 0])),
            (rig.projector, d + np.array([0, dv])),
        ):
            ray = device.rotation @ device.rays(point)
            slopes += [ray[0] / ray[2], ray[1] / ray[2]]
        solve_four(g, Sight(*slopes, sigma_u, sigma_v), out)
        z.append(out[2])
    assert np.std(z) == pytest.approx(out[3], rel=0.07)
