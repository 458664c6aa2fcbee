"""The stage node: moves within limits, alarms, a stage that is missing.

Real nodes in one process, drivers without devices, a private ROS domain.
"""

from __future__ import annotations

import math
import time

import pytest

from support import ros_graph

ros_graph.require_ros()

from geometry_msgs.msg import Point  # noqa: E402
from sl_interfaces.srv import MoveStage  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from sl_camera.stage_node import StageNode  # noqa: E402
from sl_common import topics  # noqa: E402
from sl_common.messages import stamp_from_msg  # noqa: E402
from support.devices.fake_devices import FakeStage  # noqa: E402
from support.patience import wait  # noqa: E402


def test_the_stage_moves_within_its_limits_and_tells_where_it_is() -> None:
    with ros_graph.graph() as graph:
        driver = FakeStage()
        node = graph.add(StageNode, lambda: driver, home_at_start=True)
        poses = graph.collect(topics.POSE)
        wait(lambda: poses, "a pose")
        assert driver.homed == 1

        def move(x_m: float, relative: bool = False) -> MoveStage.Response:
            request = MoveStage.Request(target=Point(x=x_m), relative=relative)
            return graph.call(topics.MOVE_STAGE, request)

        answer = move(0.004)
        assert answer.success
        assert answer.pose.pose.position.x == 0.004
        assert answer.pose.header.frame_id == "sl_world"
        assert move(0.001, relative=True).pose.pose.position.x == pytest.approx(0.005)
        for target in (1.0, math.nan, math.inf):
            refused = move(target)
            assert not refused.success
            assert "soft limit" in refused.message
        asked_ns = time.time_ns()
        later = wait(lambda: [p for p in poses if stamp_from_msg(p.header.stamp) > asked_ns], "one")
        assert later[0].pose.position.x == pytest.approx(0.005)
        driver.kind = "alarm"
        wait(lambda: node.health().level == "error", "the alarm")
        assert graph.call(topics.CLEAR_STAGE, Trigger.Request()).success
        wait(lambda: node.health().level == "ok", "the end of the alarm")


def test_a_stage_that_is_missing_is_told_and_found_when_it_comes() -> None:
    with ros_graph.graph() as graph:
        driver = FakeStage()
        driver.gone = True
        node = graph.add(StageNode, lambda: driver)
        refused = graph.call(topics.HOME_STAGE, Trigger.Request())
        assert not refused.success
        assert "not connected" in refused.message
        driver.gone = False
        wait(lambda: node.health().level == "ok", "the stage")
        driver.gone = True
        wait(lambda: node.health().level == "error", "the loss to be noticed")
        driver.gone = False
        wait(lambda: node.health().level == "ok", "the stage to be back")
