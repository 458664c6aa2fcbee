"""Linear least squares with outliers set aside."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sl_reconstruct.cloud.plane_fit import TRIM_SD, robust_sd

Array = NDArray[np.float64]

ROUNDS = 4
#: Residuals below this are rounding, never outliers, metres.
ROUNDING_M = 1e-15


def trimmed_fit(design: Array, values: Array) -> tuple[Array, NDArray[np.bool_]]:
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
    used: NDArray[np.bool_] = np.ones(len(values), dtype=np.bool_)
    found: Array = np.zeros(design.shape[1])
    for _ in range(ROUNDS):
        found = np.asarray(np.linalg.lstsq(design[used], values[used], rcond=None)[0], np.float64)
        residual = values - design @ found
        limit = max(TRIM_SD * robust_sd(residual[used]), ROUNDING_M)
        inside = np.asarray(np.abs(residual) <= limit)
        if (inside == used).all() or np.count_nonzero(inside) <= design.shape[1]:
            break
        used = inside
    return found, used
