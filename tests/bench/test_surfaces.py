"""Surfaces and their distances against closed forms, brute force and a foreign file."""

import cv2
import numpy as np
import pytest

from sl_bench.world import raycast
from sl_bench.world.reference_rig import reference_rig
from sl_bench.world.surfaces import height_map, make_surface
from sl_common.errors import ConfigError
from support.paths import DATA

TMD = DATA / "surfaces" / "coin_us_dime.tmd"


def albedos(surface, places_m):
    return np.array([raycast.albedo(surface.data, x, y) for x, y in places_m])


def test_flat_distance_is_height():
    points = np.array([[1e-3, 2e-3, 5e-6], [0, 0, -3e-6], [9.0, -9.0, 0.0]])
    assert make_surface("flat").distance_m(points) == pytest.approx([5e-6, 3e-6, 0.0], abs=1e-15)


def test_groove_has_its_included_angle():
    groove = make_surface("groove", included_angle_deg=155.92, width_m=6e-3)
    x = np.array([-2e-3, -1e-3, 1e-3, 2e-3])
    z = groove.height_m(x, np.zeros(4))
    slopes = np.arctan([(z[1] - z[0]) / 1e-3, (z[3] - z[2]) / 1e-3])
    assert 180 - np.rad2deg(slopes[1] - slopes[0]) == pytest.approx(155.92, abs=1e-6)
    assert groove.height_m(np.array([3.1e-3]), np.zeros(1)) == pytest.approx([0.0], abs=1e-15)
    # A point over the left flank: its perpendicular distance, depth * sin(half the angle).
    p = np.array([[-1e-3, 0.5e-3, z[1] + 1e-5]])
    assert groove.distance_m(p) == pytest.approx([1e-5 * np.sin(np.deg2rad(155.92 / 2))], rel=1e-9)


def test_step_distance_takes_the_nearest_of_top_bottom_and_wall():
    steps = make_surface("steps", heights_m=(100e-6,), width_m=2e-3)  # one bar, |x| < 1 mm
    points = np.array(
        [
            [0.0, 0.0, 107e-6],  # over the top
            [0.995e-3, 0.0, 40e-6],  # inside, 5 um behind the wall
            [1.004e-3, 1e-3, 50e-6],  # before the wall
            [1.004e-3, 0.0, 3e-6],  # before the wall, but nearer to the floor
            [1.003e-3, 0.0, 104e-6],  # off the upper edge: 3-4-5
            [-1.5e-3, 0.0, -6e-6],  # under the floor
        ]
    )
    expected = [7e-6, 5e-6, 4e-6, 3e-6, 5e-6, 6e-6]
    assert steps.distance_m(points) == pytest.approx(expected, rel=1e-9)
    assert steps.data.max_slope == np.inf


def test_step_bars_alternate_with_gaps():
    steps = make_surface("steps", heights_m=(10e-6, -50e-6), width_m=1e-3)
    heights = steps.height_m(np.array([-3e-3, -1e-3, 0.0, 1e-3, 3e-3]), np.zeros(5))
    assert heights == pytest.approx([0.0, 10e-6, 0.0, -50e-6, 0.0], abs=1e-15)


def test_sphere_cap_distance_is_radial_over_the_cap():
    cap = make_surface("sphere_cap", radius_m=50e-3, base_radius_m=4e-3)
    centre = np.array([0.0, 0.0, -np.sqrt(50e-3**2 - 4e-3**2)])
    n = np.array([0.03, -0.04, 0.0])
    n[2] = np.sqrt(1 - n @ n)
    assert cap.distance_m((centre + 50.007e-3 * n)[None]) == pytest.approx([7e-6], rel=1e-6)
    outside = np.array([[5e-3, 0.0, 3e-6], [4.003e-3, 0.0, 4e-6]])
    # The second stands over the plane but is nearer to the plane than to the rim.
    assert cap.distance_m(outside) == pytest.approx([3e-6, 4e-6], rel=1e-9)
    top = cap.height_m(np.zeros(1), np.zeros(1))
    assert top == pytest.approx([50e-3 + centre[2]], rel=1e-9)


