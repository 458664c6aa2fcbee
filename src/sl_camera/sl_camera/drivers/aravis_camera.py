"""Driver of GigE Vision and USB3 Vision cameras, through Aravis by GObject introspection.

Aravis is optional and imported when a camera is opened only. Feature names are SFNC's;
older cameras' names (ExposureTimeAbs, GainRaw) are known where Aravis knows them.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from sl_camera.camera.camera import CameraSettings, CameraStatistics, Frame, FrameStatus
from sl_camera.camera.device_clock import DeviceClock
from sl_camera.camera.frame_ids import GVSP_PERIOD, FrameIds
from sl_camera.camera.pixel_formats import BY_CODE, CHOICES, WireFormat, unpack
from sl_camera.drivers.aravis_library import find_camera, is_gone, load_aravis, words_of
from sl_common.errors import DeviceError, DeviceLost, DeviceRefused

#: Between two attempts to find a lost camera again.
RETRY_S = 0.5
#: The device's clock is read again so often: at 50 ppm it drifts 0.1 ms meanwhile.
LATCH_EVERY_S = 2.0
LATCH_SAMPLES = 8
#: Commands that freeze the device's clock, and where it then stands: SFNC and older GigE Vision.
LATCHES = (
    ("TimestampLatch", "TimestampLatchValue"),
    ("GevTimestampControlLatch", "GevTimestampValue"),
)
CHUNKS = ("FrameID", "Timestamp", "ExposureTime")
#: From a software trigger to the exposure: the command's way, and a busy camera's readout.
SOFTWARE_LATENCY_S = 0.05


@dataclass(frozen=True)
class AravisOptions:
    """What is set beside `CameraSettings`.

    Parameters
    ----------
    trigger_line : str
        Input that the projector's trigger is wired to.
    packet_size : int
        GigE Vision packets, bytes; 0: the largest that the network passes.
    buffers : int
        Frames that may wait; more than the longest sequence has.
    features : str
        Further GenICam features, ``"Name=Value Name=Value"``, set after all others.
    """

    trigger_line: str = "Line0"
    packet_size: int = 0
    buffers: int = 64
    features: str = ""


class AravisCamera:
    """A `CameraDriver` on Aravis.

    Parameters
    ----------
    name : str
        Id, serial number or network address; empty: the first that is found.
    options : AravisOptions, optional
        What is set beside `CameraSettings`.
    """

    def __init__(self, name: str = "", options: AravisOptions | None = None) -> None:
        self._name = name
        self._options = options or AravisOptions()
        self._aravis: Any = None
        self._camera: Any = None
        self._stream: Any = None
        self._gone = ""
        self._settings: CameraSettings | None = None
        self._format: WireFormat = BY_CODE[0x01080001]
        self._image_size = (0, 0)
        self._exposure_s = 0.0
        self._armed = False
        self._clock = DeviceClock()
        self._latch_due = 0.0
        self._ids = FrameIds(GVSP_PERIOD)
        self._chunks: Any = None
        self._chunk_names: list[str] = []
        self._tick_ns = 1.0
        self._counts = CameraStatistics()

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) as the camera says; (0, 0) before `configure`."""
        return self._image_size

    @property
    def latency_s(self) -> float:
        """See `CameraDriver.latency_s`."""
        return SOFTWARE_LATENCY_S

    # -- what the owner calls ---------------------------------------------------------------

    def open(self) -> None:
        """Connect; see `CameraDriver.open`."""
        self._release()
        self._counts = CameraStatistics()
        self._settings = None
        self._connect()

    def configure(self, settings: CameraSettings) -> None:
        """Set the camera up and disarm it; see `CameraDriver.configure`."""
        camera = self._connected()
        before = self._settings
        self.disarm()
        with self._errors("configure it"):
            self._check(camera, settings)
            try:
                self._apply(camera, settings)
            except Exception:
                if before is not None:
                    self._apply(camera, before)
                raise
        self._settings = settings

    def arm(self) -> None:
        """Start to wait for triggers; see `CameraDriver.arm`."""
        camera = self._connected()
        self.disarm()
        self._stream = None
        with self._errors("arm it"):
            stream = camera.create_stream(None, None)
            if stream is None:
                raise DeviceLost(f"{self._title()} gives no stream")
            payload = camera.get_payload()
            for _ in range(self._options.buffers):
                stream.push_buffer(self._aravis.Buffer.new_allocate(payload))
            self._ids.start()
            self._latch(camera)
            camera.start_acquisition()
        self._stream, self._armed = stream, True

    def disarm(self) -> None:
        """Stop taking frames; see `CameraDriver.disarm`."""
        if self._armed:
            self._armed = False
            with self._errors("stop it"):
                self._connected().stop_acquisition()

    def read(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame; see `CameraDriver.read`. Reconnects a lost camera."""
        if self._camera is None:
            self._reconnect(timeout_s)
        if self._gone:
            raise self._lost(self._gone)
        if self._stream is None:
            time.sleep(max(timeout_s, 0.0))
            return None
        buffer = self._stream.timeout_pop_buffer(max(0, round(timeout_s * 1e6)))
        if buffer is not None:
            return self._take(buffer)
        if self._armed and time.monotonic() >= self._latch_due:
            # Between scans only: a new reading may shift the stamps a little.
            with self._errors("read its clock"):
                self._latch(self._camera)
        return None

    def software_trigger(self) -> None:
        """Expose one frame now; from any thread."""
        camera = self._connected()
        with self._errors("trigger it"):
            camera.software_trigger()

    def statistics(self) -> CameraStatistics:
        """Counts since `open`."""
        return replace(self._counts, lost=self._ids.lost)

    def packets(self) -> dict[str, int]:
        """Aravis' counters of the stream (packets missing, resent and more); empty when idle."""
        stream = self._stream
        if stream is None:
            return {}
        names = (stream.get_info_name(i) for i in range(stream.get_n_infos()))
        return {n.removeprefix("n_"): stream.get_info_uint64_by_name(n) for n in names}

    def close(self) -> None:
        """Release the camera; never raises."""
        self._release()

    # -- connection -------------------------------------------------------------------------

    def _connect(self) -> None:
        self._aravis = load_aravis()
        self._gone = ""
        try:
            self._camera = self._aravis.Camera.new(find_camera(self._aravis, self._name))
        except DeviceError:
            raise
        except Exception as error:
            raise DeviceLost(f"{self._title()} cannot be opened: {words_of(error)}") from error
        self._camera.get_device().connect("control-lost", self._on_lost)
        gige = self._camera.is_gv_device()
        lost, self._ids = self._ids.lost, FrameIds(GVSP_PERIOD if gige else 1 << 64)
        self._ids.lost = lost if self._settings is not None else 0
        self._clock = DeviceClock()

    def _on_lost(self, _device: object) -> None:
        """Take the word of Aravis' heartbeat thread."""
        self._gone = "it does not answer any more, or another program took it"

    def _reconnect(self, timeout_s: float) -> None:
        """Find the camera again and bring it to where it was."""
        armed, settings = self._armed, self._settings
        try:
            self._connect()
            if settings is not None:
                self._armed = False
                self.configure(settings)
            if armed:
                self.arm()
        except DeviceError as error:
            self._release()
            self._armed, self._settings = armed, settings
            time.sleep(min(RETRY_S, max(timeout_s, 0.0)))
            raise DeviceLost(f"the camera is still gone: {error}") from error
        self._counts.reconnects += 1

    def _release(self) -> None:
        camera, self._camera, self._stream = self._camera, None, None
        if camera is not None and self._armed and not self._gone:
            with contextlib.suppress(Exception):  # it may be gone already
                camera.stop_acquisition()
        self._armed = False

    def _connected(self) -> Any:
        if self._camera is None:
            raise DeviceLost(f"{self._title()} is not connected")
        return self._camera

    def _lost(self, why: str) -> DeviceLost:
        """Drop the connection, remember what to come back to."""
        armed, settings = self._armed, self._settings
        self._release()
        self._armed, self._settings = armed, settings
        return DeviceLost(f"{self._title()} is gone: {why}")

    def _title(self) -> str:
        return f"the GenICam camera {self._name}".rstrip()

    @contextmanager
    def _errors(self, doing: str) -> Iterator[None]:
        """Turn what Aravis raises into this project's errors."""
        try:
            yield
        except DeviceError:
            raise
        except Exception as error:  # GLib.Error, which needs gi to be named
            words = words_of(error)
            if is_gone(self._aravis, error):
                raise self._lost(f"could not {doing}: {words}") from error
            raise DeviceRefused(f"{self._title()}: could not {doing}: {words}") from error

    # -- settings ---------------------------------------------------------------------------

    def _check(self, camera: Any, settings: CameraSettings) -> None:
        """Refuse what the camera cannot, before anything is changed."""
        exposure = camera.get_exposure_time_bounds()
        if not exposure.min <= settings.exposure_s * 1e6 <= exposure.max:
            raise DeviceRefused(
                f"exposure_s={settings.exposure_s}; this camera can {exposure.min * 1e-6:g} to "
                f"{exposure.max * 1e-6:g} s"
            )
        self._wire_format(camera, settings)
        self._gain(camera, settings)
        if settings.region is not None:
            x, y, w, h = settings.region
            width, height = _pair(camera.get_sensor_size())
            if x + w > width or y + h > height:
                raise DeviceRefused(
                    f"region {settings.region} is not on the sensor of {width} x {height}"
                )
        if settings.trigger == "hardware":
            self._check_line(camera)
        if settings.trigger == "software" and not camera.is_software_trigger_supported():
            raise DeviceRefused(f"{self._title()} has no software trigger")

    def _check_line(self, camera: Any) -> None:
        lines = list(camera.dup_available_trigger_sources())
        if self._options.trigger_line not in lines:
            raise DeviceRefused(
                f"trigger_line={self._options.trigger_line!r}; this camera has {lines}"
            )

    def _wire_format(self, camera: Any, settings: CameraSettings) -> WireFormat:
        there = list(camera.dup_available_pixel_formats_as_strings())
        for format_ in BY_CODE.values():
            if format_.name in CHOICES[settings.pixel_format] and format_.name in there:
                return format_
        raise DeviceRefused(
            f"pixel_format={settings.pixel_format!r}; this camera has {', '.join(sorted(there))}"
        )

    def _gain(self, camera: Any, settings: CameraSettings) -> float | None:
        """Gain in the camera's unit, decibels (SFNC); None: it has none, or it stays as it is."""
        if not camera.is_feature_available("Gain"):
            if settings.gain != 1.0:
                raise DeviceRefused(
                    f"gain={settings.gain}; this camera has no gain in decibels, expected 1 "
                    "(and its own feature, such as GainRaw=3, in the parameter features)"
                )
            return None
        decibels = 20.0 * math.log10(settings.gain)
        bounds = camera.get_gain_bounds()
        if not bounds.min - 1e-6 <= decibels <= bounds.max + 1e-6:
            low, high = (10 ** (db / 20.0) for db in (bounds.min, bounds.max))
            raise DeviceRefused(f"gain={settings.gain}; this camera can {low:g} to {high:g}")
        return min(max(decibels, float(bounds.min)), float(bounds.max))

    def _apply(self, camera: Any, settings: CameraSettings) -> None:
        format_ = self._wire_format(camera, settings)
        camera.set_acquisition_mode(self._aravis.AcquisitionMode.CONTINUOUS)
        camera.set_pixel_format_from_string(format_.name)
        self._set_region(camera, settings)
        self._set_light(camera, settings)
        self._set_trigger(camera, settings)
        self._set_chunks(camera)
        self._set_packets(camera)
        if self._options.features:
            camera.get_device().set_features_from_string(self._options.features)
        region = camera.get_region()
        self._image_size = (int(region.width), int(region.height))
        self._exposure_s = camera.get_exposure_time() * 1e-6
        self._format = format_

    def _set_region(self, camera: Any, settings: CameraSettings) -> None:
        wanted = settings.region or (0, 0, *_pair(camera.get_sensor_size()))
        camera.set_region(*wanted)
        region = camera.get_region()
        found = (region.x, region.y, region.width, region.height)
        if settings.region is not None and found != wanted:
            raise DeviceRefused(f"region {wanted}; the nearest that this camera can is {found}")

    def _set_light(self, camera: Any, settings: CameraSettings) -> None:
        off = self._aravis.Auto.OFF
        if camera.is_exposure_auto_available():
            camera.set_exposure_time_auto(off)
        if camera.is_gain_auto_available():
            camera.set_gain_auto(off)
        camera.set_exposure_time(settings.exposure_s * 1e6)
        gain = self._gain(camera, settings)
        if gain is not None:
            camera.set_gain(gain)

    def _set_trigger(self, camera: Any, settings: CameraSettings) -> None:
        if settings.trigger == "free":
            camera.clear_triggers()
        elif settings.trigger == "software":
            camera.set_trigger("Software")
        else:
            camera.set_trigger(self._options.trigger_line)

    def _set_chunks(self, camera: Any) -> None:
        """Ask for frame number, time stamp and exposure in each frame, where the camera can."""
        self._chunk_names = []
        self._tick_ns = _tick_ns(camera)
        if not camera.are_chunks_available():
            return
        there = camera.dup_available_enumerations_as_strings("ChunkSelector")
        names = [name for name in CHUNKS if name in there]
        features = camera.get_device().get_feature
        self._chunk_names = [name for name in names if features(f"Chunk{name}") is not None]
        camera.set_chunks(",".join(self._chunk_names))
        self._chunks = camera.create_chunk_parser()

    def _set_packets(self, camera: Any) -> None:
        if not camera.is_gv_device():
            return
        if self._options.packet_size:
            camera.gv_set_packet_size(self._options.packet_size)
        else:
            camera.gv_auto_packet_size()

    # -- time -------------------------------------------------------------------------------

    def _latch(self, camera: Any) -> None:
        """Read the device's clock against the host's, where it can be read."""
        self._latch_due = time.monotonic() + LATCH_EVERY_S
        for command, value in LATCHES:
            if camera.is_feature_available(command) and camera.is_feature_available(value):
                tick_ns = self._tick_ns
                samples = [
                    _read_clock(camera, command, value, tick_ns) for _ in range(LATCH_SAMPLES)
                ]
                self._clock.latch(samples)
                return

    # -- frames -----------------------------------------------------------------------------

    def _take(self, buffer: Any) -> Frame | None:
        """Copy a frame out of its buffer, and give the buffer back."""
        status = buffer.get_status()
        kinds = self._aravis.BufferStatus
        try:
            if status in (kinds.ABORTED, kinds.CLEARED, kinds.UNKNOWN):
                return None
            return self._frame(buffer, status == kinds.SUCCESS)
        finally:
            self._stream.push_buffer(buffer)

    def _frame(self, buffer: Any, complete: bool) -> Frame:
        width, height = self._image_size
        data = buffer.get_data()
        format_ = BY_CODE.get(buffer.get_image_pixel_format(), self._format) if complete else None
        if complete:
            width, height = buffer.get_image_width(), buffer.get_image_height()
        format_ = format_ or self._format
        size = format_.size(width, height)
        complete = complete and len(data) >= size
        if len(data) < size:
            data = data.ljust(size, b"\0")
        chunks = self._chunk_values(buffer) if complete else {}
        exposure_s = chunks.get("ExposureTime", self._exposure_s * 1e6) * 1e-6
        ticks = chunks.get("Timestamp")
        device_ns = buffer.get_timestamp() if ticks is None else round(ticks * self._tick_ns)
        self._clock.arrival(device_ns, buffer.get_system_timestamp(), exposure_s)
        # The stream numbers all frames, the broken ones too; chunks come with whole ones only.
        self._ids.take(buffer.get_frame_id())
        self._counts.received += 1
        self._counts.incomplete += not complete
        return Frame(
            unpack(data, format_, width, height),
            int(chunks.get("FrameID", buffer.get_frame_id())),
            self._clock.host_ns(device_ns),
            exposure_s,
            FrameStatus.OK if complete else FrameStatus.INCOMPLETE,
            format_.bits,
        )

    def _chunk_values(self, buffer: Any) -> dict[str, float]:
        """What the camera sent with the frame, in its units; chunks that it lacks are not there."""
        if not (self._chunk_names and buffer.has_chunks()):
            return {}
        read = {
            "FrameID": self._chunks.get_integer_value,
            "Timestamp": self._chunks.get_integer_value,
            "ExposureTime": self._chunks.get_float_value,
        }
        return {name: read[name](buffer, f"Chunk{name}") for name in self._chunk_names}


def _pair(found: Any) -> tuple[int, int]:
    """(width, height) of what Aravis returns as a named tuple."""
    return int(found[0]), int(found[1])


def _tick_ns(camera: Any) -> float:
    """Nanoseconds of a tick of the device's clock; SFNC's clock counts nanoseconds."""
    name = "GevTimestampTickFrequency"
    frequency = camera.get_integer(name) if camera.is_feature_available(name) else 0
    return 1e9 / frequency if frequency > 0 else 1.0


def _read_clock(camera: Any, command: str, value: str, tick_ns: float) -> tuple[int, int, int]:
    before_ns = time.time_ns()
    camera.execute_command(command)
    after_ns = time.time_ns()
    return before_ns, round(camera.get_integer(value) * tick_ns), after_ns
