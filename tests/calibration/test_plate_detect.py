"""Hole plates: every centre against the truth of the bench, of drawn images and of foreign data."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sl_bench.world.optics import Optics
from sl_bench.world.reference_rig import reference_rig
from sl_bench.world.surfaces import make_surface
from sl_bench.world.world import World
from sl_calibration.target.hole_detection import find_plate
from sl_calibration.target.plate import DEFAULT_PLATE, HoleFlag, Plate
from sl_calibration.target.plate_map import map_circles
from sl_common.errors import CalibrationError
from support.paths import DATA
from support.scenes.bench_scenes import tilt
from support.scenes.plate_scenes import PLATE, chamfered, drawn, exposed, pinhole, through

#: What the issue asks of a centre on the reference bench.
LIMIT_PX = 0.02
#: Drawn images: an edge's noise, 1 DN of 184 over a blur of 0.85 px, is 0.0095 px; the centre's,
#: from some 40 independent points on the smallest circle, sqrt(2 / 40) of it. Five sigma, and as
#: much again for the raster of the drawing.
DRAWN_PX = 10 * 0.0095 * np.sqrt(2 / 40)
WHITE = [(np.full((768, 1024), 255, dtype=np.uint8), 1 / 30)]
FOREIGN = DATA / "circle_plate"


def lit(world, frame=0):
    return world.expose(WHITE, 1 / 30, frame)


def truth_px(world, xy_m):
    rotation, shift = world.pose
    face = np.concatenate([xy_m, np.zeros((len(xy_m), 1))], axis=1)
    return world.rig.camera.project(face @ rotation.T + shift)


def errors_px(world, view):
    return view.centres_px - truth_px(world, view.plate_xy_m)


@pytest.fixture(scope="module")
def bench():
    return World(reference_rig(), make_surface("hole_plate"), Optics())


@pytest.fixture(scope="module")
def views(bench):
    return [find_plate(lit(bench, frame), DEFAULT_PLATE) for frame in range(3)]


# -- the reference bench -------------------------------------------------------------------------


def test_bench_centres_are_within_the_limit(bench, views):
    for view in views:
        assert len(view.ids) == 100
        assert view.good.all() and len(view.missing) == 0
        assert np.abs(errors_px(bench, view)).max() < LIMIT_PX


def test_bench_bias_and_noise_are_apart_and_small(bench, views):
    centres = np.array([view.centres_px for view in views])
    noise = centres.std(axis=0, ddof=1)
    bias = centres.mean(axis=0) - truth_px(bench, views[0].plate_xy_m)
    # a bound on any estimator: 185 DN of step, 1.2 DN of noise (mean of both sides), blur 0.86 px,
    # 160 edge points around the hole, two numbers of the centre from them
    bound = 1.2 / 185 * np.sqrt(2 * np.sqrt(np.pi) * 0.86) * np.sqrt(2 / 160)
    rms = np.sqrt(np.mean(noise**2))
    assert 0.5 * bound < rms < 2 * bound
    assert np.sqrt(np.mean(bias**2)) < 0.1 * LIMIT_PX + rms / np.sqrt(len(views))
    assert np.abs(bias.mean(axis=0)).max() < 0.05 * LIMIT_PX


def test_bench_sigma_is_that_of_the_errors(bench, views):
    # 600 numbers, mostly independent: a standard deviation is known to 1 / sqrt(1200) = 3 %;
    # the model's share of sigma is the bench's own raster and not known better than this
    z = np.concatenate([errors_px(bench, v) / v.sigma_px[:, None] for v in views])
    assert 0.7 < z.std() < 1.3
    covariance = views[0].covariance_px2
    assert np.allclose(
        views[0].sigma_px, np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2), rtol=1e-12
    )


def test_ellipse_centres_alone_would_miss_the_limit(bench, views):
    # perspective: radius (24 px) times radius over depth times sin 28 deg, about 0.02 px
    raw = errors_px(bench, views[0]) + views[0].bias_px
    assert raw[:, 0].mean() == pytest.approx(0.0194, abs=0.003)


def test_turned_tilted_and_partly_out_of_view():
    surface = make_surface("hole_plate", origin_diameter_m=0.62e-3, origin_id=(0, 0))
    world = World(reference_rig(), surface, Optics(seed=3))
    a = np.deg2rad(127.0)
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1.0]])
    world.move(tilt(2.0, -1.5) @ turn, np.array([-2.2e-3, 1.6e-3, 0.6e-3]))
    view = find_plate(lit(world), Plate(origin_diameter_m=0.62e-3))
    assert 40 < len(view.ids) < 90
    assert np.abs(errors_px(world, view)[view.good]).max() < LIMIT_PX
    assert view.good.mean() > 0.95


def test_blocked_and_damaged_holes_do_not_pull_the_others():
    blocked = [(2, 3), (7, 8)]
    world = World(reference_rig(), make_surface("hole_plate", blocked=blocked), Optics(seed=5))
    image = lit(world).astype(np.float64)
    damaged = np.array([[4, 4], [0, 9], [8, 1]])
    for u, v in truth_px(world, DEFAULT_PLATE.xy_m(damaged)):  # a chip of 10 px out of the edge
        spot = np.hypot(*np.meshgrid(np.arange(1600) - u - 24, np.arange(1200) - v)) < 10
        image[spot] = 8.0
    view = find_plate(image.astype(np.uint8), DEFAULT_PLATE)
    assert {tuple(k) for k in view.missing} == set(blocked)
    bad = {tuple(k) for k in view.ids[~view.good]}
    assert bad == {tuple(k) for k in damaged}
    assert np.abs(errors_px(world, view)[view.good]).max() < LIMIT_PX


def test_uneven_light_does_not_move_centres():
    # 30 % of the light is left at the corners; the sensor is not saturated in the middle
    world = World(reference_rig(), make_surface("hole_plate"), Optics(uneven_light=0.7, seed=2))
    view = find_plate(lit(world), DEFAULT_PLATE)
    assert view.good.sum() >= 98
    assert np.abs(errors_px(world, view)[view.good]).max() < LIMIT_PX


@pytest.mark.parametrize(
    ("uneven", "chamfer_m", "limit_px"), [(0.05, 0.0, 7e-4), (0.7, 0.0, 7e-4), (0.7, 1e-4, 3e-3)]
)
def test_without_noise_centres_are_the_truth(uneven, chamfer_m, limit_px):
    """The truth is the true camera's projection; 30 % of the light are left at the corners.

    Plain holes: four sigma of the bench's raster (0.00015 px). Chamfers: the model takes a slope's
    light as that of one cone and the rims' images as alike, which leaves 0.002 px at this width.
    """
    part = make_surface("hole_plate", chamfer_m=chamfer_m, origin_diameter_m=0)
    world = World(reference_rig(), part, Optics(uneven_light=uneven))
    world.move(np.eye(3), [0.0, 0.0, chamfer_m])  # the holes' bottoms at z = 0
    electrons = world.electrons_per_second(WHITE[0][0]) + world.ambient_e_per_s()
    view = find_plate(electrons / electrons.max() * 200, Plate(chamfer_m=chamfer_m))
    assert len(view.ids) == 100 and view.good.all()
    true = world.rig.camera.project(np.pad(view.plate_xy_m, ((0, 0), (0, 1))))
    assert np.abs(view.centres_px - true).max() < limit_px


def test_saturation_is_said_and_priced():
    # The middle of the plate is saturated, its border is not.
    world = World(reference_rig(), make_surface("hole_plate"), Optics(white_dn=250.0, seed=1))
    view = find_plate(lit(world), DEFAULT_PLATE)
    full = (view.flags & HoleFlag.SATURATED) > 0
    assert 5 < full.sum() < 100
    assert view.sigma_px[full].min() > 1.5 * np.median(view.sigma_px[~full])
    z = errors_px(world, view)[view.good] / view.sigma_px[view.good, None]
    assert np.abs(z).max() < 5.0


# -- drawn plates --------------------------------------------------------------------------------


@pytest.mark.parametrize(("tilt_deg", "turn_deg"), [(0, 3), (30, 10), (50, -30), (60, 45)])
def test_strong_perspective(tilt_deg, turn_deg):
    h = pinhole(tilt_deg, turn_deg)
    view = find_plate(drawn(PLATE, h), PLATE)
    assert view.good.sum() >= 38
    assert np.abs(view.centres_px - through(h, view.plate_xy_m)).max() < DRAWN_PX


def test_bright_dots_on_a_dark_plate():
    plate = replace(PLATE, dark_holes=False)
    h = pinhole(20.0, 15.0, scale=36e3)
    view = find_plate(drawn(plate, h), plate)
    assert len(view.ids) == 42 and view.good.all()
    assert np.abs(view.centres_px - through(h, view.plate_xy_m)).max() < DRAWN_PX


@pytest.mark.parametrize("turn_deg", [0, 45, 90, 135, 180, 270, 316])
def test_mark_fixes_the_rotation(turn_deg):
    plate = replace(PLATE, columns=6, rows=6, origin_diameter_m=0.75e-3)
    h = pinhole(15.0, turn_deg, scale=36e3)
    view = find_plate(drawn(plate, h), plate)
    assert len(view.ids) == 36
    assert np.abs(view.centres_px - through(h, view.plate_xy_m)).max() < DRAWN_PX


@pytest.mark.parametrize(("turn_deg", "quarter"), [(40, 0), (50, 1), (130, 1), (140, 2), (-50, 3)])
def test_without_a_mark_plate_x_is_nearest_to_image_right(turn_deg, quarter):
    plate = replace(PLATE, columns=6)
    h = pinhole(0.0, turn_deg)
    view = find_plate(drawn(plate, h), plate)
    # what is numbered as x is the drawn plate's x turned back by so many quarters
    c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter]
    drawn_xy = view.plate_xy_m @ np.array([[c, s], [-s, c]]).T
    assert np.abs(view.centres_px - through(h, drawn_xy)).max() < DRAWN_PX


def test_part_of_the_plate_is_numbered_by_its_mark_or_its_sides():
    marked = replace(PLATE, columns=10, origin_diameter_m=0.75e-3)
    h = pinhole(0.0, 0.0, centre_px=(260.0, 150.0))  # three columns are out of view
    view = find_plate(drawn(marked, h), marked)
    assert view.ids[:, 0].max() < 9 and view.ids[:, 0].min() == 0
    assert np.abs(view.centres_px - through(h, view.plate_xy_m)).max() < DRAWN_PX
    plain = replace(marked, origin_diameter_m=None)
    view = find_plate(drawn(plain, h), plain)
    assert np.abs(view.centres_px - through(h, view.plate_xy_m)).max() < DRAWN_PX


def test_rows_out_of_the_light_are_not_numbered():
    plate = replace(PLATE, rows=6, columns=6)
    h = pinhole(5.0, 0.0, centre_px=(200.0, 130.0))
    image = drawn(plate, h)
    image[:53] = 6  # row 5, at v = 25, and more than half of the way to row 4; below row 0 is light
    view = find_plate(image, plate)
    assert view.ids[:, 1].max() == 4 and len(view.ids) == 30
    assert np.abs(view.centres_px - through(h, view.plate_xy_m)).max() < DRAWN_PX


def test_a_plate_whose_mark_is_out_of_view_is_not_guessed():
    plate = replace(PLATE, columns=6, rows=6, origin_diameter_m=0.75e-3)
    # the lower and the upper corner are cut by the image's border: either might be the mark
    with pytest.raises(CalibrationError, match="origin mark"):
        find_plate(drawn(plate, pinhole(15.0, 45.0)), plate)


def test_a_plate_wider_than_the_image_is_not_guessed():
    plate = replace(PLATE, columns=14)
    with pytest.raises(CalibrationError, match=r"fit at \d+ offsets"):
        find_plate(drawn(plate, pinhole()), plate)


def test_turned_over_is_refused():
    plate = replace(PLATE, origin_id=(2, 0), origin_diameter_m=0.75e-3)
    over = pinhole(10.0) @ np.diag([-1.0, 1.0, 1.0])
    with pytest.raises(CalibrationError, match="turned over"):
        find_plate(drawn(plate, over), plate)
    assert len(find_plate(drawn(plate, pinhole(10.0)), plate).ids) == 42


def test_a_hole_off_the_lattice_is_flagged():
    # hole (3, 2) is blocked, and bored again 0.6 px beside its place
    h = pinhole(20.0, 5.0)
    moved = np.array([[0.6, 0.0]]) + through(h, PLATE.xy_m(np.array([[3, 2]])))
    image = drawn(PLATE, h)
    other = drawn(PLATE, np.array([[1, 0, 0.6], [0, 1, 0], [0, 0, 1.0]]) @ h)
    u, v = np.rint(moved[0]).astype(int)
    image[v - 20 : v + 20, u - 18 : u + 18] = other[v - 20 : v + 20, u - 18 : u + 18]
    view = find_plate(image, PLATE)
    outlier = (view.flags & HoleFlag.OUTLIER) > 0
    assert view.ids[outlier].tolist() == [[3, 2]]
    good = view.centres_px - through(h, view.plate_xy_m)
    assert np.abs(good[view.good]).max() < DRAWN_PX


@pytest.mark.parametrize("width_m", [0.05e-3, 0.1e-3])
def test_chamfers_do_not_move_centres(width_m):
    plate = replace(PLATE, columns=5, rows=5, chamfer_m=width_m)
    image, bottoms_px = chamfered(plate, size=(240, 240))
    view = find_plate(image, plate)
    assert len(view.ids) == 25 and view.good.all()
    error = view.centres_px - bottoms_px[view.ids[:, 1] * plate.columns + view.ids[:, 0]]
    assert np.abs(error).max() < LIMIT_PX
    assert np.abs(error.mean(axis=0)).max() < 0.25 * LIMIT_PX


def test_16_bit_and_float_images_give_the_same_centres():
    image = drawn(PLATE, pinhole(20.0))
    view = find_plate(image, PLATE)
    deep = find_plate(image.astype(np.uint16) * 16, PLATE, saturation_dn=4095.0)
    assert np.array_equal(view.ids, deep.ids)
    assert np.abs(view.centres_px - deep.centres_px).max() < 2e-3
    same = find_plate(image.astype(np.float32), PLATE)
    assert np.array_equal(view.centres_px, same.centres_px)


# -- the centre of a circle's image --------------------------------------------------------------


def test_bias_is_that_of_the_conic():
    """C' = H^-T C H^-1; the centre of a conic solves C'[:2, :2] c = -C'[:2, 2]."""
    h = pinhole(40.0, 25.0, distance_m=20e-3)
    xy, radius = np.array([[1.2e-3, -0.7e-3], [-2e-3, 1e-3]]), np.array([0.25e-3, 0.4e-3])
    found = map_circles(lambda p: through(h, p), xy, radius)
    for k, (x, y) in enumerate(xy):
        circle = np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - radius[k] ** 2]])
        conic = np.linalg.inv(h).T @ circle @ np.linalg.inv(h)
        centre = np.linalg.solve(conic[:2, :2], -conic[:2, 2])
        exact = centre - through(h, xy[k])
        # next order: (radius / distance)^2
        assert found.bias_px[k] == pytest.approx(exact, rel=2 * (radius[k] / 20e-3) ** 2 + 1e-6)


