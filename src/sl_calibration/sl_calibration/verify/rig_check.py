"""How wrong a calibration in force is, on a plate or a flat, without changing it.

The projector's coordinates at camera pixels are triangulated: on a flat they must lie in a plane,
and camera and projector rays must meet. On the hole plate, the holes' rays must meet that plane
in a lattice of the plate's pitch. The planes of several heights must be as far apart as the stage
has moved them; one height cannot tell an error of the z scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_calibration.data.session import CalibrationRequest
from sl_calibration.data.view_extraction import check_target_light, decoded_targets, observe
from sl_calibration.solve.ray_midpoints import triangulate
from sl_calibration.target.plate import Plate
from sl_common.errors import CalibrationError
from sl_projector.sequence.stack import Stack
from sl_reconstruct.cloud.plane_fit import Plane, fit_plane
from sl_reconstruct.model.calibration_file import Calibration
from sl_reconstruct.model.rig import Rig

Array = NDArray[np.float64]

TARGETS = ("plate", "flat")
#: Part of the calibrated heights that is left free at both ends where none are asked for: heights
#: that the calibration was made at would flatter it.
_INSET = 0.1


@dataclass(frozen=True)
class VerifyLimits:
    """Largest figures of a calibration that is good enough to stay in force.

    Parameters
    ----------
    rms_m : float
        Points off their planes, rays that miss and holes off the lattice, in quadrature, metres.
    flatness_m, ray_gap_m, lattice_m : float
        Each of these alone, worst height, metres.
    pitch_error : float
        Measured pitch of the holes over the plate's, less 1.
    step_m : float
        Distances of the planes against the stage's steps, metres.
    """

    rms_m: float = 3e-6
    flatness_m: float = 2e-6
    ray_gap_m: float = 2e-6
    lattice_m: float = 2e-6
    pitch_error: float = 2e-4
    step_m: float = 1e-6


@dataclass(frozen=True)
class Check:
    """What was found at one height.

    Parameters
    ----------
    target : {"plate", "flat"}
        What was looked at.
    height_m : float
        Of the stage.
    flatness_m : float
        Distances of triangulated points from their best plane, rms.
    ray_gap_m : float
        Distances at which camera and projector rays miss each other, rms.
    lattice_m : float
        Distances of the holes from the plate's lattice, laid on them without a change of scale,
        rms; NaN for a flat.
    pitch_error : float
        Measured pitch over the plate's, less 1; NaN for a flat.
    middle_m, normal : ndarray, (3,)
        The plane: a point of it and its unit normal, upwards.
    points_m, off_plane_m : ndarray, (N, 3) and (N,)
        The points and their distances from the plane.
    """

    target: str
    height_m: float
    flatness_m: float
    ray_gap_m: float
    lattice_m: float
    pitch_error: float
    middle_m: Array = field(repr=False)
    normal: Array = field(repr=False)
    points_m: Array = field(repr=False)
    off_plane_m: Array = field(repr=False)


@dataclass(frozen=True)
class Findings:
    """What was found at all heights.

    Parameters
    ----------
    checks : tuple of Check
        In the order of the heights, lowest first.
    z_axis : ndarray, (3,)
        Where a metre of the stage's z goes in the world, as it was calibrated.
    """

    checks: tuple[Check, ...]
    z_axis: Array

    @property
    def figures(self) -> dict[str, float]:
        """Figures that `VerifyLimits` limits, by the same names; NaN where one is not known."""
        worst = {
            name: _worst([getattr(check, name) for check in self.checks])
            for name in ("flatness_m", "ray_gap_m", "lattice_m", "pitch_error")
        }
        lengths = [worst[name] for name in ("flatness_m", "ray_gap_m", "lattice_m")]
        rms_m = float(np.sqrt(np.nansum(np.square(lengths))))
        return {"rms_m": rms_m, **worst, "step_m": _worst(self.step_errors_m)}

    @property
    def step_errors_m(self) -> Array:
        """Distance of each plane from the lowest, less what the stage has moved it, (N,) metres.

        NaN for one height.
        """
        measured, expected = self._travel()
        return measured - expected if len(self.checks) > 1 else np.array([np.nan])

    @property
    def z_scale_error(self) -> float:
        """Measured travel over the stage's, less 1; NaN for one height."""
        measured, expected = self._travel()
        if len(self.checks) < 2:
            return float("nan")
        return float(np.polyfit(expected, measured, 1)[0] - 1)

    def _travel(self) -> tuple[Array, Array]:
        """Travel of the planes from the lowest along their common normal: measured, expected."""
        normal = np.mean([check.normal for check in self.checks], axis=0)
        normal /= np.linalg.norm(normal)
        middles = np.array([check.middle_m for check in self.checks])
        heights = np.array([check.height_m for check in self.checks])
        measured = (middles - middles[0]) @ normal
        return measured, (heights - heights[0]) * float(normal @ self.z_axis)

    @property
    def words(self) -> str:
        """All figures, for people."""
        found = self.figures
        text = (
            f"off the plane {found['flatness_m'] * 1e6:.3f} um, rays miss by "
            f"{found['ray_gap_m'] * 1e6:.3f} um"
        )
        if np.isfinite(found["lattice_m"]):
            text += (
                f", holes off the lattice {found['lattice_m'] * 1e6:.3f} um, their pitch off by "
                f"{found['pitch_error'] * 1e6:.1f} ppm"
            )
        if len(self.checks) < 2:
            return f"{text}; one height: an error of the z scale would not be seen"
        return (
            f"{text}, planes within {found['step_m'] * 1e6:.3f} um of the stage's steps (z scale "
            f"off by {self.z_scale_error * 1e6:+.0f} ppm)"
        )


