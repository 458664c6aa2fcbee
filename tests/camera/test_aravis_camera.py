"""GigE Vision through Aravis: the fake camera that Aravis ships, and the bench's own.

The two ends are of different makers: Aravis' camera proves our driver, Aravis' host proves our
camera.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator

import numpy as np
import pytest

from sl_bench.camera.camera_emulator import CameraEmulator
from sl_bench.camera.camera_faults import CameraFaults
from sl_bench.camera.gige_camera import GigeCamera
from sl_camera.camera.camera import CameraDriver, CameraSettings, Frame, FrameStatus
from sl_camera.drivers.aravis_camera import AravisCamera, AravisOptions
from sl_camera.drivers.aravis_library import list_cameras, load_aravis
from sl_common.errors import DeviceError, DeviceLost, DeviceRefused
from support.devices.camera_bench import HEIGHT, SERIAL, WIDTH, fake_gige, gige_bench, require_gi
from support.patience import Deadline

EXPOSURE_S = 0.003
MIRRORS = np.ones((2, 2), np.bool_)
SMALL = CameraSettings(exposure_s=EXPOSURE_S, trigger="software", region=(0, 0, 64, 48))


def read(camera: CameraDriver, most: int, patience_s: float = 2.0) -> list[Frame]:
    frames: list[Frame] = []
    deadline = Deadline(patience_s)
    while len(frames) < most and not deadline.is_over:
        if (frame := camera.read(0.1)) is not None:
            frames.append(frame)
    return frames


# -- the camera that Aravis ships -----------------------------------------------------------------


def test_software_triggered_frames_without_loss_over_the_wrap_of_their_numbers() -> None:
    """Aravis' fake camera numbers from 65401 on: 65535 is followed by 1 (GigE Vision 2.0)."""
    with fake_gige():
        assert any(SERIAL in line for line in list_cameras())
        camera = AravisCamera(SERIAL)
        camera.open()
        camera.configure(SMALL)
        camera.arm()
        ids = []
        for _ in range(140):
            camera.software_trigger()
            (frame,) = read(camera, 1)
            assert frame.status is FrameStatus.OK
            assert frame.image.shape == (48, 64)
            ids.append(frame.frame_id)
        assert ids == [(65401 + i - 1) % 65535 + 1 for i in range(140)]
        counts = camera.statistics()
        assert (counts.received, counts.lost, counts.incomplete) == (140, 0, 0)
        packets = camera.packets()
        assert (packets["completed_buffers"], packets["missing_packets"]) == (140, 0)
        camera.close()


def test_old_feature_names_and_sixteen_bits() -> None:
    with fake_gige():
        camera = AravisCamera("127.0.0.1", AravisOptions(packet_size=1500, features="GainRaw=3"))
        camera.open()
        camera.configure(CameraSettings(0.004, 1.0, "software", (8, 4, 32, 16), "mono16"))
        camera.arm()
        camera.software_trigger()
        (frame,) = read(camera, 1)
        assert (frame.encoding, frame.image.shape) == ("mono16", (16, 32))
        assert camera._camera.gv_get_packet_size() == 1500
        assert camera._camera.get_integer("GainRaw") == 3
        camera.close()


def test_frames_that_lack_packets_are_incomplete() -> None:
    """One packet in fifty lost, and the fake camera cannot send again."""
    with fake_gige("-r", "20"):
        camera = AravisCamera("127.0.0.1")
        camera.open()
        camera.configure(CameraSettings(EXPOSURE_S, trigger="software", region=(0, 0, 512, 512)))
        camera.arm()
        camera.software_trigger()
        (frame,) = read(camera, 1)
        assert frame.status is FrameStatus.INCOMPLETE
        assert frame.image.shape == (512, 512)
        assert camera.statistics().incomplete == 1
        camera.close()