# -- refusals ------------------------------------------------------------------------------------


def test_lamp_off_is_refused(bench):
    dark = bench.expose([], 1 / 30, 0)
    with pytest.raises(CalibrationError, match="lamp"):
        find_plate(dark, Plate())


def test_missing_plate_is_refused():
    rng = np.random.default_rng(7)
    flat = rng.normal(180.0, 12.0, (300, 400)).clip(0, 255).astype(np.uint8)
    with pytest.raises(CalibrationError, match=r"found \d+ holes .* expected at least 15"):
        find_plate(flat, Plate())
    clutter = np.full((600, 800), 190.0)
    for u, v, r in rng.uniform((20, 20, 4), (780, 580, 18), (80, 3)):
        cv2.circle(clutter, (int(u), int(v)), int(r), 20.0, -1)
    with pytest.raises(CalibrationError, match="expected at least 15"):
        find_plate(cv2.GaussianBlur(clutter, (0, 0), 1.0).astype(np.uint8), Plate())


def test_too_few_holes_are_refused():
    h = pinhole(0.0, 0.0, centre_px=(200.0, 320.0))  # the upper two rows are in view
    few = replace(PLATE, columns=5)
    with pytest.raises(CalibrationError, match="expected at least 12"):
        find_plate(drawn(few, h), few)