def _worst(values: Sequence[float] | Array) -> float:
    found = np.abs(np.asarray(values, dtype=np.float64))
    return float(np.max(found)) if np.isfinite(found).all() else float("nan")


def stage_z_axis(calibration: Calibration) -> Array:
    """Where a metre of the stage's z goes in the world (3,); straight up where it is not known."""
    known = calibration.residuals.get("stage_z_axis")
    return np.array([0.0, 0.0, 1.0] if known is None else known, dtype=np.float64)


def default_heights(made_from: Mapping[str, Any], here_m: float) -> tuple[float, ...]:
    """Heights to check at, metres, where none are asked for.

    Parameters
    ----------
    made_from : mapping
        Of the calibration: three heights among its ``heights_m`` ...
    here_m : float
        ... or where the stage stands, if they are not known.
    """
    heights = made_from.get("heights_m") or ()
    if len(heights) < 2:
        return (here_m,)
    low, high = min(heights), max(heights)
    inset = _INSET * (high - low)
    return float(low + inset), float((low + high) / 2), float(high - inset)


def check_rig_on(stack: Stack, target: str, plate: Plate, rig: Rig) -> Check:
    """Check a rig on one stack.

    Parameters
    ----------
    stack : Stack
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
    size = stack.images.shape[:0:-1]
    if size != rig.camera.image_size or stack.sequence.dmd_size != rig.projector.image_size:
        raise CalibrationError(
            f"images of {size} pixels and patterns of {stack.sequence.dmd_size}; expected "
            f"{rig.camera.image_size} and {rig.projector.image_size}, as in the calibration"
        )
    check_target(target)
    if target == "flat":
        check_target_light(stack.images)
        found = decoded_targets(stack)
        return check_on(rig, stack.place[2], (found.camera_px, found.dmd_px))
    name = stack.sequence.name
    view = observe(stack, CalibrationRequest("both", (stack.place[2],), plate, name, least=1))
    targets, holes = (view.camera_px, view.dmd_px), (view.centres_px, view.plate_xy_m)
    return check_on(rig, stack.place[2], targets, holes)


def check_on(
    rig: Rig,
    height_m: float,
    targets: tuple[Array, Array],
    holes: tuple[Array, Array] | None = None,
) -> Check:
    """Check a rig on what was measured at one height.

    Parameters
    ----------
    rig : Rig
        The calibration in force.
    height_m : float
        Of the stage.
    targets : tuple of ndarray, (N, 2)
        Camera pixels and DMD coordinates.
    holes : tuple of ndarray, (M, 2), optional
        Camera pixels and places on the plate (metres) of its holes; None for a flat.
    """
    points, gaps = triangulate(rig, *targets)
    plane = fit_plane(points, rounds=1)
    if plane is None:
        raise CalibrationError(f"{len(points)} points that lie in no plane; expected a flat")
    lattice = _lattice(rig, plane, *holes) if holes else (float("nan"), float("nan"))
    off = plane.distances_m(points)
    figures = (_rms(off), _rms(gaps), *lattice)
    target = "plate" if holes else "flat"
    return Check(target, height_m, *figures, plane.point_m, plane.normal, points, off)


def check_target(target: str) -> None:
    """Refuse what cannot be checked on."""
    if target not in TARGETS:
        raise CalibrationError(f"target={target!r}; expected one of {TARGETS}")


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _lattice(rig: Rig, plane: Plane, centres_px: Array, plate_xy_m: Array) -> tuple[float, float]:
    """Distance of holes from the plate's lattice, rms, and measured pitch over nominal, less 1."""
    origin, rays = rig.camera.position_m, rig.camera.rays(centres_px)
    depth = ((plane.point_m - origin) @ plane.normal) / (rays @ plane.normal)
    holes = origin + depth[:, np.newaxis] * rays
    model = np.pad(plate_xy_m, ((0, 0), (0, 1)))
    p, q = holes - holes.mean(axis=0), model - model.mean(axis=0)
    left, _, right = np.linalg.svd(q.T @ p)
    sign = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    turned = q @ left @ sign @ right
    return _rms(np.linalg.norm(p - turned, axis=1)), float(np.sum(p * turned) / np.sum(q * q) - 1)
