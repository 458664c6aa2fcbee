"""The camera's node: every frame as an image with its camera info, and what got lost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import asdict, replace
from queue import Empty, SimpleQueue
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo
from sl_interfaces.msg import PatternTrigger, RigCalibration

from sl_camera.camera.camera import (
    PIXEL_BITS,
    TRIGGER_MODES,
    CameraDriver,
    CameraSettings,
    CameraStatistics,
    Frame,
    FrameStatus,
)
from sl_camera.camera.software_trigger import PatternWindows
from sl_camera.drivers.aravis_camera import AravisOptions
from sl_camera.drivers.camera_drivers import ADDRESSES, make_camera
from sl_camera.drivers.uvc_camera import UvcOptions
from sl_camera.messages import camera_info_for
from sl_common import topics
from sl_common.base_node import Health, RigNode, device_health, run
from sl_common.device_link import DeviceLink
from sl_common.errors import DeviceError, DeviceRefused, SlError
from sl_common.messages import stamp_from_msg
from sl_projector.sequence.messages import image_to_msg

READ_TIMEOUT_S = 0.1
SETTING_TIMEOUT_S = 3.0
_LIVE = ("exposure_s", "gain")


class CameraNode(RigNode):
    """Drives one camera; it is armed from when it is connected, so no trigger is missed.

    Parameters
    ----------
    make_driver : callable, optional
        Makes the (closed) driver; by default as the parameters say.
    options
        Passed to `rclpy.node.Node`.
    """

    def __init__(
        self, make_driver: Callable[[], CameraDriver] | None = None, **options: Any
    ) -> None:
        super().__init__("camera", **options)
        self._settings = self._declare_settings()
        self._address = self.declare("address", "", ADDRESSES)
        self._aravis, self._uvc = self._declare_device_options()
        self._make_driver = make_driver or self._make_configured
        self._calibrated: CameraInfo | None = None
        self._full_scale_dn = 0
        self._tell_settings = self.latch_settings(topics.CAMERA_SETTINGS)
        self._statistics = CameraStatistics()
        self._orders: SimpleQueue[tuple[CameraSettings, Future[None]]] = SimpleQueue()
        self._stop = threading.Event()
        self._images = self.advertise(topics.IMAGE)
        self._infos = self.advertise(topics.CAMERA_INFO)
        self.listen(topics.CALIBRATION, self._on_calibration)
        self._windows = PatternWindows(
            self.declare(
                "settle_s", 0.005, "software trigger: after a pattern's start, s", 0.0, 10.0
            )
        )
        if self._settings.trigger == "software":
            self.listen(topics.TRIGGER, self._on_trigger)
        self.serve_work(topics.TRIGGER_CAMERA, self._trigger)
        self.add_on_set_parameters_callback(self._on_parameters)
        self._link = DeviceLink("camera", self._connect, self.say)
        self._link.start()
        self._reader = threading.Thread(target=self._read, name="camera frames", daemon=True)
        self._reader.start()

    def _declare_settings(self) -> CameraSettings:
        default = CameraSettings()
        region = self.declare(
            "region", [0, 0, 0, 0], "x, y, width, height, pixels; width 0: the whole sensor"
        )
        return CameraSettings(
            exposure_s=self.declare(
                "exposure_s", default.exposure_s, "exposure, s", 1e-6, 60.0, live=True
            ),
            gain=self.declare("gain", default.gain, "gain factor", 1e-3, 1e3, live=True),
            trigger=self.declare("trigger", default.trigger, f"one of {TRIGGER_MODES}"),
            region=tuple(region) if region[2] else None,
            pixel_format=self.declare(
                "pixel_format", default.pixel_format, f"one of {sorted(PIXEL_BITS)}"
            ),
        )

    def _declare_device_options(self) -> tuple[AravisOptions, UvcOptions]:
        aravis, uvc = AravisOptions(), UvcOptions()
        width, height = self.declare(
            "uvc_image_size", [0, 0], "UVC: width, height, pixels; 0: the camera's own choice"
        )
        return (
            AravisOptions(
                self.declare("trigger_line", aravis.trigger_line, "Aravis: the trigger's input"),
                self.declare(
                    "packet_size", 0, "GigE Vision: bytes; 0: what the network passes", 0, 65535
                ),
                self.declare("buffers", aravis.buffers, "Aravis: frames that may wait", 4, 4096),
                self.declare("features", "", "Aravis: more GenICam features, 'Name=Value ...'"),
            ),
            UvcOptions(
                self.declare(
                    "settle_frames", uvc.settle_frames, "UVC: frames dropped per trigger", 1, 100
                ),
                (width, height),
            ),
        )

    def health(self) -> Health:
        """Device and counts; frames lost since the last report are a warning."""
        level, message = device_health(self._link.connected, self._link.reason)
        found, self._statistics = self._statistics, self._read_statistics()
        lost = self._statistics.lost + self._statistics.incomplete - found.lost - found.incomplete
        if level == "ok" and lost > 0:
            level, message = "warn", f"{lost} frames lost or incomplete in the last second"
        values: dict[str, object] = {
            "frames": self._statistics.received,
            "frames lost": self._statistics.lost,
            "frames incomplete": self._statistics.incomplete,
            "times lost": self._link.losses + self._statistics.reconnects,
            "exposure_s": self._settings.exposure_s,
            "trigger": self._settings.trigger,
            "full scale": f"{self._full_scale_dn} DN" if self._full_scale_dn else "no frame yet",
        }
        return Health(level, message, "camera", self._address, values)

    def close(self) -> None:
        """Stop reading and give the camera back."""
        self._stop.set()
        self._reader.join(timeout=5.0)
        self._link.close()
        super().close()

    def _read_statistics(self) -> CameraStatistics:
        try:
            return self._link.device().statistics()
        except DeviceError:
            return self._statistics

    def _make_configured(self) -> CameraDriver:
        return make_camera(self._address, self._aravis, self._uvc)

    def _connect(self) -> CameraDriver:
        driver = self._make_driver()
        try:
            driver.open()
            driver.configure(self._settings)
            driver.arm()
        except SlError:
            driver.close()
            raise
        return driver

    # -- frames -----------------------------------------------------------------------------

    def _read(self) -> None:
        """Publish frames as they come. This thread alone reads and configures the camera."""
        while not self._stop.is_set():
            self._obey()
            if (driver := self._link.current) is None:
                self._stop.wait(READ_TIMEOUT_S)
                continue
            try:
                frame = driver.read(READ_TIMEOUT_S)
                if frame is not None and not self._stop.is_set():
                    self._publish(frame)
            except Exception as error:  # whatever went wrong, a fresh connection is the answer
                self._link.lost(driver, error)

    def _publish(self, frame: Frame) -> None:
        """Publish whole frames; half a frame would become wrong points."""
        if frame.status is not FrameStatus.OK:
            self.get_logger().warning(f"frame {frame.frame_id} came incomplete, thrown away")
            self.note(f"frame {frame.frame_id} came incomplete, thrown away")
            return
        if self._settings.trigger == "software":
            try:
                frame = self._windows.take(frame)
            except DeviceError as error:
                self.complain(topics.IMAGE.name, error)
                return
        self._tell(self._settings, frame.full_scale_dn)
        image = image_to_msg(frame.image, frame.stamp_ns)
        self._images.publish(image)
        self._infos.publish(camera_info_for(self._calibrated, image))

    def _tell(self, settings: CameraSettings, full_scale_dn: int) -> None:
        """Latch how the camera is set and, once a frame shows it, where its pixels end."""
        if (settings, full_scale_dn) != (self._settings, self._full_scale_dn):
            self._settings, self._full_scale_dn = settings, full_scale_dn
            self._tell_settings({**asdict(settings), "full_scale_dn": full_scale_dn})

    def _on_calibration(self, message: RigCalibration) -> None:
        self._calibrated = message.camera

    # -- triggering and settings --------------------------------------------------------------

    def _on_trigger(self, message: PatternTrigger) -> None:
        """Trigger the camera when the pattern has settled; a refused one is lost, and told."""
        driver, start_ns = self._link.device(), stamp_from_msg(message.header.stamp)
        window = self._windows.announce(
            start_ns, message.exposure_s, self._settings.exposure_s, driver.latency_s
        )
        self._stop.wait(max(0.0, start_ns * 1e-9 + self._windows.settle_s - time.time()))
        try:
            driver.software_trigger()
        except SlError:
            self._windows.withdraw(window)
            raise

    def _trigger(self, _request: Any, response: Any) -> None:
        self._link.device().software_trigger()
        response.success, response.message = True, "triggered"

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        changes = {p.name: p.value for p in parameters if p.name in _LIVE}
        if not changes:
            return SetParametersResult(successful=True)
        try:
            order: Future[None] = Future()
            self._orders.put((replace(self._settings, **changes), order))
            order.result(timeout=SETTING_TIMEOUT_S)
        except (SlError, TimeoutError) as error:
            return SetParametersResult(successful=False, reason=str(error) or "no answer in time")
        return SetParametersResult(successful=True)

    def _obey(self) -> None:
        """Apply new settings between two frames; without a device they wait for it."""
        try:
            settings, order = self._orders.get_nowait()
        except Empty:
            return
        fault: SlError | None = None
        if (driver := self._link.current) is not None:
            fault = self._configure(driver, settings)
        if fault is None:
            self._tell(settings, self._full_scale_dn)
            order.set_result(None)
        else:
            order.set_exception(fault)

    def _configure(self, driver: CameraDriver, settings: CameraSettings) -> SlError | None:
        """Configure and arm; after a refusal the camera is as before, and armed again."""
        fault: SlError | None = None
        try:
            try:
                driver.configure(settings)
            except DeviceRefused as refusal:
                fault = refusal
            driver.arm()
        except DeviceError as error:
            self._link.lost(driver, error)
            fault = error
        return fault


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run(CameraNode, args)


if __name__ == "__main__":
    main()
