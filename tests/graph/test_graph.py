"""The graph as it runs: bench and nodes as processes, real drivers, one scan, a clean end."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from support import ros_graph
from support.paths import SOURCES

ros_graph.require_ros()

from geometry_msgs.msg import Point  # noqa: E402
from sl_interfaces.srv import MoveStage, Project, Scan  # noqa: E402

from sl_bench.world.reference_rig import reference_rig  # noqa: E402
from sl_bringup.graph.transport import Transport, process_environment  # noqa: E402
from sl_common import topics  # noqa: E402
from sl_reconstruct.cloud.cloud_writer import cloud_hash  # noqa: E402
from sl_reconstruct.messages import cloud_from_msg  # noqa: E402
from sl_reconstruct.model.calibration_file import rig_hash, save_calibration  # noqa: E402
from support.patience import patience, wait  # noqa: E402
from support.ros_graph import Graph  # noqa: E402

#: Where the stage puts the plate; a whole number of the emulated stage's steps.
HEIGHT_M = 0.2e-3
NODES = {
    "projector": ("sl_projector.projector_node", "device:=socket:{}/usb.sock"),
    "camera": ("sl_camera.camera_node", "address:={}/camera.sock"),
    "stage": ("sl_camera.stage_node", "port:={}/stage"),
    "synchronizer": ("sl_camera.synchronizer_node", "require_pose:=true"),
    "reconstruct": ("sl_reconstruct.reconstruct_node", "estimator:=matched"),
    "calibration": ("sl_calibration.calibration_node", "calibration_file:={}/rig.yaml"),
}


@dataclass
class Running:
    """The processes of a graph, and a node of the test's own."""

    graph: Graph
    processes: dict[str, subprocess.Popen[bytes]]

    def stop(self) -> dict[str, int]:
        """Interrupt all nodes and return their exit statuses; the bench goes last."""
        for name, process in self.processes.items():
            if name != "bench":
                process.send_signal(signal.SIGINT)
        codes = {
            n: p.wait(timeout=patience(20.0)) for n, p in self.processes.items() if n != "bench"
        }
        self.processes["bench"].send_signal(signal.SIGINT)
        return {**codes, "bench": self.processes["bench"].wait(timeout=patience(20.0))}


def start(directory: Path, domain: int) -> dict[str, subprocess.Popen[bytes]]:
    """Start the bench, then every node as its own process."""
    paths = ":".join(str(package) for package in sorted(SOURCES.iterdir()))

    def run(name: str, *arguments: str) -> subprocess.Popen[bytes]:
        environment = Transport(directory, domain).environment(name)
        with (directory / f"{name}.log").open("wb") as log:
            return subprocess.Popen(
                [sys.executable, "-m", *arguments], stdout=log, stderr=subprocess.STDOUT,
                env=process_environment({**environment, "PYTHONPATH": paths}),
                start_new_session=True,
            )  # fmt: skip

    processes = {"bench": run("bench", "sl_bench.process.bench", "--runtime-dir", str(directory))}
    wait((directory / "control.sock").exists, "the bench", 60.0)
    for name, (module, parameter) in NODES.items():
        options = ("--ros-args", "-p", parameter.format(directory))
        processes[name] = run(name, module, *options)
    return processes


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    save_calibration(tmp_path / "rig.yaml", reference_rig())
    with ros_graph.graph() as graph:
        processes = start(tmp_path, graph.domain)
        try:
            graph.await_well(NODES)
            yield Running(graph, processes)
        finally:
            for process in processes.values():
                if process.poll() is None:
                    process.kill()
                process.wait(timeout=patience(20.0))


def test_one_scan_from_trigger_to_cloud_and_a_clean_end(running: Running) -> None:
    graph = running.graph
    clouds = graph.collect(topics.POINTS)
    height = MoveStage.Request(target=Point(z=HEIGHT_M))
    moved = graph.call(topics.MOVE_STAGE, height, 60.0)
    assert moved.success, moved.message
    # The first scan may wait for the compiler.
    answer = graph.call(topics.SCAN, Scan.Request(max_repeats=3), 250.0)
    assert answer.success, answer.message
    points = cloud_from_msg(wait(lambda: clouds and clouds[-1], "the cloud"))
    report = answer.report
    assert points.shape == (1200, 1024)
    assert report.cloud_hash == cloud_hash(points)
    assert report.calibration_hash == rig_hash(reference_rig())
    assert report.points >= 0.98 * report.lit_positions  # issue 2, "Shows"
    there = np.isfinite(points["z"])
    assert report.points == there.sum()
    # A flat plate, lifted by the stage, which counts in steps of 4 um (250 per mm). Issue 2 asks
    # for 0.2 um of noise, so the median of a million points has no room for more than a step.
    assert abs(np.median(points["z"][there]) - HEIGHT_M) < 4e-6
    again = graph.call(topics.PROJECT, Project.Request(sequence="paper"), 60.0)
    assert again.success
    wait(lambda: len(clouds) == 2, "the cloud of a projection that nobody called a scan", 60.0)
    assert running.stop() == dict.fromkeys([*NODES, "bench"], 0)
