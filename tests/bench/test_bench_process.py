"""The bench as it is used: its own process, the real drivers at its endpoints."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sl_bench.process import bench
from sl_bench.process.bench_control import BenchControl
from sl_bench.process.bench_settings import BenchSettings, read_settings
from sl_bench.world.mounting import Mounting
from sl_bench.world.reference_rig import reference_rig
from sl_bench.world.surfaces import flat
from sl_bench.world.true_rig import read_rig, write_rig
from sl_bench.world.world import World
from sl_camera.camera.camera import CameraSettings
from sl_camera.drivers.socket_camera import SocketCamera
from sl_camera.stage.grbl.grbl_stage import GrblStage
from sl_camera.sync.match_events import (
    FrameDecision,
    ImageEvent,
    MatcherSettings,
    Status,
    TriggerEvent,
)
from sl_camera.sync.matching import StackMatcher
from sl_common.errors import CalibrationError, ConfigError, DeviceLost, DeviceRefused
from sl_projector.dlpc.dlpc900_driver import Dlpc900
from sl_projector.dlpc.dmd import Timing
from sl_projector.sequence.pattern_sequence import named
from sl_projector.sequence.stack import Stack, StagePose
from sl_reconstruct.model.calibration_file import load_calibration, rig_hash
from support.paths import ROOT
from support.patience import Deadline, patience

CONFIG = """
/sl/bench:
  ros__parameters:
    surface: flat
    seed: 11
    stage_travel_m: [0.05, 0.05, 0.02]
/sl/projector:
  ros__parameters: {exposure_s: 0.034}
"""
PAPER = named("paper")
TIMING = Timing(0.034, 0.0)
EXPOSURE_S = 0.033
READY_S = 120.0  # the first start on a machine compiles


def start(directory: Path, config: str = CONFIG) -> subprocess.Popen[str]:
    file = directory / "bench.yaml"
    file.write_text(config)
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(str(p) for p in sorted(ROOT.glob("src/sl_*")))
    }
    process = subprocess.Popen(
        [sys.executable, "-m", "sl_bench.process.bench", "--config", str(file), "--runtime-dir",
         str(directory / "run")],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
    )  # fmt: skip
    assert process.stdout is not None
    said = [process.stdout.readline().strip() for _ in range(2)]
    assert said == ["bench compiling", "bench ready"], process.communicate(
        timeout=patience(READY_S)
    )
    return process


def end(process: subprocess.Popen[str], number: int, directory: Path) -> None:
    process.send_signal(number)
    out, err = process.communicate(timeout=patience(30.0))
    assert (process.returncode, out, err) == (0, "", "")
    assert list((directory / "run").iterdir()) == []


class Devices:
    """The real drivers, opened at the bench's endpoints."""

    def __init__(self, directory: Path) -> None:
        self.control = BenchControl(directory)
        self.projector = Dlpc900(f"socket:{directory / 'usb.sock'}")
        self.projector.open()
        self.stage = GrblStage(str(directory / "stage"))
        self.stage.open()
        self.camera = SocketCamera(directory / "camera.sock")
        self.camera.open()
        self.arm()
        self.scan_id = 0

    def arm(self) -> None:
        self.camera.configure(CameraSettings(exposure_s=EXPOSURE_S))
        self.camera.arm()

    def close(self) -> None:
        self.camera.close()
        self.stage.close()
        self.projector.close()
        self.control.close()

    def pose(self) -> StagePose:
        x, y, z = self.stage.position_m()
        return StagePose(time.time_ns(), (x, y, z), (0.0, 0.0, 0.0, 1.0))

    def scan(self) -> tuple[list[FrameDecision], list[int]]:
        """Project `paper` and match what comes; decisions, and the frame ids."""
        self.scan_id += 1
        # A busy machine renders late, and then the frames are late: nothing is wrong with them.
        matcher = StackMatcher(MatcherSettings(timeout_s=60.0, pose_max_age_s=60.0))
        self.projector.load(PAPER, TIMING)
        decisions = matcher.pose(self.pose(), time.monotonic_ns())
        run = self.projector.run(TIMING)
        for i, pattern in enumerate(PAPER.patterns):
            stamp_ns = run.start_ns + round(i * run.timing.period_s * 1e9)
            event = TriggerEvent(
                self.scan_id, "paper", PAPER.dmd_size, i, len(PAPER), pattern, stamp_ns, 0.034
            )
            decisions += matcher.trigger(event, time.monotonic_ns())
        frame_ids: list[int] = []
        posed = False
        while matcher.busy:
            frame = self.camera.read(0.005)
            now_ns = time.monotonic_ns()
            if frame is not None:
                frame_ids.append(frame.frame_id)
                height, width = frame.image.shape
                data = frame.image.reshape(-1).copy()
                image = ImageEvent(frame.stamp_ns, height, width, frame.encoding, data)
                decisions += matcher.image(image, now_ns)
            if not posed and time.time_ns() > run.start_ns + run.duration_s * 1e9:
                decisions += matcher.pose(self.pose(), time.monotonic_ns())
                posed = True
            decisions += matcher.tick(time.monotonic_ns())
        self.projector.wait()
        return decisions, frame_ids


