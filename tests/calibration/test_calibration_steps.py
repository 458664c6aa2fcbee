"""The paper's two steps, and the data that are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sl_calibration.bundle.outlier_rejection import fits_homography
from sl_calibration.data.observations import View
from sl_calibration.data.solver_input import Holes, Targets
from sl_calibration.solve.image_centre_search import search_centre
from sl_calibration.solve.linear_step import Sensor, cost_px2, linear_step
from sl_calibration.solve.solution_pipeline import solve_rig
from sl_calibration.solve.stages import solve_camera, solve_projector
from sl_common.errors import CalibrationError
from sl_reconstruct.model.rig import Device, Division
from support.scenes.calibration_scenes import (
    CAMERA,
    HEIGHTS_M,
    PLATE_XY_M,
    PROJECTOR,
    RIG,
    SENSORS,
    Scene,
    spoil,
)

WORLD_M = np.concatenate([np.column_stack([PLATE_XY_M, np.full(100, z)]) for z in HEIGHTS_M])
DEVICES = pytest.mark.parametrize(
    ("device", "sensor"),
    [(RIG.camera, CAMERA), (RIG.projector, PROJECTOR)],
    ids=["camera", "projector"],
)


@DEVICES
def test_linear_step_is_exact_at_the_true_centre(device: Device, sensor: Sensor) -> None:
    """Only the rounds in which kappa's depth settles are left: they contract a thousandfold."""
    found = linear_step(WORLD_M, device.project(WORLD_M), device.centre_px, sensor)
    assert found.focal_length_px[0] == pytest.approx(device.focal_length_px[0], rel=1e-6)
    assert isinstance(found.lens, Division)
    assert isinstance(device.lens, Division)
    assert found.lens.kappa == pytest.approx(device.lens.kappa, rel=1e-4)
    np.testing.assert_allclose(found.rotation, device.rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation_m, device.translation_m, atol=1e-7)
    assert found.image_size == device.image_size


def test_linear_step_needs_no_lateral_offset() -> None:
    """Tsai divides by t_y, which is zero for a device that looks at the origin."""
    turned = RIG.camera.rotation
    device = Device((1600, 1200), (17e3, 17e3), (800, 600), 1e-5, turned, np.array([0, 0, 0.14]),
                    Division(1e-8))  # fmt: skip
    found = linear_step(WORLD_M, device.project(WORLD_M), device.centre_px, CAMERA)
    np.testing.assert_allclose(found.translation_m, [0, 0, 0.14], atol=1e-7)


@DEVICES
def test_search_finds_the_centre_wherever_it_is(device: Device, sensor: Sensor) -> None:
    """The projector's is 483 px off the DMD's middle. The simplex ends at 0.5 px."""
    found = search_centre(WORLD_M, device.project(WORLD_M), sensor)
    np.testing.assert_allclose(found.device.centre_px, device.centre_px, atol=1.0)
    assert found.points == len(WORLD_M)


@DEVICES
def test_search_brings_the_cost_to_the_noise(device: Device, sensor: Sensor) -> None:
    """J of N points is 2 N sigma^2 (chi-square: +- 4 / sqrt(N) of it), less a few parameters."""
    noise_px = 0.02
    pixels = device.project(WORLD_M)
    pixels += noise_px * np.random.default_rng(3).standard_normal(pixels.shape)
    found = search_centre(WORLD_M, pixels, sensor)
    expected = 2 * len(WORLD_M) * noise_px**2
    assert found.cost_after_px2 == pytest.approx(expected, rel=4 / np.sqrt(len(WORLD_M)))
    assert found.cost_before_px2 > 100 * found.cost_after_px2
    assert found.cost_after_px2 == pytest.approx(cost_px2(found.device, WORLD_M, pixels))


def test_screen_finds_gross_errors_and_spares_the_lens() -> None:
    rng = np.random.default_rng(4)
    view = np.repeat(np.arange(5), 100)
    pixels = RIG.camera.project(WORLD_M)
    assert fits_homography(WORLD_M[:, :2], pixels, view).all()
    bad = spoil(pixels, 0.05, 20.0, rng)
    np.testing.assert_array_equal(fits_homography(WORLD_M[:, :2], pixels, view), ~bad)


