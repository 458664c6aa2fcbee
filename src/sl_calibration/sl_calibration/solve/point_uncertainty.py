"""How well a triangulated point is known: the joint covariance and the edges' noise, propagated.

A point X fulfils F(X, parameters) = observed, with F the camera's (u, v) and the projector's
column (three equations, as `sl_reconstruct` solves them) or column and row (four). To first order
``dX = G (d observed - dF/d parameters d parameters)`` with G the (pseudo-)inverse of dF/dX.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_calibration.bundle.bundle_adjustment import Bundle
from sl_calibration.bundle.derivatives import project

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
    """Predict sigmas over a volume.

    Parameters
    ----------
    bundle : Bundle
        A joint solution.
    volume : Volume
        Where.
    noise : EdgeNoise
        Noise of a single point.
    shape : tuple of int
        Number of points along x, y, z.

    Returns
    -------
    points_m, sigma_m : ndarray, (nz, ny, nx, 3)
        Points that span the volume, and their 1-sigma, metres; NaN where a device does not see one.
    """
    grid = volume.grid(shape)
    sigma = point_covariance(bundle, grid.reshape(-1, 3), noise).sigma_m
    return grid, sigma.reshape(grid.shape)
