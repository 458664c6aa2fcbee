"""How well a triangulated point is known: the joint covariance and the edges' noise, propagated.

A point X fulfils F(X, parameters) = observed, with F the camera's (u, v) and the projector's
column (three equations, as `sl_reconstruct` solves them) or column and row (four). To first order
``dX = G (d observed - dF/d parameters d parameters)`` with G the (pseudo-)inverse of dF/dX.
The acceptance gate, which needs it, is here as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from sl_calibration.solve.bundle_adjustment import Bundle
from sl_calibration.solve.derivatives import project

Array = NDArray[np.float64]


class EdgeNoise(NamedTuple):
    """1-sigma of what a point is made from: camera u, v and DMD coordinates, pixels."""

    camera_u_px: float = 0.02
    camera_v_px: float = 0.0
    projector_px: float = 0.0


class PointSigma(NamedTuple):
    """Covariances (N, 3, 3) of points, square metres: from the calibration, and from the noise."""

    calibration: Array
    noise: Array

    @property
    def sigma_m(self) -> Array:
        """1-sigma of x, y, z, (N, 3) metres, of both together."""
        total = self.calibration + self.noise
        return np.sqrt(np.diagonal(total, axis1=1, axis2=2))


def point_covariance(
    bundle: Bundle, points_m: Array, noise: EdgeNoise, rows: bool = False
) -> PointSigma:
    """Predict the covariance of triangulated points.

    Parameters
    ----------
    bundle : Bundle
        A joint solution.
    points_m : ndarray, (N, 3)
        World points, metres; NaN comes out where a device does not see them.
    noise : EdgeNoise
        Noise of a single point.
    rows : bool
        Whether the DMD row is known too (four equations).
    """
    camera, projector = (project(device, points_m) for device in bundle.state.devices)
    count = 2 if rows else 1
    by_point = np.concatenate([camera.by_point, projector.by_point[:, :count]], axis=1)
    solve = _pseudo_inverse(by_point)
    problem = bundle.problem
    by_parameters = np.zeros((len(points_m), 2 + count, problem.size))
    by_parameters[:, :2, problem.columns["camera"]] = problem.chosen(camera.by_device)
    seen = problem.chosen(projector.by_device[:, :count])
    by_parameters[:, 2:, problem.columns["projector"]] = seen
    spread = solve @ by_parameters
    observed = solve * np.array([*noise[:2], *[noise.projector_px] * count])
    return PointSigma(
        spread @ bundle.covariance.matrix @ np.swapaxes(spread, 1, 2),
        observed @ np.swapaxes(observed, 1, 2),
    )


def _pseudo_inverse(matrices: Array) -> Array:
    """Least-squares inverses (N, 3, M) of (N, M, 3); NaN where a matrix holds one."""
    finite = np.isfinite(matrices).all(axis=(1, 2))
    inverse = np.full(np.swapaxes(matrices, 1, 2).shape, np.nan)
    inverse[finite] = np.linalg.pinv(matrices[finite])
    return inverse


class Volume(NamedTuple):
    """A box in the world: lowest and highest x, y, z, metres."""

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]

    def grid(self, shape: tuple[int, int, int]) -> Array:
        """Points (nz, ny, nx, 3) that span the box; shape is (nx, ny, nz)."""
        x, y, z = (
            np.linspace(a, b, n) for a, b, n in zip(self.low_m, self.high_m, shape, strict=True)
        )
        grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
        return np.asarray(grid.transpose(2, 1, 0, 3))


def sigma_map(
    bundle: Bundle, volume: Volume, noise: EdgeNoise, shape: tuple[int, int, int] = (13, 10, 3)
) -> tuple[Array, Array]:
    """Points (nz, ny, nx, 3) that span a volume, and their predicted 1-sigma, same shape, metres.

    NaN where a device does not see a point.
    """
    grid = volume.grid(shape)
    sigma = point_covariance(bundle, grid.reshape(-1, 3), noise).sigma_m
    return grid, sigma.reshape(grid.shape)


@dataclass(frozen=True)
class Limits:
    """Acceptance gate: the largest value of each figure.

    Parameters
    ----------
    hole_rms_px, target_rms_px : float
        Residuals of holes (camera pixels) and of targets (DMD pixels).
    rejected_part : float
        Part of holes or targets that were left out as wrong.
    point_sigma_m : float
        Predicted 1-sigma of z, from the calibration alone, worst in the volume, metres.
    left_out_z_m : float
        Rms error of z at a height that the calibration has not seen, worst height, metres.
    stage_scale_error : float
        True travel of z per metre read, off 1.
    stage_lean_rad : float
        Lean of z travel against the plate's normal, radians.
    uncovered_part : float
        Part of the camera's image farther from any hole than an eighth of its width.
    kept_lens_sigmas : float
        Where one device's lens is kept: how far it lies from the one that the run itself finds.
    """

    hole_rms_px: float = 0.1
    target_rms_px: float = 0.1
    rejected_part: float = 0.15
    point_sigma_m: float = 1e-6
    left_out_z_m: float = 2e-6
    stage_scale_error: float = 0.01
    stage_lean_rad: float = 0.1
    uncovered_part: float = 0.5
    kept_lens_sigmas: float = 6.0


@dataclass(frozen=True)
class Verdict:
    """Whether a calibration may be put in force.

    Parameters
    ----------
    passed : bool
        All figures are known and within their limits.
    reasons : tuple of str
        For each figure that is not, what was found and what was expected.
    figures : mapping
        All that were judged.
    """

    passed: bool
    reasons: tuple[str, ...]
    figures: Mapping[str, float]


def judge(figures: Mapping[str, float], limits: Any) -> Verdict:
    """Hold figures, named as the limits are, against them; NaN is never within a limit."""
    reasons = tuple(
        f"{name} is {figures[name]:.3g}; expected at most {limit:.3g}"
        for name, limit in asdict(limits).items()
        if name in figures and not figures[name] <= limit
    )
    return Verdict(not reasons, reasons, dict(figures))


def uncovered_part(pixels: Array, image_size: tuple[int, int]) -> float:
    """Part of an image farther from any of (N, 2) pixels than an eighth of its width."""
    width, height = image_size
    u, v = np.meshgrid(np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 25))
    places = np.stack([u.ravel(), v.ravel()], axis=1)
    distance, _ = KDTree(pixels).query(places)
    return float(np.mean(distance > width / 8))
