"""The projector node: triggers at their exposures, and a device that is missing, busy or faulty.

Real nodes in one process, drivers without devices, a private ROS domain.
"""

from __future__ import annotations

import math
import struct
import time
from pathlib import Path

import numpy as np
import pytest

from support import ros_graph

ros_graph.require_ros()

from sl_interfaces.msg import PatternTrigger  # noqa: E402
from sl_interfaces.srv import Project  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from sl_bench.dlpc.dlpc900_emulator import Dlpc900Emulator  # noqa: E402
from sl_bench.dlpc.usb_server import EmulatedUsb, UsbSocketServer  # noqa: E402
from sl_common import topics  # noqa: E402
from sl_common.errors import ConfigError, DeviceError  # noqa: E402
from sl_common.messages import stamp_from_msg  # noqa: E402
from sl_projector.projector_node import ProjectorNode  # noqa: E402
from support.devices.fake_devices import FakeProjector  # noqa: E402
from support.patience import wait  # noqa: E402
from support.ros_graph import Graph  # noqa: E402
from support.scenes.tiny_scans import tiny_sequence  # noqa: E402
from support.tiny_graph import tiny_projector  # noqa: E402


def project(graph: Graph, name: str = "paper", exposure_s: float = 0.004) -> Project.Response:
    request = Project.Request(sequence=name, exposure_s=exposure_s)
    return graph.call(topics.PROJECT, request)


def test_each_trigger_is_published_at_its_exposure_and_not_before(tmp_path: Path) -> None:
    outside = tmp_path / "outside.yaml"
    outside.write_text("- {kind: white}\n")
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside" / "mine.yaml").write_text(
        "format: 1\nname: mine\ndmd_size: [128, 96]\npatterns:\n- {kind: white}\n- {kind: black}\n"
    )
    arrived: list[tuple[int, PatternTrigger]] = []
    with ros_graph.graph() as graph:
        driver = FakeProjector()
        graph.add(tiny_projector, lambda: driver, sequence_dir=str(tmp_path / "inside"))
        graph.tester.listen(topics.TRIGGER, lambda m: arrived.append((time.time_ns(), m)))
        wait(lambda: driver.opened, "the projector")
        wait(lambda: graph.tester.count_publishers(topics.TRIGGER.name), "its triggers")
        assert project(graph, "mine").success
        answer = project(graph, "paper", 0.02)
        assert answer.success
        count = len(tiny_sequence("paper"))
        assert answer.count == count
        wait(lambda: len(arrived) == 2 + count, "all triggers")
        for name in ("../outside", "outside", "/etc/passwd", str(outside), "mine/../../outside"):
            refused = project(graph, name)
            assert (refused.success, refused.count) == (False, 0)
            assert "no sequence is called" in refused.message
    messages = [m for _, m in arrived[2:]]
    assert [m.index for m in messages] == list(range(count))
    assert {(m.scan_id, m.count, m.sequence) for m in messages} == {
        (answer.scan_id, count, "paper")
    }
    stamps = [stamp_from_msg(m.header.stamp) for m in messages]
    assert np.diff(stamps).tolist() == [20_000_000] * (count - 1)
    assert all(at_ns >= stamp for (at_ns, _), stamp in zip(arrived[2:], stamps, strict=True))


def test_a_projector_that_is_missing_is_told_and_found_when_it_comes() -> None:
    with ros_graph.graph() as graph:
        driver = FakeProjector()
        driver.gone = True
        node = graph.add(tiny_projector, lambda: driver)
        answer = project(graph)
        assert not answer.success
        assert "not connected" in answer.message
        assert node.health().level == "error"
        driver.gone = False
        wait(lambda: node.health().level == "ok", "the projector")
        assert project(graph).success
        driver.gone = True
        wait(lambda: node.health().level == "error", "the loss to be noticed")
        driver.gone = False
        wait(lambda: project(graph).success, "the projector to be back")
        driver.fault = DeviceError("sequencer abort")
        answer = project(graph)
        assert (answer.success, answer.message) == (False, "sequencer abort")
        driver.fault = None
        assert project(graph).success


def test_trigger_outputs_are_as_the_parameters_say(tmp_path: Path) -> None:
    dmd = Dlpc900Emulator()
    server = UsbSocketServer(str(tmp_path / "usb"), EmulatedUsb(dmd))
    with ros_graph.graph() as graph:
        node = graph.add(
            ProjectorNode, device=f"socket:{tmp_path}/usb",
            trigger_out_rising_delay_s=[1e-3, -20e-6], trigger_out_inverted=[True, False],
        )  # fmt: skip
        wait(lambda: node.health().level == "ok", "the projector")
        for command, inverted, rising_us in ((0x1A1D, 1, 1000), (0x1A1E, 0, -20)):
            (reply,) = dmd.receive(struct.pack("<BBHH", 0xC0, 1, 2, command))
            assert struct.unpack_from("<Bhh", reply, 4) == (inverted, rising_us, 0)
        with pytest.raises(ConfigError, match="two outputs"):
            graph.add(ProjectorNode, trigger_out_rising_delay_s=[0.0])
    server.close()


def test_a_busy_projector_refuses_and_stop_ends_what_it_shows() -> None:
    with ros_graph.graph() as graph:
        driver = FakeProjector()
        graph.add(tiny_projector, lambda: driver)
        wait(lambda: driver.opened, "the projector")
        request = Project.Request(sequence="paper", exposure_s=5.0)
        first = graph.call_async(topics.PROJECT, request)
        wait(lambda: driver._info, "the first projection")
        busy = project(graph)
        assert not busy.success
        assert "busy" in busy.message
        assert graph.call(topics.STOP_PROJECTOR, Trigger.Request()).success
        wait(first.done, "the first projection's end")
        assert not first.result().success
        assert project(graph).success
        for exposure_s in (-1.0, math.nan, 1e9):
            assert "exposure" in project(graph, exposure_s=exposure_s).message
