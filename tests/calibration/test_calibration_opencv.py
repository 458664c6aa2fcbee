"""OpenCV's terms: files that it and we read, its calibration of free poses, foreign data."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sl_calibration.board.planar_target import solve_free, solve_free_pair
from sl_calibration.report.opencv_export import opencv_values, save_opencv
from sl_calibration.solve.linear_step import Sensor
from sl_common.errors import CalibrationError
from sl_reconstruct.model.calibration_file import load_rig
from sl_reconstruct.model.rig import BrownConrady, Device
from support.scenes.calibration_scenes import CAMERA, PROJECTOR, RIG, grid

POINTS_M = np.random.default_rng(0).uniform(-1, 1, (50, 3)) * [5e-3, 4e-3, 1e-3]


@pytest.mark.parametrize("name", ["cam", "proj"])
def test_opencv_projects_as_we_do(name: str) -> None:
    """From the camera's frame, with nothing but the exported numbers."""
    values = opencv_values(RIG)
    local = POINTS_M @ RIG.camera.rotation.T + RIG.camera.translation_m
    rotation, translation = np.eye(3), np.zeros(3)
    if name == "proj":
        rotation, translation = values["R"], values["T"] / 1e3
    turn = cv2.Rodrigues(rotation)[0]
    matrix, distortion = values[f"{name}_K"], values[f"{name}_dist"]
    seen = cv2.projectPoints(local, turn, translation, matrix, distortion)[0].reshape(-1, 2)
    ours = (RIG.projector if name == "proj" else RIG.camera).project(POINTS_M)
    error_px = values[f"{name}_lens_error_px"]
    assert error_px < 0.02
    np.testing.assert_allclose(seen, ours, atol=1.01 * error_px + 1e-6)


@pytest.mark.parametrize("suffix", [".json", ".xml", ".yml"])
def test_what_is_written_can_be_read(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"rig{suffix}"
    save_opencv(path, RIG)
    again = load_rig(path)
    assert again.camera.image_size == RIG.camera.image_size
    assert again.projector.image_size == RIG.projector.image_size
    local = POINTS_M @ RIG.camera.rotation.T + RIG.camera.translation_m
    np.testing.assert_allclose(again.camera.project(local), RIG.camera.project(POINTS_M), atol=0.02)
    np.testing.assert_allclose(
        again.projector.project(local), RIG.projector.project(POINTS_M), atol=0.02
    )
    assert list(tmp_path.iterdir()) == [path]


def test_an_unknown_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"expected \.json"):
        save_opencv(tmp_path / "rig.txt", RIG)


# -- free poses -----------------------------------------------------------------------------------

TARGET_M = grid(0.16, 0.12, 9, 7)
LENS = BrownConrady((-0.2, 0.1, 0.0, 0.0, 0.0))
WORLD = (np.eye(3), np.zeros(3))
EYE = Device((1280, 1024), (1500.0, 1510.0), (640.0, 500.0), 5e-6, *WORLD, LENS)
TURN = cv2.Rodrigues(np.array([0.02, 0.3, 0.01]))[0]
LAMP = Device((1024, 768), (1600.0, 1605.0), (510.0, 700.0), 1e-5, TURN,
              np.array([-0.2, 0.01, 0.05]), LENS)  # fmt: skip


def poses(count: int) -> list[np.ndarray]:
    """The target in front of both devices, leaning every which way, (N, 3) in the camera."""
    rng = np.random.default_rng(1)
    turns = rng.uniform(-0.5, 0.5, (count, 3))
    moves = rng.uniform(-0.03, 0.03, (count, 3)) + np.array([0.0, 0.0, 0.6])
    flat = np.pad(TARGET_M, ((0, 0), (0, 1)))
    return [flat @ cv2.Rodrigues(t)[0].T + m for t, m in zip(turns, moves, strict=True)]


def test_free_poses_find_camera_and_projector() -> None:
    """Focal lengths and centres within 4 of the stated sigmas; rms of vectors: sqrt(2) of noise."""
    noise_px = 0.05
    rng = np.random.default_rng(2)
    views = poses(12)
    seen, thrown = (
        [device.project(view) + noise_px * rng.standard_normal((63, 2)) for view in views]
        for device in (EYE, LAMP)
    )
    sensors = (Sensor(EYE.image_size, 5e-6), Sensor(LAMP.image_size, 1e-5))
    pair = solve_free_pair([TARGET_M] * 12, seen, thrown, sensors)
    for solution, true in ((pair.camera, EYE), (pair.projector, LAMP)):
        assert solution.rms_px == pytest.approx(noise_px * np.sqrt(2), rel=0.1)
        assert solution.view_rms_px.shape == (12,)
        for i in (0, 1):
            off = solution.device.focal_length_px[i] - true.focal_length_px[i]
            assert abs(off) < 4 * solution.sigmas[f"focal_length_px.{i}"]
            off = solution.device.image_centre_px[i] - true.image_centre_px[i]
            assert abs(off) < 4 * solution.sigmas[f"image_centre_px.{i}"]
    # 1.5 px of 0.6 m in the worst place: the baseline of 0.2 m is known to some tenths of a mm
    np.testing.assert_allclose(pair.rig.projector.translation_m, LAMP.translation_m, atol=1e-3)
    np.testing.assert_allclose(pair.rig.projector.rotation, LAMP.rotation, atol=2e-3)


def test_free_poses_are_refused_where_there_are_too_few() -> None:
    seen = [EYE.project(view) for view in poses(2)]
    with pytest.raises(CalibrationError, match="63, 63] points in 2 views; expected at least 6"):
        solve_free([TARGET_M] * 2, seen, CAMERA)
    with pytest.raises(CalibrationError, match="coefficients=3"):
        solve_free([TARGET_M] * 3, seen, PROJECTOR, 3)
    with pytest.raises(CalibrationError, match="shapes"):
        solve_free([TARGET_M] * 3, seen, PROJECTOR)
