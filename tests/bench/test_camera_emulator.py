"""The socket camera's driver against the emulated camera, without a world: pixels count frames."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from sl_bench.camera.camera_emulator import GIVEN_UP_S, CameraEmulator, Exposure
from sl_bench.camera.camera_faults import CameraFaults
from sl_camera.camera.camera import CameraSettings, Frame, FrameStatus
from sl_camera.drivers import socket_protocol as wire
from sl_camera.drivers.socket_camera import SocketCamera
from sl_common.errors import ConfigError, DeviceError, DeviceLost, DeviceRefused
from support.patience import Deadline

WIDTH, HEIGHT = 12, 8
PERIOD_NS = 5_000_000
EXPOSURE_S = 0.004
MIRRORS = np.ones((2, 2), np.bool_)


class Wiring:
    """An emulated camera, its driver, and what the test holds in its hands."""

    def __init__(self, directory: Path) -> None:
        self.exposures: list[Exposure] = []
        self.stage_m = (0.0, 0.0, 0.0)
        self.renderer = self.render
        self.path = directory / "camera.sock"
        self.emulator = CameraEmulator(
            self.path, lambda exposure: self.renderer(exposure), (WIDTH, HEIGHT),
            stage_m=lambda _: self.stage_m, mirrors_now=lambda: MIRRORS, max_rate_hz=200.0,
            readout_s=0.0005,
        )  # fmt: skip
        self.camera = SocketCamera(self.path)

    def render(self, exposure: Exposure) -> np.ndarray:  # type: ignore[type-arg]
        self.exposures.append(exposure)
        image = np.full((HEIGHT, WIDTH), exposure.number, np.uint8)
        image[0] = np.arange(WIDTH)
        return image

    def edges(
        self, count: int, start_ns: int | None = None, period_ns: int = PERIOD_NS
    ) -> list[int]:
        """Edges in the past, all at once: rendering never waits."""
        start_ns = start_ns or time.time_ns() - count * period_ns - 10**9
        stamps = [start_ns + i * period_ns for i in range(count)]
        for i, stamp_ns in enumerate(stamps):
            self.emulator.on_exposure(MIRRORS, i, stamp_ns, period_ns * 1e-9)
        return stamps

    def read(self, most: int, timeout_s: float = 1.0) -> list[tuple[Frame, int]]:
        """Frames and the number in their pixels, which are read before they are overwritten."""
        frames = []
        while len(frames) < most and (frame := self.camera.read(timeout_s)) is not None:
            frames.append((frame, int(frame.image[-1, -1])))
            timeout_s = min(timeout_s, 0.5)
        return frames


@pytest.fixture
def wiring(tmp_path: Path) -> Iterator[Wiring]:
    wiring = Wiring(tmp_path)
    wiring.emulator.start()
    wiring.camera.open()
    wiring.camera.configure(CameraSettings(exposure_s=EXPOSURE_S))
    wiring.camera.arm()
    yield wiring
    wiring.camera.close()
    wiring.emulator.close()
    assert not wiring.path.exists()


def numbers(frames: list[tuple[Frame, int]]) -> list[int]:
    return [number for _, number in frames]


def test_a_frame_per_edge_in_order_with_the_edges_stamps(wiring: Wiring) -> None:
    stamps = wiring.edges(20)
    frames = wiring.read(20)
    assert [f.stamp_ns for f, _ in frames] == stamps
    assert numbers(frames) == list(range(1, 21))
    assert [f.frame_id for f, _ in frames] == list(range(1, 21))
    assert {f.status for f, _ in frames} == {FrameStatus.OK}
    assert frames[0][0].exposure_s == EXPOSURE_S
    assert frames[0][0].encoding == "mono8"
    assert wiring.camera.image_size == (WIDTH, HEIGHT)
    assert wiring.camera.statistics().received == 20
    assert wiring.camera.statistics().lost == 0


def test_frames_come_after_their_exposure_and_not_before(wiring: Wiring) -> None:
    start_ns = time.time_ns() + 30_000_000
    wiring.edges(1, start_ns)
    ((frame, _),) = wiring.read(1)
    assert time.time_ns() >= frame.stamp_ns + EXPOSURE_S * 1e9


def test_pixels_stay_for_as_many_reads_as_the_ring_has_buffers(wiring: Wiring) -> None:
    wiring.edges(4)
    frames = [wiring.camera.read(1.0) for _ in range(4)]
    assert [int(f.image[-1, -1]) for f in frames if f is not None] == [1, 2, 3, 4]


def test_integrates_what_the_dmd_showed_during_the_exposure(wiring: Wiring) -> None:
    """An exposure of 4 ms sees one pattern of 5 ms; one of 8 ms also 2 ms of the next, 6 ms on."""
    wiring.edges(1)
    wiring.read(1)
    ((_, seconds),) = wiring.exposures[0].shown
    assert seconds == pytest.approx(EXPOSURE_S)
    wiring.camera.configure(CameraSettings(exposure_s=0.008))
    wiring.camera.arm()
    start_ns = time.time_ns() + 100_000_000
    wiring.emulator.on_exposure(MIRRORS, 0, start_ns, 0.005)
    wiring.emulator.on_exposure(~MIRRORS, 1, start_ns + 6_000_000, 0.005)
    wiring.read(1)
    parts = wiring.exposures[-1].shown
    assert [seconds for _, seconds in parts] == pytest.approx([0.005, 0.002])
    assert not parts[1][0].any()
    assert wiring.emulator.edges_lost == 1


def test_edges_that_come_too_early_are_lost_as_a_camera_loses_them(wiring: Wiring) -> None:
    """200 Hz at most, edges at 1000 Hz: every fifth is taken, frame ids stay consecutive."""
    stamps = wiring.edges(20, period_ns=1_000_000)
    frames = wiring.read(20)
    assert [f.stamp_ns for f, _ in frames] == stamps[::5]
    assert [f.frame_id for f, _ in frames] == [1, 2, 3, 4]
    assert wiring.emulator.edges_lost == 16


def test_stage_that_moves_during_the_exposure_counts_in_the_middle(wiring: Wiring) -> None:
    start_ns = time.time_ns() + 20_000_000
    wiring.edges(1, start_ns)
    wiring.stage_m = (2e-3, 0.0, -4e-3)
    wiring.read(1)
    assert wiring.exposures[0].stage_m == pytest.approx((1e-3, 0.0, -2e-3))


def test_nothing_is_exposed_before_arm_and_after_disarm(wiring: Wiring) -> None:
    wiring.camera.disarm()
    wiring.edges(3)
    assert wiring.camera.read(0.2) is None
    wiring.camera.arm()
    wiring.edges(1)
    assert len(wiring.read(1)) == 1


def test_frames_of_before_are_gone_after_arm(wiring: Wiring) -> None:
    wiring.edges(5)
    wiring.camera.arm()
    (stamp_ns,) = wiring.edges(1)
    assert [f.stamp_ns for f, _ in wiring.read(5, 0.5)] == [stamp_ns]


def test_frames_far_behind_are_given_up_when_another_sequence_begins(wiring: Wiring) -> None:
    rendering, go_on = threading.Event(), threading.Event()

    def render(exposure: Exposure) -> np.ndarray:  # type: ignore[type-arg]
        rendering.set()
        assert go_on.wait(15.0)
        return Wiring.render(wiring, exposure)

    wiring.renderer = render
    long_ago_ns = time.time_ns() - round(2 * GIVEN_UP_S * 1e9)
    first = wiring.edges(5, long_ago_ns)
    assert rendering.wait(15.0)
    second = wiring.edges(3, long_ago_ns + 10**9)
    go_on.set()
    assert [f.stamp_ns for f, _ in wiring.read(8)] == [first[0], *second]
    assert wiring.emulator.frames_given_up == 4


def test_software_trigger_sees_what_the_dmd_shows(wiring: Wiring) -> None:
    wiring.camera.configure(CameraSettings(exposure_s=EXPOSURE_S, trigger="software"))
    wiring.camera.arm()
    wiring.edges(2)
    before_ns = time.time_ns()
    wiring.camera.software_trigger()
    ((frame, _),) = wiring.read(1)
    assert before_ns <= frame.stamp_ns <= time.time_ns()
    assert wiring.exposures[-1].shown == [(MIRRORS, EXPOSURE_S)]
    assert wiring.camera.read(0.1) is None


def test_free_run(wiring: Wiring) -> None:
    wiring.camera.configure(CameraSettings(exposure_s=EXPOSURE_S, trigger="free"))
    wiring.camera.arm()
    frames = wiring.read(5)
    gaps = np.diff([f.stamp_ns for f, _ in frames])
    assert len(gaps) == 4
    assert gaps.min() >= 0.99 * PERIOD_NS


def test_region_and_gain(wiring: Wiring) -> None:
    wiring.camera.configure(CameraSettings(EXPOSURE_S, gain=2.0, region=(3, 0, 5, 2)))
    assert wiring.camera.image_size == (5, 2)
    wiring.camera.arm()
    wiring.edges(1)
    frame = wiring.camera.read(1.0)
    assert frame is not None
    assert frame.image.tolist() == [[6, 8, 10, 12, 14], [2, 2, 2, 2, 2]]


@pytest.mark.parametrize(
    "settings", [CameraSettings(pixel_format="mono16"), CameraSettings(region=(0, 0, WIDTH + 1, 1))]
)
def test_refused_settings_leave_the_camera_as_it_was(
    wiring: Wiring, settings: CameraSettings
) -> None:
    with pytest.raises(DeviceRefused):
        wiring.camera.configure(settings)
    wiring.edges(1)
    assert len(wiring.read(1)) == 1


@pytest.mark.parametrize(
    "bad",
    [
        {"exposure_s": 0.0}, {"exposure_s": float("nan")}, {"gain": -1.0}, {"trigger": "clock"},
        {"pixel_format": "rgb8"}, {"region": (-1, 0, 4, 4)}, {"region": (0, 0, 0, 4)},
    ],
)  # fmt: skip
def test_settings_out_of_range(bad: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        CameraSettings(**bad)  # type: ignore[arg-type]


# -- faults -----------------------------------------------------------------------------------

FAULTS: list[tuple[str, list[int]]] = [
    ("drop", [1, 2, 4, 5, 6]),
    ("duplicate", [1, 2, 3, 3, 4, 5, 6]),
    ("swap", [1, 2, 4, 3, 5, 6]),
    ("delay", [1, 2, 4, 5, 6, 3]),
    ("lost_trigger", [1, 2, 3, 4, 5]),
]


@pytest.mark.parametrize(("fault", "expected"), FAULTS)
def test_fault_at_the_third_frame(wiring: Wiring, fault: str, expected: list[int]) -> None:
    wiring.emulator.faults = CameraFaults(at={fault: [2]}, delay_s=0.3)
    stamps = wiring.edges(6)
    frames = wiring.read(7, 1.0)
    assert numbers(frames) == expected
    if fault == "lost_trigger":
        assert [f.stamp_ns for f, _ in frames] == stamps[:2] + stamps[3:]
    assert wiring.camera.statistics().lost == (1 if fault == "drop" else 0)


def test_swap_of_the_last_frame_delivers_it_late(wiring: Wiring) -> None:
    wiring.emulator.faults = CameraFaults(at={"swap": [2]})
    wiring.edges(3)
    assert numbers(wiring.read(4)) == [1, 2, 3]


def test_faults_of_the_picture(wiring: Wiring) -> None:
    wiring.emulator.faults = CameraFaults(
        at={"stamp": [0], "wrong_size": [1], "saturate": [2], "incomplete": [3]}, stamp_s=0.02
    )
    stamps = wiring.edges(5)
    found = wiring.read(5)
    (stamped, _), (small, _), (_, white), (half, _), (good, _) = found
    assert stamped.stamp_ns == stamps[0] + 20_000_000
    assert small.image.shape == (HEIGHT // 2, WIDTH // 2)
    assert white == 255
    assert half.status is FrameStatus.INCOMPLETE
    assert not half.image[HEIGHT // 2 :].any()
    assert good.status is FrameStatus.OK
    assert wiring.camera.statistics().incomplete == 1


def test_faults_by_chance_follow_their_probability_and_their_seed() -> None:
    def drops(seed: int) -> list[bool]:
        faults = CameraFaults(seed=seed, drop=0.1)
        return ["drop" in faults.next_frame() for _ in range(2000)]

    # Binomial: 200 of 2000 with a standard deviation of 13.4; four of them.
    assert abs(sum(drops(1)) - 200) < 54
    assert drops(1) == drops(1)
    assert drops(1) != drops(2)


@pytest.mark.parametrize("bad", [{"drop": 1.5}, {"swap": -0.1}, {"at": {"explode": [1]}}])
def test_faults_that_do_not_exist(bad: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        CameraFaults(**bad)  # type: ignore[arg-type]


# -- connection -------------------------------------------------------------------------------


def test_unplugged_camera_comes_back_as_it_was(wiring: Wiring) -> None:
    wiring.emulator.disconnect(0.3)
    with pytest.raises(DeviceLost):
        for _ in range(50):
            wiring.camera.read(0.1)
    deadline = Deadline(60.0)
    while wiring.camera.statistics().reconnects == 0:
        assert not deadline.is_over
        try:
            wiring.camera.read(0.1)
        except DeviceLost:
            continue
    wiring.edges(2)
    assert len(wiring.read(2)) == 2


def test_a_second_client_is_served_after_the_first_is_gone(wiring: Wiring) -> None:
    wiring.camera.close()
    second = SocketCamera(wiring.path)
    second.open()
    second.configure(CameraSettings(exposure_s=EXPOSURE_S))
    second.close()


def test_no_camera(tmp_path: Path) -> None:
    camera = SocketCamera(tmp_path / "none.sock")
    with pytest.raises(DeviceLost, match=r"none\.sock"):
        camera.open()
    camera.close()
    camera.close()


@pytest.mark.parametrize(
    "line", [b"nonsense\n", b"[]\n", b'{"op": "explode"}\n', b'{"op": "configure", "iso": 3}\n']
)
def test_nonsense_is_refused_and_the_camera_lives(wiring: Wiring, line: bytes) -> None:
    wiring.camera.close()
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(10.0)
        client.connect(str(wiring.path))
        client.sendall(line)
        header = wire.parse_header(client.recv(wire.HEADER_SIZE, socket.MSG_WAITALL))
        answer = json.loads(client.recv(header.payload, socket.MSG_WAITALL))
    assert answer["ok"] is False
    assert answer["error"]
    wiring.camera.open()
    wiring.camera.arm()


def header_with(**changes: int) -> bytes:
    fields = {"kind": 1, "payload": 4, "pixel_bytes": 1, "width": 2, "height": 2, **changes}
    return wire.Header(**fields).pack()


@pytest.mark.parametrize(
    "make",
    [
        lambda: b"XXXX" + header_with()[4:],
        lambda: header_with(kind=7),
        lambda: header_with(payload=5),
        lambda: header_with(width=0),
        lambda: header_with(pixel_bytes=4),
        lambda: header_with(width=1 << 20, height=1 << 20, payload=1),
    ],
)
def test_headers_that_cannot_be(make: Callable[[], bytes]) -> None:
    with pytest.raises(DeviceError, match="camera sent"):
        wire.parse_header(make())


def test_lost_frames_are_counted_over_the_wrap_of_the_counter(tmp_path: Path) -> None:
    camera = SocketCamera(tmp_path / "none.sock")
    for frame_id in (0xFFFFFFFE, 0xFFFFFFFF, 1, 2, 2, 5):
        camera._count(wire.Header(wire.FRAME, 4, 1, 2, 2, frame_id))
    assert camera.statistics().lost == 3
    camera._count(wire.Header(wire.FRAME, 4, 1, 2, 2, 4))  # late, not lost
    assert camera.statistics().lost == 2
