"""Which starts a camera's bundle is tried from, in which order, and which outcome is taken."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from sl_calibration.bundle.bundle_adjustment import Bundle, solve_bundle
from sl_calibration.bundle.rig_problem import RigProblem
from sl_calibration.data.solver_input import Holes
from sl_calibration.solve.image_centre_search import search_centre
from sl_calibration.solve.linear_step import Sensor, linear_step
from sl_common.errors import CalibrationError
from sl_reconstruct.model.rig import Device

#: A start is good when it leads to residuals within this many stated sigmas; else others are tried.
GOOD_SCALE = 3.0
#: Image centres for further starts, in image sizes off the middle. A stage that leans by a degree
#: looks to the paper's search like an image centre off by hundreds of pixels.
_CENTRES = np.array([[0, 0], [-0.3, -0.3], [0.3, 0.3], [-0.3, 0.3], [0.3, -0.3]])


def solve_from_many_starts(problem: RigProblem, good: NDArray[np.bool_], sensor: Sensor) -> Bundle:
    """Solve a camera from the paper's solution; from others where that leads nowhere.

    Parameters
    ----------
    problem : RigProblem
        Of a camera alone.
    good : ndarray of bool, (N,)
        Holes that the starts are made from.
    sensor : Sensor
        Image size and pixel pitch.

    Raises
    ------
    CalibrationError
        When no start leads to a solution.
    """
    best: Bundle | None = None
    refusal = CalibrationError("no start was found")
    for device in _starts(problem.holes.part(good), sensor):
        try:
            found = solve_bundle(problem, problem.start(device))
        except CalibrationError as error:
            refusal = error
            continue
        if best is None or found.misfit < best.misfit:
            best = found
        if best.scales.max() < GOOD_SCALE:
            break
    if best is None:
        raise refusal
    return best


def _starts(holes: Holes, sensor: Sensor) -> Iterator[Device]:
    """Yield the paper's solution, first or last: it is good where the stage is as the paper's."""
    points = holes.nominal_m
    search = search_centre(points, holes.pixels, sensor)
    noise_px2 = float(np.sum(holes.sigma_px**2))
    faultless = search.cost_after_px2 < GOOD_SCALE**2 * noise_px2
    if faultless:
        yield search.device
    size = np.array(sensor.image_size)
    for off in _CENTRES:
        with suppress(CalibrationError):
            yield linear_step(points, holes.pixels, (size - 1) / 2 + off * size, sensor)
    if not faultless:
        yield search.device
