"""The rig model, Eqs. (1) and (2) of Tsai & Hung (2005): two devices seen as cameras.

World to device ``P = R wP + T`` (device z forward, x right, y down), pin-hole projection
``Q_u = C + f (X/Z, Y/Z)`` and a lens model between the ideal ``Q_u`` and the observed ``Q_d``.
The projector is an inverse camera: its image is the DMD. Pixel (0, 0) is centred on the upper
left pixel; all lengths are metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_common.errors import CalibrationError

Array = NDArray[np.float64]

#: An orthonormal matrix written with 10 digits passes; the OCR of the paper's Table 1 does not.
ORTHONORMAL_TOLERANCE = 1e-6


class Lens(Protocol):
    """What lies between the ideal and the observed image point."""

    def undistort(self, q_px: Array, focal_px: Array, centre_px: Array) -> Array:
        """Ideal image points of observed ones, both (..., 2) in pixels.

        Parameters
        ----------
        q_px : ndarray, (..., 2)
            Observed image points, pixels.
        focal_px, centre_px : ndarray, (2,)
            Focal lengths and image centre, pixels.
        """
        ...

    def distort(self, q_px: Array, focal_px: Array, centre_px: Array) -> Array:
        """Observed image points of ideal ones, both (..., 2) in pixels.

        Parameters
        ----------
        q_px : ndarray, (..., 2)
            Ideal image points, pixels.
        focal_px, centre_px : ndarray, (2,)
            Focal lengths and image centre, pixels.
        """
        ...


@dataclass(frozen=True)
class Division:
    """The paper's lens, Eqs. (1c), (2c): ``Q_u - C = (Q_d - C)(1 + kappa r^2)``, r = ``|Q_d - C|``.

    Parameters
    ----------
    kappa : float
        Distortion factor, px^-2.
    """

    kappa: float = 0.0

    def undistort(self, q_px: Array, focal_px: Array, centre_px: Array) -> Array:
        """See `Lens`; closed form."""
        offset = q_px - centre_px
        r2 = np.sum(offset**2, axis=-1, keepdims=True)
        return np.asarray(centre_px + offset * (1.0 + self.kappa * r2))

    def distort(self, q_px: Array, focal_px: Array, centre_px: Array) -> Array:
        """See `Lens`: the root of ``r_u = r_d (1 + kappa r_d^2)`` by Newton from r_u.

        NaN where there is none (kappa < 0 and r_u beyond the fold of the model).
        """
        offset = q_px - centre_px
        ru = np.linalg.norm(offset, axis=-1, keepdims=True)
        with np.errstate(all="ignore"):
            rd = ru / (1.0 + self.kappa * ru**2)
            for _ in range(12):
                rd = rd - (rd * (1 + self.kappa * rd**2) - ru) / (1 + 3 * self.kappa * rd**2)
            scale = np.where(ru > 0, rd / ru, 1.0)
            folded = 1 + 3 * self.kappa * rd**2 <= 0
            missed = np.abs(rd * (1 + self.kappa * rd**2) - ru) > 1e-9 * (1 + ru)
        return np.asarray(centre_px + offset * np.where(folded | missed, np.nan, scale))


@dataclass(frozen=True)
class BrownConrady:
    """OpenCV's lens model, for rigs that were calibrated elsewhere.

    Parameters
    ----------
    coefficients : tuple of float
        (k1, k2, p1, p2, k3), on normalised coordinates.
    """

    coefficients: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def undistort(self, q_px: Array, focal_px: Array, centre_px: Array) -> Array:
        """See `Lens`; by OpenCV's iteration carried to 1e-12."""
        flat = np.ascontiguousarray(q_px, dtype=np.float64).reshape(-1, 1, 2)
        matrix = _camera_matrix(focal_px, centre_px)
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-12)
        out = cv2.undistortPoints(
            flat, matrix, np.array(self.coefficients), None, None, matrix, criteria=stop
        )
        return np.asarray(out, dtype=np.float64).reshape(q_px.shape)

    def distort(self, q_px: Array, focal_px: Array, centre_px: Array) -> Array:
        """See `Lens`; closed form."""
        k1, k2, p1, p2, k3 = self.coefficients
        x, y = np.moveaxis((q_px - centre_px) / focal_px, -1, 0)
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.asarray(centre_px + focal_px * np.stack([xd, yd], axis=-1))


