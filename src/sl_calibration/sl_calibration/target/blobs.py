"""Candidates for holes: dark spots, roughly elliptic, whatever the light across the image."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.float32]

#: Windows of the local mean, as fractions of the image's longer side.
WINDOWS = (0.0125, 0.04, 0.12)
#: A spot is darker than its surroundings by this fraction of the image's range ...
CONTRAST = 0.05
#: ... and this fraction of their level.
RELATIVE_CONTRAST = 0.08
#: A spot's area over that of the ellipse with its second moments: 1 for an ellipse.
FULLNESS = (0.93, 1.03)
#: Smallest spot: nine pixels across three rows are no ellipse.
MIN_POINTS = 8
MIN_ASPECT = 0.2


class Blobs(NamedTuple):
    """N spots: centres (N, 2) px and shapes (N, 2, 2) px^2.

    The shape is A A^T of the ellipse ``centre + A (cos, sin)``: four times its second moments.
    """

    centres_px: Array
    shapes_px2: Array

    @property
    def sizes_px(self) -> Array:
        """Geometric mean of the semi-axes, (N,)."""
        return np.asarray(np.linalg.det(self.shapes_px2) ** 0.25)


def inverse_roots(shapes_px2: Array) -> Array:
    """S^-1/2 of shapes S, both (N, 2, 2): maps each ellipse on the unit circle."""
    values, vectors = np.linalg.eigh(shapes_px2)
    return np.asarray(np.einsum("nij,nj,nkj->nik", vectors, 1 / np.sqrt(values), vectors))


def find_blobs(image: Image) -> Blobs:
    """Find dark elliptic spots in an image (H, W), one entry each, in no order."""
    smooth = cv2.GaussianBlur(image, (3, 3), 0)
    low, high = np.percentile(smooth[::8, ::8], (1, 99))
    found: list[tuple[float, ...]] = []
    for fraction in WINDOWS:
        side = max(7, int(fraction * max(image.shape))) | 1
        surround = cv2.boxFilter(smooth, -1, (side, side))
        limit = surround - np.float32(CONTRAST * (high - low))
        dark = (smooth < limit) & (smooth < (1 - RELATIVE_CONTRAST) * surround)
        found += _ellipses(dark.view(np.uint8))
    return _distinct(np.array(found, dtype=np.float64).reshape(-1, 6))


def _ellipses(dark: NDArray[np.uint8]) -> list[tuple[float, ...]]:
    """Return (u, v, shape uu, uv, vv, misfit) of the elliptic components of a mask."""
    contours, tree = cv2.findContours(dark, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if tree is None:
        return []
    outer = np.flatnonzero(tree[0, :, 3] < 0).tolist()
    spots = (_ellipse(contours[i]) for i in outer if len(contours[i]) >= MIN_POINTS)
    return [spot for spot in spots if spot is not None]


def _ellipse(contour: NDArray[np.int32]) -> tuple[float, ...] | None:
    m = cv2.moments(contour)
    area = m["m00"]
    if area < 4.0:
        return None
    uu, uv, vv = 4 * m["mu20"] / area, 4 * m["mu11"] / area, 4 * m["mu02"] / area
    det = uu * vv - uv * uv
    aspect2 = det / (0.5 * (uu + vv)) ** 2
    if det <= 0.0 or aspect2 < MIN_ASPECT:
        return None
    fullness = area / (np.pi * det**0.5)
    slack = 1.0 / det**0.25  # a small spot is a polygon of few corners
    if not FULLNESS[0] - 0.3 * slack < fullness < FULLNESS[1] + 0.3 * slack:
        return None
    # the contour runs through the centres of the outermost pixels: half a pixel inside the spot
    grow = (1 + 0.5 / det**0.25) ** 2
    return (m["m10"] / area, m["m01"] / area, grow * uu, grow * uv, grow * vv, abs(fullness - 1))


def _distinct(found: Array) -> Blobs:
    """Keep the most elliptic of the spots that several windows found."""
    found = found[np.argsort(found[:, 5], kind="stable")]
    kept = np.ones(len(found), dtype=bool)
    size = np.sqrt(0.5 * (found[:, 2] + found[:, 4]))
    for i in range(len(found)):
        if kept[i]:
            near = np.hypot(*(found[:, :2] - found[i, :2]).T) < 0.5 * size[i]
            near[: i + 1] = False
            kept &= ~near
    found = found[kept]
    shapes = found[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    return Blobs(found[:, :2], shapes)
