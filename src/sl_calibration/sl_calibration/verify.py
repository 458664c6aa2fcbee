"""How wrong a calibration in force is, on a plate or a flat, without changing it.

The projector's coordinates at camera pixels are triangulated: on a flat they must lie in a plane,
and camera and projector rays must meet. On the hole plate, the holes' rays must meet that plane
in a lattice of the plate's pitch.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sl_calibration.observe import MIN_TARGETS, check_light, observe
from sl_calibration.plate import Plate
from sl_calibration.session import Order, Taken
from sl_projector.errors import CalibrationError
from sl_reconstruct.correspondence import correspondences
from sl_reconstruct.rig import Rig

Array = NDArray[np.float64]

TARGETS = ("plate", "flat")


@dataclass(frozen=True)
class Check:
    """What a check found.

    Parameters
    ----------
    target : {"plate", "flat"}
        What was looked at.
    plane_rms_m : float
        Distances of triangulated points from their best plane, rms.
    gap_rms_m : float
        Distances at which camera and projector rays miss each other, rms.
    lattice_rms_m : float
        Distances of the holes from the plate's lattice, laid on them without a change of scale,
        rms; 0 for a flat.
    scale_error : float
        Measured pitch over the plate's, less 1; 0 for a flat.
    points : int
        Points triangulated.
    points_m, off_plane_m : ndarray, (N, 3) and (N,)
        The points and their distances from the plane.
    """

    target: str
    plane_rms_m: float
    gap_rms_m: float
    lattice_rms_m: float
    scale_error: float
    points: int
    points_m: Array = field(repr=False)
    off_plane_m: Array = field(repr=False)

    @property
    def rms_m(self) -> float:
        """All that was found, in quadrature."""
        return float(np.sqrt(self.plane_rms_m**2 + self.gap_rms_m**2 + self.lattice_rms_m**2))

    @property
    def words(self) -> str:
        """The parts, for people."""
        text = (
            f"off the plane {self.plane_rms_m * 1e6:.3f} um, rays miss by "
            f"{self.gap_rms_m * 1e6:.3f} um"
        )
        if self.target == "plate":
            text += (
                f", holes off the lattice {self.lattice_rms_m * 1e6:.3f} um, its scale off by "
                f"{self.scale_error * 1e6:.1f} ppm"
            )
        return text


def check_rig_on(taken: Taken, target: str, plate: Plate, rig: Rig) -> Check:
    """Check a rig on one stack.

    Parameters
    ----------
    taken : Taken
        Images of plate or flat under a sequence of both axes.
    target : {"plate", "flat"}
        What lies there.
    plate : Plate
        The plate, where it is one.
    rig : Rig
        The calibration in force.

    Raises
    ------
    CalibrationError
        When the target is unknown, the images are not of the rig's size, or there is no light, no
        plate, or too little of the patterns to be seen.
    """
    if target not in TARGETS:
        raise CalibrationError(f"target={target!r}; expected one of {TARGETS}")
    size = taken.images.shape[:0:-1]
    if size != rig.camera.image_size or taken.sequence.dmd_size != rig.projector.image_size:
        raise CalibrationError(
            f"images of {size} pixels and patterns of {taken.sequence.dmd_size}; expected "
            f"{rig.camera.image_size} and {rig.projector.image_size}, as in the calibration"
        )
    if target == "plate":
        order = Order("both", (0.0, 1.0, 2.0), plate, taken.sequence.name)
        view = observe(taken, order)
        points, gaps = triangulate(rig, view.camera_px, view.dmd_px)
        lattice, scale = _lattice(rig, points, view.centres_px, view.plate_xy_m)
    else:
        check_light(taken.images, taken.sequence)
        found = correspondences(taken.images, taken.sequence)
        if len(found) < MIN_TARGETS:
            raise CalibrationError(
                f"the projector's coordinates were decoded at {len(found)} places; expected at "
                f"least {MIN_TARGETS} on a flat"
            )
        points, gaps = triangulate(rig, found.camera_px, found.dmd_px)
        lattice, scale = 0.0, 1.0
    off = _off_plane(points)
    return Check(target, _rms(off), _rms(gaps), lattice, scale - 1, len(points), points, off)


def triangulate(rig: Rig, camera_px: Array, dmd_px: Array) -> tuple[Array, Array]:
    """Middles (N, 3) of the shortest lines between both rays, and their lengths (N,), metres."""
    a, b = rig.camera.rays(camera_px), rig.projector.rays(dmd_px)
    base = rig.projector.position_m - rig.camera.position_m
    aa, ab, bb = (np.sum(p * q, axis=1) for p, q in ((a, a), (a, b), (b, b)))
    ac, bc = a @ base, b @ base
    scale = aa * bb - ab * ab
    near_a = (ac * bb - ab * bc) / scale
    near_b = (ab * ac - aa * bc) / scale
    first = rig.camera.position_m + near_a[:, np.newaxis] * a
    second = rig.projector.position_m + near_b[:, np.newaxis] * b
    return 0.5 * (first + second), np.linalg.norm(first - second, axis=1)


def _plane(points: Array) -> tuple[Array, Array]:
    """A point and the unit normal of the best plane."""
    middle = points.mean(axis=0)
    return middle, np.linalg.svd(points - middle, full_matrices=False)[2][2]


def _off_plane(points: Array) -> Array:
    middle, normal = _plane(points)
    return np.asarray((points - middle) @ normal)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _lattice(rig: Rig, points: Array, centres_px: Array, plate_xy_m: Array) -> tuple[float, float]:
    """Distance of holes from the plate's lattice, rms, and measured pitch over nominal."""
    middle, normal = _plane(points)
    origin, rays = rig.camera.position_m, rig.camera.rays(centres_px)
    depth = ((middle - origin) @ normal) / (rays @ normal)
    holes = origin + depth[:, np.newaxis] * rays
    model = np.pad(plate_xy_m, ((0, 0), (0, 1)))
    p, q = holes - holes.mean(axis=0), model - model.mean(axis=0)
    left, _, right = np.linalg.svd(q.T @ p)
    sign = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    turned = q @ left @ sign @ right
    return _rms(np.linalg.norm(p - turned, axis=1)), float(np.sum(p * turned) / np.sum(q * q))
