"""A first look for wrong points: what does not even fit a homography of its view's plane."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: A lens bends a plane's image off the homography by a pixel or two, everywhere alike; a point
#: that is off by so many times the middle deviation is wrong. The bundle looks closer.
SCREEN_FACTOR = 8.0
_LEAST_POINTS = 8
_LEAST_PX = 0.05
_ROUNDS = 3


def fits_plane(plane: Array, pixels: Array, view: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Which points fit their view's homography.

    Parameters
    ----------
    plane : ndarray, (N, 2)
        Coordinates in the plane: on the plate, or in another device's image of it.
    pixels : ndarray, (N, 2)
        Observed pixels.
    view : ndarray, (N,)
        View of each point.

    Returns
    -------
    ndarray of bool, (N,)
        False for gross errors; True throughout views of fewer than 8 points.
    """
    good = np.ones(len(pixels), dtype=np.bool_)
    for k in np.unique(view):
        rows = np.flatnonzero(view == k)
        if len(rows) >= _LEAST_POINTS:
            good[rows] = _fits(plane[rows], pixels[rows])
    return good


def _fits(plane: Array, pixels: Array) -> NDArray[np.bool_]:
    # OpenCV judges by distances in its own units: both sides to unit size first
    scaled = (plane - plane.mean(axis=0)) / (np.ptp(plane) + 1e-300)
    matrix, _ = cv2.findHomography(scaled, pixels, cv2.LMEDS)
    good = np.ones(len(pixels), dtype=np.bool_)
    for _ in range(_ROUNDS):
        if matrix is None:
            break
        mapped = cv2.perspectiveTransform(scaled[:, np.newaxis], matrix)[:, 0]
        off = np.hypot(*(mapped - pixels).T)
        good = np.asarray(off <= SCREEN_FACTOR * max(float(np.median(off)), _LEAST_PX))
        # the median's homography fits the image's middle; over all good points it fits them all
        matrix, _ = cv2.findHomography(scaled[good], pixels[good], 0)
    return good
