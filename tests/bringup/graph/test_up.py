"""The supervisor, with tiny processes in place of nodes; no ROS."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from sl_bringup.graph.graph import Graph, GraphOptions, is_running, lock_directory
from sl_bringup.graph.graph_config import NODES, Changes, find_config, started_nodes, write_config
from sl_bringup.graph.supervisor import Process, Supervisor, Timing
from sl_common.errors import ConfigError
from support.patience import Deadline
from support.processes import wait_until_ended

QUICK = Timing(backoff_s=0.05, backoff_limit_s=0.2, interrupt_s=0.5, terminate_s=0.5)
#: Ends with status 0 on SIGINT, as nodes do.
OBEDIENT = """
import signal, sys, time
signal.signal(signal.SIGINT, lambda *_: sys.exit(0))
print("up", flush=True)
time.sleep(60)
"""
DEAF = """
import signal, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("up", flush=True)
time.sleep(60)
"""


def python(name: str, code: str) -> Process:
    """A process of the plain interpreter: without site it starts in milliseconds."""
    return Process(name, (sys.executable, "-S", "-E", "-c", code), {"PATH": os.environ["PATH"]})


class Told:
    """What the supervisor said."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def __call__(self, line: str) -> None:
        self.lines.append(line)

    def count(self, text: str) -> int:
        return sum(text in line for line in self.lines)


async def until(condition: Callable[[], bool]) -> None:
    deadline = Deadline()
    while not condition():
        assert not deadline.is_over, "what was waited for did not happen"
        await asyncio.sleep(0.01)


def test_lines_carry_name_and_number_and_all_end_cleanly() -> None:
    told = Told()

    async def go() -> list[str]:
        async with Supervisor(told, QUICK) as supervisor:
            supervisor.start(python("camera", OBEDIENT))
            supervisor.start(python("stage", OBEDIENT))
            await until(lambda: told.count("up") == 2)
        return supervisor.unclean

    assert asyncio.run(go()) == []
    assert "[camera-1] up" in told.lines
    assert "[stage-2] up" in told.lines
    assert told.count("process has finished cleanly") == 2


def test_a_process_that_dies_is_started_again_after_growing_pauses() -> None:
    told = Told()

    async def go() -> dict[str, int]:
        async with Supervisor(told, QUICK) as supervisor:
            supervisor.start(python("camera", "raise SystemExit(3)"))
            await until(lambda: supervisor.starts["camera"] >= 5 if supervisor.starts else False)
        return supervisor.starts

    starts = asyncio.run(go())
    assert starts["camera"] >= 5
    # 50 ms, doubled each time, up to the limit of 200 ms.
    deaths = [line for line in told.lines if "restart in" in line]
    assert all("exit code 3" in line for line in deaths)
    assert [line.rsplit(" ", 2)[1] for line in deaths[:4]] == ["0.05", "0.1", "0.2", "0.2"]


def test_a_killed_process_comes_back() -> None:
    told = Told()

    async def go() -> tuple[int, int]:
        async with Supervisor(told, QUICK) as supervisor:
            supervisor.start(python("camera", OBEDIENT))
            await until(lambda: told.count("up") == 1)
            first = supervisor.running["camera"]
            os.kill(first, signal.SIGKILL)
            await until(lambda: told.count("up") == 2)
            return first, supervisor.running["camera"]

    first, second = asyncio.run(go())
    assert first != second
    assert told.count("exit code -9") == 1


def test_a_program_that_is_not_there_is_told_and_tried_again() -> None:
    told = Told()

    async def go() -> None:
        async with Supervisor(told, QUICK) as supervisor:
            supervisor.start(Process("camera", ("/nonexistent/camera",), {}))
            await until(lambda: told.count("cannot be started") == 2)

    asyncio.run(go())


def test_a_deaf_process_is_killed_and_counts_as_unclean() -> None:
    told = Told()

    async def go() -> tuple[list[str], int]:
        async with Supervisor(told, QUICK) as supervisor:
            supervisor.start(python("camera", DEAF))
            await until(lambda: told.count("up") == 1)
            pid = supervisor.running["camera"]
        return supervisor.unclean, pid

    unclean, pid = asyncio.run(go())
    assert unclean == ["camera: exit code -9"]
    assert told.count("sending SIGTERM") == told.count("sending SIGKILL") == 1
    wait_until_ended(pid)


def test_the_children_of_a_process_end_with_it() -> None:
    told = Told()
    parent = (
        "import subprocess, sys\n"
        "command = [sys.executable, '-S', '-E', '-c', 'import time; time.sleep(60)']\n"
        "child = subprocess.Popen(command)\n"
        "print('child', child.pid, flush=True)\n"
        "child.wait()\n"
    )

    async def go() -> int:
        async with Supervisor(told, QUICK) as supervisor:
            supervisor.start(python("camera", parent))
            await until(lambda: told.count("child") == 1)
        return int(next(line for line in told.lines if "child" in line).split()[-1])

    child = asyncio.run(go())
    wait_until_ended(child)