def test_a_camera_that_is_not_on_gige_vision_has_no_packets() -> None:
    """What a USB3 Vision camera goes through, by Aravis' camera without a transport.

    No packet sizes, no packet counters.
    """
    require_gi()
    aravis = load_aravis()
    aravis.enable_interface("Fake")
    try:
        camera = AravisCamera("Fake_1", AravisOptions(packet_size=9000))
        camera.open()
        camera.configure(SMALL)
        camera.arm()
        for i in range(5):
            camera.software_trigger()
            (frame,) = read(camera, 1)
            assert (frame.status, frame.frame_id) == (FrameStatus.OK, 65401 + i)
        assert camera.statistics().lost == 0
        assert "missing_packets" not in camera.packets()
        camera.close()
    finally:
        aravis.disable_interface("Fake")
        aravis.update_device_list()


def test_a_camera_that_another_program_controls_is_told() -> None:
    with fake_gige():
        first, second = AravisCamera("127.0.0.1"), AravisCamera("127.0.0.1")
        first.open()
        first.configure(SMALL)
        with pytest.raises(DeviceError):
            second.open()
            second.configure(SMALL)
        second.close()
        first.arm()
        first.software_trigger()
        assert len(read(first, 1)) == 1
        first.close()


def test_no_camera_is_told_with_what_was_found() -> None:
    require_gi()
    with pytest.raises(DeviceLost, match="NOSUCH"):
        AravisCamera("NOSUCH").open()


# -- the bench's camera ---------------------------------------------------------------------------


class Wired:
    """The bench's camera, the driver, and the trigger line between DMD and camera."""

    def __init__(self, emulator: CameraEmulator, gige: GigeCamera) -> None:
        self.emulator, self.gige = emulator, gige
        self.camera = AravisCamera("127.0.0.1")

    def ready(self, **changes: object) -> None:
        fields = {"exposure_s": EXPOSURE_S, **changes}
        self.camera.open()
        self.camera.configure(CameraSettings(**fields))  # type: ignore[arg-type]
        self.camera.arm()

    def edges(self, count: int, period_s: float = 0.01) -> list[int]:
        """Edges of the DMD's trigger output from now on."""
        stamps = []
        for i in range(count):
            stamps.append(time.time_ns())
            self.emulator.on_exposure(MIRRORS, i, stamps[-1], period_s)
            time.sleep(period_s)
        return stamps


@pytest.fixture
def wired() -> Iterator[Wired]:
    with gige_bench() as (emulator, gige):
        wired = Wired(emulator, gige)
        yield wired
        wired.camera.close()


def test_a_frame_per_edge_with_the_edges_time(wired: Wired) -> None:
    """The camera's clock is an hour off; half of a reading over loopback is below 1 ms."""
    wired.ready()
    stamps = wired.edges(30)
    frames = read(wired.camera, 30)
    assert [int(f.image[-1, -1]) for f in frames] == list(range(1, 31))
    assert [f.frame_id for f in frames] == list(range(1, 31))
    errors_ns = [f.stamp_ns - s for f, s in zip(frames, stamps, strict=True)]
    assert max(abs(e) for e in errors_ns) < 1_000_000
    assert {f.exposure_s for f in frames} == {EXPOSURE_S}
    assert wired.camera.statistics().lost == 0


def test_exposure_gain_and_region_reach_the_camera(wired: Wired) -> None:
    wired.ready(exposure_s=0.00625, gain=2.0, region=(3, 0, 5, 2))
    wired.edges(1)
    (frame,) = read(wired.camera, 1)
    assert frame.image.tolist() == [[6, 8, 10, 12, 14], [2, 2, 2, 2, 2]]
    assert frame.exposure_s == pytest.approx(0.00625)
    with pytest.raises(DeviceRefused, match="1 to 15"):  # 24 dB is 15.85
        wired.camera.configure(CameraSettings(gain=30.0))