def test_another_lattice_than_the_plate_is_refused():
    with pytest.raises(CalibrationError, match="7 x 6 holes; expected at most 5 x 5"):
        find_plate(drawn(PLATE, pinhole()), replace(PLATE, columns=5, rows=5))


def test_colour_images_and_impossible_plates_are_refused():
    with pytest.raises(CalibrationError, match="grey image"):
        find_plate(np.zeros((100, 100, 3), dtype=np.uint8), PLATE)
    with pytest.raises(CalibrationError, match="narrower than pitch_m"):
        Plate(diameter_m=2e-3)
    with pytest.raises(CalibrationError, match="at least 3 x 3"):
        Plate(columns=2)
    with pytest.raises(CalibrationError, match="expected a hole"):
        Plate(origin_diameter_m=0.7e-3, origin_id=(10, 0))
    with pytest.raises(CalibrationError, match="at least 16 %"):
        Plate(origin_diameter_m=0.46e-3)


def test_image_without_structure_but_noise_is_no_plate():
    with pytest.raises(CalibrationError):
        find_plate(exposed(np.ones((900, 900)), noise_dn=3.0), PLATE)


# -- foreign images ------------------------------------------------------------------------------


@pytest.mark.skipif(
    not FOREIGN.is_dir(), reason="no ../shared/data/circle_plate beside the project"
)
def test_foreign_views_calibrate_as_published():
    """15 views of a printed plate; its sheet says dots of half a pitch, a mark of one pitch."""
    plate = Plate(10, 10, 0.0254, 0.0127, origin_diameter_m=0.0254)
    on_plate, in_image = [], []
    for i in range(15):
        view = find_plate(cv2.imread(str(FOREIGN / f"images/{i}.png"), cv2.IMREAD_GRAYSCALE), plate)
        good = view.good
        assert good.sum() >= 95
        face = np.concatenate([view.plate_xy_m[good], np.zeros((good.sum(), 1))], axis=1)
        on_plate.append(face.astype(np.float32))
        in_image.append(view.centres_px[good].astype(np.float32))
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    rms, k, *_ = cv2.calibrateCamera(on_plate, in_image, (640, 480), None, None, flags=flags)
    assert rms <= 0.21
    assert k[0, 0] == pytest.approx(541.5, rel=3e-3)
    assert k[1, 1] == pytest.approx(543.0, rel=3e-3)
