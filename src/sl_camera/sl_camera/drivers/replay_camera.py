"""A recording as a camera: the frames of a bag's ``camera/image_raw``, one per trigger, in order.

Reads rosbag2 (mcap or sqlite3) without ROS. Frames carry the time of the live trigger; what was
recorded beside them is not looked at, so a bag of another sequence gives wrong counts or nonsense,
which the matching and the decoding refuse.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from sl_camera.camera.camera import CameraSettings, CameraStatistics, Frame
from sl_common.errors import DeviceError, DeviceLost, DeviceRefused
from sl_common.topics import IMAGE

ENCODINGS: dict[str, np.dtype[Any]] = {"mono8": np.dtype(np.uint8), "mono16": np.dtype("<u2")}


class ReplayCamera:
    """A `CameraDriver` on a bag. `arm` starts at its first frame.

    Parameters
    ----------
    path : path
        rosbag2 directory, or one ``.mcap`` or ``.db3`` file.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._reader: AnyReader | None = None
        self._frames: Iterator[NDArray[Any]] = iter(())
        self._next: NDArray[Any] | None = None
        self._settings: CameraSettings | None = None
        self._image_size = (0, 0)
        self._armed = False
        self._taken = 0
        self._triggers: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._counts = CameraStatistics()

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) of the bag's first frame; valid after `configure`."""
        return self._image_size

    @property
    def latency_s(self) -> float:
        """Frames are ready."""
        return 0.0

    def open(self) -> None:
        """Open the bag and look at its first frame; see `CameraDriver.open`."""
        self.close()
        self._counts = CameraStatistics()
        try:
            reader = AnyReader([self._path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
            reader.open()
        except Exception as error:  # a damaged bag makes the reader fail in any way it can
            raise DeviceLost(
                f"no whole bag at {self._path}: {_words(error)} (slrig repair mends what was cut)"
            ) from error
        self._reader = reader
        try:
            self._rewind()
            if self._next is None:
                raise DeviceLost(f"{self._path} has no frames on {IMAGE.name}")
        except DeviceError:
            self.close()
            raise

    def configure(self, settings: CameraSettings) -> None:
        """Check that the recording is what is asked for; see `CameraDriver.configure`."""
        frame = self._first()
        if settings.trigger == "hardware":
            raise DeviceRefused(
                "trigger='hardware'; a recording has no trigger line, expected 'software' or 'free'"
            )
        if settings.region is not None:
            raise DeviceRefused(f"region {settings.region}; a recording has its own, expected none")
        if (settings.pixel_format == "mono8") != (frame.dtype == np.uint8):
            raise DeviceRefused(
                f"pixel_format={settings.pixel_format!r}; the frames are {frame.dtype}"
            )
        self._settings = settings
        self._image_size = (frame.shape[1], frame.shape[0])
        self._armed = False

    def arm(self) -> None:
        """Begin with the first frame; see `CameraDriver.arm`."""
        self._first()
        self._rewind()
        self._triggers = queue.SimpleQueue()
        self._armed = True

    def disarm(self) -> None:
        """Stop giving frames; see `CameraDriver.disarm`."""
        self._armed = False

    def software_trigger(self) -> None:
        """Give the next frame.

        Raises
        ------
        DeviceRefused
            When the bag is at its end.
        """
        if self._reader is None:
            raise DeviceLost(f"{self._path} is not open")
        if self._armed and self._next is None:
            raise DeviceRefused(
                f"the recording {self._path} is at its end after {self._taken} frames; expected "
                "one for this trigger (arming begins again)"
            )
        self._triggers.put(time.time_ns())

    def read(self, timeout_s: float) -> Frame | None:
        """Next frame; see `CameraDriver.read`. At the end of the bag None, for ever."""
        settings = self._settings
        if self._reader is None:
            raise DeviceLost(f"{self._path} is not open")
        if not self._armed or settings is None:
            time.sleep(max(timeout_s, 0.0))
            return None
        stamp_ns = self._moment(settings, timeout_s)
        image = self._next
        if stamp_ns is None or image is None:
            return None
        over_ns = stamp_ns + round(settings.exposure_s * 1e9)
        time.sleep(max(0.0, (over_ns - time.time_ns()) * 1e-9))
        self._next = next(self._frames, None)
        self._taken += 1
        self._counts.received += 1
        return Frame(image, self._taken, stamp_ns, settings.exposure_s)

    def statistics(self) -> CameraStatistics:
        """Counts since `open`."""
        return replace(self._counts)

    def close(self) -> None:
        """Close the bag; never raises."""
        reader, self._reader = self._reader, None
        self._armed, self._next = False, None
        if reader is not None:
            reader.close()

    # -- inside -----------------------------------------------------------------------------

    def _moment(self, settings: CameraSettings, timeout_s: float) -> int | None:
        """Start of the next frame's exposure; None when there is none in time."""
        if settings.trigger == "free":
            return time.time_ns()
        try:
            return self._triggers.get(timeout=max(timeout_s, 0.0))
        except queue.Empty:
            return None

    def _first(self) -> NDArray[Any]:
        if self._reader is None:
            raise DeviceLost(f"{self._path} is not open")
        if self._next is None:
            self._rewind()
        assert self._next is not None  # `open` has looked
        return self._next

    def _rewind(self) -> None:
        assert self._reader is not None
        self._taken = 0
        self._frames = _images(self._reader, self._path)
        self._next = next(self._frames, None)


def _images(reader: AnyReader, path: Path) -> Iterator[NDArray[Any]]:
    """Yield the pixels of every image, in order; a DeviceError where one cannot be used."""
    topics = sorted({c.topic for c in reader.connections if c.topic.endswith("/" + IMAGE.name)})
    if len(topics) > 1:
        raise DeviceError(f"{path} has several cameras: {', '.join(topics)}; expected one")
    connections = [
        c for c in reader.connections if c.topic in topics and c.msgtype == IMAGE.msgtype
    ]
    if not connections:
        return
    messages = reader.messages(connections)
    while True:
        try:
            connection, _, data = next(messages)
            message: Any = reader.deserialize(data, connection.msgtype)
        except StopIteration:
            return
        except Exception as error:
            raise DeviceError(f"{path} cannot be read on: {_words(error)}") from error
        yield _pixels(message, path)


def _pixels(message: Any, path: Path) -> NDArray[Any]:
    dtype = ENCODINGS.get(message.encoding)
    if dtype is None:
        raise DeviceError(f"{path}: a frame is {message.encoding!r}; expected mono8 or mono16")
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    stored = dtype.newbyteorder(">") if message.is_bigendian else dtype
    pixels: NDArray[Any] = np.ascontiguousarray(rows[:, : message.width * dtype.itemsize])
    return pixels.view(stored).astype(dtype, copy=False)


def _words(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
