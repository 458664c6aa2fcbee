"""The covariance of the parameters, from one triangle of the weighted Jacobian.

Everything runs on the triangle of a QR factorisation (columns scaled to unit length), never on
normal equations: focal length, depth and image centre of a tele lens are so correlated that
squaring the condition number would cost half the digits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from sl_common.errors import CalibrationError

Array = NDArray[np.float64]

_BLOCK_ROWS = 128
#: Reciprocal condition of the scaled Jacobian below which parameters cannot be told apart.
SINGULAR = 1e-9


class Linearised(NamedTuple):
    """Residuals and derivatives at a state.

    ``residuals`` (M, 2) in stated sigmas, ``jacobian`` (M, 2, P); ``prior`` (K,) and
    ``prior_jacobian`` (K, P) of what is known before.
    """

    residuals: Array
    jacobian: Array
    prior: Array
    prior_jacobian: Array


class WeightedSystem(NamedTuple):
    """Triangle (P, P) of the scaled, weighted Jacobian, rotated residual, column sizes, cost.

    ``points`` that count, and degrees of freedom ``dof``, with what is known before.
    """

    triangle: Array
    right: Array
    sizes: Array
    cost: float
    points: int
    dof: int

    def step(self, damping: float) -> Array:
        """Step (P,) of Levenberg and Marquardt."""
        rows = np.concatenate([self.triangle, np.sqrt(damping) * np.eye(len(self.sizes))])
        right = np.concatenate([-self.right, np.zeros(len(self.sizes))])
        return np.asarray(np.linalg.lstsq(rows, right, rcond=None)[0] / self.sizes)

    def covariance(self) -> Array:
        """Covariance (P, P) of the parameters.

        Raises
        ------
        CalibrationError
            When the points do not determine the parameters.
        """
        reciprocal = 1 / np.linalg.cond(self.triangle)
        if self.dof <= 0 or not reciprocal > SINGULAR:
            raise CalibrationError(
                f"{self.points} points do not determine {len(self.sizes)} parameters (reciprocal "
                f"condition {reciprocal:.1e}); expected more views, or views farther apart"
            )
        inverse = solve_triangular(self.triangle, np.eye(len(self.sizes)))
        inverse /= self.sizes[:, np.newaxis]
        return np.asarray(inverse @ inverse.T)


def weighted_system(at: Linearised, weights: Array) -> WeightedSystem:
    """Factorise a weighted problem.

    Parameters
    ----------
    at : Linearised
        Residuals and derivatives.
    weights : ndarray, (M,)
        Of the points; 0 leaves a point out. What is known before has weight 1.

    Raises
    ------
    CalibrationError
        When there are fewer rows than parameters.
    """
    used = weights > 0
    root = np.sqrt(weights[used])[:, np.newaxis]
    rows = (at.jacobian[used] * root[:, :, np.newaxis]).reshape(-1, at.jacobian.shape[2])
    rows = np.concatenate([rows, at.prior_jacobian])
    right = np.concatenate([(at.residuals[used] * root).ravel(), at.prior])
    points, dof = int(used.sum()), len(rows) - rows.shape[1]
    if dof < 0:
        raise CalibrationError(
            f"{points} usable points for {rows.shape[1]} parameters; expected many more"
        )
    sizes = np.linalg.norm(rows, axis=0)
    sizes[sizes == 0] = 1.0
    both = triangle(np.column_stack([rows / sizes, right]))
    n = len(sizes)
    return WeightedSystem(both[:n, :n], both[:n, n], sizes, float(right @ right), points, dof)


def triangle(rows: Array) -> Array:
    """Triangle R (P, P) of the QR factorisation of a tall matrix (M, P), by blocks of rows.

    Blocks so small that the BLAS does not spread them over threads: on a machine that works at
    other things too, waiting for its threads takes several times longer than the factorisation.
    """
    width = rows.shape[1]
    block = max(_BLOCK_ROWS, 3 * width)
    while len(rows) > block:
        short = -len(rows) % block
        rows = np.concatenate([rows, np.zeros((short, width))])
        blocks = rows.reshape(-1, block, width)
        rows = np.asarray(np.linalg.qr(blocks, mode="r")).reshape(-1, width)
    rows = np.concatenate([rows, np.zeros((max(0, width - len(rows)), width))])
    return np.asarray(np.linalg.qr(rows, mode="r"))
