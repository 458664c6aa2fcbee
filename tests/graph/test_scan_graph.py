"""Scans by the whole graph: from trigger to cloud, repeats, refusals, action and cancelling.

Real nodes in one process, drivers without devices, a private ROS domain.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from support import ros_graph

ros_graph.require_ros()

from sl_interfaces.action import Scan as ScanAction  # noqa: E402
from sl_interfaces.srv import Scan  # noqa: E402

from sl_camera.camera_node import CameraNode  # noqa: E402
from sl_camera.stage_node import StageNode  # noqa: E402
from sl_camera.synchronizer_node import SynchronizerNode  # noqa: E402
from sl_common import topics  # noqa: E402
from sl_reconstruct.cloud.cloud_writer import cloud_hash  # noqa: E402
from sl_reconstruct.messages import cloud_from_msg  # noqa: E402
from sl_reconstruct.model.calibration_file import rig_hash, save_calibration  # noqa: E402
from sl_reconstruct.reconstruct_node import ReconstructNode  # noqa: E402
from support.devices.fake_devices import FakeProjector, FakeStage, WiredPair  # noqa: E402
from support.patience import PATIENCE_S, patience, wait  # noqa: E402
from support.ros_graph import Graph  # noqa: E402
from support.scenes.rigs import tiny_rig  # noqa: E402
from support.tiny_graph import assert_plane, calibrated_by, frames, tiny_projector  # noqa: E402


class Rig:
    """The whole graph on drivers without devices."""

    def __init__(self, graph: Graph, calibration: Path) -> None:
        self.graph = graph
        self.pair = WiredPair(lambda sequence: frames(sequence.name))
        graph.add(tiny_projector, lambda: self.pair.projector, exposure_s=0.01)
        graph.add(CameraNode, lambda: self.pair.camera)
        graph.add(StageNode, FakeStage, pose_rate_hz=50.0)
        graph.add(SynchronizerNode, timeout_s=0.4)
        calibrated_by(graph, calibration)
        self.node = graph.add(ReconstructNode)
        self.clouds = graph.collect(topics.POINTS)
        wait(lambda: self.pair.camera.armed and self.pair.projector.opened, "the devices")
        wait(lambda: self.node.health().level == "ok", "the kernels", 200.0)

    def scan(self, max_repeats: int = 2, sequence: str = "precise") -> Scan.Response:
        self.clouds.clear()
        self.pair.runs = 0
        request = Scan.Request(sequence=sequence, max_repeats=max_repeats)
        return self.graph.call(topics.SCAN, request, 60.0)

    def expect_good(self, answer: Scan.Response) -> None:
        assert answer.success, answer.message
        cloud = wait(lambda: self.clouds and self.clouds[0], "the cloud")
        assert_plane(cloud)
        points = cloud_from_msg(cloud)
        report = answer.report
        assert report.points == np.isfinite(points["z"]).sum()
        assert report.points + sum(r.count for r in report.refused) == report.lit_positions
        assert (report.rows, report.columns) == points.shape
        assert report.cloud_hash == cloud_hash(points)
        assert report.calibration_hash == rig_hash(tiny_rig())
        assert report.median_sigma_m == pytest.approx(float(np.nanmedian(points["sigma"])))


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    save_calibration(path, tiny_rig())
    with ros_graph.graph() as graph:
        yield Rig(graph, path)


def test_a_scan_from_trigger_to_cloud(rig: Rig) -> None:
    answer = rig.scan()
    rig.expect_good(answer)
    assert (answer.report.attempts, answer.report.attempt_messages) == (1, [])


def test_a_dropped_frame_repeats_the_scan_and_is_told(rig: Rig) -> None:
    rig.pair.drop = {0: {5}}
    answer = rig.scan()
    rig.pair.drop = {}
    rig.expect_good(answer)
    assert answer.report.attempts == 2
    assert "image" in answer.report.attempt_messages[0]
    assert len(rig.clouds) == 1


def test_exchanged_content_never_becomes_a_cloud(rig: Rig) -> None:
    rig.pair.swap = {0: 4}
    answer = rig.scan()
    rig.pair.swap = {}
    rig.expect_good(answer)
    assert answer.report.attempts == 2
    assert len(rig.clouds) == 1


def test_a_doubled_trigger_repeats_the_scan(rig: Rig) -> None:
    rig.pair.twice = {0: {7}}
    answer = rig.scan()
    rig.pair.twice = {}
    rig.expect_good(answer)
    assert answer.report.attempts == 2
    assert "twice" in answer.report.attempt_messages[0]


@pytest.mark.parametrize("index", [0, 1, 3, 12])
def test_a_frame_that_is_white_all_over_never_becomes_wrong_points(rig: Rig, index: int) -> None:
    """White, black, a code and a fine pattern: refused, or the points that are left are right."""
    rig.pair.white = {0: index}
    answer = rig.scan(max_repeats=0)
    rig.pair.white = {}
    if answer.success:
        assert_plane(wait(lambda: rig.clouds and rig.clouds[0], "the cloud"))
    else:
        assert answer.message
    rig.expect_good(rig.scan())


def test_a_scan_that_is_always_spoilt_is_refused_with_its_reason(rig: Rig) -> None:
    rig.pair.drop = {run: {0} for run in range(9)}
    answer = rig.scan(max_repeats=1)
    rig.pair.drop = {}
    assert not answer.success
    assert "2 times" in answer.message
    assert len(answer.report.attempt_messages) == 1
    assert not rig.clouds
    rig.expect_good(rig.scan())


def test_unknown_sequences_and_bad_exposures_are_refused_at_once(rig: Rig) -> None:
    assert "no sequence is called 'nix'" in rig.scan(sequence="nix").message
    for exposure_s in (-1.0, math.nan, 1e9):
        request = Scan.Request(exposure_s=exposure_s)
        assert "exposure_s" in rig.graph.call(topics.SCAN, request).message


def test_the_action_tells_progress_and_a_second_scan_is_refused(rig: Rig) -> None:
    rig.clouds.clear()
    told: list[ScanAction.Feedback] = []
    client = rig.graph.tester.action_client(topics.SCAN_ACTION)
    assert client.wait_for_server(patience(PATIENCE_S))
    goal = ScanAction.Goal(sequence="precise", max_repeats=255)
    sent = client.send_goal_async(goal, lambda m: told.append(m.feedback))
    wait(sent.done, "the goal to be accepted")
    wait(lambda: told, "the first feedback")
    second = rig.graph.call(topics.SCAN, Scan.Request())
    assert not second.success
    assert "running already" in second.message
    result = sent.result().get_result_async()
    wait(result.done, "the scan's end")
    assert result.result().result.success
    assert {m.stage for m in told} >= {"match", "publish"}
    assert told[-1].progress == 1.0
    client.destroy()


def test_a_scan_can_be_cancelled_and_the_next_one_is_right(rig: Rig) -> None:
    client = rig.graph.tester.action_client(topics.SCAN_ACTION)
    assert client.wait_for_server(patience(PATIENCE_S))
    goal = ScanAction.Goal(sequence="precise", exposure_s=10.0, max_repeats=0)
    sent = client.send_goal_async(goal)
    wait(sent.done, "the goal to be accepted")
    time.sleep(0.1)
    result = sent.result().get_result_async()
    sent.result().cancel_goal_async()
    wait(result.done, "the cancelled scan's end")
    assert result.result().status == 5  # action_msgs/GoalStatus.STATUS_CANCELED
    assert not result.result().result.success
    client.destroy()
    wait(lambda: rig.scan(max_repeats=0).success, "the projector to be free", 20.0)


def test_a_graph_without_a_camera_says_so(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    save_calibration(path, tiny_rig())
    with ros_graph.graph() as graph:
        graph.add(tiny_projector, FakeProjector)
        calibrated_by(graph, path)
        graph.add(ReconstructNode, silence_timeout_s=1.0)
        answer = graph.call(topics.SCAN, Scan.Request())
        assert not answer.success
        assert "is the camera node running" in answer.message