@pytest.fixture(scope="module")
def devices(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Devices]:
    directory = tmp_path_factory.mktemp("bench")
    process = start(directory)
    devices = Devices(directory / "run")
    yield devices
    devices.close()
    end(process, signal.SIGTERM, directory)


def complete(decisions: list[FrameDecision]) -> Stack:
    last = next(d for d in reversed(decisions) if d.status >= Status.STACK_COMPLETE)
    assert last.stack is not None, last.reason
    return last.stack


def refused(decisions: list[FrameDecision]) -> str:
    (verdict,) = [d for d in decisions if d.status >= Status.STACK_COMPLETE]
    assert verdict.status is Status.STACK_REFUSED
    return verdict.reason


def test_paper_stack_is_what_the_world_shows_for_each_pattern(devices: Devices) -> None:
    """Seed and frame number make a frame repeatable, so the same world gives the same pixels."""
    decisions, frame_ids = devices.scan()
    stack = complete(decisions)
    assert stack.images.shape == (11, 1200, 1600)
    world = World(reference_rig(), flat(), BenchSettings(seed=11).make_optics())
    for i in (0, 7, 10):
        expected = world.expose([(PAPER.frame(i), EXPOSURE_S)], EXPOSURE_S, frame_ids[i])
        # Not bit by bit: the exposure went through nanoseconds, which may tip a pixel over.
        assert np.mean(stack.images[i] != expected) < 1e-4


def test_edges_on_the_images_lie_where_rays_and_part_meet(devices: Devices) -> None:
    """I8 rises at column boundaries 4 (mod 16) and falls at 12; truth is traced, not rendered."""
    stack = complete(devices.scan()[0])
    row = 600
    world = World(reference_rig(), flat())
    boundaries = np.arange(20, 1004, 8)
    boundaries = boundaries[(boundaries % 16 == 4) | (boundaries % 16 == 12)]
    truth = world.truth_edges(boundaries.astype(np.float64), row)
    line = stack.images[7, row].astype(np.float64)
    # Stripes are some 11 px wide: the local threshold is the mean of a running minimum and maximum.
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(line, 10, mode="edge"), 21)
    signed = line - (windows.min(axis=1) + windows.max(axis=1)) / 2
    at = np.flatnonzero(np.signbit(signed[1:]) != np.signbit(signed[:-1]))
    crossings = at + signed[at] / (signed[at] - signed[at + 1])
    off = np.abs(crossings[:, None] - truth[np.isfinite(truth)][None]).min(axis=0)
    assert np.isfinite(truth).sum() > 110
    # Noise of an edge is about 0.03 px; the crude threshold adds some tenths of a pixel.
    assert np.quantile(off, 0.95) < 0.3


def test_dropped_frame_refuses_the_scan_and_the_next_one_is_whole(devices: Devices) -> None:
    devices.control.fault("camera", at={"drop": [4]})
    assert "image 5 of 11 did not come" in refused(devices.scan()[0])
    assert devices.control.state()["camera"]["edges_lost"] == 0
    complete(devices.scan()[0])


def test_lost_trigger_edge_of_the_dmd_refuses_the_scan(devices: Devices) -> None:
    devices.control.fault("projector", lost_edges=[6])
    assert "image 7 of 11 did not come" in refused(devices.scan()[0])
    devices.control.clear_faults()
    complete(devices.scan()[0])


def test_part_follows_the_real_stage_driver(devices: Devices) -> None:
    def height_m() -> float:
        return float(devices.control.true_points([[800.0, 600.0]])["points_m"][0][2])

    before = height_m()
    devices.stage.move_to(0.0, 0.0, 0.5e-3)
    assert devices.control.state()["stage_m"] == pytest.approx([0.0, 0.0, 0.5e-3], abs=1e-9)
    assert height_m() - before == pytest.approx(0.5e-3, abs=1e-9)
    devices.stage.move_to(0.0, 0.0, 0.0)


def test_software_trigger_shows_the_dmd_at_rest(devices: Devices) -> None:
    devices.camera.configure(CameraSettings(exposure_s=EXPOSURE_S, trigger="software"))
    devices.camera.arm()
    devices.camera.software_trigger()
    frame = devices.camera.read(10.0)
    assert frame is not None
    # All mirrors off: ambient light, 3 % of 190 DN, is left.
    assert 3.0 < frame.image.mean() < 8.0
    devices.arm()


def test_lamp_and_parts_can_be_exchanged(devices: Devices) -> None:
    devices.control.lamp(0.0)
    dark = complete(devices.scan()[0])
    # Ambient light is 3 % of 190 DN.
    assert dark.images.mean() < 10
    devices.control.lamp(1.0)
    devices.control.put("steps")
    assert complete(devices.scan()[0]).images[0].mean() > 40
    devices.control.put("flat")


def test_camera_unplugged_in_use(devices: Devices) -> None:
    devices.control.fault("camera", disconnect_s=0.2)
    with pytest.raises(DeviceLost):
        for _ in range(100):
            devices.camera.read(0.05)
    deadline = Deadline(60.0)
    while not deadline.is_over and devices.camera.statistics().reconnects == 0:
        try:
            devices.camera.read(0.05)
        except DeviceLost:
            continue
    complete(devices.scan()[0])


