"""Calibration as it runs: bench and nodes as processes, one service call, checked by the truth."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml

from support import ros_graph
from support.paths import SOURCES

ros_graph.require_ros()

from sl_interfaces.action import Calibrate as CalibrateAction  # noqa: E402
from sl_interfaces.srv import Calibrate, Verify  # noqa: E402

from sl_bench.process.bench_control import BenchControl  # noqa: E402
from sl_bringup.graph.transport import Transport, process_environment  # noqa: E402
from sl_calibration.solve.ray_midpoints import triangulate  # noqa: E402
from sl_common import topics  # noqa: E402
from sl_reconstruct.model.calibration_file import load_rig, parse_calibration, rig_hash  # noqa: E402
from support.patience import patience, wait  # noqa: E402
from support.ros_graph import Graph  # noqa: E402

NODES = {
    "projector": ("sl_projector.projector_node", "device:=socket:{}/usb.sock"),
    "camera": ("sl_camera.camera_node", "address:={}/camera.sock"),
    "stage": ("sl_camera.stage_node", "port:={}/stage"),
    "synchronizer": ("sl_camera.synchronizer_node", "require_pose:=true"),
    "calibration": ("sl_calibration.calibration_node", "store_dir:={}/store"),
}
HEIGHTS_M = [-0.8e-3, 0.0, 0.8e-3]


@dataclass
class Running:
    """The processes of a graph, and a node of the test's own."""

    graph: Graph
    directory: Path
    processes: dict[str, subprocess.Popen[bytes]]

    @property
    def store(self) -> Path:
        return self.directory / "store"

    def calibrate(self, **request: object) -> Calibrate.Response:
        # The first call may wait for the compiler.
        return self.graph.call(topics.CALIBRATE, Calibrate.Request(**request), 250)

    def height_m(self) -> float:
        with BenchControl(self.directory) as bench:
            return float(bench.state()["stage_m"][2])


def start(directory: Path, domain: int) -> dict[str, subprocess.Popen[bytes]]:
    """Start the bench with a hole plate on it, then every node as its own process."""
    paths = ":".join(str(package) for package in sorted(SOURCES.iterdir()))
    config = {"/sl/bench": {"ros__parameters": {"surface": "hole_plate", "seed": 5}}}
    (directory / "bench.yaml").write_text(yaml.safe_dump(config))

    def run(name: str, *arguments: str) -> subprocess.Popen[bytes]:
        environment = Transport(directory, domain).environment(name)
        with (directory / f"{name}.log").open("wb") as log:
            return subprocess.Popen(
                [sys.executable, "-m", *arguments], stdout=log, stderr=subprocess.STDOUT,
                env=process_environment({**environment, "PYTHONPATH": paths}),
                start_new_session=True,
            )  # fmt: skip

    options = ("--config", str(directory / "bench.yaml"), "--runtime-dir", str(directory))
    processes = {"bench": run("bench", "sl_bench.process.bench", *options)}
    wait((directory / "control.sock").exists, "the bench", 280.0)
    for name, (module, parameter) in NODES.items():
        processes[name] = run(name, module, "--ros-args", "-p", parameter.format(directory))
    return processes


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    directory = tmp_path_factory.mktemp("graph")
    with ros_graph.graph() as graph:
        processes = start(directory, graph.domain)
        try:
            graph.await_well(NODES)
            yield Running(graph, directory, processes)
        finally:
            for process in processes.values():
                process.send_signal(signal.SIGINT)
            for process in processes.values():
                try:
                    process.wait(timeout=patience(20.0))
                except subprocess.TimeoutExpired:
                    process.kill()


@pytest.fixture(scope="module")
def calibrated(running: Running) -> Calibrate.Response:
    answer = running.calibrate(heights_m=HEIGHTS_M)
    assert answer.success, answer.message
    return answer


def test_refusals_come_before_anything_moves(running: Running) -> None:
    before_m = running.height_m()
    assert "does not reach" in running.calibrate(heights_m=[0.0, 1e-3, 0.5]).message
    assert "1 different heights" in running.calibrate(heights_m=[0.0]).message
    assert "positive number" in running.calibrate(plate_pitch_m=-1.0).message
    assert "nothing to verify" in running.graph.call(topics.VERIFY, Verify.Request()
    ).message  # fmt: skip
    assert running.height_m() == before_m
    assert not (running.store / "current").exists()


