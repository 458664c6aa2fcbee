"""The full bundle adjustment: robust descent, rejection of wrong points, covariance.

Levenberg-Marquardt under Cauchy weights, then with the points that are left (`outlier_rejection`),
every step and the covariance from one QR factorisation (`covariance`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sl_calibration.bundle.covariance import Linearised, weighted_system
from sl_calibration.bundle.outlier_rejection import (
    cauchy_weights,
    inlier_weights,
    inliers,
    sigma_scales,
)
from sl_calibration.bundle.parameters import State
from sl_calibration.bundle.rig_problem import RigProblem
from sl_calibration.bundle.stage_model import StageReport, stage_report
from sl_common.errors import CalibrationError
from sl_reconstruct.model.calibration_file import Covariance

Array = NDArray[np.float64]

_MAX_STEPS = 30
_MAX_REJECTIONS = 6
_MAX_DAMPING = 1e9
#: Converged when a step can lower the cost by no more than this part of it.
_STILL = 1e-7


@dataclass(frozen=True)
class Bundle:
    """A solved bundle with its evidence.

    Parameters
    ----------
    problem : RigProblem
        What was solved: observations and freedom.
    state : State
        Devices, stage and flat.
    covariance : Covariance
        Of every parameter, by name; rotations are small turns about the device's own axes.
    residuals_px : ndarray, (M, 2)
        Predicted less observed, of holes, then targets, wrong ones included, pixels.
    used : ndarray of bool, (M,)
        False for points that were rejected as wrong.
    chi2, dof : float, int
        Of used points and priors with the sigmas as stated, and its degrees of freedom.
    scales : ndarray, (2,)
        Factors by which the sigmas of holes and targets were enlarged to agree with the residuals.
    """

    problem: RigProblem
    state: State
    covariance: Covariance
    residuals_px: Array
    used: NDArray[np.bool_]
    chi2: float
    dof: int
    scales: Array

    @property
    def sigmas(self) -> dict[str, float]:
        """1-sigma of each parameter by name."""
        values = np.sqrt(np.diag(self.covariance.matrix))
        return dict(zip(self.covariance.parameters, map(float, values), strict=True))

    @property
    def stage(self) -> StageReport:
        """The stage's directions and scales with their sigmas."""
        full, problem = np.zeros((9, 9)), self.problem
        block = problem.columns["axes"]
        rows = np.array([3 * axis + i for axis in problem.moving for i in range(3)], dtype=int)
        full[np.ix_(rows, rows)] = self.covariance.matrix[block, block]
        return stage_report(self.state.axes, full, problem.moving)

    @property
    def misfit(self) -> float:
        """Median length of all residuals in sigmas: what tells a right start from a wrong one."""
        return float(np.median(np.hypot(*(self.residuals_px / self.problem.sigma_px).T)))

    def linearised(self) -> Linearised:
        """Residuals and derivatives at the solution, in the enlarged sigmas."""
        at = self.problem.linearised(self.state)
        for group, scale in zip(self.problem.groups, self.scales, strict=True):
            at.residuals[group] /= scale
            at.jacobian[group] /= scale
        return at

    def residuals_of(self, group: int) -> Array:
        """Residuals (N, 2) of used holes (0) or targets (1), pixels."""
        part = self.problem.groups[group]
        return np.asarray(self.residuals_px[part][self.used[part]])

    def rms_px(self, group: int) -> float:
        """Root mean square of the residual vectors' lengths; NaN for none."""
        return rms(self.residuals_of(group))


def rms(vectors: Array) -> float:
    """Root mean square length of vectors (N, D); NaN for none."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1)))) if len(vectors) else np.nan


def solve_bundle(problem: RigProblem, start: State) -> Bundle:
    """Minimise the residuals, leave out wrong points, and say how well the parameters are known.

    Parameters
    ----------
    problem : RigProblem
        Observations and freedom.
    start : State
        Where to begin: `RigProblem.start`.

    Raises
    ------
    CalibrationError
        When too few points are left or the points do not determine the parameters.
    """
    groups = problem.groups
    state = _descend(problem, start, lambda residuals: cauchy_weights(residuals, groups))
    used: NDArray[np.bool_] | None = None
    for _ in range(_MAX_REJECTIONS):
        residuals = problem.residuals(state)
        good = inliers(residuals, groups)
        if used is not None and (good == used).all():
            break
        used = good
        weights = inlier_weights(residuals, used, groups)
        state = _descend(problem, state, lambda _, fixed=weights: fixed)  # type: ignore[misc]
    return _solved(problem, state, np.asarray(used))


def _solved(problem: RigProblem, state: State, used: NDArray[np.bool_]) -> Bundle:
    at, groups = problem.linearised(state), problem.groups
    system = weighted_system(at, inlier_weights(at.residuals, used, groups))
    return Bundle(
        problem,
        state,
        Covariance(problem.parameters, system.covariance()),
        residuals_px=at.residuals * problem.sigma_px,
        used=used,
        chi2=_cost(problem, state, used.astype(np.float64)),
        dof=system.dof,
        scales=sigma_scales(at.residuals, used, groups),
    )


def _cost(problem: RigProblem, state: State, weights: Array) -> float:
    """Cost of a state, infinite where there is none."""
    residuals, prior = problem.residuals(state), problem.priors(state)[0]
    used = weights > 0
    cost = np.sum(weights[used] * np.sum(residuals[used] ** 2, axis=1)) + prior @ prior
    return float(cost) if np.isfinite(cost) else np.inf


def _descend(problem: RigProblem, state: State, weigh: Callable[[Array], Array]) -> State:
    """Levenberg-Marquardt; the weights are renewed at each step."""
    damping = 1e-6
    for _ in range(_MAX_STEPS):
        here = problem.linearised(state)
        weights = weigh(here.residuals)
        system = weighted_system(here, weights)
        while True:
            candidate, cost = _try(problem, state, system.step(damping), weights)
            if cost <= system.cost:
                break
            damping *= 10
            if damping > _MAX_DAMPING:
                return state
        state = candidate
        damping = max(damping / 10, 1e-12)
        if system.cost - cost <= _STILL * (system.cost + 1e-6):
            break
    return state


def _try(problem: RigProblem, state: State, step: Array, weights: Array) -> tuple[State, float]:
    """State after a step and its cost; infinite where the step leads nowhere."""
    try:
        candidate = problem.moved(state, step)
    except CalibrationError:
        return state, np.inf
    return candidate, _cost(problem, candidate, weights)