def test_hole_plate_lies_in_view_and_has_the_holes_it_is_asked_for():
    plate = make_surface("hole_plate", blocked=[(2, 3)], hole_albedo=0.1)
    centres = plate.centres_m
    assert centres.shape == (10, 10, 2)
    assert np.diff(centres[0, :, 0]) == pytest.approx(np.full(9, 0.9e-3))
    world = np.concatenate([centres.reshape(-1, 2), np.zeros((100, 1))], axis=1)
    rig = reference_rig()
    for device, margin_px in ((rig.camera, 40), (rig.projector, 20)):
        px = device.project(world)
        assert np.all((px > margin_px) & (px < np.array(device.image_size) - margin_px))
    albedo = albedos(plate, centres.reshape(-1, 2)).reshape(10, 10)
    assert albedo[3, 2] == 1.0
    assert np.sum(np.isclose(albedo, 0.1)) == 99
    rim = centres[0, 0] + np.array([[0.2249e-3, 0.0], [0.0, 0.2251e-3]])
    assert albedos(plate, rim) == pytest.approx([0.1, 1.0])


def test_chamfer_is_a_cone():
    mark = {"origin_diameter_m": 0.6e-3, "origin_id": (0, 0)}
    plate = make_surface("hole_plate", chamfer_m=60e-6, **mark)
    x0, y0 = plate.centres_m[0, 0]
    x = x0 + np.array([0.30e-3, 0.33e-3, 0.36e-3, 0.40e-3])
    heights = plate.height_m(x, np.full(4, y0))
    assert heights == pytest.approx([-60e-6, -30e-6, 0.0, 0.0], abs=1e-12)
    over_cone = np.array([[x[1], y0, -30e-6 + 5e-6]])
    assert plate.distance_m(over_cone) == pytest.approx([5e-6 / np.sqrt(2)], rel=1e-6)


def test_coin_is_as_high_and_as_steep_as_asked():
    coin = make_surface("coin", height_m=50e-6, flank_m=80e-6)
    grid = coin.data.grid
    assert grid.max() == pytest.approx(50e-6, rel=1e-6)
    assert grid.min() == 0.0
    assert grid[0].max() == 0.0
    gy, gx = np.gradient(grid, 5e-6)
    # Smoothstep's steepest slope is 1.5 height / width.
    assert np.hypot(gx, gy).max() == pytest.approx(1.5 * 50e-6 / 80e-6, rel=0.02)
    assert 0.1 < np.mean(grid > 25e-6) < 0.4


def test_grid_distance_is_that_of_brute_force():
    coin = make_surface("coin")
    rng = np.random.default_rng(1)
    points = rng.uniform([-4e-3, -4e-3, -10e-6], [4e-3, 4e-3, 60e-6], (300, 3))
    points[:, 2] = coin.height_m(points[:, 0], points[:, 1]) + rng.uniform(-15e-6, 15e-6, 300)
    near = (np.mgrid[-30e-6:30e-6:61j, -30e-6:30e-6:61j]).reshape(2, -1).T
    x, y = points[:, :1] + near[:, 0], points[:, 1:2] + near[:, 1]
    level, rise = np.hypot(near[:, 0], near[:, 1]), coin.height_m(x, y) - points[:, 2:]
    gap = np.hypot(level, rise)
    # Feet 1 um apart: at most 0.71 um beside the true foot, which adds 0.51 um^2 / (2 d).
    brute = gap.min(axis=1)
    d = coin.distance_m(points)
    assert np.all(d <= brute + 1e-12)
    assert np.all(brute <= np.sqrt(d**2 + (0.71e-6 * 1.4) ** 2) + 0.3e-6)
    on = np.stack([x[:, 0], y[:, 0], coin.height_m(x[:, 0], y[:, 0])], axis=1)
    assert coin.distance_m(on) == pytest.approx(np.zeros(300), abs=1e-12)


