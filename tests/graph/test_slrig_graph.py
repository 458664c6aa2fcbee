"""The commands as a user gives them: up, scan, doctor, a crash, Ctrl-C; with real processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from plyfile import PlyData

from sl_bringup.graph.graph_config import NODES
from sl_bringup.graph.transport import process_environment
from support.domains import ReservedDomain
from support.paths import ROOT
from support.patience import patience
from support.processes import wait_until_ended
from support.slrig_command import READY_PATIENCE_S, Command

SOAK = ROOT / "benchmarks" / "soak_faults.py"


@pytest.fixture(scope="module")
def graph(ros_domain: int) -> Iterator[Command]:
    command = Command("up", "--bench", "--surface", "groove", "--domain", f"{ros_domain}")
    try:
        command.wait_for("graph ready", READY_PATIENCE_S)
        yield command
    finally:
        command.end(signal.SIGINT)


def scan(output: Path, *arguments: str) -> tuple[int, dict[str, object], str]:
    command = Command("scan", "--output", str(output), *arguments)
    status = command.end(patience_s=120.0)
    file = output / "report.json"
    return status, json.loads(file.read_text()) if file.is_file() else {}, command.text


def test_a_scan_of_the_groove(graph: Command, tmp_path: Path) -> None:
    """The bench's groove has 155.92 degrees; `paper` promises it within 0.05."""
    status, report, told = scan(tmp_path, "--sequence", "paper", "--measure", "groove")
    assert status == 0, told
    assert report["good"]
    assert report["groove"]["included_angle_deg"] == pytest.approx(155.92, abs=0.05)  # type: ignore[index]
    assert report["points"] == report["lit_positions"] - sum(report["refused"].values())  # type: ignore[attr-defined]
    assert PlyData.read(tmp_path / "cloud.ply")["vertex"].count == report["points"]
    pictures = ("height", "relief", "residual", "profile", "refusals")
    assert {file.name for file in tmp_path.iterdir()} == {
        "cloud.ply", "cloud.pcd", "height.tiff", "height.png", "report.json", "report.html",
        *(f"picture_{name}.png" for name in pictures),
    }  # fmt: skip
    assert f"{report['points']:,} of" in told


def test_a_sequence_that_does_not_exist_is_refused(graph: Command, tmp_path: Path) -> None:
    status, report, told = scan(tmp_path, "--sequence", "zebra", "--no-pictures")
    assert status == 1
    assert not report["good"]
    assert "zebra" in told
    assert not (tmp_path / "cloud.ply").exists()


def test_an_interrupted_calibration_does_not_go_on_in_the_graph(
    graph: Command, ros_domain: int
) -> None:
    command = Command("calibrate", "--domain", f"{ros_domain}")
    command.wait_for("planes", 120.0)
    assert command.end(signal.SIGINT, patience_s=120.0) == 130, command.text
    graph.wait_for("calibration cancelled; stage and projector were stopped", 120.0)


def test_a_calibration_that_nobody_waits_for_does_not_go_on(
    graph: Command, ros_domain: int
) -> None:
    """A run of seven views takes longer than a second on any machine."""
    cancelled = "calibration cancelled; stage and projector were stopped"
    before = graph.text.count(cancelled)
    command = Command("calibrate", "--domain", f"{ros_domain}", "--timeout", "1")
    assert command.end(patience_s=120.0) == 1, command.text
    assert "did not answer within 1 s" in command.text
    graph.wait_for(cancelled, 120.0, times=before + 1)


def test_scans_with_devices_that_fail_at_random(graph: Command, ros_domain: int) -> None:
    """A taste of ``benchmarks/soak_faults.py``: no wrong cloud, no dead node, all well again.

    The seed has a late, a lost and an ill-sized frame, serial noise, an unplugged projector, a
    stale reply, a refused command, and a scan without a fault.
    """
    soak = subprocess.run(
        [sys.executable, str(SOAK), "--attach", "--domain", f"{ros_domain}", "--scans", "8",
         "--seed", "64", "--sequences", "paper"],
        env=process_environment({"PYTHONPATH": os.pathsep.join(sys.path)}),
        capture_output=True, text=True, timeout=patience(600.0), check=False,
    )  # fmt: skip
    assert soak.returncode == 0, soak.stdout + soak.stderr
    figures = json.loads(soak.stdout[soak.stdout.index("{") :])
    assert figures["scans"] == 8
    assert not figures["defects"]
    assert figures["totals"]["refused"] < 8


def test_a_node_that_is_killed_comes_back_and_scans_go_on(graph: Command, tmp_path: Path) -> None:
    before = graph.text.count("camera connected")
    os.kill(graph.pid_of("camera"), signal.SIGKILL)
    graph.wait_for("camera connected", 60.0, times=before + 1)
    status, _, told = scan(tmp_path, "--sequence", "paper")
    assert status == 0, told


def test_the_doctor_sees_the_graph(graph: Command, ros_domain: int) -> None:
    command = Command("doctor", "--bench", "--domain", f"{ros_domain}")
    assert command.end() == 0, command.text
    assert "running and ready" in command.text


def test_a_second_graph_in_the_domain_is_refused(graph: Command, ros_domain: int) -> None:
    command = Command("up", "--bench", "--domain", f"{ros_domain}")
    assert command.end() == 1
    assert "runs already" in command.text


def test_ctrl_c_ends_everything_cleanly(graph: Command) -> None:
    """The last test of the graph: it takes it down."""
    pids = [graph.pid_of(name) for name in ("bench", *NODES)]
    assert graph.end(signal.SIGINT) == 0, graph.text
    assert graph.text.count("process has finished cleanly") == len(pids)
    for pid in pids:
        wait_until_ended(pid)


def test_without_a_graph_the_scan_says_what_to_do(tmp_path: Path) -> None:
    nobodys = ReservedDomain()  # this module's graph may live on in the process's own domain
    try:
        status, _, told = scan(tmp_path, "--domain", f"{nobodys.number}")
    finally:
        nobodys.release()
    assert status == 1
    assert "slrig up" in told
