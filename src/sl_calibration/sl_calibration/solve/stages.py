"""The stages of a calibration: the camera alone, the projector with it, then both together.

The camera from the plate's holes by the paper's two steps (Fig. 4) and the full bundle; the
projector as an inverse camera (Fig. 5), whose targets are its light as the camera sees it; then
both refined together, with one covariance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sl_calibration.data.homography_prefilter import fits_plane
from sl_calibration.data.observations import Holes, HoleView, Targets, TargetView
from sl_calibration.solve.bundle_adjustment import Bundle, Freedom, RigProblem, solve_bundle
from sl_calibration.solve.derivatives import meet
from sl_calibration.solve.image_centre_search import CentreSearch, search_centre
from sl_calibration.solve.linear import Sensor, linear_step
from sl_calibration.solve.observability import check_determined, check_side, check_views
from sl_calibration.solve.stage_model import FAULTLESS
from sl_common.errors import CalibrationError
from sl_reconstruct.model.rig import Device, Rig

Array = NDArray[np.float64]

#: A start is good when it leads to residuals within so many stated sigmas; else others are tried.
GOOD_SCALE = 3.0
#: Image centres for further starts, in image sizes off the middle. A stage that leans by a degree
#: looks to the paper's search like an image centre off by hundreds of pixels.
_STARTS = np.array([[0, 0], [-0.3, -0.3], [0.3, 0.3], [-0.3, 0.3], [0.3, -0.3]])

#: The search of the image centre takes the linear step a hundred times; it needs no more points.
_SEARCH_POINTS = 2000


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


def world_points(targets: Targets, camera: Device, axes: Array) -> Array:
    """Where the camera's rays meet the plate's plane at each height, (N, 3) metres.

    ``axes`` (3, 3) is the stage's A, from the camera's bundle. The patterns are taken to fall on
    the plate (or on a flat in its place); where the flat is another, the joint refinement finds
    its offset and slopes.
    """
    heights = (targets.stage_m @ axes.T)[:, 2]
    normal = np.array([0.0, 0.0, 1.0])
    return meet(camera, targets.camera_px, normal, heights)


def solve_projector(
    views: Sequence[TargetView],
    camera: Device,
    axes: Array,
    sensor: Sensor,
    square_pixels: bool = True,
) -> DeviceSolution:
    """Calibrate a projector with a calibrated camera: the paper's two steps, then the bundle.

    Parameters
    ----------
    views : sequence of TargetView
        DMD coordinates on a flat at two or more heights.
    camera : Device
        The calibrated camera.
    axes : ndarray, (3, 3)
        The stage's axes as they were found with it (`State.axes`); the unit matrix if faultless.
    sensor : Sensor
        Size of the DMD and its pitch.
    square_pixels : bool
        One focal length, or fx and fy.

    Notes
    -----
    The targets' world points are taken as true: the covariance does not hold the camera's part.
    `solve_joint` solves both together and does.

    Raises
    ------
    CalibrationError
        When the views are degenerate, or nothing fits them.
    """
    targets = Targets.of(views)
    check_views(targets.stage_m, targets.view, "projected targets")
    good = fits_plane(targets.camera_px, targets.pixels, targets.view)
    check_views(targets.stage_m[good], targets.view[good], "projected targets that fit a plane")
    points = world_points(targets, camera, axes)
    good &= np.isfinite(points).all(axis=1)
    few = np.flatnonzero(good)
    few = few[:: 1 + len(few) // _SEARCH_POINTS]
    search = search_centre(points[few], targets.pixels[few], sensor)
    seen = Holes(points, np.zeros_like(points), targets.view, targets.pixels, targets.sigma_px)
    problem = RigProblem(
        ("projector",), seen, Targets.of([]), Freedom(FAULTLESS, None, square_pixels)
    )
    bundle = solve_bundle(problem, problem.start(search.device))
    check_determined(bundle)
    check_side(bundle)
    return DeviceSolution(search, bundle)


def solve_joint(
    holes: Sequence[HoleView],
    targets: Sequence[TargetView],
    camera: DeviceSolution,
    projector: DeviceSolution,
    freedom: Freedom | None = None,
) -> Bundle:
    """Refine both devices, the stage and, where wanted, the flat on holes and targets at once.

    Parameters
    ----------
    holes, targets : sequence
        All views.
    camera, projector : DeviceSolution
        Where to start.
    freedom : Freedom
        What is estimated besides the devices.

    Notes
    -----
    Two devices see the stage's travel from two sides: together they determine its scale and both
    leans, which the camera alone does not.

    Raises
    ------
    CalibrationError
        When the views do not determine the parameters.
    """
    problem = RigProblem(
        ("camera", "projector"), Holes.of(holes), Targets.of(targets), freedom or Freedom()
    )
    start = problem.start(camera.device, projector.device)
    bundle = solve_bundle(problem, start._replace(axes=camera.bundle.state.axes))
    check_determined(bundle)
    check_side(bundle)
    return bundle


def rig_of(bundle: Bundle) -> Rig:
    """Return the rig of a joint solution."""
    camera, projector = bundle.state.devices
    return Rig(camera, projector)
