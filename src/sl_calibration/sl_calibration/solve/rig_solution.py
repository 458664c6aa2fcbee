"""From observations to a rig with its evidence: camera, projector, both together, the checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_calibration.data.observations import HoleView, TargetView
from sl_calibration.solve.bundle_adjustment import Bundle, Freedom
from sl_calibration.solve.cross_validation import LeftOut, leave_heights_out
from sl_calibration.solve.linear import Sensor
from sl_calibration.solve.stages import (
    DeviceSolution,
    rig_of,
    solve_camera,
    solve_joint,
    solve_projector,
)
from sl_calibration.solve.uncertainty import EdgeNoise, Volume, sigma_map, uncovered_part
from sl_reconstruct.model.calibration_file import Calibration
from sl_reconstruct.model.rig import Device, Rig

Array = NDArray[np.float64]

#: More targets of a view add time but no knowledge: their errors are the decoder's, not noise.
MAX_TARGETS = 800
_NO_NOISE = EdgeNoise(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class RigSolution:
    """A calibrated rig and what speaks for it.

    Parameters
    ----------
    camera, projector : DeviceSolution
        Each on its own: the paper's two steps, then its bundle.
    joint : Bundle
        Both together, with one covariance: the result.
    left_out : tuple of LeftOut
        The check on each height; empty for two heights.
    """

    camera: DeviceSolution
    projector: DeviceSolution
    joint: Bundle
    left_out: tuple[LeftOut, ...] = field(default=())

    @property
    def rig(self) -> Rig:
        """The rig."""
        return rig_of(self.joint)

    @property
    def volume(self) -> Volume:
        """Box of the holes and heights used, grown by half a hole pitch or so in x and y."""
        holes = self.joint.problem.holes
        used = self.joint.used[self.joint.problem.groups[0]]
        points = (holes.points_m + holes.stage_m @ self.joint.state.axes.T)[used]
        low, high = points.min(axis=0), points.max(axis=0)
        grow = 0.05 * (high - low) * [1, 1, 0]
        return Volume(_triple(low - grow), _triple(high + grow))

    def figures(self, volume: Volume | None = None) -> dict[str, float]:
        """Figures that `sl_calibration.solve.uncertainty.Limits` limits, by the same names."""
        joint, stage = self.joint, self.joint.stage
        sigma = sigma_map(joint, volume or self.volume, _NO_NOISE)[1]
        rejected = [1 - float(np.mean(joint.used[group])) for group in joint.problem.groups]
        used = joint.used[joint.problem.groups[0]]
        return {
            "hole_rms_px": joint.rms_px(0),
            "target_rms_px": joint.rms_px(1),
            "rejected_part": max(rejected),
            "point_sigma_m": float(np.max(sigma[..., 2])),
            "left_out_z_m": max((left.z_rms_m for left in self.left_out), default=np.nan),
            "stage_scale_error": float(np.nan_to_num(abs(stage.scale[2] - 1))),
            "stage_lean_rad": float(np.nan_to_num(np.hypot(*stage.z_lean_rad))),
            "uncovered_part": uncovered_part(
                joint.problem.holes.pixels[used], self.rig.camera.image_size
            ),
        }

    def calibration(self, made_from: Mapping[str, Any] | None = None) -> Calibration:
        """Return what the calibration file holds: rig, covariance, residuals."""
        joint = self.joint
        residuals = {
            "camera_rms_px": joint.rms_px(0),
            "projector_rms_px": joint.rms_px(1),
            "chi2": joint.chi2,
            "degrees_of_freedom": joint.dof,
            # What a check of z against the stage needs: where a metre of its z goes.
            "stage_z_axis": [float(v) for v in joint.state.axes[:, 2]],
        }
        return Calibration(self.rig, joint.covariance, residuals, made_from or {})


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def metres_per_pixel(device: Device, point_m: Array | None = None) -> float:
    """Size of a device's pixel on the part, across its ray, at a world point (the origin)."""
    point = np.zeros(3) if point_m is None else point_m
    depth = float((device.rotation @ point + device.translation_m)[2])
    return depth / device.focal_length_px[0]


def thinned(view: TargetView, most: int = MAX_TARGETS) -> TargetView:
    """Return the view with at most so many targets, drawn evenly, always the same ones."""
    count = len(view.camera_px)
    if count <= most:
        return view
    rows = np.sort(np.random.default_rng(0).choice(count, most, replace=False))
    return TargetView(
        view.stage_m, view.camera_px[rows], view.projector_px[rows], view.sigma_px[rows]
    )


def solve_rig(
    holes: Sequence[HoleView],
    targets: Sequence[TargetView],
    camera: Sensor,
    projector: Sensor,
    freedom: Freedom | None = None,
) -> RigSolution:
    """Calibrate a rig.

    Parameters
    ----------
    holes, targets : sequence
        The plate seen by the camera, and the patterns on it, at three or more heights (two leave
        no check).
    camera, projector : Sensor
        Image sizes and pixel pitches.
    freedom : Freedom
        What is estimated besides the devices; by default the stage's z travel.

    Raises
    ------
    CalibrationError
        When the views are degenerate, with what is missing, or nothing fits them.
    """
    freedom = freedom or Freedom()
    few = [thinned(view) for view in targets]
    seen = solve_camera(holes, camera, freedom)
    thrown = solve_projector(
        few, seen.device, seen.bundle.state.axes, projector, freedom.square_pixels
    )
    joint = solve_joint(holes, few, seen, thrown, freedom)
    return RigSolution(seen, thrown, joint, leave_heights_out(joint))
