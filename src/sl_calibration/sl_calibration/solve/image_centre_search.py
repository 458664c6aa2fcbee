"""The paper's non-linear step (Fig. 4b): the image centre that minimises J."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from sl_calibration.solve.linear_step import Sensor, cost_px2, linear_step
from sl_common.errors import CalibrationError
from sl_reconstruct.model.rig import Device

Array = NDArray[np.float64]

#: First look: centres on a grid over this many image sizes about the middle, since a projector's
#: centre lies at the DMD's border or beyond.
_LOOK = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])


class CentreSearch(NamedTuple):
    """Outcome of the search.

    ``device``; J with the centre in the image's middle and at the minimum, px^2 (before is NaN
    where no device fits the middle); the number of points; the linear steps taken.
    """

    device: Device
    cost_before_px2: float
    cost_after_px2: float
    points: int
    steps: int


def search_centre(points_m: Array, pixels: Array, sensor: Sensor) -> CentreSearch:
    """Find the image centre by Nelder and Mead's simplex, the linear step inside.

    Parameters
    ----------
    points_m : ndarray, (N, 3)
        World points, metres.
    pixels : ndarray, (N, 2)
        Observed images, pixels; wrong ones removed.
    sensor : Sensor
        Image size and pixel pitch.

    Raises
    ------
    CalibrationError
        When the linear step has a solution for no image centre that was tried.
    """
    size = np.array(sensor.image_size)
    middle = (size - 1) / 2

    def cost(centre_px: Array) -> float:
        try:
            value = cost_px2(linear_step(points_m, pixels, centre_px, sensor), points_m, pixels)
        except CalibrationError:
            return np.inf
        return value if np.isfinite(value) else np.inf

    grid = [middle + size * np.array([x, y]) for y in _LOOK for x in _LOOK]
    costs = [cost(centre) for centre in grid]
    best = int(np.argmin(costs))
    if not np.isfinite(costs[best]):
        raise CalibrationError(
            f"the linear step fits no device to {len(points_m)} points, whatever the image centre; "
            "expected non-coplanar points seen from above (are the heights' signs right?)"
        )
    simplex = grid[best] + 0.15 * size.min() * np.array([[0, 0], [1, 0], [0, 1]])
    options = {"initial_simplex": simplex, "xatol": 0.5, "fatol": 1e-4 * costs[best], "maxfev": 200}
    found = minimize(cost, grid[best], method="Nelder-Mead", options=options)
    device = linear_step(points_m, pixels, found.x, sensor)
    before = costs[len(costs) // 2]
    before = before if np.isfinite(before) else np.nan
    steps = len(grid) + int(found.nfev)
    return CentreSearch(device, before, float(found.fun), len(points_m), steps)
