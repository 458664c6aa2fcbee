"""The stages of a calibration: the camera alone, the projector with it, then both together.

The camera from the plate's holes by the paper's two steps (Fig. 4) and the full bundle; the
projector as an inverse camera (Fig. 5), whose targets are its light as the camera sees it; then
both refined together, with one covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sl_calibration.bundle.bundle_adjustment import Bundle, solve_bundle
from sl_calibration.bundle.derivatives import meet
from sl_calibration.bundle.outlier_rejection import fits_homography
from sl_calibration.bundle.parameters import Freedom
from sl_calibration.bundle.rig_problem import RigProblem
from sl_calibration.bundle.stage_model import FAULTLESS
from sl_calibration.data.solver_input import Holes, Targets
from sl_calibration.solve.image_centre_search import CentreSearch, search_centre
from sl_calibration.solve.linear_step import Sensor
from sl_calibration.solve.observability import check_solution, check_views
from sl_calibration.solve.starts import solve_from_many_starts
from sl_reconstruct.model.rig import Device

Array = NDArray[np.float64]

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


def solve_camera(holes: Holes, sensor: Sensor, freedom: Freedom | None = None) -> DeviceSolution:
    """Calibrate a camera.

    Parameters
    ----------
    holes : Holes
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
    good = _prefiltered(holes.points_m[:, :2], holes, "holes")
    problem = RigProblem(("camera",), holes, Targets.of([]), freedom or Freedom())
    bundle = solve_from_many_starts(problem, good, sensor)
    check_solution(bundle)
    used = bundle.used
    world_m = (holes.points_m + holes.stage_m @ bundle.state.axes.T)[used]
    return DeviceSolution(search_centre(world_m, holes.pixels[used], sensor), bundle)


def _prefiltered(plane: Array, data: Holes | Targets, what: str) -> NDArray[np.bool_]:
    """Points that fit a homography of their view; refuses views that leave parameters open."""
    check_views(data.stage_m, data.view, what)
    good = fits_homography(plane, data.pixels, data.view)
    check_views(data.stage_m[good], data.view[good], f"{what} that fit a plane")
    return good


def solve_projector(
    targets: Targets, camera: Device, axes: Array, sensor: Sensor, square_pixels: bool = True
) -> DeviceSolution:
    """Calibrate a projector with a calibrated camera: the paper's two steps, then the bundle.

    Parameters
    ----------
    targets : Targets
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
    good = _prefiltered(targets.camera_px, targets, "projected targets")
    # where the rays meet the plate's plane; the joint solution finds where the flat is another
    heights = (targets.stage_m @ axes.T)[:, 2]
    points = meet(camera, targets.camera_px, np.array([0.0, 0.0, 1.0]), heights)
    good &= np.isfinite(points).all(axis=1)
    few = np.flatnonzero(good)
    few = few[:: 1 + len(few) // _SEARCH_POINTS]
    search = search_centre(points[few], targets.pixels[few], sensor)
    seen = Holes(points, np.zeros_like(points), targets.view, targets.pixels, targets.sigma_px)
    problem = RigProblem(
        ("projector",), seen, Targets.of([]), Freedom(FAULTLESS, None, square_pixels)
    )
    bundle = solve_bundle(problem, problem.start(search.device))
    check_solution(bundle)
    return DeviceSolution(search, bundle)


def solve_joint(
    holes: Holes,
    targets: Targets,
    camera: DeviceSolution,
    projector: DeviceSolution,
    freedom: Freedom | None = None,
) -> Bundle:
    """Refine both devices, the stage and, where wanted, the flat on holes and targets at once.

    Parameters
    ----------
    holes, targets : Holes, Targets
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
    problem = RigProblem(("camera", "projector"), holes, targets, freedom or Freedom())
    start = problem.start(camera.device, projector.device)
    bundle = solve_bundle(problem, start._replace(axes=camera.bundle.state.axes))
    check_solution(bundle)
    return bundle
