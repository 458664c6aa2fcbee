"""Which points are wrong: a first look by homographies, then weights and rejection in the bundle.

A group is a slice of points whose stated sigmas are wrong by the same factor, if they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: A lens bends a plane's image off the homography by a pixel or two, everywhere alike. A point
#: that is off by this many times the median deviation is wrong. The bundle looks closer.
PREFILTER_FACTOR = 8.0
_LEAST_POINTS = 8
_LEAST_PX = 0.05
_ROUNDS = 3
#: Cauchy's weight is 1/2 at this many sigma: 95 % efficient on good points.
CAUCHY_SIGMA = 2.385
#: A point farther off than this, in robust sigmas, is rejected; of good points 4 in a million are.
REJECT_SIGMA = 5.0
#: Median of the length of a vector of two unit-normal coordinates.
_RAYLEIGH_MEDIAN = float(np.sqrt(2 * np.log(2)))


def fits_homography(plane: Array, pixels: Array, view: NDArray[np.intp]) -> Mask:
    """Find gross errors before anything is solved.

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


def _fits(plane: Array, pixels: Array) -> Mask:
    # OpenCV judges by distances in its own units: both sides to unit size first
    scaled = (plane - plane.mean(axis=0)) / (np.ptp(plane) + 1e-300)
    matrix, _ = cv2.findHomography(scaled, pixels, cv2.LMEDS)
    good = np.ones(len(pixels), dtype=np.bool_)
    for _ in range(_ROUNDS):
        if matrix is None:
            break
        mapped = cv2.perspectiveTransform(scaled[:, np.newaxis], matrix)[:, 0]
        off = np.hypot(*(mapped - pixels).T)
        good = np.asarray(off <= PREFILTER_FACTOR * max(float(np.median(off)), _LEAST_PX))
        # the median's homography fits the image's middle; over all good points it fits them all
        matrix, _ = cv2.findHomography(scaled[good], pixels[good], 0)
    return good


def _lengths(residuals: Array, groups: Sequence[slice]) -> tuple[Array, Array]:
    """Lengths (M,) of residuals, and the robust sigma of their group, at least the stated one."""
    lengths = np.nan_to_num(np.hypot(*residuals.T), nan=np.inf, posinf=np.inf)
    spread = np.ones(len(lengths))
    for group in groups:
        if lengths[group].size:
            spread[group] = max(1.0, float(np.median(lengths[group])) / _RAYLEIGH_MEDIAN)
    return lengths, spread


def cauchy_weights(residuals: Array, groups: Sequence[slice]) -> Array:
    """Weigh points in a robust descent.

    Parameters
    ----------
    residuals : ndarray, (M, 2)
        In stated sigmas.
    groups : sequence of slice
        Each group is judged by its own robust spread.

    Returns
    -------
    ndarray, (M,)
        1 for no residual, falling to 0.
    """
    lengths, spread = _lengths(residuals, groups)
    return np.asarray(1.0 / (1.0 + (lengths / (CAUCHY_SIGMA * spread)) ** 2))


def inliers(residuals: Array, groups: Sequence[slice]) -> Mask:
    """Find the points to use, (M,) bool.

    Parameters
    ----------
    residuals, groups : ndarray, (M, 2), and sequence of slice
        As in `cauchy_weights`.
    """
    lengths, spread = _lengths(residuals, groups)
    return np.asarray(lengths <= REJECT_SIGMA * spread)


def sigma_scales(residuals: Array, used: Mask, groups: Sequence[slice]) -> Array:
    """Factors (G,) by which stated sigmas are to be enlarged: rms of used residuals, at least 1.

    Parameters
    ----------
    residuals, used : ndarray, (M, 2) and (M,) bool
        In stated sigmas, and which of them count.
    groups : sequence of slice
        G groups, each with a factor of its own.
    """
    parts = [residuals[group][used[group]] for group in groups]
    return np.array([max(1.0, np.sqrt(np.mean(p**2))) if p.size else 1.0 for p in parts])


def inlier_weights(residuals: Array, used: Mask, groups: Sequence[slice]) -> Array:
    """Weights (M,): 1 / scale^2 for used points and 0 for others.

    Parameters
    ----------
    residuals, used, groups
        As in `sigma_scales`.
    """
    weights = used.astype(np.float64)
    for group, scale in zip(groups, sigma_scales(residuals, used, groups), strict=True):
        weights[group] /= scale**2
    return weights
