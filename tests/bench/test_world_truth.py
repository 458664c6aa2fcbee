"""Ground truth of the world against closed forms and the rig model, which it does not use."""

import numpy as np
import pytest

from sl_bench.world.surfaces import make_surface
from sl_bench.world.world import World
from sl_common.errors import ConfigError
from sl_reconstruct.model.rig import BrownConrady
from support.scenes.bench_scenes import pixel_grid, small_world, tilt
from support.scenes.rigs import FULL, MIDDLE, small_rig, with_lenses


def on_rays(world: World, q: np.ndarray, points: np.ndarray) -> None:
    """Assert that points lie on their pixels' rays, by the rig model: within 1e-6 px."""
    assert world.rig.camera.project(points) == pytest.approx(q, abs=1e-6)


def test_plane_at_a_pose_is_where_rays_meet_it():
    world = small_world(window=FULL)
    R, t = tilt(3.0, -2.0), np.array([1e-4, -2e-4, 3e-4])
    world.move(R, t)
    q = pixel_grid(world, 97)
    o, d = world.rig.camera.position_m, world.rig.camera.rays(q)
    n = R[:, 2]
    expected = o + d * ((t - o) @ n / (d @ n))[:, None]
    assert world.truth_points(q) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("name", ["groove", "steps", "sphere_cap", "coin", "hole_plate"])
def test_truth_lies_on_the_ray_and_on_the_surface(name):
    world = small_world(name, window=FULL, **({"chamfer_m": 5e-5} if name == "hole_plate" else {}))
    R, t = tilt(-1.0, 2.0), np.array([5e-5, 1e-4, -2e-4])
    world.move(R, t)
    q = pixel_grid(world, 31)
    points = world.truth_points(q)
    on_rays(world, q, points)
    # Distances have forms of their own: polylines, the sphere's centre, a search on the grid.
    in_part = (points - t) @ R
    assert world.surface.distance_m(in_part) == pytest.approx(np.zeros(len(q)), abs=1e-10)


def test_groove_truth_is_on_its_flanks():
    world = small_world("groove", window=FULL, included_angle_deg=155.92, width_m=6e-3)
    x, _, z = world.truth_points(pixel_grid(world, 31)).T
    depth = 3e-3 / np.tan(np.deg2rad(155.92 / 2))
    assert z == pytest.approx(np.minimum(np.abs(x) / 3e-3 - 1.0, 0.0) * depth, abs=1e-12)


def test_sphere_truth_is_on_the_near_side_of_the_sphere():
    world = small_world("sphere_cap", window=FULL, radius_m=50e-3, base_radius_m=4e-3)
    points = world.truth_points(pixel_grid(world, 31))
    centre = np.array([0.0, 0.0, -np.sqrt(50e-3**2 - 4e-3**2)])
    inside = np.hypot(points[:, 0], points[:, 1]) < 4e-3
    radius = np.linalg.norm(points[inside] - centre, axis=1)
    assert radius == pytest.approx(np.full(inside.sum(), 50e-3), abs=1e-12)
    assert np.all(points[inside, 2] > 0.0)
    assert points[~inside, 2] == pytest.approx(np.zeros((~inside).sum()), abs=1e-12)


def test_lens_kernels_of_both_models_agree_with_the_rig():
    rig = small_rig(FULL)
    brown = (BrownConrady((k, 2 * k, 1e-3, -5e-4, k)) for k in (-0.9, 0.8))
    for r in (rig, with_lenses(rig, *brown)):
        world = World(r, make_surface("sphere_cap"))
        q = pixel_grid(world, 53)
        on_rays(world, q, world.truth_points(q))
        k = np.array([200, 500, 800])
        u = world.truth_edges(k, 333.25)
        seen = world.truth_points(np.stack([u, np.full(3, 333.25)], axis=1))
        assert r.projector.project(seen)[:, 0] == pytest.approx(k - 0.5, abs=1e-6)


def test_edges_along_rows_and_columns_are_where_the_rig_says():
    world = small_world("groove", window=FULL)
    k = np.arange(0, 1025, 64)
    u = world.truth_edges(k, 600.0)
    assert np.isfinite(u).all()
    seen = world.truth_points(np.stack([u, np.full(k.size, 600.0)], axis=1))
    assert world.rig.projector.project(seen)[:, 0] == pytest.approx(k - 0.5, abs=1e-6)
    v = world.truth_edges(np.array([100, 400]), 700.5, axis="row")
    seen = world.truth_points(np.stack([np.full(2, 700.5), v], axis=1))
    assert world.rig.projector.project(seen)[:, 1] == pytest.approx([99.5, 399.5], abs=1e-6)


def test_edges_out_of_view_or_inside_a_jump_are_nan():
    assert np.isnan(small_world().truth_edges(np.array([0, 1024]), 100.0)).all()
    bar = small_world("steps", heights_m=(2e-3,), width_m=1e-3)
    k = np.arange(300, 700)
    found = bar.truth_edges(k, 100.0)
    jump = np.isnan(found[:-1]) & np.isfinite(found[1:])
    assert jump.sum() >= 1