def _camera_matrix(focal_px: Array, centre_px: Array) -> Array:
    return np.array([[focal_px[0], 0, centre_px[0]], [0, focal_px[1], centre_px[1]], [0, 0, 1.0]])


@dataclass(frozen=True)
class Device:
    """A camera, or a projector seen as one.

    Parameters
    ----------
    image_size : tuple of int
        (width, height), pixels.
    focal_length_px : tuple of float
        (fx, fy), pixels; the paper has fx = fy.
    image_centre_px : tuple of float
        Image centre C = (u, v); it may lie anywhere.
    pixel_pitch_m : float
        Pixel pitch on the chip, metres; used in reports only.
    rotation : ndarray, (3, 3)
        device_from_world rotation.
    translation_m : ndarray, (3,)
        device_from_world translation, metres.
    lens : Lens
        Distortion model.

    Raises
    ------
    CalibrationError
        When a number is not finite, a size is not positive, or the rotation is not a rotation.
    """

    image_size: tuple[int, int]
    focal_length_px: tuple[float, float]
    image_centre_px: tuple[float, float]
    pixel_pitch_m: float
    rotation: Array
    translation_m: Array
    lens: Division | BrownConrady

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation", np.asarray(self.rotation, dtype=np.float64))
        object.__setattr__(self, "translation_m", np.asarray(self.translation_m, dtype=np.float64))
        if self.rotation.shape != (3, 3) or self.translation_m.shape != (3,):
            raise CalibrationError(
                f"rotation.shape={self.rotation.shape}, translation_m.shape="
                f"{self.translation_m.shape}; expected (3, 3) and (3,)"
            )
        numbers = [*self.focal_length_px, *self.image_centre_px, self.pixel_pitch_m]
        if not np.all(np.isfinite([*numbers, *self.rotation.flat, *self.translation_m])):
            raise CalibrationError("a device parameter is not finite; expected real numbers")
        if min(*self.image_size, *self.focal_length_px, self.pixel_pitch_m) <= 0:
            raise CalibrationError(
                f"image_size={self.image_size}, focal_length_px={self.focal_length_px}, "
                f"pixel_pitch_m={self.pixel_pitch_m}; expected positive numbers"
            )
        error = float(np.abs(self.rotation @ self.rotation.T - np.eye(3)).max())
        if error > ORTHONORMAL_TOLERANCE or np.linalg.det(self.rotation) < 0:
            raise CalibrationError(
                f"rotation is off orthonormal by {error:.2g} (det "
                f"{np.linalg.det(self.rotation):+.3f}); expected a rotation within "
                f"{ORTHONORMAL_TOLERANCE:g}"
            )

    @property
    def focal_px(self) -> Array:
        """(fx, fy) as an array."""
        return np.array(self.focal_length_px, dtype=np.float64)

    @property
    def centre_px(self) -> Array:
        """Image centre C as an array."""
        return np.array(self.image_centre_px, dtype=np.float64)

    @property
    def camera_matrix(self) -> Array:
        """OpenCV's K, (3, 3)."""
        return _camera_matrix(self.focal_px, self.centre_px)

    @property
    def position_m(self) -> Array:
        """Optical centre in the world, (3,) metres."""
        return np.asarray(-self.rotation.T @ self.translation_m)

    def project(self, points_m: Array) -> Array:
        """Observed pixels (..., 2) of world points (..., 3); NaN behind the device."""
        local = points_m @ self.rotation.T + self.translation_m
        with np.errstate(all="ignore"):
            depth = np.where(local[..., 2:] > 0, local[..., 2:], np.nan)
            ideal = self.centre_px + self.focal_px * local[..., :2] / depth
        return self.lens.distort(ideal, self.focal_px, self.centre_px)

    def rays(self, q_px: Array) -> Array:
        """World directions (..., 3) of the rays through observed pixels (..., 2).

        A direction has unit component along the optical axis, so ``position_m + t * ray`` lies at
        depth t metres in front of the device.
        """
        ideal = self.lens.undistort(
            np.asarray(q_px, dtype=np.float64), self.focal_px, self.centre_px
        )
        slope = (ideal - self.centre_px) / self.focal_px
        local = np.concatenate([slope, np.ones_like(slope[..., :1])], axis=-1)
        return np.asarray(local @ self.rotation)


@dataclass(frozen=True)
class Rig:
    """Camera and projector in one world."""

    camera: Device
    projector: Device
