"""Whether views can carry a calibration at all, and whether what was solved is determined.

Degenerate data are refused with what is missing; they are never turned into a calibration.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from sl_calibration.bundle.bundle_adjustment import Bundle
from sl_common.errors import CalibrationError

Array = NDArray[np.float64]

#: Points of a view that counts; a plane's image alone has eight parameters, four points' worth.
MIN_POINTS = 12
MIN_HEIGHTS = 2
#: Points of one height are within this, metres.
_SAME_HEIGHT_M = 1e-6
#: What a calibration must pin down: sigma of the focal length, relative; of the image centre, as a
#: part of the image's width; of the direction of z travel, radians (1 mm of travel then shifts the
#: part by less than 5 um sideways). The reference rig reaches 1e-4, 1e-4 and 5e-5.
MAX_FOCAL_SIGMA = 0.01
MAX_CENTRE_SIGMA = 0.02
MAX_LEAN_SIGMA_RAD = 0.005


def check_views(stage_m: Array, view: NDArray[np.intp], what: str) -> None:
    """Refuse views that leave parameters open, whatever their noise.

    Parameters
    ----------
    stage_m : ndarray, (N, 3)
        Stage position of each point, metres.
    view : ndarray, (N,)
        View of each point.
    what : str
        What the points are, for the message.

    Raises
    ------
    CalibrationError
        Naming how many points and heights there are and how many it takes.
    """
    counts = {int(k): int(np.sum(view == k)) for k in np.unique(view)}
    good = [k for k, count in counts.items() if count >= MIN_POINTS]
    if not good:
        raise CalibrationError(
            f"{list(counts.values())} {what} in {len(counts)} views; expected at least "
            f"{MIN_POINTS} in each of {MIN_HEIGHTS} views at different heights"
        )
    heights = np.sort([stage_m[view == k][0, 2] for k in good])
    distinct = 1 + int(np.sum(np.diff(heights) > _SAME_HEIGHT_M))
    if distinct < MIN_HEIGHTS:
        raise CalibrationError(
            f"{what} at one height only (z = {heights[0] * 1e3:.4f} mm) in {len(good)} views of at "
            f"least {MIN_POINTS}; expected at least {MIN_HEIGHTS} heights: from one plane, focal "
            "length, distance and image centre cannot be told apart"
        )


def check_solution(bundle: Bundle) -> None:
    """Refuse a solution that the data leave open, or with a device below the plate.

    Raises
    ------
    CalibrationError
        With the predicted sigma of a focal length, an image centre or z travel, and the span of
        heights that would do; or with where the device would be, as for a plate turned over.
    """
    span_mm = float(np.ptp(bundle.problem.positions_m[:, 2])) * 1e3
    for what, sigma, limit, unit in _sigmas(bundle):
        if not sigma <= limit:
            raise CalibrationError(
                f"the {what} would be known to {sigma:.2g} {unit} only, from heights over "
                f"{span_mm:.4g} mm; expected {limit:.2g} {unit} or better: heights over "
                f"{1.1 * span_mm * sigma / limit:.2g} mm or more, or more holes"
            )
    _check_side(bundle)


def _sigmas(bundle: Bundle) -> Iterator[tuple[str, float, float, str]]:
    """What is checked: name, 1-sigma, limit, unit."""
    problem = bundle.problem
    if 2 in problem.moving:
        lean = float(np.max(bundle.stage.z_lean_sigma_rad))
        yield "direction of z travel", lean, MAX_LEAN_SIGMA_RAD, "rad"
    for name, device in zip(problem.names, bundle.state.devices, strict=True):
        sigma = np.sqrt(np.diag(bundle.covariance.matrix))[problem.columns[name]]
        first = 1 if problem.freedom.square_pixels else 2
        focal_px, width = device.focal_length_px[0], device.image_size[0]
        yield f"{name}'s focal length", float(sigma[0]), MAX_FOCAL_SIGMA * focal_px, "px"
        centre = float(sigma[first : first + 2].max())
        yield f"{name}'s image centre", centre, MAX_CENTRE_SIGMA * width, "px"


def _check_side(bundle: Bundle) -> None:
    """Refuse devices below the plate: a plate turned over, or heights counted downwards."""
    for name, device in zip(bundle.problem.names, bundle.state.devices, strict=True):
        height_m = float(device.position_m[2])
        if height_m <= 0:
            raise CalibrationError(
                f"the {name} would stand at z = {height_m * 1e3:.4g} mm, behind the plate; "
                "expected it in front: is the plate turned over, or do heights grow away from "
                "the devices?"
            )


def uncovered_part(pixels: Array, image_size: tuple[int, int]) -> float:
    """Part of an image farther from any point than an eighth of its width.

    Parameters
    ----------
    pixels : ndarray, (N, 2)
        Points that were measured.
    image_size : tuple of int
        (width, height), pixels.
    """
    width, height = image_size
    u, v = np.meshgrid(np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 25))
    places = np.stack([u.ravel(), v.ravel()], axis=1)
    distance, _ = KDTree(pixels).query(places)
    return float(np.mean(distance > width / 8))
