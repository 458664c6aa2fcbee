"""Robust least squares: Levenberg-Marquardt under Cauchy weights, rejection, covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from sl_calibration.bundle.covariance import Linearised, weighted_system
from sl_calibration.bundle.outlier_rejection import (
    cauchy_weights,
    inlier_weights,
    inliers,
    sigma_scales,
)
from sl_common.errors import CalibrationError

Array = NDArray[np.float64]
State = TypeVar("State")

_MAX_STEPS = 30
_MAX_REJECTIONS = 6
_MAX_DAMPING = 1e9
#: Converged when a step can lower the cost by no more than this part of it.
_STILL = 1e-7


class Problem(Protocol[State]):
    """What the solver needs to know of a problem with P parameters and M points."""

    @property
    def groups(self) -> Sequence[slice]:
        """Points whose stated sigmas are wrong by the same factor, if they are."""
        ...

    def residuals(self, state: State) -> Array:
        """Residuals in sigmas (M, 2)."""
        ...

    def evaluate(self, state: State) -> tuple[Array, Array]:
        """Residuals in sigmas (M, 2) and their derivatives (M, 2, P)."""
        ...

    def priors(self, state: State) -> tuple[Array, Array]:
        """Residuals in sigmas (K,) of what is known before, derivatives (K, P)."""
        ...

    def moved(self, state: State, step: Array) -> State:
        """Move a state.

        Parameters
        ----------
        state : State
            Where to start from.
        step : ndarray, (P,)
            In the units of the parameters.

        Raises
        ------
        CalibrationError
            When the step leads to no possible state.
        """
        ...


class Fit(NamedTuple):
    """Outcome.

    ``residuals`` (M, 2) in stated sigmas, rejected ones included; ``used`` (M,); ``covariance``
    (P, P); ``chi2`` of used points and priors with the stated sigmas, and its degrees of freedom;
    ``scales`` (G,): by how much each group's sigmas had to be enlarged to agree with its residuals
    (1 where they were right), as they are in the covariance.
    """

    residuals: Array
    used: NDArray[np.bool_]
    covariance: Array
    chi2: float
    dof: int
    scales: Array


def solve(problem: Problem[State], start: State) -> tuple[State, Fit]:
    """Minimise the residuals, leave out wrong points, and say how well the parameters are known.

    Parameters
    ----------
    problem : Problem
        Residuals and derivatives.
    start : State
        Where to begin.

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
    return state, _fit(problem, state, np.asarray(used))


def _cost(problem: Problem[State], state: State, weights: Array) -> float:
    """Cost of a state, infinite where there is none."""
    residuals, prior = problem.residuals(state), problem.priors(state)[0]
    used = weights > 0
    cost = np.sum(weights[used] * np.sum(residuals[used] ** 2, axis=1)) + prior @ prior
    return float(cost) if np.isfinite(cost) else np.inf


def _linearised(problem: Problem[State], state: State) -> Linearised:
    return Linearised(*problem.evaluate(state), *problem.priors(state))


def _descend(problem: Problem[State], state: State, weigh: Callable[[Array], Array]) -> State:
    """Levenberg-Marquardt; the weights are renewed at each step."""
    damping = 1e-6
    for _ in range(_MAX_STEPS):
        here = _linearised(problem, state)
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


def _try(problem: Problem[State], state: State, step: Array, weights: Array) -> tuple[State, float]:
    """State after a step and its cost; infinite where the step leads nowhere."""
    try:
        candidate = problem.moved(state, step)
    except CalibrationError:
        return state, np.inf
    return candidate, _cost(problem, candidate, weights)


def _fit(problem: Problem[State], state: State, used: NDArray[np.bool_]) -> Fit:
    at, groups = _linearised(problem, state), problem.groups
    system = weighted_system(at, inlier_weights(at.residuals, used, groups))
    stated = _cost(problem, state, used.astype(np.float64))
    scales = sigma_scales(at.residuals, used, groups)
    return Fit(at.residuals, used, system.covariance(), stated, system.dof, scales)
