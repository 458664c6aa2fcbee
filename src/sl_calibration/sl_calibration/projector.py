"""The projector as an inverse camera (Fig. 5): its targets are its light as the camera sees it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sl_calibration.bundle import Freedom, RigProblem, solve_bundle
from sl_calibration.camera import DeviceSolution
from sl_calibration.derivatives import meet
from sl_calibration.enough import check_determined, check_side, check_views
from sl_calibration.linear import Sensor
from sl_calibration.samples import Holes, Targets, TargetView
from sl_calibration.screen import fits_plane
from sl_calibration.search import search_centre
from sl_calibration.stage import FAULTLESS
from sl_reconstruct.rig import Device

Array = NDArray[np.float64]

#: The search of the image centre takes the linear step a hundred times; it needs no more points.
_SEARCH_POINTS = 2000


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
