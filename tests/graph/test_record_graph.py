"""A live graph recorded, evaluated and replayed: three times the same bits; with real processes."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from support.patience import wait
from support.ros_graph import graph as ros_graph
from support.ros_graph import require_ros
from support.slrig_command import READY_PATIENCE_S, Command

require_ros()


from sl_bringup.bag.bags import open_bag  # noqa: E402
from sl_bringup.cli.main import main  # noqa: E402
from sl_camera.sync.match_events import MatcherSettings  # noqa: E402
from sl_camera.synchronizer_node import SynchronizerNode  # noqa: E402
from sl_common import topics  # noqa: E402
from sl_common.topics import (  # noqa: E402
    CALIBRATION_RUN,
    CAMERA_INFO,
    CAMERA_SETTINGS,
    FRAME,
    MATCHING,
    PROJECTOR_INFO,
    RECORDED_TOPICS,
    REPORT,
    SETTINGS,
)
from sl_reconstruct.reconstruct_node import ReconstructNode  # noqa: E402

SCANS = 2
#: Nothing is calibrated here.
OF_SCANS = [topic for topic in RECORDED_TOPICS if topic is not CALIBRATION_RUN]
#: More than the recorder needs to find every publisher.
DISCOVERY_S = 2.5
#: A recording is as long as its scans took, which on a slow machine is minutes.
REPLAY_PATIENCE_S = 280.0


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory, ros_domain: int) -> Iterator[tuple[Path, list]]:
    """Two recordings of the same scans, one ended by Ctrl-C, one by SIGKILL; the live hashes."""
    folder, domain = tmp_path_factory.mktemp("live"), f"{ros_domain}"
    up = Command("up", "--bench", "--surface", "groove", "--domain", domain)
    commands = [up]
    try:
        up.wait_for("graph ready", READY_PATIENCE_S)
        for name in ("whole", "killed"):
            output = str(folder / name)
            commands.append(Command("record", "--output", output, "--domain", domain))
            commands[-1].wait_for("recording to", 60.0)
        time.sleep(DISCOVERY_S)
        hashes = []
        for number in range(SCANS):
            out = folder / f"scan_{number}"
            arguments = ("--sequence", "paper", "--output", str(out), "--no-pictures")
            scan = Command("scan", *arguments, "--domain", domain)
            assert scan.end(patience_s=120.0) == 0, scan.text
            hashes.append(json.loads((out / "report.json").read_text())["cloud_hash"])
        wait(lambda: reports_in(folder / "killed") == SCANS, "the last report", 60.0)
        _, whole, killed = commands
        killed.end(signal.SIGKILL)
        assert whole.end(signal.SIGINT) == 0, whole.text
        yield folder, hashes
    finally:
        for command in commands[1:]:
            command.end(signal.SIGKILL)
        up.end(signal.SIGINT)


def reports_in(bag: Path) -> int:
    """Reports that a recorder has handed over so far: they come after all else of a scan."""
    with open_bag(bag) as opened:
        return len(list(opened.messages(REPORT)))


def evaluated(bag: Path, output: Path) -> list[str]:
    main(["evaluate", str(bag), "--output", str(output), "--pictures", "none"])
    return [s["cloud_hash"] for s in json.loads((output / "summary.json").read_text())["scans"]]


def test_the_evaluation_gives_the_live_bits(live: tuple[Path, list], tmp_path: Path) -> None:
    folder, hashes = live
    assert evaluated(folder / "whole", tmp_path / "out") == hashes
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["live"] == {"same": SCANS, "different": 0, "unknown": 0}
    assert summary["lost"] == []


def test_every_topic_is_in_the_bag(live: tuple[Path, list]) -> None:
    folder, _ = live
    with open_bag(folder / "whole") as bag:
        assert [t.name for t in OF_SCANS if not bag.has(t)] == []
        frames = [m.message for m in bag.messages(FRAME)]
        assert sum(m.status == m.MATCHED for m in frames) == 11 * SCANS
        assert len(list(bag.messages(CAMERA_INFO))) == 11 * SCANS
        assert list(bag.messages(PROJECTOR_INFO))
        (camera,), (matching,), (settings,) = (
            [json.loads(m.message.data) for m in bag.messages(topic)]
            for topic in (CAMERA_SETTINGS, MATCHING, SETTINGS)
        )
        assert camera["full_scale_dn"] == 255
        assert matching == MatcherSettings().to_dict()
        assert settings["estimator"] == "matched"


def test_a_killed_recorder_leaves_all_but_the_last_second(
    live: tuple[Path, list], tmp_path: Path
) -> None:
    folder, hashes = live
    assert evaluated(folder / "killed", tmp_path / "out") == hashes
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["lost"]
    assert main(["repair", str(folder / "killed"), "--output", str(tmp_path / "mended")]) == 0
    with AnyReader([tmp_path / "mended"]) as reader:
        assert {c.topic for c in reader.connections} == {f"/sl/{t.name}" for t in OF_SCANS}


def test_a_replay_gives_the_live_bits(live: tuple[Path, list]) -> None:
    """Raw topics only, twice as fast, into fresh nodes that live in the recording's time."""
    folder, hashes = live
    with ros_graph() as nodes:
        nodes.add(SynchronizerNode, use_sim_time=True)
        reconstruct = nodes.add(ReconstructNode, use_sim_time=True)
        wait(lambda: reconstruct._ready, "the reconstruction", READY_PATIENCE_S)
        reports = nodes.collect(topics.REPORT)
        nodes.collect(topics.POINTS)  # else nothing is reconstructed
        bag, domain = str(folder / "whole"), f"{nodes.domain}"
        command = Command("replay", bag, "--rate", "2", "--domain", domain)
        assert command.end(patience_s=REPLAY_PATIENCE_S) == 0, command.text
        wait(lambda: len(reports) == SCANS, "the clouds", REPLAY_PATIENCE_S)
        assert [report.cloud_hash for report in reports] == hashes
    assert os.environ["ROS_DOMAIN_ID"] != domain
