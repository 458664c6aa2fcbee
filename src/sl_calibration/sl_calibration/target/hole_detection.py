"""From an image to the plate's holes: spots, lattice, edges, identity, centres.

1. `blobs`: dark elliptic spots.  2. `lattice`: those on a square lattice.
3. `hole_identification`: which hole is which.  4. `hole_fit`: sub-pixel edges, also of holes that
no spot was found for.  5. `plate_map`: the circle's centre from the ellipse's; outliers.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_calibration.target.blobs import Blobs, find_blobs
from sl_calibration.target.hole_fit import HoleFits, fit_holes
from sl_calibration.target.hole_identification import FoundLattice, place
from sl_calibration.target.lattice import Lattice, find_lattice
from sl_calibration.target.plate import HoleFlag, Ids, Plate, PlateView
from sl_calibration.target.plate_map import OUTLIER_SIGMAS, LocalMap, PlateMap, fit_map, map_circles
from sl_common.errors import CalibrationError

Array = NDArray[np.float64]
Image = NDArray[np.float32]

#: Fewer holes than this, or than `MIN_SHARE` of the plate, are no view of it.
MIN_HOLES = 12
MIN_SHARE = 0.15
#: Range of grey levels below which there is no light, DN (or the same share of 255).
MIN_RANGE = 10.0 / 255.0
#: A chamfer narrower than this is taken as part of the blur: it moves all centres alike, by a tenth
#: of a pixel at most, which no calibration can tell from a moved plate.
MIN_CHAMFER_PX = 1.5
#: Sigma of a centre before its noise is looked at.
ROUGH_SIGMA_PX = 0.02
#: Added in quadrature to sigma: what the model of a blurred step leaves on clean images.
MODEL_SIGMA_PX = 0.0004
#: Sigma of a centre whose surroundings are all at the top of the scale, px: light that changes by
#: 10 % across the hole moves a clipped edge of 1 px blur by about this much.
SATURATED_SIGMA_PX = 0.03
#: Share of saturated plate beside a hole from which the hole says so.
MIN_SATURATED = 0.1
#: An edge is poor when its misfit is this many times the median hole's, or its contrast or its
#: size is off by these factors.
MISFIT_FACTOR = 4.0
MIN_CONTRAST = 0.3
BLUR_FACTOR = 1.8
SIZE_FACTOR = 1.15


def find_plate(
    image: NDArray[np.uint8] | NDArray[np.uint16] | Image,
    plate: Plate,
    saturation_dn: float | None = None,
) -> PlateView:
    """Find the plate's holes and their centres in one image.

    Parameters
    ----------
    image : ndarray, (H, W)
        Grey levels, uint8, uint16 or float32; an evenly lit plate is not needed.
    plate : Plate
        What to look for.
    saturation_dn : float, optional
        Level at which the sensor is full; by default 255 for uint8, none for other types.

    Returns
    -------
    PlateView
        All holes that were measured, flagged where they are not to be fitted.

    Raises
    ------
    CalibrationError
        When the image is no grey image, there is no light, no plate, too little of it, more than
        one way to number its holes, or its back is turned to the camera.

    Notes
    -----
    Without an origin mark the rotation by quarter turns is taken in which plate x is nearest to
    image right (plate y is then up).
    """
    seen = _prepared(image, plate, saturation_dn)
    blobs = find_blobs(seen.image)
    lattice = find_lattice(blobs, *_ratios(plate), enough=int(0.9 * plate.hole_count))
    _check_enough(plate, len(lattice), len(blobs.centres_px))
    return _view(seen, *_measured(seen, *_identified(seen, blobs, lattice)))


class _Seen(NamedTuple):
    """The image with dark holes (H, W), its plate, and the level that counts as saturated."""

    image: Image
    plate: Plate
    full: float


def _prepared(image: NDArray[np.generic], plate: Plate, full: float | None) -> _Seen:
    if image.ndim != 2 or min(image.shape) < 32:
        raise CalibrationError(f"image.shape={image.shape}; expected a grey image of 32 px or more")
    top = 255.0 if image.dtype == np.uint8 else np.inf
    top = top if full is None else float(full)
    grey = np.asarray(image).astype(np.float32)
    low, high = np.percentile(grey[::4, ::4], (0.5, 99.5))
    scale = top if np.isfinite(top) else max(float(grey.max()), 1.0)
    if high - low < MIN_RANGE * scale:
        raise CalibrationError(
            f"the image spans {low:.0f} to {high:.0f} DN; expected a lit plate with a range of at "
            f"least {MIN_RANGE * scale:.0f} DN (is the lamp off, or no plate with holes there?)"
        )
    if plate.dark_holes:
        return _Seen(grey, plate, top)
    return _Seen(np.float32(grey.max()) - grey, plate, np.inf)


def _ratios(plate: Plate) -> tuple[float, float]:
    """Pitch over radius, and the mark's diameter over a hole's."""
    mark = plate.origin_diameter_m or plate.diameter_m
    return 2 * plate.pitch_m / plate.diameter_m, mark / plate.diameter_m


def _check_enough(plate: Plate, holes: int, spots: int) -> None:
    least = max(MIN_HOLES, int(np.ceil(MIN_SHARE * plate.hole_count)))
    if holes < least:
        raise CalibrationError(
            f"found {holes} holes on a lattice among {spots} spots; expected at least {least} of "
            f"the plate's {plate.columns} x {plate.rows} (is the plate in view and in focus?)"
        )


def _identified(seen: _Seen, blobs: Blobs, lattice: Lattice) -> tuple[Ids, Blobs]:
    """Number the holes: (column, row) and spots, in the same order."""
    plate = seen.plate
    ij, spots = np.array(list(lattice)), np.array(list(lattice.values()))
    found = Blobs(blobs.centres_px[spots], blobs.shapes_px2[spots])
    h, _ = cv2.findHomography(ij.astype(np.float64), found.centres_px, cv2.LMEDS)
    margin = 1.2 * float(np.median(found.sizes_px)) * _ratios(plate)[1] + 2.0
    marks = _marks(plate, found, ij, np.asarray(h))
    return place(plate, FoundLattice(ij, marks, np.asarray(h), seen.image, margin)).ids(ij), found


def _marks(plate: Plate, found: Blobs, ij: Ids, lattice_to_image: Array) -> NDArray[np.bool_]:
    """Holes nearer to the mark's size than to a hole's, measured in lattice steps."""
    if plate.origin_diameter_m is None:
        return np.zeros(len(ij), dtype=bool)
    x = np.concatenate([ij, np.ones((len(ij), 1))], axis=1) @ lattice_to_image[2]
    size = found.sizes_px * np.abs(x) ** 1.5  # a homography's area scale goes with 1 / x^3
    ratio = np.log(size / np.median(size)) / np.log(_ratios(plate)[1])
    return np.asarray(ratio > 0.5)


def _measured(seen: _Seen, ids: Ids, start: Blobs) -> tuple[Ids, HoleFits]:
    """Fit the edges of the holes that were found, then of those that should be there too."""
    plate = seen.plate
    if plate.chamfer_m:
        # a spot may be as large as its chamfer's upper rim: start from the holes' bottoms
        everywhere = np.ones(len(ids), dtype=bool)
        rough, _ = fit_map(plate, ids, start.centres_px, ROUGH_SIGMA_PX, everywhere)
        start = Blobs(start.centres_px, _circles(plate, rough, ids).spots.shapes_px2)
    fits = _fitted(seen, ids, start)
    use = np.isfinite(fits.centres_px[:, 0])
    _check_enough(plate, int(use.sum()), len(ids))
    rough, _ = fit_map(plate, ids, fits.centres_px, ROUGH_SIGMA_PX, use & ~_poor(fits))
    more = _unseen(seen, ids[use], rough)
    if len(more):
        extra = _fitted(seen, more, _circles(plate, rough, more).spots)
        fits = HoleFits(*(np.concatenate(pair) for pair in zip(fits, extra, strict=True)))
        # a place that no spot was seen at and that has no clean edge is no hole
        clean = np.arange(len(fits.misfit)) < len(ids)
        ids = np.concatenate([ids, more])
        use = np.isfinite(fits.centres_px[:, 0]) & (clean | ~_poor(fits))
    return ids[use], HoleFits(*(field[use] for field in fits))


def _circles(plate: Plate, seen: PlateMap, ids: Ids) -> LocalMap:
    return map_circles(seen, plate.xy_m(ids), plate.radius_m(ids))


def _fitted(seen: _Seen, ids: Ids, start: Blobs) -> HoleFits:
    plate, radius = seen.plate, seen.plate.radius_m(ids)
    step = start.sizes_px * plate.pitch_m / radius
    gap = step * (1 - (plate.diameter_m + 2 * plate.chamfer_m) / plate.pitch_m)
    resolved = start.sizes_px * plate.chamfer_m / radius > MIN_CHAMFER_PX
    rim = 1 + np.where(resolved, plate.chamfer_m / radius, 0.0)
    return fit_holes(seen.image, start, gap, rim, seen.full)


def _unseen(seen: _Seen, ids: Ids, rough: PlateMap) -> Ids:
    """Holes that are not among ``ids`` but should lie in the image, (M, 2)."""
    plate, known = seen.plate, {tuple(k) for k in ids.tolist()}
    whole = [(c, r) for r in range(plate.rows) for c in range(plate.columns)]
    rest = np.array([k for k in whole if k not in known], dtype=np.int64).reshape(-1, 2)
    if len(rest) == 0:
        return rest
    local = _circles(plate, rough, rest)
    reach = np.linalg.norm(local.jacobian_px_per_m, axis=2) * local.radius_m[:, None] + 3.0
    q, last = local.centres_px, np.array(seen.image.shape[::-1]) - 1
    return np.asarray(rest[np.all((q > reach) & (q < last - reach), axis=1)])


def _view(seen: _Seen, ids: Ids, fits: HoleFits) -> PlateView:
    """Turn fits into centres of circles, with their flags."""
    plate, poor = seen.plate, _poor(fits)
    covariance = _covariance(fits)
    sigma = np.sqrt(0.5 * np.trace(covariance, axis1=1, axis2=2))
    found, _ = fit_map(plate, ids, fits.centres_px, sigma, ~poor)
    bias = _circles(plate, found, ids).bias_px
    centres = fits.centres_px - bias
    found, z = fit_map(plate, ids, centres, sigma, ~poor)
    poor |= _odd_size(fits, _circles(plate, found, ids))
    flags = HoleFlag.POOR_EDGE * poor + HoleFlag.OUTLIER * (z > OUTLIER_SIGMAS)
    flags = (flags + HoleFlag.SATURATED * (fits.saturated > MIN_SATURATED)).astype(np.uint8)
    missing = _unseen(seen, ids, found)
    view = PlateView(ids, plate.xy_m(ids), centres, sigma, covariance, flags, missing, bias)
    return view.taken(np.lexsort((ids[:, 0], ids[:, 1])))


def _covariance(fits: HoleFits) -> Array:
    """Of the centres: noise, the model's own error, clipped light."""
    extra = MODEL_SIGMA_PX**2 + (SATURATED_SIGMA_PX * fits.saturated) ** 2
    return np.asarray(fits.covariance_px2 + extra[:, None, None] * np.eye(2))


def _poor(fits: HoleFits) -> NDArray[np.bool_]:
    """Edges that are much worse than those of the other holes."""
    with np.errstate(invalid="ignore"):
        rough = fits.misfit > MISFIT_FACTOR * np.nanmedian(fits.misfit)
        faint = fits.contrast < MIN_CONTRAST * np.nanmedian(fits.contrast)
        blurred = fits.blur_px > BLUR_FACTOR * np.nanmedian(fits.blur_px)
    return np.asarray(rough | faint | blurred | ~np.isfinite(fits.misfit))


def _odd_size(fits: HoleFits, local: LocalMap) -> NDArray[np.bool_]:
    """Holes whose size, beside the plate's local scale, is not that of the others."""
    scale = np.sqrt(np.abs(np.linalg.det(local.jacobian_px_per_m))) * local.radius_m
    ratio = np.log(np.linalg.det(fits.shapes_px2) ** 0.25 / scale)
    return np.asarray(np.abs(ratio - np.median(ratio)) > np.log(SIZE_FACTOR))