def views(heights_m: list[float], holes: int = 100, noise_px: float = 0.01) -> list[View]:
    made = Scene(hole_noise_px=noise_px).views(5, np.array([[0, 0, z] for z in heights_m]))
    return [of_holes(view, slice(holes)) for view in made]


def of_holes(view: View, which: slice) -> View:
    names = ("hole_ids", "plate_xy_m", "centres_px", "centres_sigma_px")
    return replace(view, **{name: getattr(view, name)[which] for name in names})


@pytest.mark.parametrize(
    ("seen", "message"),
    [
        ([], "expected at least 12 in each of 2 views"),
        (views([0.0]), "one height only .*expected at least 2 heights"),
        (views([1e-3, 1e-3, 1e-3]), "one height only"),
        (views([-1e-3, 1e-3], holes=9), r"\[9, 9\] holes in 2 views; expected at least 12"),
        (
            views([0.0, 5e-6], noise_px=0.05),
            r"z travel would be known to .* from heights over 0.005 mm; expected .* or more",
        ),
    ],
    ids=["none", "one height", "one height thrice", "few holes", "heights too close"],
)
def test_degenerate_views_are_refused(seen: list[View], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        solve_camera(Holes.of(seen), CAMERA)


def test_holes_in_one_line_are_refused() -> None:
    line = [of_holes(view, slice(40, 60)) for view in views([-1e-3, 0.0, 1e-3])]
    line = [replace(view, plate_xy_m=view.plate_xy_m * [1, 0]) for view in line]
    with pytest.raises(CalibrationError):
        solve_camera(Holes.of(line), CAMERA)


def test_a_plate_turned_over_is_refused() -> None:
    """From behind, x is mirrored: only a camera below the plate could see that."""
    seen = views([-1e-3, 0.0, 1e-3])
    mirrored = [replace(view, plate_xy_m=view.plate_xy_m * [-1, 1]) for view in seen]
    with pytest.raises(CalibrationError, match=r"turned over|signs right"):
        solve_camera(Holes.of(mirrored), CAMERA)


def test_heights_of_the_wrong_sign_are_refused() -> None:
    flipped = [replace(view, height_m=-view.height_m) for view in views([-1e-3, 0.0, 1e-3])]
    with pytest.raises(CalibrationError):
        solve_camera(Holes.of(flipped), CAMERA)


def test_a_projector_seen_at_one_height_is_refused() -> None:
    targets = Targets.of(Scene().views(6, np.zeros((1, 3))))
    with pytest.raises(CalibrationError, match="projected targets at one height only"):
        solve_projector(targets, RIG.camera, np.eye(3), PROJECTOR)


def test_a_rig_without_targets_is_refused() -> None:
    none = dict.fromkeys(("camera_px", "dmd_px", "dmd_sigma_px"), np.empty((0, 2)))
    holes = [replace(view, **none) for view in Scene().views(6)]
    with pytest.raises(CalibrationError, match="projected targets"):
        solve_rig(holes, SENSORS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"xy_m": [0.0]}, r"xy_m.shape=\(1,\); expected \(2,\)"),
        ({"plate_xy_m": np.zeros((4, 2))}, r"plate_xy_m.shape=\(4, 2\); expected \(100, 2\)"),
        ({"centres_px": np.full((100, 2), np.nan)}, "not finite"),
        ({"centres_sigma_px": np.zeros(100)}, "not positive"),
        ({"centres_sigma_px": np.ones(4)}, "sigma_px.shape"),
        ({"dmd_sigma_px": np.ones(108)}, r"dmd_sigma_px.shape=\(108,\); expected \(108, 2\)"),
    ],
)
def test_broken_observations_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        replace(Scene().views(6)[0], **change)  # type: ignore[arg-type]


def test_targets_have_a_sigma_for_each_coordinate() -> None:
    view = Scene().views(6)[0]
    sigma_px = np.array([[1.0, 2.0]] * len(view.dmd_px))
    joined = Targets.of([replace(view, dmd_sigma_px=sigma_px)])
    np.testing.assert_array_equal(joined.sigma_px, sigma_px)
