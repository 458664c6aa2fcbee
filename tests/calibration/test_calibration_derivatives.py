"""Every analytic derivative of the calibration against its numeric twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sl_bench.world.mounting import Mounting
from sl_calibration.bundle.covariance import triangle
from sl_calibration.bundle.derivatives import intersect, meet, moved, project
from sl_calibration.bundle.parameters import FlatPrior, Freedom
from sl_calibration.bundle.rig_problem import RigProblem
from sl_calibration.bundle.stage_model import StagePrior, stage_report
from sl_calibration.data.solver_input import Holes, Targets
from sl_common.errors import CalibrationError
from sl_reconstruct.model.rig import BrownConrady, Device
from support.scenes.calibration_scenes import RIG, Scene

#: Steps for central differences: f, C, kappa, turns, T.
STEPS = np.array([1e-1] * 2 + [1e-2] * 2 + [1e-12] + [1e-6] * 3 + [1e-7] * 3)
POINTS = np.random.default_rng(0).uniform(-1, 1, (20, 3)) * [5e-3, 4e-3, 1e-3]


def agree(analytic: np.ndarray, numeric: np.ndarray) -> None:
    """Central differences of these steps are good to 1e-6 of a column's largest entry."""
    size = np.abs(numeric).max(axis=tuple(range(numeric.ndim - 1)))
    assert (np.abs(analytic - numeric) <= 1e-6 * size + 1e-30).all()


@pytest.mark.parametrize("device", [RIG.camera, RIG.projector], ids=["camera", "projector"])
def test_projection(device: Device) -> None:
    found = project(device, POINTS)
    np.testing.assert_array_equal(found.pixels, device.project(POINTS))
    twin = [
        (moved(device, d).project(POINTS) - moved(device, -d).project(POINTS)) / (2 * step)
        for d, step in zip(np.diag(STEPS), STEPS, strict=True)
    ]
    agree(found.by_device, np.stack(twin, axis=-1))
    twin = [
        (device.project(POINTS + d) - device.project(POINTS - d)) / 2e-7 for d in 1e-7 * np.eye(3)
    ]
    agree(found.by_point, np.stack(twin, axis=-1))


def test_a_point_behind_the_device_has_no_derivative() -> None:
    behind = np.array([[0.0, 0.0, 0.1]]) + RIG.camera.position_m
    assert np.isnan(project(RIG.camera, behind).pixels).all()


def test_ray_and_plane() -> None:
    pixels = RIG.camera.project(POINTS)
    normal = np.array([0.03, -0.02, 1.0])
    height = POINTS @ normal
    found = intersect(RIG.camera, pixels, normal, height)
    np.testing.assert_allclose(found.points_m, POINTS, atol=1e-14)
    np.testing.assert_allclose(meet(RIG.camera, pixels, normal, height), POINTS, atol=1e-14)
    twin = [
        (
            meet(moved(RIG.camera, d), pixels, normal, height)
            - meet(moved(RIG.camera, -d), pixels, normal, height)
        )
        / (2 * step)
        for d, step in zip(np.diag(STEPS), STEPS, strict=True)
    ]
    agree(found.by_device, np.stack(twin, axis=-1))
    up, down = (meet(RIG.camera, pixels, normal, height + h) for h in (1e-6, -1e-6))
    agree(found.by_height, (up - down) / 2e-6)


@pytest.mark.parametrize("square", [True, False])
def test_the_whole_bundle(square: bool) -> None:
    """Both devices, three stage axes, positions and flat, at a state that is off the solution."""
    scene = Scene(Mounting(scale=(1.001, 1, 0.999), tilt_rad=(0.02, 0.03, 0.1)))
    stage = np.array([[0, 0, 0], [2e-4, 0, 1e-4], [0, 3e-4, 2e-4]])
    views = scene.views(1, stage)
    freedom = Freedom(StagePrior(0.01, 0.1, 1e-6), FlatPrior(), square)
    problem = RigProblem(("camera", "projector"), Holes.of(views), Targets.of(views), freedom)
    device = np.array([0.1, 1e-2, 1e-2, 1e-12, *[1e-6] * 3, *[1e-7] * 3])
    device = device if square else np.concatenate([device[:1], device])
    steps = np.array([*device, *device, *[1e-4] * 9, *[1e-7] * 9, 1e-7, 1e-5, 1e-5])
    rng = np.random.default_rng(2)
    start = problem.moved(problem.start(scene.rig.camera, scene.rig.projector),
                          steps * rng.normal(0, 3, problem.size))  # fmt: skip
    residuals, jacobian, prior, by_prior = problem.linearised(start)
    np.testing.assert_allclose(problem.residuals(start), residuals, atol=1e-6)
    for i, step in enumerate(np.diag(steps)):
        up, down = problem.moved(start, step), problem.moved(start, -step)
        twin = (problem.residuals(up) - problem.residuals(down)) / (2 * steps[i])
        # residuals are of size 1e2 to 1e4 sigmas: differences keep 1e-11 of that
        limit = 1e-5 * np.abs(twin).max() + 1e-8 / steps[i]
        np.testing.assert_allclose(jacobian[:, :, i], twin, atol=limit)
        twin = (problem.priors(up)[0] - problem.priors(down)[0]) / (2 * steps[i])
        np.testing.assert_allclose(by_prior[:, i], twin, atol=1e-5 * np.abs(twin).max() + 1e-8)
    assert len(problem.parameters) == problem.size == jacobian.shape[2]
    assert len(prior) == 9 + 9 + 3 - 2  # x and y have no preferred direction in the plane


def test_stage_report_is_exact_for_a_leaning_stage() -> None:
    """z leans 0.01 rad towards x, y leans 0.02 rad towards x, and z travels 0.1 % too far."""
    axes = np.array([[1, np.sin(0.02), np.sin(0.01)], [0, np.cos(0.02), 0], [0, 0, np.cos(0.01)]])
    axes[:, 2] *= 1.001
    report = stage_report(axes, 1e-8 * np.eye(9), (0, 1, 2))
    np.testing.assert_allclose(report.scale, [1, 1, 1.001], atol=1e-12)
    np.testing.assert_allclose(report.z_lean_rad, [0.01, 0], atol=1e-12)
    lean = np.arcsin(np.sin(0.02) * np.sin(0.01))
    np.testing.assert_allclose(report.squareness_rad, [0.02, 0.01, lean], atol=1e-12)
    # each end of a unit axis moves by 1e-4 across; two ends make an angle
    np.testing.assert_allclose(report.scale_sigma, 1e-4, rtol=1e-3)
    np.testing.assert_allclose(report.squareness_sigma_rad, np.sqrt(2) * 1e-4, rtol=2e-3)
    assert np.isnan(stage_report(axes, np.zeros((9, 9)), (2,)).squareness_rad).all()


def test_triangle_by_blocks_is_the_triangle() -> None:
    """R is unique up to the signs of its rows, so R^T R is the test."""
    for rows in (3, 100, 5000):
        matrix = np.random.default_rng(rows).normal(size=(rows, 7))
        small = triangle(matrix)
        assert small.shape == (7, 7)
        np.testing.assert_allclose(small.T @ small, matrix.T @ matrix, atol=1e-10 * rows)


def test_only_the_papers_lens_is_bundled() -> None:
    other = replace(RIG.camera, lens=BrownConrady())
    with pytest.raises(CalibrationError, match="expected the paper's model"):
        project(other, POINTS)
