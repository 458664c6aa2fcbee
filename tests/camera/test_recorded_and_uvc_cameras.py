"""What a recording, a webcam and a software trigger do beyond the contract."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from sl_camera.camera.camera import CameraSettings, Frame
from sl_camera.camera.software_trigger import PatternWindows
from sl_camera.drivers.camera_drivers import make_camera
from sl_camera.drivers.replay_camera import ReplayCamera
from sl_camera.drivers.uvc_camera import UvcCamera, UvcOptions
from sl_common.errors import ConfigError, DeviceError, DeviceLost, DeviceRefused
from support.devices.camera_bench import HEIGHT, WIDTH, FakeCapture, write_bag

SOFTWARE = CameraSettings(exposure_s=0.001, trigger="software")


def ready(camera: ReplayCamera | UvcCamera, settings: CameraSettings = SOFTWARE) -> None:
    camera.open()
    camera.configure(settings)
    camera.arm()


# -- recordings -----------------------------------------------------------------------------------


def test_a_recording_gives_its_frames_in_order_with_the_time_of_now(tmp_path: Path) -> None:
    images = np.random.default_rng(2).integers(0, 256, (5, 6, 8), np.uint8)
    camera = ReplayCamera(write_bag(tmp_path / "bag", images))
    ready(camera)
    for image in images:
        before_ns = time.time_ns()
        camera.software_trigger()
        frame = camera.read(1.0)
        assert frame is not None
        assert np.array_equal(frame.image, image)
        assert before_ns <= frame.stamp_ns <= time.time_ns()
    with pytest.raises(DeviceRefused, match="at its end after 5 frames"):
        camera.software_trigger()
    assert camera.read(0.01) is None
    camera.arm()
    camera.software_trigger()
    again = camera.read(1.0)
    assert again is not None
    assert np.array_equal(again.image, images[0])
    camera.close()


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_recording_of_any_camera_driver_is_read(tmp_path: Path, storage: StoragePlugin) -> None:
    """Another namespace, padded rows, big-endian pixels of 16 bits."""
    store = get_typestore(Stores.ROS2_JAZZY)
    make = store.types
    pixels = np.array([[1, 2, 3], [4, 65535, 0]], np.uint16)
    rows = np.zeros((2, 8), np.uint8)
    rows[:, :6] = pixels.astype(">u2").view(np.uint8).reshape(2, 6)
    header = make["std_msgs/msg/Header"](make["builtin_interfaces/msg/Time"](7, 8), "camera")
    image = make["sensor_msgs/msg/Image"](header, 2, 3, "mono16", 1, 8, rows.ravel())
    with Writer(tmp_path / "bag", version=9, storage_plugin=storage) as writer:
        topic = writer.add_connection(
            "/cell/camera/image_raw", "sensor_msgs/msg/Image", typestore=store
        )
        writer.write(topic, 1, store.serialize_cdr(image, "sensor_msgs/msg/Image"))
    camera = ReplayCamera(tmp_path / "bag")
    ready(camera, CameraSettings(0.001, trigger="software", pixel_format="mono16"))
    camera.software_trigger()
    frame = camera.read(1.0)
    assert frame is not None
    assert frame.image.dtype == np.uint16
    assert np.array_equal(frame.image, pixels)
    with pytest.raises(DeviceRefused, match="mono8"):
        camera.configure(SOFTWARE)
    camera.close()


def test_what_is_no_recording_of_frames_is_told(tmp_path: Path) -> None:
    with pytest.raises(DeviceLost, match="nowhere"):
        ReplayCamera(tmp_path / "nowhere").open()
    (tmp_path / "bad.mcap").write_bytes(b"nonsense")
    with pytest.raises(DeviceLost, match=r"bad\.mcap"):
        ReplayCamera(tmp_path / "bad.mcap").open()
    with pytest.raises(DeviceLost, match="no frames"):
        ReplayCamera(write_bag(tmp_path / "empty", np.empty((0, 2, 2), np.uint8))).open()


def test_a_recording_has_no_trigger_line(tmp_path: Path) -> None:
    camera = ReplayCamera(write_bag(tmp_path / "bag", np.zeros((1, 2, 2), np.uint8)))
    camera.open()
    with pytest.raises(DeviceRefused, match="software"):
        camera.configure(CameraSettings(trigger="hardware"))
    camera.close()


# -- webcams --------------------------------------------------------------------------------------


def test_frames_in_flight_at_the_trigger_are_thrown_away() -> None:
    capture = FakeCapture()
    camera = UvcCamera("/dev/video7", UvcOptions(settle_frames=3), lambda device: capture)
    ready(camera)
    for _ in range(3):
        camera.read(0.05)
        camera.software_trigger()
        seen = capture.frames
        frame = None
        while frame is None:
            frame = camera.read(0.5)
        assert int(frame.image[0, 0]) == seen + 4
    camera.close()
    assert capture.released == 1


def test_a_webcam_is_set_to_a_fixed_exposure_or_refuses() -> None:
    capture = FakeCapture(longest_exposure_s=0.02)
    camera = UvcCamera("0", None, lambda device: capture)
    ready(camera, CameraSettings(0.01, trigger="software"))
    # V4L2: exposure_auto 1 is manual, exposure_absolute counts 100 us.
    assert capture.properties[cv2.CAP_PROP_AUTO_EXPOSURE] == 1.0
    assert capture.properties[cv2.CAP_PROP_EXPOSURE] == 100.0
    with pytest.raises(DeviceRefused, match=r"made 0\.02 s of it"):
        camera.configure(CameraSettings(0.5, trigger="software"))
    assert capture.properties[cv2.CAP_PROP_EXPOSURE] == 100.0
    with pytest.raises(DeviceRefused, match="no trigger input"):
        camera.configure(CameraSettings(0.01, trigger="hardware"))
    camera.close()


def test_an_unplugged_webcam_comes_back_as_it_was() -> None:
    captures = [FakeCapture()]
    camera = UvcCamera("0", None, lambda device: captures[-1])
    region = CameraSettings(0.001, trigger="free", region=(4, 2, 10, 6))
    ready(camera, region)
    assert camera.image_size == (10, 6)
    captures[-1].there = False
    for _ in range(2):
        with pytest.raises(DeviceLost):
            camera.read(0.01)
    captures.append(FakeCapture())
    frame = camera.read(0.5)
    assert frame is not None
    assert frame.image.shape == (6, 10)
    assert camera.statistics().reconnects == 1
    assert captures[0].released
    camera.close()


def test_colours_become_grey() -> None:
    """OpenCV documents 0.299 R + 0.587 G + 0.114 B."""
    capture = FakeCapture()
    colour = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    colour[:] = (10, 100, 200)  # blue, green, red
    capture.read = lambda: (True, colour)  # type: ignore[method-assign]
    camera = UvcCamera("0", None, lambda device: capture)
    ready(camera, CameraSettings(0.001, trigger="free"))
    frame = camera.read(0.5)
    assert frame is not None
    assert abs(int(frame.image[0, 0]) - (0.299 * 200 + 0.587 * 100 + 0.114 * 10)) <= 1
    camera.close()


# -- addresses ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("address", "kind"),
    [
        ("aravis:", "AravisCamera"), ("aravis:22334455", "AravisCamera"), ("uvc:0", "UvcCamera"),
        ("uvc:/dev/video2", "UvcCamera"), ("bag:/data/run1", "ReplayCamera"),
        ("socket:run/camera.sock", "SocketCamera"), ("/run/camera.sock", "SocketCamera"),
    ],
)  # fmt: skip
def test_the_address_chooses_the_driver(address: str, kind: str) -> None:
    assert type(make_camera(address)).__name__ == kind


@pytest.mark.parametrize("address", ["", "uvc:", "bag:", "gige:1", "aravis", "socket:"])
def test_an_address_of_no_kind_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match="aravis:SERIAL"):
        make_camera(address)


# -- software trigger -----------------------------------------------------------------------------

MS = 1_000_000


def frame_at(start_ns: int, exposure_s: float = 0.01) -> Frame:
    return Frame(np.zeros((2, 2), np.uint8), 1, start_ns, exposure_s)


def test_a_frame_belongs_to_the_pattern_it_was_exposed_in_wholly() -> None:
    windows = PatternWindows(0.0)
    now = time.time_ns()
    for i in range(3):
        windows.announce(now + i * 100 * MS, 0.1, 0.01, 0.0)
    assert windows.take(frame_at(now + 20 * MS)).stamp_ns == now
    # The second pattern's frame got lost; the third one's is told by its time.
    assert windows.take(frame_at(now + 250 * MS)).stamp_ns == now + 200 * MS
    # Nothing is expected any more: a frame keeps its own time.
    assert windows.take(frame_at(now + 260 * MS)).stamp_ns == now + 260 * MS


def test_a_frame_that_shows_two_patterns_is_thrown_away() -> None:
    windows = PatternWindows(0.0)
    now = time.time_ns()
    windows.announce(now, 0.1, 0.01, 0.0)
    with pytest.raises(DeviceError, match=r"5\.0 ms after"):
        windows.take(frame_at(now + 95 * MS))


def test_a_camera_that_cannot_be_done_in_time_is_not_triggered() -> None:
    windows = PatternWindows(0.02)
    with pytest.raises(DeviceRefused, match=r"needs 0\.13 s"):
        windows.announce(time.time_ns(), 0.12, 0.01, 0.1)
    with pytest.raises(DeviceRefused, match="late"):
        windows.announce(time.time_ns() - 100 * MS, 0.15, 0.01, 0.05)
    window = windows.announce(time.time_ns(), 0.2, 0.01, 0.1)
    windows.withdraw(window)
    early = frame_at(window.start_ns + MS)
    assert windows.take(early) is early