def test_one_call_calibrates_the_rig(running: Running, calibrated: Calibrate.Response) -> None:
    with BenchControl(running.directory) as bench:
        truth = bench.true_rig()
    document = yaml.safe_dump(truth)
    true = parse_calibration(document).rig
    rig = load_rig(calibrated.calibration_file)
    # The world is the plate with the stage at zero, which is the bench's world: the plate's middle
    # lies at its origin. Nothing is aligned.
    grid = np.stack(np.meshgrid(
        np.linspace(-6e-3, 6e-3, 7), np.linspace(-4.5e-3, 4.5e-3, 5), [-1e-3, 0.0, 1e-3],
    ), axis=-1).reshape(-1, 3)  # fmt: skip
    points, _ = triangulate(rig, true.camera.project(grid), true.projector.project(grid))
    rms_m = float(np.sqrt(np.mean(np.sum((points - grid) ** 2, axis=1))))
    assert rms_m < 1e-6  # issue 3, "Shows"
    # Three heights of 100 holes, and two views aside that may lose a row or a column.
    assert (calibrated.accepted, calibrated.views) == (True, 5)
    assert 480 <= calibrated.holes <= 500
    # The bench's stage is square; 0.02 px of a hole is 0.16 um of 0.5 mm of travel.
    assert np.abs(calibrated.stage_squareness_rad).max() < 3e-4
    assert abs(calibrated.stage_z_scale - 1) < 1e-3
    assert calibrated.camera_rms_px < 0.02
    assert calibrated.predicted_sigma_m < 1e-6
    assert Path(calibrated.report).is_file()
    assert running.height_m() == 0.0


def test_it_is_in_force_and_stored(running: Running, calibrated: Calibrate.Response) -> None:
    rigs = running.graph.collect(topics.CALIBRATION)
    message = wait(lambda: rigs and rigs[-1], "the latched calibration")
    assert message.hash == calibrated.hash
    assert rig_hash(parse_calibration(message.yaml).rig) == calibrated.hash
    assert message.camera.width == 1600
    assert message.projector.width == 1024
    run = (running.store / "current").read_text().strip()
    assert Path(calibrated.calibration_file) == running.store / run / "calibration.yaml"


def test_verify_finds_a_good_rig_good(running: Running, calibrated: Calibrate.Response) -> None:
    answer = running.graph.call(topics.VERIFY, Verify.Request(), 150.0)
    assert answer.success, answer.message
    assert not answer.recalibrate
    assert answer.rms_m < 1e-6
    assert answer.views == 3
    assert answer.step_m < 1e-6
    assert Path(answer.report).is_file()
    assert running.height_m() == 0.0


def test_a_dark_lamp_is_refused_and_the_old_calibration_stays(
    running: Running, calibrated: Calibrate.Response
) -> None:
    with BenchControl(running.directory) as bench:
        bench.lamp(0.0)
        answer = running.calibrate(heights_m=HEIGHTS_M)
        bench.lamp(1.0)
    assert not answer.success
    assert "is its lamp on" in answer.message
    assert "view 1 of 5" in answer.message
    assert (running.store / "current").read_text().strip() in calibrated.calibration_file
    assert running.height_m() == 0.0


def test_a_run_can_be_cancelled_half_way(running: Running, calibrated: Calibrate.Response) -> None:
    told: list[CalibrateAction.Feedback] = []
    client = running.graph.action_client(topics.CALIBRATE_ACTION)
    goal = CalibrateAction.Goal(heights_m=HEIGHTS_M)
    sent = client.send_goal_async(goal, lambda m: told.append(m.feedback))
    wait(sent.done, "the goal to be accepted")
    wait(lambda: told and told[-1].stage == "planes", "the first view", 120.0)
    second = running.calibrate(heights_m=HEIGHTS_M)
    assert "going on already" in second.message
    result = sent.result().get_result_async()
    sent.result().cancel_goal_async()
    wait(result.done, "the cancelled run's end", 120.0)
    assert result.result().status == 5  # action_msgs/GoalStatus.STATUS_CANCELED
    assert "cancelled" in result.result().result.message
    assert (running.store / "current").read_text().strip() in calibrated.calibration_file
