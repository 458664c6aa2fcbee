"""The camera from the plate's holes: the paper's two steps (Fig. 4), then the full bundle."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sl_calibration.bundle import Bundle, Freedom, RigProblem, solve_bundle
from sl_calibration.enough import check_determined, check_side, check_views
from sl_calibration.linear import Sensor, linear_step
from sl_calibration.samples import Holes, HoleView, Targets
from sl_calibration.screen import fits_plane
from sl_calibration.search import CentreSearch, search_centre
from sl_projector.errors import CalibrationError
from sl_reconstruct.rig import Device

Array = NDArray[np.float64]

#: A start is good when it leads to residuals within so many stated sigmas; else others are tried.
GOOD_SCALE = 3.0
#: Image centres for further starts, in image sizes off the middle. A stage that leans by a degree
#: looks to the paper's search like an image centre off by hundreds of pixels.
_STARTS = np.array([[0, 0], [-0.3, -0.3], [0.3, 0.3], [-0.3, 0.3], [0.3, -0.3]])


@dataclass(frozen=True)
class DeviceSolution:
    """One device, solved on its own.

    Parameters
    ----------
    search : CentreSearch
        The paper's solution: linear step within the search of the image centre, its J.
    bundle : Bundle
        The full bundle, with covariance and residuals.
    """

    search: CentreSearch
    bundle: Bundle

    @property
    def device(self) -> Device:
        """The device of the bundle."""
        return self.bundle.state.devices[0]


def solve_camera(
    views: Sequence[HoleView], sensor: Sensor, freedom: Freedom | None = None
) -> DeviceSolution:
    """Calibrate a camera.

    Parameters
    ----------
    views : sequence of HoleView
        The plate at two or more heights; five over the depth of the volume are good.
    sensor : Sensor
        Image size and pixel pitch.
    freedom : Freedom
        What is estimated besides the camera.

    Notes
    -----
    One camera tells z travel's scale from its lean mostly by where the lens distorts least, and by
    the stage's prior; `solve_joint` sees the travel from two sides and needs neither.
    The search is done twice: for a faultless stage, as the paper does, to start the bundle; then
    for the stage as the bundle found it, which is what is reported.

    Raises
    ------
    CalibrationError
        When the views are degenerate, or nothing fits them.
    """
    holes = Holes.of(views)
    check_views(holes.stage_m, holes.view, "holes")
    good = fits_plane(holes.points_m[:, :2], holes.pixels, holes.view)
    check_views(holes.stage_m[good], holes.view[good], "holes that fit a plane")
    problem = RigProblem(("camera",), holes, Targets.of([]), freedom or Freedom())
    bundle = _from_many_starts(problem, good, sensor)
    check_determined(bundle)
    check_side(bundle)
    used = bundle.used
    world_m = (holes.points_m + holes.stage_m @ bundle.state.axes.T)[used]
    return DeviceSolution(search_centre(world_m, holes.pixels[used], sensor), bundle)


def _from_many_starts(problem: RigProblem, good: NDArray[np.bool_], sensor: Sensor) -> Bundle:
    """Bundle from the paper's solution; from others where that leads nowhere."""
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
    for off in _STARTS:
        with suppress(CalibrationError):
            yield linear_step(points, holes.pixels, (size - 1) / 2 + off * size, sensor)
    if not faultless:
        yield search.device
