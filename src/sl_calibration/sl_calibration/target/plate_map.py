"""From the plate to the image without a camera model: a homography and a smooth rest.

The rest (a polynomial in the plate's coordinates, of the order that the number of holes carries)
takes up what the lens does. Holes off the map are outliers, and its local shape tells by how much
the centre of a circle's image misses the image of the circle's centre.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_calibration.target.blobs import Blobs
from sl_calibration.target.plate import Ids, Plate

Array = NDArray[np.float64]

#: (least number of holes, order of the rest): order 3 has 10 numbers per axis, order 5 has 21.
#: The reference rig's lens leaves 0.008 px beyond third order, and none beyond fifth.
ORDERS = ((70, 5), (40, 3), (0, 0))
#: A hole is an outlier from this many robust sigmas off the map.
OUTLIER_SIGMAS = 5.0
#: Limits of the rounds in which the map is fitted to what the last round kept.
LIMITS = (15.0, 8.0, OUTLIER_SIGMAS, OUTLIER_SIGMAS, OUTLIER_SIGMAS)
#: Points on a circle: enough for its first three harmonics.
CIRCLE_POINTS = 16


@dataclass(frozen=True)
class PlateMap:
    """Smooth map of plate coordinates (metres) to the image (pixels).

    Parameters
    ----------
    homography : ndarray, (3, 3)
        Of plate coordinates over ``scale_m``.
    rest_px : ndarray, (terms, 2)
        Coefficients of the polynomial that is added.
    scale_m : float
        Half extent of the plate: makes coordinates of order 1.
    """

    homography: Array
    rest_px: Array
    scale_m: float

    def __call__(self, xy_m: Array) -> Array:
        """Pixels (..., 2) of plate points (..., 2)."""
        xy = np.asarray(xy_m, dtype=np.float64) / self.scale_m
        local = xy @ self.homography[:, :2].T + self.homography[:, 2]
        return np.asarray(local[..., :2] / local[..., 2:] + _powers(xy, self.order) @ self.rest_px)

    @property
    def order(self) -> int:
        """Of the polynomial: n (n + 1) / 2 terms are of order n - 1."""
        return round(math.sqrt(2 * len(self.rest_px))) - 1


def _powers(xy: Array, order: int) -> Array:
    """Monomials up to an order, (..., terms)."""
    x, y = xy[..., 0], xy[..., 1]
    terms = [x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)]
    return np.stack(terms, axis=-1)


def fit_map(
    plate: Plate, ids: Ids, q_px: Array, sigma_px: Array | float, trusted: NDArray[np.bool_]
) -> tuple[PlateMap, Array]:
    """Fit the map robustly.

    Parameters
    ----------
    plate : Plate
        The plate.
    ids, q_px : ndarray, (N, 2)
        Holes (column, row) and their centres in the image, pixels.
    sigma_px : float or ndarray, (N,)
        1-sigma of these: a hole nearer to the map is no outlier.
    trusted : ndarray, (N,) bool
        Those that may shape the map; at least 4.

    Returns
    -------
    map : PlateMap
    z : ndarray, (N,)
        Distance of each hole from the map over its robust sigma.
    """
    scale = 0.5 * plate.pitch_m * max(plate.columns, plate.rows)
    xy_m = plate.xy_m(ids)
    xy = xy_m / scale
    first, _ = cv2.findHomography(xy[trusted], q_px[trusted], cv2.LMEDS)
    found = PlateMap(np.eye(3) if first is None else np.asarray(first), np.zeros((1, 2)), scale)
    for limit in LIMITS:
        off = np.linalg.norm(q_px - found(xy_m), axis=1)
        # |off| of a clean hole is Rayleigh distributed: median 1.18 sigma
        z = off / np.maximum(np.median(off[trusted]) / 1.18, sigma_px)
        used = trusted & (z < limit)
        if used.sum() < 8:
            break
        found = _fitted(xy[used], q_px[used], scale)
    return found, z


def _fitted(xy: Array, q_px: Array, scale_m: float) -> PlateMap:
    homography, _ = cv2.findHomography(xy, q_px, 0)
    plain = PlateMap(np.asarray(homography), np.zeros((1, 2)), scale_m)
    order = next(order for least, order in ORDERS if len(xy) >= least)
    rest, *_ = np.linalg.lstsq(_powers(xy, order), q_px - plain(xy * scale_m), rcond=None)
    return replace(plain, rest_px=np.asarray(rest))


@dataclass(frozen=True)
class LocalMap:
    """Images of circles under a smooth map, to second order in their radius.

    Parameters
    ----------
    centres_px : ndarray, (N, 2)
        Images of the circles' centres.
    bias_px : ndarray, (N, 2)
        Centres of the ellipses fitted to the images of the circles, minus ``centres_px``.
    jacobian_px_per_m : ndarray, (N, 2, 2)
        Of the map at the centres.
    radius_m : ndarray, (N,)
        Of the circles.
    """

    centres_px: Array
    bias_px: Array
    jacobian_px_per_m: Array
    radius_m: Array

    @property
    def spots(self) -> Blobs:
        """The circles' images as ellipses."""
        a = self.jacobian_px_per_m * self.radius_m[:, None, None]
        return Blobs(self.centres_px, np.asarray(a @ np.swapaxes(a, 1, 2)))


def map_circles(project: Callable[[Array], Array], xy_m: Array, radius_m: Array) -> LocalMap:
    """Send circles through any smooth map of the plate to the image.

    A circle's image, seen in the frame where it is a circle to first order, deviates from it by a
    radial offset over the angle; the first harmonic of that is what an ellipse fit calls a shift
    of the centre. For a homography this is the closed form of the conic's centre to second order.

    Parameters
    ----------
    project : callable
        (..., 2) metres on the plate to (..., 2) pixels: a `PlateMap`, or a rig's camera.
    xy_m, radius_m : ndarray, (N, 2) and (N,)
        Circles.
    """
    angle = np.arange(CIRCLE_POINTS) * (2 * np.pi / CIRCLE_POINTS)
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    centres = project(xy_m)
    rim = project(xy_m[:, None] + radius_m[:, None, None] * unit)
    affine = 2 / CIRCLE_POINTS * np.einsum("nki,kj->nij", rim, unit)  # per radius
    local = np.linalg.solve(affine[:, None], (rim - centres[:, None])[..., None])[..., 0]
    radial = np.sum((local - unit) * unit, axis=-1)
    shift = 2 / CIRCLE_POINTS * radial @ unit
    bias = np.einsum("nij,nj->ni", affine, shift)
    return LocalMap(centres, bias, affine / radius_m[:, None, None], radius_m)
