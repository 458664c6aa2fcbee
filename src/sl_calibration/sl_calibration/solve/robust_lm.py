"""Robust least squares: Levenberg-Marquardt under Cauchy weights, then rejection, then covariance.

Everything runs on the triangle of one QR factorisation of the weighted Jacobian (columns scaled
to unit length), never on normal equations: focal length, depth and image centre of a tele lens
are so correlated that squaring the condition number would cost half the digits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from sl_common.errors import CalibrationError

Array = NDArray[np.float64]
State = TypeVar("State")

#: Cauchy's weight is 1/2 at so many sigma: 95 % efficient on good points.
CAUCHY_SIGMA = 2.385
#: A point farther off than this, in robust sigmas, is rejected; of good points 4 in a million are.
REJECT_SIGMA = 5.0
#: Median of the length of a vector of two unit-normal coordinates.
_RAYLEIGH_MEDIAN = float(np.sqrt(2 * np.log(2)))
_MAX_STEPS = 30
_MAX_REJECTIONS = 6
_MAX_DAMPING = 1e9
_BLOCK_ROWS = 128
#: Converged when a step can lower the cost by no more than this part of it.
_STILL = 1e-7
#: Reciprocal condition of the scaled Jacobian below which parameters cannot be told apart.
SINGULAR = 1e-9


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
        """Residuals in sigmas (K,) of what is known beforehand, derivatives (K, P)."""
        ...

    def moved(self, state: State, step: Array) -> State:
        """State after a step (P,); CalibrationError where there is none."""
        ...


class Fit(NamedTuple):
    """Outcome.

    ``residuals`` (M, 2) in stated sigmas, rejected ones included; ``used`` (M,); ``covariance``
    (P, P) of the weighted normal equations; ``chi2`` of used points and priors with the stated
    sigmas, and its degrees of freedom; ``scales`` (G,): by how much each group's sigmas had to be
    enlarged to agree with its residuals (1 where they were right), as they are in the covariance.
    """

    residuals: Array
    used: NDArray[np.bool_]
    covariance: Array
    chi2: float
    dof: int
    scales: Array


class _System(NamedTuple):
    """Triangle (P, P) of the scaled, weighted Jacobian, rotated residual, column sizes, cost."""

    triangle: Array
    right: Array
    sizes: Array
    cost: float


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
    state = _descend(problem, start, lambda residuals: _cauchy(residuals, groups))
    used: NDArray[np.bool_] | None = None
    for _ in range(_MAX_REJECTIONS):
        residuals = problem.residuals(state)
        kept = _inliers(residuals, groups)
        if used is not None and (kept == used).all():
            break
        used = kept
        weights = _plain(residuals, used, groups)
        state = _descend(problem, state, lambda _, fixed=weights: fixed)  # type: ignore[misc]
    return state, _conclude(problem, state, np.asarray(used))


def _lengths(residuals: Array) -> Array:
    return np.asarray(np.nan_to_num(np.hypot(*residuals.T), nan=np.inf, posinf=np.inf))


def _spread(lengths: Array, groups: Sequence[slice]) -> Array:
    """Robust sigma (M,) of each point's coordinates, by its group; at least the stated one."""
    spread = np.ones(len(lengths))
    for group in groups:
        if lengths[group].size:
            spread[group] = max(1.0, float(np.median(lengths[group])) / _RAYLEIGH_MEDIAN)
    return spread


def _inliers(residuals: Array, groups: Sequence[slice]) -> NDArray[np.bool_]:
    lengths = _lengths(residuals)
    return np.asarray(lengths <= REJECT_SIGMA * _spread(lengths, groups))


def _cauchy(residuals: Array, groups: Sequence[slice]) -> Array:
    lengths = _lengths(residuals)
    spread = _spread(lengths, groups)
    return np.asarray(1.0 / (1.0 + (lengths / (CAUCHY_SIGMA * spread)) ** 2))


def _scales(residuals: Array, used: NDArray[np.bool_], groups: Sequence[slice]) -> Array:
    """Rms of each group's used residuals in stated sigmas; at least 1."""
    parts = [residuals[group][used[group]] for group in groups]
    return np.array([max(1.0, np.sqrt(np.mean(p**2))) if p.size else 1.0 for p in parts])