def test_a_line_without_end_is_cut() -> None:
    told = Told()

    async def go() -> None:
        async with Supervisor(told, QUICK) as supervisor:
            code = "import sys, time; sys.stdout.write('x' * 200_000); sys.stdout.flush(); "
            supervisor.start(python("camera", code + "time.sleep(60)"))
            await until(lambda: told.count("xxx") >= 2)

    asyncio.run(go())
    assert max(len(line) for line in told.lines) < 1 << 18


def test_one_graph_in_a_domain(tmp_path: Path) -> None:
    held = lock_directory(tmp_path)
    assert is_running(tmp_path)
    with pytest.raises(ConfigError, match=str(os.getpid())):
        lock_directory(tmp_path)
    held.close()
    assert not is_running(tmp_path)


def sections(file: Path) -> dict[str, dict[str, object]]:
    return {k: v["ros__parameters"] for k, v in yaml.safe_load(file.read_text()).items()}


def test_the_bench_file_gets_its_endpoints_and_the_users_changes(tmp_path: Path) -> None:
    changes = Changes(calibration=tmp_path / "mine.yaml", surface="coin")
    written = sections(write_config(find_config("bench.yaml"), tmp_path, changes))
    assert written["/sl/projector"]["device"] == f"socket:{tmp_path}/usb.sock"
    assert written["/sl/stage"]["port"] == f"{tmp_path}/stage"
    assert written["/sl/calibration"]["calibration_file"] == f"{tmp_path}/mine.yaml"
    assert written["/sl/bench"]["surface"] == "coin"
    assert written["/sl/bench"]["rig"] == "reference"


def test_a_new_namespace_moves_the_nodes_but_not_the_bench(tmp_path: Path) -> None:
    changes = Changes(ros_args=("-r", "__ns:=/cell/left"))
    written = sections(write_config(find_config("bench.yaml"), tmp_path, changes))
    assert "/cell/left/camera" in written
    assert "/sl/camera" not in written
    assert "/sl/bench" in written


def test_relative_paths_are_those_of_the_users_file(tmp_path: Path) -> None:
    source = tmp_path / "rig.yaml"
    source.write_text("/sl/calibration: {ros__parameters: {calibration_file: ../cal.yaml}}")
    written = sections(write_config(source, tmp_path / "run", Changes()))
    assert written["/sl/calibration"]["calibration_file"] == str(tmp_path.parent / "cal.yaml")


@pytest.mark.parametrize(
    "text", ["", "[1, 2]", "/sl/camera: 3", "/sl/camera: {exposure_s: 1}", "a: [", "a: 1\na: 2",
     "/sl/reconstruct: {ros__parameters: {calibration_file: one_owner.yaml}}"],
)  # fmt: skip
def test_a_file_that_is_no_parameter_file_is_refused(tmp_path: Path, text: str) -> None:
    source = tmp_path / "rig.yaml"
    source.write_text(text)
    with pytest.raises(ConfigError, match=r"rig\.yaml"):
        write_config(source, tmp_path / "run", Changes())


@pytest.mark.parametrize("name", ["bench.yaml", "hardware.yaml"])
def test_both_files_name_every_node(name: str) -> None:
    found = yaml.safe_load(find_config(name).read_text())
    nodes = {f"/sl/{name}" for name in NODES}
    assert nodes | ({"/sl/bench"} if name == "bench.yaml" else set()) == set(found)


def test_a_camera_or_stage_without_a_section_is_not_started(tmp_path: Path) -> None:
    source = tmp_path / "rig.yaml"
    source.write_text("/sl/projector:\n  ros__parameters: {device: usb}\n")
    others = ["projector", "synchronizer", "reconstruct", "calibration"]
    assert list(started_nodes(source)) == others
    source.write_text("/sl/stage:\n  ros__parameters: {kind: manual}\n")
    assert sorted(started_nodes(source)) == sorted([*others, "stage"])
    assert started_nodes(find_config("hardware.yaml")) == NODES


@pytest.mark.parametrize(
    ("lines", "deaths", "expected"),
    [(["bench compiling"], 0, True), ([], 0, False), (["bench compiling"], 1, False)],
)
def test_the_bench_may_compile_for_longer_than_the_timeout(
    lines: list[str], deaths: int, expected: bool
) -> None:
    """It says ready after three time-outs; a bench that does not compile, or dies, is given up."""

    async def work() -> bool:
        told = Told()
        graph = Graph(GraphOptions(bench=True), told)
        graph.supervisor.starts["bench"] = 1
        for line in lines:
            graph._listen(line)
        answer = asyncio.create_task(graph._await_bench(0.1))
        await asyncio.sleep(0.05)
        graph.supervisor.starts["bench"] += deaths
        await asyncio.sleep(0.3)
        graph._listen("bench ready")
        found = await answer
        assert told.count("the bench does not answer") == (not found)
        return found

    assert asyncio.run(work()) is expected