def test_true_rig_over_the_control_socket(devices: Devices) -> None:
    document = devices.control.true_rig()
    assert document["projector"]["kappa"] == 3.76e-8
    assert document["camera"]["image_size"] == [1600, 1200]


@pytest.mark.parametrize(
    "request_",
    [
        {}, {"explode": 1}, {"put": {"surface": "teapot"}}, {"put": {}}, {"lamp": -1},
        {"lamp": "bright"}, {"truth": "age"}, {"fault": {"coffee": {}}},
        {"fault": {"camera": {"drop": 2}}}, {"fault": {"camera": {"explode": 1}}},
        {"fault": {"projector": {"explode": 1}}}, {"fault": {"stage": {"start": None}}},
        {"put": 3}, {"fault": {"stage": 1}},
    ],
)  # fmt: skip
def test_requests_that_cannot_be(devices: Devices, request_: dict[str, object]) -> None:
    with pytest.raises(DeviceRefused):
        devices.control.ask(request_)
    assert devices.control.state()["ok"] is True


def test_no_bench(tmp_path: Path) -> None:
    with pytest.raises(DeviceLost, match="is it running"):
        BenchControl(tmp_path)


# -- without a process ------------------------------------------------------------------------


def test_written_rig_is_read_by_the_reconstruction_bit_by_bit(tmp_path: Path) -> None:
    file = tmp_path / "rig.yaml"
    assert bench.main(["--write-calibration", str(file)]) == 0
    assert rig_hash(load_calibration(file).rig) == rig_hash(reference_rig())
    assert rig_hash(read_rig(file)) == rig_hash(reference_rig())


def test_rig_from_a_calibration_file(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.yaml", reference_rig())
    (tmp_path / "bench.yaml").write_text("/sl/bench: {ros__parameters: {rig: rig.yaml}}")
    rig = read_settings(tmp_path / "bench.yaml").make_rig()
    assert rig_hash(rig) == rig_hash(reference_rig())
    (tmp_path / "rig.yaml").write_text("camera: {model: division}")
    with pytest.raises(CalibrationError, match=r"rig\.yaml"):
        read_settings(tmp_path / "bench.yaml").make_rig()


@pytest.mark.parametrize(
    ("parameters", "told"),
    [
        ("{surfaces: flat}", "surfaces"),
        ("{seed: many}", "seed"),
        ("{seed: 1.5}", "seed"),
        ("{stage_homed: 1}", "stage_homed"),
        ("{camera_frame_rate_hz: 0}", "camera_frame_rate_hz"),
        ("{camera_frame_rate_hz: .nan}", "camera_frame_rate_hz"),
        ("{stage_scale: [1, 1]}", "stage_scale"),
        ("{stage_travel_m: [50, 50, 20]}", "stage_travel_m"),
        ("{optics: 3}", "optics"),
        ("[1, 2]", "mapping"),
    ],
)
def test_settings_that_cannot_be(tmp_path: Path, parameters: str, told: str) -> None:
    file = tmp_path / "bench.yaml"
    file.write_text(f"/sl/bench: {{ros__parameters: {parameters}}}")
    with pytest.raises(ConfigError, match=told):
        read_settings(file)


@pytest.mark.parametrize(
    "settings",
    [
        BenchSettings(surface="teapot"), BenchSettings(finish="velvet"),
        BenchSettings(optics={"colour": 3}), BenchSettings(dmd_model="DLP6500"),
        BenchSettings(stage_scale=(1.0, 0.0, 1.0)),
    ],
)  # fmt: skip
def test_bench_of_things_that_do_not_exist(settings: BenchSettings, tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        bench.Bench(settings, tmp_path)


def test_command_says_what_is_wrong(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert bench.main(["--config", str(tmp_path / "none.yaml")]) == 1
    assert "none.yaml" in capsys.readouterr().err
    assert bench.main([]) == 1
    assert "--runtime-dir" in capsys.readouterr().err


def test_mounting_moves_and_turns_as_its_numbers_say() -> None:
    rotation, translation = Mounting(offset_m=(1e-3, 0.0, 0.0)).pose((0.0, 2e-3, 3e-3))
    assert rotation == pytest.approx(np.eye(3))
    assert translation == pytest.approx([1e-3, 2e-3, 3e-3])
    # y leans towards x by 30 degrees: a move of 1 mm in y goes (sin 30, cos 30) mm.
    leaning = Mounting(squareness_rad=(np.pi / 6, 0.0, 0.0), scale=(1.0, 2.0, 1.0))
    assert leaning.pose((0.0, 1e-3, 0.0))[1] == pytest.approx([1e-3, np.sqrt(3) * 1e-3, 0.0])
    # A quarter turn about x takes the part's y to the world's z.
    turned = Mounting(tilt_rad=(np.pi / 2, 0.0, 0.0)).pose((0.0, 0.0, 0.0))[0]
    assert turned @ [0.0, 1.0, 0.0] == pytest.approx([0.0, 0.0, 1.0])