@pytest.mark.parametrize("pixel_format", ["mono12", "mono12p"])
def test_twelve_bits_arrive_as_they_were(pixel_format: str) -> None:
    with gige_bench(bits=12, first=3000) as ends:
        wired = Wired(*ends)
        wired.ready(pixel_format=pixel_format)
        wired.edges(2)
        frames = read(wired.camera, 2)
        for number, frame in zip((3000, 3001), frames, strict=True):
            expected = np.full((HEIGHT, WIDTH), number)
            expected[0] = np.arange(WIDTH)
            assert np.array_equal(frame.image, expected)
            assert (frame.encoding, frame.full_scale_dn) == ("mono16", 4095)
        wired.camera.close()


def test_the_camera_numbers_wrap_and_chunks_count_on() -> None:
    with gige_bench(first=65533) as ends:
        wired = Wired(*ends)
        wired.ready()
        wired.edges(6)
        frames = read(wired.camera, 6)
        assert [f.frame_id for f in frames] == list(range(65533, 65539))
        assert wired.camera.statistics().lost == 0
        wired.camera.close()


def test_lost_packets_are_sent_again() -> None:
    with gige_bench(size=(512, 384)) as ends:
        wired = Wired(*ends)
        wired.camera = AravisCamera("127.0.0.1", AravisOptions(packet_size=1500))
        wired.ready()
        wired.gige.stream.lose = 0.02  # of 137 packets a frame
        wired.edges(20, period_s=0.02)
        frames = read(wired.camera, 20, 5.0)
        assert [int(f.image[-1, -1]) for f in frames] == list(range(1, 21))
        assert {f.status for f in frames} == {FrameStatus.OK}
        assert wired.camera.packets()["resent_packets"] > 0
        wired.camera.close()


def test_frames_whose_packets_stay_lost_are_incomplete_or_counted(wired: Wired) -> None:
    wired.ready()
    wired.gige.stream.resend = False
    wired.gige.stream.lose = 0.2
    wired.edges(20)
    wired.gige.stream.lose = 0.0
    time.sleep(0.5)
    wired.edges(1)
    frames = read(wired.camera, 21)
    counts = wired.camera.statistics()
    assert counts.received == len(frames)
    assert counts.incomplete == sum(f.status is FrameStatus.INCOMPLETE for f in frames) > 0
    assert counts.received + counts.lost == 21
    for frame in frames:
        if frame.status is FrameStatus.OK:
            assert int(frame.image[-1, -1]) == frame.frame_id


def test_a_dropped_frame_is_counted_and_half_a_frame_is_incomplete(wired: Wired) -> None:
    wired.emulator.faults = CameraFaults(at={"drop": [1], "incomplete": [3]})
    wired.ready()
    wired.edges(6)
    frames = read(wired.camera, 5, 3.0)
    good = [f.frame_id for f in frames if f.status is FrameStatus.OK]
    assert good == [1, 3, 5, 6]
    counts = wired.camera.statistics()
    assert (counts.received, counts.lost, counts.incomplete) == (5, 1, 1)


def test_an_unplugged_camera_comes_back_as_it_was(wired: Wired) -> None:
    wired.ready(region=(0, 0, 32, 16))
    wired.edges(1)
    assert len(read(wired.camera, 1)) == 1
    wired.gige.disconnect(1.0)
    with pytest.raises(DeviceLost):
        for _ in itertools.repeat(None, 100):
            wired.camera.read(0.1)
    deadline = Deadline(15.0)
    while wired.camera.statistics().reconnects == 0:
        assert not deadline.is_over
        try:
            wired.camera.read(0.1)
        except DeviceLost:
            continue
    wired.edges(2)
    assert [f.image.shape for f in read(wired.camera, 2)] == [(16, 32)] * 2


def test_the_bench_lets_go_of_a_host_that_falls_silent(wired: Wired) -> None:
    wired.ready()
    wired.gige._heard -= 10.0
    with pytest.raises(DeviceLost):
        for _ in itertools.repeat(None, 100):
            wired.camera.read(0.1)