def _plain(residuals: Array, used: NDArray[np.bool_], groups: Sequence[slice]) -> Array:
    """1 / scale^2 for used points and 0 for others."""
    weights = used.astype(np.float64)
    for group, scale in zip(groups, _scales(residuals, used, groups), strict=True):
        weights[group] /= scale**2
    return weights


def _system(
    residuals: Array, jacobian: Array, priors: tuple[Array, Array], weights: Array
) -> _System:
    prior, prior_jacobian = priors
    used = weights > 0
    root = np.sqrt(weights[used])[:, np.newaxis]
    rows = (jacobian[used] * root[:, :, np.newaxis]).reshape(-1, jacobian.shape[2])
    rows = np.concatenate([rows, prior_jacobian])
    right = np.concatenate([(residuals[used] * root).ravel(), prior])
    if len(rows) < rows.shape[1]:
        raise CalibrationError(
            f"{int(used.sum())} usable points for {rows.shape[1]} parameters; expected many more"
        )
    sizes = np.linalg.norm(rows, axis=0)
    sizes[sizes == 0] = 1.0
    both = triangle(np.column_stack([rows / sizes, right]))
    n = len(sizes)
    return _System(both[:n, :n], both[:n, n], sizes, float(right @ right))


def triangle(rows: Array) -> Array:
    """Triangle R of the QR factorisation of a tall matrix, by blocks of rows.

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


def _cost(problem: Problem[State], state: State, weights: Array) -> float:
    """Cost of a state, infinite where there is none."""
    residuals, prior = problem.residuals(state), problem.priors(state)[0]
    used = weights > 0
    cost = np.sum(weights[used] * np.sum(residuals[used] ** 2, axis=1)) + prior @ prior
    return float(cost) if np.isfinite(cost) else np.inf


def _descend(problem: Problem[State], state: State, weigh: Callable[[Array], Array]) -> State:
    """Levenberg-Marquardt; the weights are renewed at each step."""
    damping = 1e-6
    for _ in range(_MAX_STEPS):
        residuals, jacobian = problem.evaluate(state)
        weights = weigh(residuals)
        system = _system(residuals, jacobian, problem.priors(state), weights)
        while True:
            candidate, cost = _try(problem, state, _step(system, damping), weights)
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


def _step(system: _System, damping: float) -> Array:
    n = len(system.sizes)
    rows = np.concatenate([system.triangle, np.sqrt(damping) * np.eye(n)])
    right = np.concatenate([-system.right, np.zeros(n)])
    return np.asarray(np.linalg.lstsq(rows, right, rcond=None)[0] / system.sizes)


def _try(problem: Problem[State], state: State, step: Array, weights: Array) -> tuple[State, float]:
    """State after a step and its cost; infinite where the step leads nowhere."""
    try:
        candidate = problem.moved(state, step)
    except CalibrationError:
        return state, np.inf
    return candidate, _cost(problem, candidate, weights)


def _conclude(problem: Problem[State], state: State, used: NDArray[np.bool_]) -> Fit:
    residuals, jacobian = problem.evaluate(state)
    priors, groups = problem.priors(state), problem.groups
    system = _system(residuals, jacobian, priors, _plain(residuals, used, groups))
    stated = _cost(problem, state, used.astype(np.float64))
    dof = 2 * int(used.sum()) + len(priors[0]) - len(system.sizes)
    reciprocal = 1 / np.linalg.cond(system.triangle)
    if dof <= 0 or not reciprocal > SINGULAR:
        raise CalibrationError(
            f"{int(used.sum())} points do not determine {len(system.sizes)} parameters (reciprocal "
            f"condition {reciprocal:.1e}); expected more views, or views farther apart"
        )
    inverse = solve_triangular(system.triangle, np.eye(len(system.sizes)))
    inverse /= system.sizes[:, np.newaxis]
    scales = _scales(residuals, used, groups)
    return Fit(residuals, used, inverse @ inverse.T, stated, dof, scales)
