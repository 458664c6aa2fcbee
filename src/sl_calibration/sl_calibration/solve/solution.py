"""What is solved, and what speaks for it: devices, covariance, checks, the figures to be judged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_calibration.bundle.bundle_adjustment import Bundle
from sl_calibration.data.observations import Observations
from sl_calibration.solve.acceptance import Limits, Verdict
from sl_calibration.solve.cross_validation import HeightError
from sl_calibration.solve.image_centre_search import CentreSearch
from sl_calibration.solve.observability import uncovered_part
from sl_calibration.solve.point_uncertainty import EdgeNoise, Volume, sigma_map
from sl_calibration.solve.ray_midpoints import triangulate
from sl_calibration.solve.stages import DeviceSolution
from sl_reconstruct.model.calibration_file import Calibration
from sl_reconstruct.model.rig import Device, Rig

Array = NDArray[np.float64]

_NO_NOISE = EdgeNoise(0.0, 0.0, 0.0)
#: Quantiles of the targets that bound the lit volume: the outermost may be wrong.
_BOUNDS = (0.002, 0.998)


@dataclass(frozen=True)
class Solution:
    """A calibrated rig, or a camera alone.

    Parameters
    ----------
    camera : DeviceSolution
        On its own: the paper's two steps, then its bundle.
    projector : DeviceSolution or None
        The same; None for a camera alone.
    bundle : Bundle
        The result: both together, with one covariance, or the camera's.
    left_out : tuple of HeightError
        The check on each height; empty for two heights and for a camera alone.
    """

    camera: DeviceSolution
    projector: DeviceSolution | None
    bundle: Bundle
    left_out: tuple[HeightError, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Devices that were solved."""
        return self.bundle.problem.names

    @property
    def searches(self) -> tuple[CentreSearch, ...]:
        """The paper's searches, as `names`."""
        return tuple(device.search for device in (self.camera, self.projector) if device)

    @property
    def rig(self) -> Rig:
        """The rig."""
        return Rig(*self.bundle.state.devices)

    @cached_property
    def lit_volume(self) -> Volume:
        """Box of everything that the projector lit and the camera saw: the triangulated targets."""
        data = self.bundle.problem.targets
        used = self.bundle.used[self.bundle.problem.groups[1]]
        points, _ = triangulate(self.rig, data.camera_px[used], data.pixels[used])
        low, high = np.quantile(points, _BOUNDS, axis=0).tolist()
        return Volume(tuple(low), tuple(high))

    @property
    def figures(self) -> dict[str, float]:
        """Figures that `Limits` limits, by the same names; those that this solution has."""
        bundle = self.bundle
        problem, stage = bundle.problem, bundle.stage
        rejected = [1 - float(np.mean(bundle.used[g])) for g in problem.groups if g.stop > g.start]
        seen_px = problem.holes.pixels[bundle.used[problem.groups[0]]]
        figures = {
            "hole_rms_px": bundle.rms_px(0),
            "rejected_part": max(rejected),
            "stage_lean_rad": float(np.nan_to_num(np.hypot(*stage.z_lean_rad))),
            "uncovered_part": uncovered_part(seen_px, bundle.state.devices[0].image_size),
        }
        if self.projector:
            sigma = sigma_map(bundle, self.lit_volume, _NO_NOISE)[1]
            figures |= {
                "target_rms_px": bundle.rms_px(1),
                "point_sigma_m": float(np.max(sigma[..., 2])),
                "left_out_z_m": max((e.z_rms_m for e in self.left_out), default=np.nan),
                "stage_scale_error": float(np.nan_to_num(abs(stage.scale[2] - 1))),
            }
        return figures

    def calibration(self, made_from: Mapping[str, Any] | None = None) -> Calibration:
        """Return what the calibration file of a rig holds: rig, covariance, residuals."""
        bundle = self.bundle
        residuals = {
            "camera_rms_px": bundle.rms_px(0),
            "projector_rms_px": bundle.rms_px(1),
            "chi2": bundle.chi2,
            "degrees_of_freedom": bundle.dof,
            # What a check of z against the stage needs: where a metre of its z goes.
            "stage_z_axis": [float(v) for v in bundle.state.axes[:, 2]],
        }
        return Calibration(self.rig, bundle.covariance, residuals, made_from or {})


@dataclass(frozen=True)
class JudgedSolution:
    """A run's solution and its verdict.

    Parameters
    ----------
    observations : Observations
        What it was solved from.
    solution : Solution
        Rig or camera.
    verdict : Verdict
        On its figures.
    limits : Limits
        What they were held against.
    seconds : float
        How long it took.
    """

    observations: Observations
    solution: Solution
    verdict: Verdict
    limits: Limits
    seconds: float

    @property
    def names(self) -> tuple[str, ...]:
        """Devices that were solved."""
        return self.solution.names

    @property
    def bundle(self) -> Bundle:
        """What counts."""
        return self.solution.bundle

    @property
    def edge_noise(self) -> EdgeNoise:
        """Noise of a point's edge, as it was found on the plate."""
        edges = [v.edge_sigma_px for v in self.observations.views if np.isfinite(v.edge_sigma_px)]
        return EdgeNoise(float(np.median(edges))) if edges else EdgeNoise()

    @property
    def predicted_sigma_m(self) -> float:
        """Predicted 1-sigma of a point's z, edge noise included, worst in the volume."""
        sigma = sigma_map(self.bundle, self.solution.lit_volume, self.edge_noise)[1]
        return float(np.nanmax(sigma[..., 2]))

    @property
    def left_out_rms_m(self) -> float:
        """Error of z at heights left out, rms of all; NaN where there were too few."""
        errors = [error.z_rms_m for error in self.solution.left_out]
        return float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan")


def metres_per_pixel(device: Device) -> float:
    """Size of a device's pixel on the part, across its ray, at the world's origin."""
    return float(device.translation_m[2]) / device.focal_length_px[0]
