"""Leave one height out: how well the others predict it.

The solution without a height is one Gauss-Newton step away from the full one; the problem is so
nearly linear there that the step's own error is of second order, and a check of five heights costs
less than one solution.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_calibration.bundle.bundle_adjustment import Bundle, rms
from sl_calibration.bundle.covariance import triangle
from sl_calibration.bundle.derivatives import intersect, project
from sl_calibration.bundle.parameters import State

Array = NDArray[np.float64]


class HeightError(NamedTuple):
    """Errors at a height that the solution has not seen; NaN where there is nothing to compare.

    ``height_m`` of the stage; rms of holes (camera pixels), of targets (DMD pixels), and of the
    targets' triangulated z against the plane where the stage has put it (metres).
    """

    height_m: float
    hole_rms_px: float
    target_rms_px: float
    z_rms_m: float


def leave_heights_out(bundle: Bundle) -> tuple[HeightError, ...]:
    """Leave out each height in turn; empty for fewer than three heights, which leaves no check.

    Views aside (other x or y) are left out with their height, but not compared: what x and y
    travel does may be told by them alone.
    """
    problem = bundle.problem
    stage_m = np.concatenate([problem.holes.stage_m, problem.targets.stage_m])
    heights, aside = stage_m[:, 2], np.any(stage_m[:, :2], axis=1)
    distinct = np.unique(heights)
    if len(distinct) < 3:
        return ()
    residuals, jacobian, prior, by_prior = bundle.linearised()
    found = []
    for height_m in distinct:
        others = bundle.used & (heights != height_m)
        rows = np.concatenate([jacobian[others].reshape(-1, problem.size), by_prior])
        right = np.concatenate([residuals[others].ravel(), prior])
        size = np.linalg.norm(rows, axis=0)
        size[size == 0] = 1.0  # x and y travel, where only this height tells of them
        small = triangle(np.column_stack([rows / size, right]))
        step = -np.linalg.lstsq(small[:, :-1], small[:, -1], rcond=None)[0] / size
        state = problem.moved(bundle.state, step)
        here = bundle.used & (heights == height_m) & ~aside
        found.append(_compare(bundle, state, here, float(height_m)))
    return tuple(found)


def _compare(bundle: Bundle, state: State, rows: NDArray[np.bool_], height_m: float) -> HeightError:
    problem = bundle.problem
    residuals = problem.linearised(state).residuals * problem.sigma_px
    hole_rms, target_rms = (rms(residuals[group][rows[group]]) for group in problem.groups)
    z_error = _height_errors(bundle, state)[rows[problem.groups[1]], np.newaxis]
    return HeightError(height_m, hole_rms, target_rms, rms(z_error))


def _height_errors(bundle: Bundle, state: State) -> Array:
    """Triangulated z of every target, by its column, less that of its plane, (N,) metres."""
    data = bundle.problem.targets
    normal, height, _ = bundle.problem.planes(state)
    hit = intersect(state.devices[0], data.camera_px, normal, height)
    seen = project(state.devices[1], hit.points_m)
    column_by_height = np.einsum("nj,nj->n", seen.by_point[:, 0], hit.by_height)
    risen = (data.pixels[:, 0] - seen.pixels[:, 0]) / column_by_height
    return np.asarray(risen * hit.by_height[:, 2])