def bar_world(height_m: float = 200e-6, **params) -> World:
    """One bar, |x| < 0.8 mm, with vertical walls."""
    return small_world("steps", window=FULL, heights_m=(height_m,), width_m=1.6e-3, **params)


def test_step_throws_a_shadow_as_long_as_the_light_is_low():
    world, h, edge = bar_world(), 200e-6, 0.8e-3
    px, _, pz = world.rig.projector.position_m
    tip = edge + h * (edge - px) / (pz - h)  # light over the upper edge, down to the floor
    assert 20e-6 < tip - edge < 60e-6
    x = np.array([edge + 1e-8, tip - 1e-8, tip + 1e-8])
    floor = np.stack([x, np.full(3, 1e-3), np.zeros(3)], axis=1)
    q = world.rig.camera.project(floor)
    assert world.truth_points(q) == pytest.approx(floor, abs=1e-11)
    assert world.truth_lit(q).tolist() == [False, False, True]


def test_step_hides_the_floor_behind_it_from_the_camera():
    world, h, edge = bar_world(), 200e-6, -0.8e-3
    cx, _, cz = world.rig.camera.position_m
    hidden_to = edge - h * (cx - edge) / (cz - h)
    x = np.array([hidden_to - 1e-8, hidden_to + 1e-8, edge - 1e-8])
    floor = np.stack([x, np.full(3, 1e-3), np.zeros(3)], axis=1)
    points = world.truth_points(world.rig.camera.project(floor))
    assert points[0] == pytest.approx(floor[0], abs=1e-11)
    assert points[1:, 2] == pytest.approx([h, h], abs=1e-12)


def test_wall_that_the_camera_sees_is_truth_and_dark():
    world = bar_world()
    wall = np.array([[0.8e-3, 1e-3, z] for z in (20e-6, 100e-6, 180e-6)])
    q = world.rig.camera.project(wall)
    assert world.truth_points(q) == pytest.approx(wall, abs=1e-11)
    assert not world.truth_lit(q).any()


def test_marched_shadow_and_occlusion_are_those_of_the_same_shape_in_closed_form():
    # A bar with flanks of slope 20 on a grid: steeper than both devices' rays.
    step, h = 5e-6, 100e-6
    x = (np.arange(401) - 200) * step
    line = h * (np.abs(x) <= 0.8e-3 + 1e-9)
    world = small_world("height_map", window=FULL, source=np.tile(line, (401, 1)), step_m=step)
    base = -world.surface.data.z_min_m  # heights are about their mean
    px, _, pz = world.rig.projector.position_m
    cx, _, cz = world.rig.camera.position_m
    tip = 0.8e-3 + h * (0.8e-3 - px) / (pz - h + base)
    hidden_to = -0.8e-3 - h * (cx + 0.8e-3) / (cz - h + base)
    # Marching steps are half a cell: what a ray pierces for less than 2.5 um may be missed.
    x = np.array([tip - 3e-6, tip + 1e-7, hidden_to - 1e-7, hidden_to + 3e-6])
    floor = np.stack([x, np.zeros(4), np.full(4, -base)], axis=1)
    q = world.rig.camera.project(floor)
    assert world.truth_lit(q)[:3].tolist() == [False, True, True]
    points = world.truth_points(q)
    assert points[:3] == pytest.approx(floor[:3], abs=1e-10)
    assert points[3, 2] == pytest.approx(h - base, abs=2e-6)


def test_only_what_the_dmd_reaches_is_lit():
    world = small_world(window=FULL)
    q = pixel_grid(world, 13)
    uv = world.rig.projector.project(world.truth_points(q))
    inside = np.all((uv >= -0.5) & (uv <= np.array([1023.5, 767.5])), axis=1)
    assert np.array_equal(world.truth_lit(q), inside)
    assert 0.6 < inside.mean() < 0.95


def test_surface_turned_away_is_seen_by_nobody():
    world = small_world()
    world.move(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    q = pixel_grid(world, 50)
    assert not world.truth_lit(q).any()


@pytest.mark.parametrize(
    ("rotation", "translation"),
    [
        (np.eye(3) * 1.01, np.zeros(3)),
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3)),
        (np.eye(2), np.zeros(3)),
        (np.eye(3), np.array([0.0, np.nan, 0.0])),
        (np.eye(3), np.zeros(2)),
    ],
)
def test_impossible_poses_are_refused(rotation, translation):
    world = small_world()
    with pytest.raises(ConfigError, match="pose"):
        world.move(rotation, translation)
    assert np.array_equal(world.pose[0], np.eye(3))


def test_window_of_the_camera_sees_what_the_whole_camera_sees():
    whole, part = small_world("coin", window=FULL), small_world("coin")
    q = pixel_grid(part, 29)
    shift = np.array(MIDDLE[:2])
    assert part.truth_points(q) == pytest.approx(whole.truth_points(q + shift), abs=1e-12)
