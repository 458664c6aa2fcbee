"""Least squares with outliers set aside."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sl_reconstruct.cloud.plane_fit import TRIM_SD, robust_sd

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROUNDS = 4
#: Residuals below this are rounding, never outliers, metres.
ROUNDING_M = 1e-15


def trimmed_fit(design: Array, values: Array) -> tuple[Array, Mask]:
    """Fit ``values = design @ found``; points off by more than 5 robust deviations do not count.

    Parameters
    ----------
    design : ndarray, (n, p)
        Of the model.
    values : ndarray, (n,)
        Measured.

    Returns
    -------
    found : ndarray, (p,)
        Parameters.
    used : ndarray of bool, (n,)
        Points that count.
    """
    start: Array = np.zeros(design.shape[1])

    def fit(used: Mask, _: Array) -> Array:
        return np.asarray(np.linalg.lstsq(design[used], values[used], rcond=None)[0], np.float64)

    return trim(fit, lambda found: values - design @ found, start, ROUNDS)


def trim(
    fit: Callable[[Mask, Array], Array],
    residual: Callable[[Array], Array],
    start: Array,
    rounds: int,
) -> tuple[Array, Mask]:
    """Fit in rounds, each without the outliers of the one before.

    Parameters
    ----------
    fit : callable
        Points that count (n,) and the last parameters (p,) to new parameters (p,).
    residual : callable
        Parameters to the residuals (n,) of all points, metres.
    start : ndarray, (p,)
        Parameters to begin with.
    rounds : int
        Fits at the most.

    Returns
    -------
    found, used
        As of `trimmed_fit`.
    """
    found, used = start, np.ones(len(residual(start)), dtype=np.bool_)
    for _ in range(rounds):
        found = fit(used, found)
        off = residual(found)
        limit = max(TRIM_SD * robust_sd(off[used]), ROUNDING_M)
        inside = np.asarray(np.abs(off) <= limit)
        if (inside == used).all() or np.count_nonzero(inside) <= len(found):
            break
        used = inside
    return found, used
