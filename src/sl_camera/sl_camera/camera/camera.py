"""What a camera is to this project; each driver says it in its maker's words.

The order of calls is `open`, `configure`, `arm`, then `read` until `disarm` or `close`. All are
called by one owner (`camera_node`); only `software_trigger` may come from another thread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import ConfigError

TriggerMode = Literal["hardware", "software", "free"]
PixelFormat = Literal["mono8", "mono10", "mono10p", "mono12", "mono12p", "mono16"]
Encoding = Literal["mono8", "mono16"]

TRIGGER_MODES: tuple[TriggerMode, ...] = get_args(TriggerMode)
#: Significant bits of each pixel format; "p" is packed on the way, for slow cables.
PIXEL_BITS: dict[PixelFormat, int] = {
    "mono8": 8, "mono10": 10, "mono10p": 10, "mono12": 12, "mono12p": 12, "mono16": 16,
}  # fmt: skip


class FrameStatus(StrEnum):
    """How a frame arrived."""

    OK = "ok"
    INCOMPLETE = "incomplete"


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame as the camera delivered it.

    Parameters
    ----------
    image : ndarray, (H, W), uint8 or uint16
        Pixels. May be a view into a ring of buffers: it stays as it is until as many further frames
        were read as the driver's ``ring`` says less one.
    frame_id : int
        The camera's own count; a gap is a frame lost on the way.
    stamp_ns : int
        Start of the exposure, host clock, nanoseconds since the epoch.
    exposure_s : float
        Exposure as the camera says, seconds.
    status : FrameStatus
        Whether all pixels are there.
    bits : int
        Significant bits of a pixel; 0: all of its type.
    """

    image: NDArray[np.uint8] | NDArray[np.uint16]
    frame_id: int
    stamp_ns: int
    exposure_s: float
    status: FrameStatus = FrameStatus.OK
    bits: int = 0

    @property
    def encoding(self) -> Encoding:
        """ROS name of the pixel format."""
        return "mono8" if self.image.dtype == np.uint8 else "mono16"

    @property
    def full_scale_dn(self) -> int:
        """Largest value that a pixel can have: there it is saturated."""
        return (1 << (self.bits or 8 * self.image.itemsize)) - 1


@dataclass(frozen=True)
class CameraSettings:
    """What a camera is told before it is armed.

    Parameters
    ----------
    exposure_s : float
        Exposure, seconds; a little shorter than the pattern's.
    gain : float
        Factor on the signal, 1 is the camera's own.
    trigger : {"hardware", "software", "free"}
        A frame per edge on the trigger line, per call of `software_trigger`, or as fast as it goes.
    region : tuple of int or None
        (x, y, width, height), pixels; None is the whole sensor.
    pixel_format : {"mono8", "mono10", "mono10p", "mono12", "mono12p", "mono16"}
        Bits per pixel, "p" packed on the cable; above 8 they come as 16-bit integers, not scaled.

    Raises
    ------
    ConfigError
        When a value is out of range.
    """

    exposure_s: float = 0.03
    gain: float = 1.0
    trigger: TriggerMode = "hardware"
    region: tuple[int, int, int, int] | None = None
    pixel_format: PixelFormat = "mono8"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.exposure_s) and 0 < self.exposure_s <= 60):
            raise ConfigError(f"exposure_s={self.exposure_s}; expected more than 0, at most 60")
        if not (math.isfinite(self.gain) and 0 < self.gain <= 1000):
            raise ConfigError(f"gain={self.gain}; expected more than 0, at most 1000")
        if self.trigger not in TRIGGER_MODES:
            raise ConfigError(f"trigger={self.trigger!r}; expected one of {TRIGGER_MODES}")
        if self.pixel_format not in PIXEL_BITS:
            raise ConfigError(
                f"pixel_format={self.pixel_format!r}; expected one of {sorted(PIXEL_BITS)}"
            )
        if self.region is not None and (min(self.region[:2]) < 0 or min(self.region[2:]) < 1):
            raise ConfigError(f"region={self.region}; expected x, y >= 0 and width, height >= 1")


@dataclass
class CameraStatistics:
    """Counted since `open`; a lost frame is a normal, counted event."""

    received: int = 0
    lost: int = 0
    incomplete: int = 0
    reconnects: int = 0


class CameraDriver(Protocol):
    """A camera. Every method but `close` raises `DeviceError` when the device fails."""

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) of the next frames, pixels; valid after `configure`."""
        ...

    @property
    def latency_s(self) -> float:
        """From `software_trigger` to the start of the exposure at the latest, seconds."""
        ...

    def open(self) -> None:
        """Connect. Called once by the owner; afterwards the camera is idle and can be configured.

        Raises
        ------
        DeviceLost
            When there is no camera.
        """
        ...

    def configure(self, settings: CameraSettings) -> None:
        """Set exposure, gain, trigger, region and pixel format; disarms.

        Afterwards the camera does as told, or an error was raised and it is as before.

        Raises
        ------
        DeviceRefused
            When the camera cannot do that; the message says what it can.
        """
        ...

    def arm(self) -> None:
        """Start to wait for triggers. Afterwards no edge is missed; old frames are gone.

        Called before the projector is started.
        """
        ...

    def disarm(self) -> None:
        """Stop taking frames. Afterwards no new frame comes; frames taken before may be read."""
        ...

    def read(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame, in the order of delivery; None when none came in time.

        A driver that can reconnects by itself: `DeviceLost` says that the camera is gone for now,
        and the next call tries again.
        """
        ...

    def software_trigger(self) -> None:
        """Expose one frame now; it comes out of `read`. For trigger mode "software"."""
        ...

    def statistics(self) -> CameraStatistics:
        """Counts since `open`, a copy."""
        ...

    def close(self) -> None:
        """Release the camera; never raises, may be called twice."""
        ...
