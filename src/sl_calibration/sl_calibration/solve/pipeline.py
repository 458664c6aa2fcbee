"""A run's observations solved and judged: a rig, a rig with one lens kept, a camera alone."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sl_calibration.data.observations import HoleView, TargetView
from sl_calibration.data.views import Observations
from sl_calibration.solve.bundle_adjustment import Bundle, FlatPrior, Freedom
from sl_calibration.solve.fixed_intrinsics import Kept, solve_keeping
from sl_calibration.solve.image_centre_search import CentreSearch
from sl_calibration.solve.linear import Sensor
from sl_calibration.solve.rig_solution import RigSolution, solve_rig
from sl_calibration.solve.stages import DeviceSolution, solve_camera
from sl_calibration.solve.uncertainty import (
    EdgeNoise,
    Limits,
    Verdict,
    Volume,
    judge,
    sigma_map,
    uncovered_part,
)
from sl_calibration.verify.verification import triangulate


@dataclass(frozen=True)
class Solved:
    """A rig's solution, its verdict and how long it took."""

    observations: Observations
    solution: RigSolution
    verdict: Verdict
    limits: Limits
    seconds: float

    @property
    def names(self) -> tuple[str, ...]:
        """Devices that were solved."""
        return ("camera", "projector")

    @property
    def bundle(self) -> Bundle:
        """What counts."""
        return self.solution.joint

    @property
    def searches(self) -> tuple[CentreSearch, ...]:
        """The paper's searches, as `names`."""
        return self.solution.camera.search, self.solution.projector.search

    @property
    def edge_noise(self) -> EdgeNoise:
        """Noise of a point's edge, as it was found on the plate."""
        edges = [v.edge_sigma_px for v in self.observations.views if np.isfinite(v.edge_sigma_px)]
        return EdgeNoise(float(np.median(edges))) if edges else EdgeNoise()

    @property
    def volume(self) -> Volume:
        """Box of everything that the projector lit and the camera saw."""
        return lit_volume(self.solution)

    @property
    def predicted_sigma_m(self) -> float:
        """Predicted 1-sigma of a point's z, edge noise included, worst in the volume."""
        sigma = sigma_map(self.solution.joint, self.volume, self.edge_noise)[1]
        return float(np.nanmax(sigma[..., 2]))

    @property
    def left_out_rms_m(self) -> float:
        """Error of z at heights left out, rms of all; NaN where there were too few."""
        errors = [left.z_rms_m for left in self.solution.left_out]
        return float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan")


@dataclass(frozen=True)
class SolvedCamera:
    """The same of a camera alone."""

    observations: Observations
    solution: DeviceSolution
    verdict: Verdict
    limits: Limits
    seconds: float

    @property
    def names(self) -> tuple[str, ...]:
        """Devices that were solved."""
        return ("camera",)

    @property
    def bundle(self) -> Bundle:
        """What counts."""
        return self.solution.bundle

    @property
    def searches(self) -> tuple[CentreSearch, ...]:
        """The paper's searches, as `names`."""
        return (self.solution.search,)


def hole_views(observations: Observations) -> list[HoleView]:
    """Holes as the solver wants them."""
    return [
        HoleView(stage_m, v.plate_xy_m, v.centres_px, v.centres_sigma_px)
        for stage_m, v in zip(observations.stage_m, observations.views, strict=True)
    ]


def target_views(observations: Observations) -> list[TargetView]:
    """Targets as the solver wants them."""
    return [
        TargetView(stage_m, v.camera_px, v.dmd_px, v.dmd_sigma_px)
        for stage_m, v in zip(observations.stage_m, observations.views, strict=True)
    ]


def solve(observations: Observations, limits: Limits) -> Solved:
    """Solve a rig and judge it; with one lens kept where ``made_from`` says so.

    Raises
    ------
    CalibrationError
        When the observations do not determine a rig.
    """
    began_s = time.perf_counter()
    camera = Sensor(observations.camera_size, observations.camera_pitch_m)
    projector = Sensor(observations.dmd_size, observations.dmd_pitch_m)
    solution = solve_rig(
        hole_views(observations), target_views(observations), camera, projector,
        _freedom(observations.made_from),
    )  # fmt: skip
    figures = {}
    if plain := observations.made_from.get("kept"):
        solution, figures["kept_lens_sigmas"] = solve_keeping(solution, Kept.of_plain(plain))
    figures |= solution.figures(lit_volume(solution))
    verdict = judge(figures, limits)
    return Solved(observations, solution, verdict, limits, time.perf_counter() - began_s)


def solve_camera_alone(observations: Observations, limits: Limits) -> SolvedCamera:
    """Solve the camera from the holes, and judge it by the limits that can be told.

    Raises
    ------
    CalibrationError
        When the observations do not determine a camera.
    """
    began_s = time.perf_counter()
    camera = Sensor(observations.camera_size, observations.camera_pitch_m)
    found = solve_camera(hole_views(observations), camera, _freedom(observations.made_from))
    bundle = found.bundle
    figures = {
        "hole_rms_px": bundle.rms_px(0),
        "rejected_part": 1 - float(np.mean(bundle.used)),
        "stage_lean_rad": float(np.nan_to_num(np.hypot(*bundle.stage.z_lean_rad))),
        "uncovered_part": uncovered_part(
            bundle.problem.holes.pixels[bundle.used], observations.camera_size
        ),
    }
    seconds = time.perf_counter() - began_s
    return SolvedCamera(observations, found, judge(figures, limits), limits, seconds)


def lit_volume(solution: RigSolution) -> Volume:
    """Box of the triangulated targets, without the outermost that may be wrong."""
    joint = solution.joint
    used = joint.used[joint.problem.groups[1]]
    data = joint.problem.targets
    points, _ = triangulate(solution.rig, data.camera_px[used], data.pixels[used])
    low, high = np.quantile(points, (0.002, 0.998), axis=0)
    return Volume(
        (float(low[0]), float(low[1]), float(low[2])),
        (float(high[0]), float(high[1]), float(high[2])),
    )


def _freedom(made_from: Mapping[str, Any]) -> Freedom:
    """What is estimated: with chamfered holes also how far their edges lie below the face."""
    chamfer_m = float(made_from.get("plate", {}).get("chamfer_m", 0.0))
    return Freedom(flat=FlatPrior(2 * chamfer_m, 1e-3)) if chamfer_m else Freedom()
