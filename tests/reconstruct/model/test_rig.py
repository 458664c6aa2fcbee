"""The rig model against closed forms, OpenCV and the paper's numbers."""

import cv2
import numpy as np
import pytest

from sl_bench.world.reference_rig import reference_rig
from sl_common.errors import CalibrationError
from sl_reconstruct.model.rig import BrownConrady, Device, Division

BROWN = (-0.25, 0.24, 1e-3, -2e-3, 0.05)


def device(**changes) -> Device:
    values = {
        "image_size": (640, 480),
        "focal_length_px": (800.0, 810.0),
        "image_centre_px": (330.0, 228.0),
        "pixel_pitch_m": 5e-6,
        "rotation": cv2.Rodrigues(np.array([0.1, -0.3, 0.05]))[0],
        "translation_m": np.array([0.01, -0.02, 0.5]),
        "lens": Division(3e-8),
    }
    return Device(**(values | changes))


def some_pixels(size, count=200, seed=1):
    return np.random.default_rng(seed).uniform((0, 0), np.array(size) - 1, (count, 2))


def test_division_model_is_equation_1c():
    # Q_u - C = (Q_d - C)(1 + kappa r^2), by hand: r = 500, 1 + 1e-8 * 250000 = 1.0025
    lens = Division(1e-8)
    got = lens.undistort(np.array([[300.0, 400.0]]), np.ones(2), np.zeros(2))
    np.testing.assert_allclose(got, [[300.75, 401.0]], rtol=1e-15)


@pytest.mark.parametrize("lens", [Division(3.76e-8), Division(-2e-7), BrownConrady(BROWN)])
def test_distort_undoes_undistort(lens):
    d = device(lens=lens)
    q = some_pixels(d.image_size)
    ideal = lens.undistort(q, d.focal_px, d.centre_px)
    assert np.abs(ideal - q).max() > 0.1
    np.testing.assert_allclose(lens.distort(ideal, d.focal_px, d.centre_px), q, atol=1e-9)


def test_brown_conrady_is_opencv():
    d = device(lens=BrownConrady(BROWN))
    points = np.random.default_rng(2).uniform(-0.05, 0.05, (50, 3))
    want, _ = cv2.projectPoints(
        points, cv2.Rodrigues(d.rotation)[0], d.translation_m, d.camera_matrix, np.array(BROWN)
    )
    np.testing.assert_allclose(d.project(points), want[:, 0], atol=1e-9)


@pytest.mark.parametrize("lens", [Division(3e-8), BrownConrady(BROWN)])
def test_rays_go_through_the_points_that_project_there(lens):
    d = device(lens=lens)
    q = some_pixels(d.image_size)
    points = d.position_m + 0.4 * d.rays(q)
    depth = (points @ d.rotation.T + d.translation_m)[:, 2]
    np.testing.assert_allclose(depth, 0.4, rtol=1e-12)
    np.testing.assert_allclose(d.project(points), q, atol=1e-8)


def test_points_behind_a_device_have_no_image():
    d = device()
    assert np.isnan(d.project(d.position_m - 0.1 * d.rays(np.array([320.0, 240.0])))).all()


def test_folded_distortion_has_no_image():
    # r_u = r(1 + k r^2) with k = -1e-6 peaks at r = 1/sqrt(3e-6) = 577: r_u = 385
    lens = Division(-1e-6)
    assert np.isnan(lens.distort(np.array([[500.0, 0.0]]), np.ones(2), np.zeros(2))).all()


def test_reference_rig_is_the_papers():
    rig = reference_rig()
    tilt = np.rad2deg(np.arccos(-rig.projector.rotation[2, 2]))
    assert tilt == pytest.approx(4.3)
    assert np.rad2deg(np.arccos(-rig.camera.rotation[2, 2])) == pytest.approx(28.3)
    f_mm = rig.projector.focal_length_px[0] * rig.projector.pixel_pitch_m * 1e3
    assert f_mm == pytest.approx(95.665)
    assert rig.camera.focal_length_px[0] * rig.camera.pixel_pitch_m * 1e3 == pytest.approx(192.792)
    origin = np.zeros(3)
    np.testing.assert_allclose(rig.projector.project(origin), [511.5, 383.5], atol=1e-6)
    np.testing.assert_allclose(rig.camera.project(origin), [799.5, 599.5], atol=1e-6)


def test_reference_camera_sees_the_whole_dmd_field():
    rig = reference_rig()
    corners = np.array([[-0.5, -0.5], [1023.5, -0.5], [1023.5, 767.5], [-0.5, 767.5]])
    ray = rig.projector.rays(corners)
    plane = rig.projector.position_m - ray * (rig.projector.position_m[2] / ray[:, 2:])
    width, height = np.ptp(plane[:, :2], axis=0)
    # 12 x 9 mm, plus what the paper's distortion adds at the far corner (4.5 %)
    assert 12e-3 < width < 12.8e-3
    assert 9e-3 < height < 9.6e-3
    image = rig.camera.project(plane)
    assert np.all(image > 0)
    assert np.all(image < np.array([1599, 1199]))


@pytest.mark.parametrize(
    "changes",
    [
        {"rotation": np.array([[-0.99696, -0.01997, 0.0753], [0.01537, -0.97544, -0.03913],
                               [0.07603, -0.03877, 0.99635]])},  # the paper's Table 1 as scanned
        {"rotation": -np.eye(3)},
        {"rotation": np.eye(2)},
        {"translation_m": np.array([0.0, np.nan, 1.0])},
        {"focal_length_px": (-800.0, 800.0)},
        {"image_size": (0, 480)},
    ],
)  # fmt: skip
def test_impossible_devices_are_refused(changes):
    with pytest.raises(CalibrationError, match="expected"):
        device(**changes)
