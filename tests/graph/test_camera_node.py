"""The camera node: frames and their info, exposure, software trigger, a camera that comes back.

Real nodes in one process, drivers without devices, a private ROS domain.
"""

from __future__ import annotations

import time

import numpy as np

from support import ros_graph

ros_graph.require_ros()

from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sl_interfaces.msg import PatternTrigger  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from sl_camera.camera.camera import Frame, FrameStatus  # noqa: E402
from sl_camera.camera_node import CameraNode  # noqa: E402
from sl_common import topics  # noqa: E402
from sl_common.errors import DeviceLost  # noqa: E402
from sl_common.messages import stamp_from_msg, stamp_to_msg  # noqa: E402
from support.devices.fake_devices import FakeCamera  # noqa: E402
from support.patience import wait  # noqa: E402
from support.tiny_graph import HEIGHT, WIDTH, set_parameters  # noqa: E402


def test_the_camera_publishes_whole_frames_with_their_info_and_comes_back() -> None:
    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 4096, (HEIGHT, WIDTH), dtype=np.uint16)
    with ros_graph.graph() as graph:
        driver = FakeCamera()
        driver.gone = True
        node = graph.add(CameraNode, lambda: driver)
        images = graph.collect(topics.IMAGE)
        infos = graph.collect(topics.CAMERA_INFO)
        driver.gone = False
        wait(lambda: driver.armed == 1, "the camera")
        driver.frames.put(Frame(pixels, 1, 10**18, 0.01, FrameStatus.INCOMPLETE))
        driver.frames.put(Frame(pixels, 2, 10**18 + 7, 0.01))
        driver.frames.put(DeviceLost("unplugged"))
        wait(lambda: driver.armed == 2, "the camera to be found again")
        driver.frames.put(Frame(pixels, 1, 10**18 + 9, 0.01))
        wait(lambda: len(images) == 2 and len(infos) == 2, "two images")
        assert [stamp_from_msg(m.header.stamp) for m in images] == [10**18 + 7, 10**18 + 9]
        assert [m.header for m in infos] == [m.header for m in images]
        image = images[0]
        assert (image.height, image.width, image.step) == (HEIGHT, WIDTH, 2 * WIDTH)
        assert (image.encoding, image.header.frame_id) == ("mono16", "sl_camera_optical")
        assert bytes(image.data) == pixels.astype("<u2").tobytes()
        assert list(infos[0].k) == [0.0] * 9  # no calibration: "uncalibrated" (CameraInfo.msg)
        assert node.health().values["times lost"] == 1


def test_exposure_is_a_parameter_and_what_the_camera_cannot_is_refused() -> None:
    with ros_graph.graph() as graph:
        driver = FakeCamera()
        graph.add(CameraNode, lambda: driver)
        wait(lambda: driver.armed, "the camera")

        def set_exposure(value: float) -> tuple[bool, str]:
            parameter = Parameter("exposure_s", value=value).to_parameter_msg()
            request = SetParameters.Request(parameters=[parameter])
            result = graph.call(set_parameters("camera"), request).results[0]
            return result.successful, result.reason

        assert set_exposure(0.02)[0]
        assert driver.settings is not None
        assert driver.settings.exposure_s == 0.02
        successful, reason = set_exposure(2.0)
        assert not successful
        assert "1 s at most" in reason
        assert not set_exposure(-1.0)[0]
        assert driver.settings.exposure_s == 0.02
        armed = driver.armed
        assert set_exposure(0.03)[0]
        assert driver.armed > armed


def test_a_software_triggered_camera_follows_the_projector() -> None:
    """Frames get the stamp of the pattern in which they were exposed wholly, or are thrown away."""
    with ros_graph.graph() as graph:
        driver = FakeCamera()
        node = graph.add(CameraNode, lambda: driver, trigger="software", exposure_s=0.01)
        images = graph.collect(topics.IMAGE)
        wait(lambda: driver.armed, "the camera")
        triggers = graph.publisher(topics.TRIGGER)

        def show(pattern_s: float) -> int:
            message = PatternTrigger(exposure_s=pattern_s)
            stamp_ns = time.time_ns()
            message.header.stamp = stamp_to_msg(stamp_ns)
            triggers.publish(message)
            return stamp_ns

        def expose(start_ns: int) -> None:
            driver.frames.put(Frame(np.zeros((4, 4), np.uint8), 1, start_ns, 0.01))

        first_ns = show(5.0)
        wait(lambda: driver.triggered == 1, "a software trigger")
        expose(first_ns + 300_000_000)
        wait(lambda: images, "the image")
        assert stamp_from_msg(images[0].header.stamp) == first_ns
        assert graph.call(topics.TRIGGER_CAMERA, Trigger.Request()).success
        assert driver.triggered == 2

        second_ns = show(5.0)
        wait(lambda: driver.triggered == 3, "a software trigger")
        expose(second_ns + 4_995_000_000)  # ends 5 ms after its pattern
        wait(lambda: "ended" in node.last_error, "the complaint")
        show(0.012)  # 5 ms to settle and 10 ms of exposure do not fit
        wait(lambda: "needs 0.015 s" in node.last_error, "the complaint")
        assert (driver.triggered, len(images)) == (3, 1)
