"""The images of one scan, as matching, reconstruction, calibration and evaluation pass them on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import CalibrationError
from sl_common.topics import WORLD_FRAME
from sl_projector.sequence.pattern_sequence import PatternSequence

Pixels: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]

#: Pixel type of each encoding that a scan may have.
PIXEL_TYPES: dict[str, np.dtype[Any]] = {"mono8": np.dtype(np.uint8), "mono16": np.dtype("<u2")}
#: Longest deviation of a quaternion's length from 1.
_UNIT_TOLERANCE = 1e-3


def encoding_of(pixels: Pixels) -> str:
    """Encoding of an image or stack, "mono8" or "mono16"."""
    return "mono8" if pixels.dtype == np.uint8 else "mono16"


@dataclass(frozen=True, slots=True)
class StagePose:
    """Where the part stood.

    Parameters
    ----------
    stamp_ns : int
        When it stood there, host clock.
    position_m : tuple of float
        (x, y, z), metres.
    quaternion_xyzw : tuple of float
        Unit quaternion; by default not turned.
    frame_id : str
        Frame that both are in.
    """

    stamp_ns: int
    position_m: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    frame_id: str = WORLD_FRAME

    def fault(self) -> str:
        """Say why this is not a pose; empty when it is one."""
        if not all(map(math.isfinite, (*self.position_m, *self.quaternion_xyzw))):
            return f"the stage pose is not a number: {self.position_m}, {self.quaternion_xyzw}"
        norm = math.hypot(*self.quaternion_xyzw)
        if abs(norm - 1.0) > _UNIT_TOLERANCE:
            return f"the stage pose has a quaternion of length {norm:.4g}, expected 1"
        return ""


@dataclass(slots=True, eq=False)
class Stack:
    """All images of one scan, in pattern order.

    Parameters
    ----------
    images : ndarray, (N, H, W), uint8 or uint16
        One per pattern. It may be a view into a message; a stack of `StackMatcher` is handed back
        with its `recycle`.
    sequence : PatternSequence
        What was projected.
    scan_id : int
        The scan; 0 where it has no number.
    stamps_ns : tuple of int
        Start of each exposure, camera's clock, nanoseconds.
    exposure_s : float
        Exposure of each pattern, seconds.
    pose : StagePose or None
        Where the part stood during all exposures; None where nobody asked for it.
    """

    images: Pixels
    sequence: PatternSequence
    scan_id: int = 0
    stamps_ns: tuple[int, ...] = ()
    exposure_s: float = 0.0
    pose: StagePose | None = None

    @property
    def encoding(self) -> str:
        """Pixel format, "mono8" or "mono16"."""
        return encoding_of(self.images)

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) of the images, pixels."""
        _, height, width = self.images.shape
        return width, height

    @property
    def place(self) -> tuple[float, float, float]:
        """Where the stage stood: x, y, z, metres.

        Raises
        ------
        CalibrationError
            When the stack has no pose.
        """
        if self.pose is None:
            raise CalibrationError(
                f"the stack of scan {self.scan_id} has no stage pose; expected one: set the "
                "synchronizer's parameter require_pose"
            )
        return self.pose.position_m

    def release_images(self) -> Pixels:
        """Hand the images over: their memory is free as soon as the caller drops them."""
        images = self.images
        self.images = np.empty((0, *images.shape[1:]), images.dtype)
        return images
