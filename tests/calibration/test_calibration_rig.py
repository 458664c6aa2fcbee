"""The whole solution against the truth it was simulated from: errors, and sigmas that hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sl_bench.world.mounting import Mounting
from sl_calibration.bundle.bundle_adjustment import Bundle, solve_bundle
from sl_calibration.bundle.parameters import FlatPrior, Freedom
from sl_calibration.bundle.rig_problem import RigProblem
from sl_calibration.bundle.stage_model import FAULTLESS, StagePrior
from sl_calibration.data.solver_input import Holes, Targets
from sl_calibration.solve.acceptance import Limits, judge
from sl_calibration.solve.cross_validation import leave_heights_out
from sl_calibration.solve.observability import uncovered_part
from sl_calibration.solve.point_uncertainty import EdgeNoise, Volume, point_covariance, sigma_map
from sl_calibration.solve.solution import Solution, metres_per_pixel
from sl_calibration.solve.solution_pipeline import solve_rig, thinned
from sl_calibration.solve.stages import solve_camera
from sl_reconstruct.model.calibration_file import dump_calibration, parse_calibration
from sl_reconstruct.model.rig import Device, Rig
from support.scenes.calibration_scenes import (
    CAMERA,
    HEIGHTS_M,
    SENSORS,
    Scene,
    grid,
    spoil,
    triangulate,
)

SEEDS = 40
VOLUME = Volume((-6e-3, -4.5e-3, -1e-3), (6e-3, 4.5e-3, 1e-3))
POINTS_M = VOLUME.grid((4, 3, 3)).reshape(-1, 3)
NO_NOISE = EdgeNoise(0, 0, 0)
#: Plate tilted by 2 degrees, z 0.1 % too long and 0.2 degrees out of square.
FAULTY = Mounting(
    scale=(1, 1, 1.001), squareness_rad=(0, np.deg2rad(0.2), 0),
    tilt_rad=(np.deg2rad(1.2), np.deg2rad(1.6), 0.3), offset_m=(2e-4, -1e-4, 5e-5),
)  # fmt: skip


def joint(scene: Scene, seed: int, freedom: Freedom) -> Bundle:
    """Bundle from the truth, which is as good a start as any to the same minimum."""
    views = scene.views(seed)
    problem = RigProblem(("camera", "projector"), Holes.of(views), Targets.of(views), freedom)
    return solve_bundle(problem, problem.start(scene.rig.camera, scene.rig.projector))


def point_errors(bundle: Bundle, scene: Scene, noise: np.ndarray | float = 0.0) -> np.ndarray:
    """Errors (N, 3) of triangulated points, in metres, with noise on camera u."""
    seen = scene.rig.camera.project(POINTS_M) + noise
    column = scene.rig.projector.project(POINTS_M)[:, 0]
    return triangulate(Rig(*bundle.state.devices), seen, column, POINTS_M) - POINTS_M


@pytest.fixture(scope="module")
def solved() -> list[Bundle]:
    scene = Scene(FAULTY, hole_noise_px=0.02, targets=(10, 7))
    return [joint(scene, seed, Freedom()) for seed in range(SEEDS)]


def test_focal_lengths_and_centres_are_within_their_sigmas(solved: list[Bundle]) -> None:
    """3 sigma holds 99.7 % of each; 95 % of 40 seeds are asked for."""
    truth = Scene(FAULTY).rig
    for name, device in (("camera", truth.camera), ("projector", truth.projector)):
        within = []
        for bundle in solved:
            found = bundle.state.devices[bundle.problem.names.index(name)]
            off = np.array([found.focal_length_px[0] - device.focal_length_px[0],
                            *(found.centre_px - device.centre_px),
                            found.lens.kappa - device.lens.kappa])  # fmt: skip
            sigmas = [
                bundle.sigmas[f"{name}.{p}"]
                for p in ("focal_length_px", "image_centre_px.0", "image_centre_px.1", "kappa")
            ]
            within.append(np.abs(off) <= 3 * np.array(sigmas))
        assert (np.mean(within, axis=0) >= 0.95).all()


def test_parameters_have_unit_z_scores(solved: list[Bundle]) -> None:
    """Rms of 40 z-scores: 1 +- 1/sqrt(80) = 0.11 each; of 20 parameters none beyond 4 sigma."""
    truth = Scene(FAULTY).rig
    scores = []
    for bundle in solved:
        row: list[float] = []
        for true, found in zip((truth.camera, truth.projector), bundle.state.devices, strict=True):
            turn = found.rotation @ true.rotation.T
            row += [found.focal_length_px[0] - true.focal_length_px[0],
                    *(found.centre_px - true.centre_px), found.lens.kappa - true.lens.kappa,
                    turn[2, 1], turn[0, 2], turn[1, 0],
                    *(found.translation_m - true.translation_m)]  # fmt: skip
        scores.append(np.array(row) / np.sqrt(np.diag(bundle.covariance.matrix))[:20])
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    assert (np.abs(rms - 1) <= 4 * 0.112).all()


def test_points_are_right_to_a_micrometre_and_know_it(solved: list[Bundle]) -> None:
    """At most 1.0 um rms over 12 x 9 x 2 mm; z-scores near 1, as far as 40 seeds can tell.

    Errors of one calibration's points hang together, so that there are few more than 40
    independent ones for each axis: 1 +- 0.11, limits at 3 sigma.
    """
    scene = Scene(FAULTY)
    errors = np.array([point_errors(bundle, scene) for bundle in solved])
    sigmas = np.array([point_covariance(b, POINTS_M, NO_NOISE).sigma_m for b in solved])
    assert np.sqrt(np.mean(np.sum(errors**2, axis=2), axis=1)).max() < 1.0e-6
    z_scores = np.sqrt(np.mean((errors / sigmas) ** 2, axis=(0, 1)))
    np.testing.assert_allclose(z_scores, 1.0, atol=0.33)


def test_edge_noise_is_in_the_points_sigma(solved: list[Bundle]) -> None:
    """0.05 px of camera u moves z by far more than the calibration does; 36 x 40 draws: 2 %."""
    scene, noise_px = Scene(FAULTY), 0.05
    rng = np.random.default_rng(7)
    scores = []
    for bundle in solved:
        noise = noise_px * rng.standard_normal((len(POINTS_M), 1)) * [1.0, 0.0]
        sigma = point_covariance(bundle, POINTS_M, EdgeNoise(noise_px, 0, 0)).sigma_m
        scores.append(point_errors(bundle, scene, noise) / sigma)
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(scores), axis=(0, 1)))[2], 1, atol=0.1)


def test_knowing_the_row_too_does_not_hurt(solved: list[Bundle]) -> None:
    noise = EdgeNoise(0.02, 0.02, 0.02)
    three = point_covariance(solved[0], POINTS_M, noise).noise
    four = point_covariance(solved[0], POINTS_M, noise, rows=True).noise
    assert (np.trace(four, axis1=1, axis2=2) < np.trace(three, axis1=1, axis2=2)).all()


def test_the_stage_is_found_out(solved: list[Bundle]) -> None:
    """Scale 0.1 % off, lean of 2 degrees of tilt and 0.2 degrees of the stage: within 4 sigma."""
    axis = Scene(FAULTY).axes[:, 2]
    report = solved[0].stage
    assert report.scale_sigma[2] < 2e-4
    assert abs(report.scale[2] - np.linalg.norm(axis)) < 4 * report.scale_sigma[2]
    lean = np.arctan(axis[:2] / axis[2])
    assert (np.abs(report.z_lean_rad - lean) < 4 * report.z_lean_sigma_rad).all()
    assert np.isnan(report.squareness_rad).all(), "x and y did not move"


@pytest.fixture(scope="module")
def worst() -> tuple[Solution, Scene, list[np.ndarray], list[np.ndarray]]:
    """The whole way, with every fault of the issue at once."""
    scene = Scene(FAULTY, hole_noise_px=0.02, targets=(20, 15))
    views = scene.views(11)
    rng = np.random.default_rng(12)
    bad_holes = [spoil(view.centres_px, 0.05, 0.5, rng) for view in views]
    bad_targets = [spoil(view.dmd_px, 0.05, 4.0, rng) for view in views]
    return solve_rig(views, SENSORS), scene, bad_holes, bad_targets


def test_wrong_points_are_left_out(worst) -> None:  # type: ignore[no-untyped-def]
    solution, _, bad_holes, bad_targets = worst
    bad = np.concatenate([*bad_holes, *bad_targets])
    assert bad.sum() > 60
    assert not solution.bundle.used[bad].any()
    # 5 sigma leaves out 4 of a million good ones
    assert (solution.bundle.used[~bad]).mean() > 0.999


def test_the_whole_way_ends_at_the_truth(worst) -> None:  # type: ignore[no-untyped-def]
    solution, scene, *_ = worst
    errors = point_errors(solution.bundle, scene)
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 1.0e-6
    # residual vectors of two coordinates: sqrt(2) of the noise, to 4 / sqrt(2 N)
    assert solution.bundle.rms_px(0) == pytest.approx(0.02 * np.sqrt(2), rel=0.13)
    assert solution.bundle.rms_px(1) == pytest.approx(0.01 * np.sqrt(2), rel=0.08)
    assert solution.bundle.chi2 == pytest.approx(solution.bundle.dof, rel=4 * np.sqrt(2 / 3700))
    search = solution.camera.search
    assert search.cost_after_px2 < search.cost_before_px2


@pytest.mark.parametrize("seed", range(4))
def test_however_the_plate_lies(seed: int) -> None:
    """Tilts to 4 degrees, turns to 45, a stage out of square by half a degree, 0.5 % too long."""
    rng = np.random.default_rng(seed)
    x, y = np.deg2rad(rng.uniform(-4, 4, 2))
    a, b, c = rng.normal(0, 0.01, 3)
    mounting = Mounting((1, 1, rng.normal(1, 0.005)), (a, b, c), (x, y, rng.uniform(-0.8, 0.8)))
    scene = Scene(mounting, hole_noise_px=0.02)
    views = scene.views(seed)
    for view in views:
        spoil(view.centres_px, 0.05, rng.choice([0.3, 3, 30]), rng)
    errors = point_errors(solve_rig(views, SENSORS).bundle, scene)
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 1.0e-6


def test_the_worst_case_passes_the_gate(worst) -> None:  # type: ignore[no-untyped-def]
    solution, *_ = worst
    figures = solution.figures
    verdict = judge(figures, Limits())
    assert verdict.passed, verdict.reasons
    # Where no lens is kept, its limit has nothing to limit.
    assert set(figures) == set(Limits.__dataclass_fields__) - {"kept_lens_sigmas"}
    grown = judge(figures | {"left_out_z_m": 1e-5, "hole_rms_px": np.nan}, Limits())
    assert not grown.passed
    assert [reason.split()[0] for reason in grown.reasons] == ["hole_rms_px", "left_out_z_m"]


def test_a_height_left_out_is_predicted_to_the_noise(worst) -> None:  # type: ignore[no-untyped-def]
    """z of a single target has the decoder's noise alone: 0.01 DMD px times dz/du along the ray.

    dz/du by differences of the true rig: the columns of a point and of one a micrometre up its
    camera ray. The calibration adds some per cent.
    """
    solution, scene, *_ = worst
    rig, point = scene.rig, np.zeros((1, 3))
    ray = rig.camera.rays(rig.camera.project(point))
    up = point + ray / ray[:, 2:] * 1e-6
    dz_du = 1e-6 / (rig.projector.project(up) - rig.projector.project(point))[0, 0]
    heights = [left.height_m for left in solution.left_out]
    np.testing.assert_allclose(heights, HEIGHTS_M)
    for left in solution.left_out:
        assert left.z_rms_m == pytest.approx(abs(dz_du) * 0.01, rel=0.2)
        assert left.hole_rms_px == pytest.approx(0.02 * np.sqrt(2), rel=0.3)


def test_one_step_is_the_solution_without_the_height() -> None:
    scene = Scene(FAULTY)
    views = scene.views(13)
    bundle = joint(scene, 13, Freedom())
    problem = RigProblem(
        ("camera", "projector"), Holes.of(views[1:]), Targets.of(views[1:]), Freedom()
    )
    without = solve_bundle(problem, problem.start(scene.rig.camera, scene.rig.projector))
    first = scene.axes @ views[0].place + np.pad(views[0].plate_xy_m, ((0, 0), (0, 1)))
    moved = first + (without.state.axes - scene.axes) @ views[0].place
    off = without.state.devices[0].project(moved) - views[0].centres_px
    found = leave_heights_out(bundle)[0]
    assert found.hole_rms_px == pytest.approx(np.sqrt(np.mean(np.sum(off**2, axis=1))), rel=1e-3)


def test_two_heights_leave_no_check() -> None:
    scene = Scene()
    views = scene.views(14, np.array([[0, 0, -1e-3], [0, 0, 1e-3]]))
    solution = solve_rig(views, SENSORS)
    assert solution.left_out == ()
    reasons = judge(solution.figures, Limits()).reasons
    assert [reason.split()[0] for reason in reasons] == ["left_out_z_m"]


def test_a_camera_alone_says_what_it_does_not_know() -> None:
    """The better the stage is known, the better is the camera; what it says holds throughout.

    The truth is within 4 of its own sigmas whatever is assumed; alone, the camera knows the
    scale of z travel at least twice worse than both devices together.
    """
    holes = Holes.of(Scene().views(15))
    true = Scene().rig.camera
    free = solve_camera(holes, CAMERA)
    held = solve_camera(holes, CAMERA, Freedom(FAULTLESS))
    loose = solve_camera(holes, CAMERA, Freedom(StagePrior(0.02, 0.05)))
    name = "camera.focal_length_px"
    assert held.bundle.sigmas[name] < free.bundle.sigmas[name] < loose.bundle.sigmas[name]
    for found in (free, held, loose):
        off = abs(found.device.focal_length_px[0] - true.focal_length_px[0])
        assert off < 4 * found.bundle.sigmas[name]
    assert not held.bundle.problem.moving
    both = joint(Scene(), 15, Freedom()).stage
    assert free.bundle.stage.scale_sigma[2] > 2 * both.scale_sigma[2]


def test_squareness_is_told_from_tilt_when_x_and_y_move() -> None:
    scene = Scene(Mounting((1.0005, 0.9995, 1.001), (0.001, 0.0035, -0.002), (0.02, 0.03, 0.05)))
    places = np.array([[0, 0, -1], [0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0.0]]) * 1e-3
    views = scene.views(16, places)
    report = solve_rig(views, SENSORS).bundle.stage
    true = scene.mounting.axes / np.linalg.norm(scene.mounting.axes, axis=0)
    angles = np.arcsin([true[:, 0] @ true[:, 1], true[:, 0] @ true[:, 2], true[:, 1] @ true[:, 2]])
    assert (np.abs(report.squareness_rad - angles) < 4 * report.squareness_sigma_rad).all()
    assert (np.abs(report.scale - np.linalg.norm(scene.mounting.axes, axis=0))
            < 4 * report.scale_sigma).all()  # fmt: skip
    assert report.squareness_sigma_rad.max() < 5e-4


def test_a_flat_that_is_not_the_plate_is_found_but_costs_dearly() -> None:
    """0.2 mm thicker than the plate, and lying 0.5 degrees askew.

    How high the patterns lie over the plate is hardly seen: the points shift in z together. The
    predicted sigma says so, and the gate would not let such a calibration pass.
    """
    flat = (2e-4, 0.009, -0.004)
    scene = Scene(flat=flat, targets=(20, 15))
    bundle = joint(scene, 17, Freedom(flat=FlatPrior()))
    sigma = np.sqrt(np.diag(bundle.covariance.matrix))[bundle.problem.columns["flat"]]
    assert (np.abs(bundle.state.flat - flat) < 4 * sigma).all()
    predicted = point_covariance(bundle, POINTS_M, NO_NOISE).sigma_m
    assert (np.abs(point_errors(bundle, scene)) < 4 * predicted).all()
    assert predicted[:, 2].min() > Limits().point_sigma_m


def test_a_stage_that_does_not_repeat() -> None:
    """Positions off by 1 um each: estimated, or else the residuals give it away."""
    scene = Scene()
    rng = np.random.default_rng(18)
    told = np.array([[0, 0, z] for z in HEIGHTS_M])
    real = told + 1e-6 * rng.standard_normal(told.shape)
    views = scene.views(18, real)
    views = [replace(view, height_m=z) for view, z in zip(views, HEIGHTS_M, strict=True)]
    trusted = solve_rig(views, SENSORS).bundle
    loose = Freedom(StagePrior(position_sigma_m=1e-6))
    known = solve_rig(views, SENSORS, loose).bundle
    assert trusted.scales[0] > 2
    assert known.scales.max() < 1.1
    errors = known.state.errors_m - (real - told)
    # the mean and the part along z travel belong to the world and the scale
    along = np.outer(HEIGHTS_M, HEIGHTS_M @ errors) / np.sum(HEIGHTS_M**2)
    assert np.abs(errors - errors.mean(axis=0) - along).max() < 2e-7


def test_fx_and_fy_where_wanted() -> None:
    bundle = joint(Scene(targets=(20, 15)), 19, Freedom(square_pixels=False))
    for name, device in zip(bundle.problem.names, bundle.state.devices, strict=True):
        ratio = device.focal_length_px[1] / device.focal_length_px[0]
        both = [bundle.covariance.parameters.index(f"{name}.focal_length_px.{i}") for i in (0, 1)]
        spread = bundle.covariance.matrix[np.ix_(both, both)]
        sigma = np.sqrt([1, -1] @ spread @ [1, -1]) / device.focal_length_px[0]
        assert 0 < abs(ratio - 1) < 4 * sigma


def test_the_file_holds_it_all(solved: list[Bundle], worst) -> None:  # type: ignore[no-untyped-def]
    solution, *_ = worst
    calibration = solution.calibration({"seed": 11})
    again = parse_calibration(dump_calibration(calibration))
    assert again.hash == calibration.hash
    assert again.covariance is not None
    assert again.covariance.parameters == solution.bundle.covariance.parameters
    np.testing.assert_array_equal(again.covariance.matrix, solution.bundle.covariance.matrix)
    assert again.residuals["camera_rms_px"] == solution.bundle.rms_px(0)


def test_sigma_map_spans_the_volume(solved: list[Bundle]) -> None:
    points, sigma = sigma_map(solved[0], VOLUME, EdgeNoise(), (5, 4, 3))
    assert points.shape == sigma.shape == (3, 4, 5, 3)
    np.testing.assert_allclose([points.reshape(-1, 3).min(0), points.reshape(-1, 3).max(0)],
                               [VOLUME.low_m, VOLUME.high_m])  # fmt: skip
    assert (np.diff(points[0, 0, :, 0]) > 0).all()
    assert (sigma > 0).all()


def test_uncovered_part_of_an_image() -> None:
    """One pixel in a corner covers a quarter of a disc of an eighth of the width."""
    left = uncovered_part(np.zeros((1, 2)), (1600, 1200))
    assert left == pytest.approx(1 - np.pi / 4 * 200**2 / (1600 * 1200), abs=0.01)
    full = grid(1599, 1199, 20, 20) + np.array([799.5, 599.5])
    assert uncovered_part(full, (1600, 1200)) == 0


def test_pixel_size_on_the_part() -> None:
    """The reference rig's DMD throws a field of 12 mm with 1024 columns on z = 0."""
    projector: Device = Scene().rig.projector
    assert metres_per_pixel(projector) == pytest.approx(12e-3 / 1024, rel=0.02)


def test_too_many_targets_are_thinned_the_same_way_each_time() -> None:
    view = Scene(targets=(40, 30)).views(20)[0]
    few = thinned(view, 100)
    assert len(few.camera_px) == 100
    np.testing.assert_array_equal(few.camera_px, thinned(view, 100).camera_px)
    assert thinned(few, 100) is few
