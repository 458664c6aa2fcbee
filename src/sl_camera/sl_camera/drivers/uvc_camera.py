"""Driver of webcams (UVC, anything that V4L2 knows) through OpenCV: show a pattern, settle, take.

What such a camera cannot: it has no trigger input, numbers no frames and says no exposure start.
It runs free; after a software trigger some frames are thrown away, because they were exposed or
buffered before, and the next one is taken. Stamps are estimates, right to a frame period or two.
Grey values pass the camera's own gamma and compression; for measuring to a micrometre use another.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_camera.camera.camera import CameraSettings, CameraStatistics, Frame
from sl_common.errors import ConfigError, DeviceLost, DeviceRefused

#: V4L2's exposure_auto menu: 1 is manual; its exposure counts 100 us.
MANUAL_EXPOSURE = 1.0
EXPOSURE_UNIT_S = 1e-4
#: The exposure that a camera takes may differ so much from the one wanted.
EXPOSURE_SLACK = 0.1
DEFAULT_RATE_HZ = 30.0
RETRY_S = 0.5


class Capture(Protocol):
    """What is used of `cv2.VideoCapture`."""

    def isOpened(self) -> bool:  # noqa: N802  # OpenCV's name
        """Whether there is a camera."""
        ...

    def get(self, prop: int) -> float:
        """Value of a property; 0 where it is unknown."""
        ...

    def set(self, prop: int, value: float) -> bool:
        """Set a property; the camera may take another value.

        Parameters
        ----------
        prop : int
            OpenCV's ``CAP_PROP_*``.
        value : float
            In OpenCV's unit of the property.
        """
        ...

    def read(self) -> tuple[bool, NDArray[Any]]:
        """Wait for the next frame; False when none comes."""
        ...

    def release(self) -> None:
        """Close the camera."""
        ...


@dataclass(frozen=True)
class UvcOptions:
    """What is set beside `CameraSettings`.

    Parameters
    ----------
    settle_frames : int
        Frames thrown away after a trigger: the buffered ones and the one that is being exposed.
    image_size : tuple of int
        (width, height) asked for; (0, 0) is the camera's own choice.
    """

    settle_frames: int = 4
    image_size: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        if not 1 <= self.settle_frames <= 100:
            raise ConfigError(f"settle_frames={self.settle_frames}; expected 1 to 100")


def open_capture(device: int | str) -> Capture:
    """Open a camera by index or device file."""
    capture: Capture = cv2.VideoCapture(device, cv2.CAP_V4L2)
    return capture


class UvcCamera:
    """A `CameraDriver` on OpenCV.

    Parameters
    ----------
    device : str
        Index or device file: "0", "/dev/video2".
    options : UvcOptions, optional
        What is set beside `CameraSettings`.
    capture : callable
        Opens the camera; tests give another.
    """

    def __init__(
        self,
        device: str = "0",
        options: UvcOptions | None = None,
        capture: Callable[[int | str], Capture] = open_capture,
    ) -> None:
        self._device: int | str = int(device) if device.isdigit() else device
        self._options = options or UvcOptions()
        self._open_capture = capture
        self._capture: Capture | None = None
        self._settings: CameraSettings | None = None
        self._image_size = (0, 0)
        self._exposure_s = 0.0
        self._period_s = 1.0 / DEFAULT_RATE_HZ
        self._armed = False
        self._frame_id = 0
        self._triggers: deque[int] = deque()
        self._dropped = 0
        self._counts = CameraStatistics()

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) of the next frames; valid after `configure`."""
        return self._image_size

    @property
    def latency_s(self) -> float:
        """Frames that settle, the one before them, and the estimate's own uncertainty."""
        return (self._options.settle_frames + 2) * self._period_s

    # -- what the owner calls ---------------------------------------------------------------

    def open(self) -> None:
        """Connect; see `CameraDriver.open`."""
        self.close()
        self._counts = CameraStatistics()
        self._settings = None
        self._connect()

    def configure(self, settings: CameraSettings) -> None:
        """Set the camera up and disarm it; see `CameraDriver.configure`."""
        capture = self._connected()
        _check(settings)
        before_s = capture.get(cv2.CAP_PROP_EXPOSURE) * EXPOSURE_UNIT_S
        width, height = self._set_up(capture)
        if settings.region is not None:
            x, y, w, h = settings.region
            if x + w > width or y + h > height:
                raise DeviceRefused(f"region {settings.region} is not on {width} x {height}")
            width, height = w, h
        self._exposure_s = self._expose(capture, settings.exposure_s, before_s)
        rate_hz = capture.get(cv2.CAP_PROP_FPS)
        self._period_s = max(1.0 / (rate_hz if rate_hz > 0 else DEFAULT_RATE_HZ), self._exposure_s)
        self._image_size = (width, height)
        self._settings = settings
        self.disarm()

    def arm(self) -> None:
        """Take frames from here on; see `CameraDriver.arm`."""
        self._connected()
        self._triggers.clear()
        self._dropped = 0
        self._armed = True

    def disarm(self) -> None:
        """Stop taking frames; see `CameraDriver.disarm`."""
        self._armed = False
        self._triggers.clear()

    def read(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame; the driver reads on between triggers, so that none is old."""
        if self._capture is None:
            self._reconnect(timeout_s)
        if not self._armed or self._settings is None:
            time.sleep(max(timeout_s, 0.0))
            return None
        deadline = time.monotonic() + timeout_s
        while True:
            frame = self._next(self._settings)
            if frame is not None or time.monotonic() >= deadline:
                return frame

    def software_trigger(self) -> None:
        """Take the first frame that is exposed wholly after now; from any thread."""
        self._connected()
        self._triggers.append(time.time_ns())

    def statistics(self) -> CameraStatistics:
        """Counts since `open`; lost frames cannot be known."""
        return replace(self._counts)

    def close(self) -> None:
        """Release the camera; never raises."""
        capture, self._capture = self._capture, None
        self._armed = False
        if capture is not None:
            capture.release()

    # -- inside -----------------------------------------------------------------------------

    def _connect(self) -> None:
        capture = self._open_capture(self._device)
        if not capture.isOpened():
            capture.release()
            raise DeviceLost(
                f"no camera {self._device}, or no permission for it, or another program has it; "
                "expected a V4L2 device (v4l2-ctl --list-devices; group video)"
            )
        self._capture = capture

    def _reconnect(self, timeout_s: float) -> None:
        settings = self._settings
        try:
            self._connect()
            if settings is not None:
                self.configure(settings)
                self.arm()
        except (DeviceLost, DeviceRefused) as error:
            self.close()
            time.sleep(min(RETRY_S, max(timeout_s, 0.0)))
            raise DeviceLost(f"the camera is still gone: {error}") from error
        self._counts.reconnects += 1

    def _connected(self) -> Capture:
        if self._capture is None:
            raise DeviceLost(f"camera {self._device} is not connected")
        return self._capture

    def _set_up(self, capture: Capture) -> tuple[int, int]:
        """Size and buffers; returns (width, height)."""
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        width, height = self._options.image_size
        if width:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
        found = (
            round(capture.get(cv2.CAP_PROP_FRAME_WIDTH)),
            round(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)),
        )
        if width and found != (width, height):
            raise DeviceRefused(
                f"image_size={(width, height)}; the nearest that camera {self._device} can is "
                f"{found}"
            )
        return found

    def _expose(self, capture: Capture, wanted_s: float, before_s: float) -> float:
        """Fix the exposure and return it, seconds; put the old one back when it is refused."""
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL_EXPOSURE)
        capture.set(cv2.CAP_PROP_EXPOSURE, max(1.0, round(wanted_s / EXPOSURE_UNIT_S)))
        found_s = capture.get(cv2.CAP_PROP_EXPOSURE) * EXPOSURE_UNIT_S
        if abs(found_s - wanted_s) <= max(EXPOSURE_SLACK * wanted_s, EXPOSURE_UNIT_S):
            return found_s
        capture.set(cv2.CAP_PROP_EXPOSURE, before_s / EXPOSURE_UNIT_S)
        raise DeviceRefused(
            f"exposure_s={wanted_s:g}; camera {self._device} made {found_s:g} s of it (see "
            "v4l2-ctl --list-ctrls for what it can)"
        )

    def _next(self, settings: CameraSettings) -> Frame | None:
        """Read one frame; None when it is not the one that was asked for."""
        ok, image = self._connected().read()
        arrived_ns = time.time_ns()
        if not ok:
            armed = self._armed
            self.close()
            self._armed = armed
            raise DeviceLost(f"camera {self._device} delivers no frames any more")
        if settings.trigger == "software" and not self._settled():
            return None
        self._frame_id += 1
        self._counts.received += 1
        start_ns = arrived_ns - round((self._period_s + self._exposure_s) * 1e9)
        return Frame(_grey(image, settings), self._frame_id, start_ns, self._exposure_s)

    def _settled(self) -> bool:
        """Whether the frame that just came is the first one wholly after the oldest trigger."""
        if not self._triggers:
            return False
        self._dropped += 1
        if self._dropped <= self._options.settle_frames:
            return False
        self._dropped = 0
        self._triggers.popleft()
        return True


def _check(settings: CameraSettings) -> None:
    if settings.trigger == "hardware":
        raise DeviceRefused(
            "trigger='hardware'; a UVC camera has no trigger input, expected 'software' or 'free'"
        )
    if settings.pixel_format != "mono8":
        raise DeviceRefused(f"pixel_format={settings.pixel_format!r}; expected 'mono8'")
    if settings.gain != 1.0:
        raise DeviceRefused(
            f"gain={settings.gain}; a UVC camera's gain has no unit, expected 1 (set it with "
            "v4l2-ctl --set-ctrl gain=...)"
        )


def _grey(image: NDArray[Any], settings: CameraSettings) -> NDArray[np.uint8]:
    if settings.region is not None:
        x, y, w, h = settings.region
        image = image[y : y + h, x : x + w]
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.ascontiguousarray(grey, dtype=np.uint8)
