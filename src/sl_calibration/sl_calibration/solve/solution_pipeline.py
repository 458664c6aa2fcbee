"""A run's observations solved and judged: a rig, a rig with one lens fixed, a camera alone.

The order of a rig's solution: camera, projector, both together (`stages`), where wanted both again
with one lens fixed (`fixed_intrinsics`), each height left out (`cross_validation`), the verdict
(`acceptance`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sl_calibration.bundle.parameters import FixedLens, FlatPrior, Freedom
from sl_calibration.data.observations import Observations, View
from sl_calibration.data.solver_input import Holes, Targets
from sl_calibration.solve.acceptance import Limits, judge
from sl_calibration.solve.cross_validation import leave_heights_out
from sl_calibration.solve.fixed_intrinsics import solve_with_fixed_lens
from sl_calibration.solve.linear_step import Sensor
from sl_calibration.solve.solution import JudgedSolution, Solution
from sl_calibration.solve.stages import solve_camera, solve_joint, solve_projector

#: More targets of a view add time but no knowledge: their errors are the decoder's, not noise.
MAX_TARGETS = 800


def solve(observations: Observations, limits: Limits) -> JudgedSolution:
    """Solve a rig and judge it; with one lens fixed where ``made_from["kept"]`` says so.

    Parameters
    ----------
    observations : Observations
        Views of holes and targets at three or more heights.
    limits : Limits
        Acceptance gate.

    Raises
    ------
    CalibrationError
        When the observations do not determine a rig.
    """
    began_s = time.perf_counter()
    projector = Sensor(observations.dmd_size, observations.dmd_pitch_m)
    sensors = _camera(observations), projector
    solution = solve_rig(observations.views, sensors, _freedom(observations.made_from))
    figures = {}
    if plain := observations.made_from.get("kept"):
        lens = FixedLens.of_plain(plain)
        bundle, figures["kept_lens_sigmas"] = solve_with_fixed_lens(solution.bundle, lens)
        solution = replace(solution, bundle=bundle, left_out=leave_heights_out(bundle))
    verdict = judge(figures | solution.figures, limits)
    return JudgedSolution(observations, solution, verdict, limits, time.perf_counter() - began_s)


def solve_camera_alone(observations: Observations, limits: Limits) -> JudgedSolution:
    """Solve the camera from the holes, and judge it by the figures that it has.

    Parameters
    ----------
    observations : Observations
        Views of holes at two or more heights; targets are not looked at.
    limits : Limits
        Acceptance gate.

    Raises
    ------
    CalibrationError
        When the observations do not determine a camera.
    """
    began_s = time.perf_counter()
    freedom = _freedom(observations.made_from)
    camera = solve_camera(Holes.of(observations.views), _camera(observations), freedom)
    solution = Solution(camera, None, camera.bundle)
    verdict = judge(solution.figures, limits)
    return JudgedSolution(observations, solution, verdict, limits, time.perf_counter() - began_s)


def _camera(observations: Observations) -> Sensor:
    return Sensor(observations.camera_size, observations.camera_pitch_m)


def _freedom(made_from: Mapping[str, Any]) -> Freedom:
    """What is estimated: with chamfered holes also how far their edges lie below the face."""
    chamfer_m = float(made_from.get("plate", {}).get("chamfer_m", 0.0))
    return Freedom(flat=FlatPrior(2 * chamfer_m, 1e-3)) if chamfer_m else Freedom()


def solve_rig(
    views: Sequence[View], sensors: tuple[Sensor, Sensor], freedom: Freedom | None = None
) -> Solution:
    """Calibrate a rig.

    Parameters
    ----------
    views : sequence of View
        The plate seen by the camera, and the patterns on it, at three or more heights (two leave
        no check).
    sensors : tuple of Sensor
        Image size and pixel pitch of camera and projector.
    freedom : Freedom
        What is estimated besides the devices; by default the stage's z travel.

    Raises
    ------
    CalibrationError
        When the views are degenerate, with what is missing, or nothing fits them.
    """
    freedom = freedom or Freedom()
    holes, targets = Holes.of(views), Targets.of([thinned(view) for view in views])
    camera = solve_camera(holes, sensors[0], freedom)
    axes = camera.bundle.state.axes
    projector = solve_projector(targets, camera.device, axes, sensors[1], freedom.square_pixels)
    joint = solve_joint(holes, targets, camera, projector, freedom)
    return Solution(camera, projector, joint, leave_heights_out(joint))


def thinned(view: View, most: int = MAX_TARGETS) -> View:
    """Draw some targets of a view, evenly, always the same ones.

    Parameters
    ----------
    view : View
        Returned as it is where it has few enough.
    most : int
        Number of targets to keep.
    """
    count = len(view.camera_px)
    if count <= most:
        return view
    rows = np.sort(np.random.default_rng(0).choice(count, most, replace=False))
    names = ("camera_px", "dmd_px", "dmd_sigma_px")
    return replace(view, **{name: getattr(view, name)[rows] for name in names})