def test_distance_of_nothing_is_nan():
    for name in ("flat", "steps", "sphere_cap", "coin", "hole_plate"):
        assert np.isnan(make_surface(name).distance_m(np.full((1, 3), np.nan))).all()


def test_height_map_of_an_array_is_bilinear_with_the_first_row_on_top():
    heights = np.array([[0.0, 0.0], [0.0, 4.0]])  # the last row lies at the smallest y
    surface = height_map(heights, step_m=1e-3, unit_m=1e-6)
    x, y = np.array([0.5e-3, 0.5e-3, 0.0]), np.array([-0.5e-3, 0.5e-3, 0.0])
    assert surface.height_m(x, y) == pytest.approx([3e-6, -1e-6, 0.0], abs=1e-15)


def test_height_map_files_of_two_kinds_hold_the_same_surface(tmp_path):
    heights = np.random.default_rng(3).normal(size=(20, 30)).astype(np.float32)
    np.save(tmp_path / "a.npy", heights)
    cv2.imwrite(str(tmp_path / "a.tif"), heights)
    made = [
        make_surface("height_map", source=str(tmp_path / name), step_m=1e-5, unit_m=1e-6)
        for name in ("a.npy", "a.tif")
    ]
    assert np.array_equal(made[0].data.grid, made[1].data.grid)
    assert np.ptp(made[0].data.grid) == pytest.approx(1e-6 * np.ptp(heights), rel=1e-6)


@pytest.mark.skipif(not TMD.exists(), reason="no ../shared/data/surfaces")
def test_coin_file_is_read_in_millimetres():
    dime = make_surface("height_map", source=TMD)
    # README of the data: 300 x 300, 0.0632 mm step, 0.351 mm range.
    assert dime.data.grid.shape == (300, 300)
    assert dime.data.params[0] == pytest.approx(0.0632e-3, rel=1e-3)
    assert np.ptp(dime.data.grid) == pytest.approx(0.351e-3, rel=1e-3)


@pytest.mark.skipif(not TMD.exists(), reason="no ../shared/data/surfaces")
@pytest.mark.parametrize("size", [10, 40, 70, 1000])
def test_cut_height_file_is_refused(tmp_path, size):
    (tmp_path / "cut.tmd").write_bytes(TMD.read_bytes()[:size])
    with pytest.raises(ConfigError, match=r"cut\.tmd"):
        make_surface("height_map", source=tmp_path / "cut.tmd")


@pytest.mark.parametrize(
    ("name", "params"),
    [
        ("teapot", {}),
        ("flat", {"colour": 3}),
        ("groove", {"included_angle_deg": 180.0}),
        ("steps", {"heights_m": ()}),
        ("steps", {"heights_m": (np.nan,)}),
        ("sphere_cap", {"radius_m": 1e-3, "base_radius_m": 2e-3}),
        ("hole_plate", {"diameter_m": 1e-3}),
        ("hole_plate", {"blocked": [(10, 0)]}),
        ("coin", {"flank_m": 1e-6}),
        ("height_map", {"source": np.zeros((5, 5))}),
        ("height_map", {"source": np.full((5, 5), np.nan), "step_m": 1e-5}),
        ("height_map", {"source": np.zeros(5), "step_m": 1e-5}),
        ("height_map", {"source": "nowhere.npy", "step_m": 1e-5}),
        ("height_map", {"source": "nowhere.tif", "step_m": 1e-5}),
        ("height_map", {"source": "nowhere.stl", "step_m": 1e-5}),
    ],
)
def test_impossible_parts_are_refused(name, params):
    with pytest.raises(ConfigError):
        make_surface(name, **params)
