"""The reconstruct node against bad stacks and calibrations: a reason each, then the right cloud.

Real nodes in one process, drivers without devices, a private ROS domain.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from support import ros_graph

ros_graph.require_ros()

from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sl_interfaces.msg import Pattern as PatternMsg  # noqa: E402
from sl_interfaces.msg import PatternStack, RigCalibration  # noqa: E402
from sl_interfaces.srv import Measure  # noqa: E402

from sl_common import topics  # noqa: E402
from sl_common.errors import StackError  # noqa: E402
from sl_common.messages import stamp_to_msg  # noqa: E402
from sl_projector.sequence.messages import stack_to_msg  # noqa: E402
from sl_projector.sequence.stack import Stack, StagePose  # noqa: E402
from sl_reconstruct.cloud.refusals import REFUSALS, Reason  # noqa: E402
from sl_reconstruct.messages import cloud_from_msg, refusals_from_msg  # noqa: E402
from sl_reconstruct.model.calibration_file import dump_calibration, rig_hash, save_calibration  # noqa: E402
from sl_reconstruct.reconstruct_node import ReconstructNode  # noqa: E402
from support.patience import wait  # noqa: E402
from support.ros_graph import Graph  # noqa: E402
from support.scenes.rigs import tiny_rig  # noqa: E402
from support.scenes.tiny_scans import SLOPE, tiny_sequence  # noqa: E402
from support.tiny_graph import (  # noqa: E402
    PERIOD_NS,
    PLANE_TOLERANCE_M,
    assert_plane,
    calibrated_by,
    frames,
    set_parameters,
)


def stack_message(name: str = "precise", scan_id: int = 1) -> PatternStack:
    """A good stack of the tiny plane."""
    sequence = tiny_sequence(name)
    start_ns = time.time_ns()
    stamps = tuple(start_ns + i * PERIOD_NS for i in range(len(sequence)))
    still = StagePose(start_ns, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    stack = Stack(frames(name), sequence, scan_id, stamps, 0.019, still)
    return stack_to_msg(stack)


class Works:
    """A reconstruction node with the tiny rig's calibration, and what it publishes."""

    def __init__(self, graph: Graph, calibration: Path) -> None:
        self.graph = graph
        self.owner = calibrated_by(graph, calibration)
        self.node = graph.add(ReconstructNode)
        self.stacks = graph.publisher(topics.STACK)
        self.clouds = graph.collect(topics.POINTS)
        self.refusals = graph.collect(topics.REFUSALS)
        self.reports = graph.collect(topics.REPORT)
        wait(lambda: self.node.health().level == "ok", "the kernels", 200.0)

    def refused(self) -> int:
        return int(sum(n for what, n in self.node.counts.items() if "refused" in what))

    def expect_refusal(self, message: PatternStack, word: str) -> None:
        before = self.refused()
        self.stacks.publish(message)
        wait(lambda: self.refused() > before, "a refusal")
        assert word in self.node.last_error

    def expect_plane(self) -> None:
        self.clouds.clear()
        self.stacks.publish(stack_message())
        assert_plane(wait(lambda: self.clouds and self.clouds[0], "the cloud", 60.0))


@pytest.fixture(scope="module")
def works(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Works]:
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    save_calibration(path, tiny_rig())
    with ros_graph.graph() as graph:
        yield Works(graph, path)


def with_fields(**fields: object) -> PatternStack:
    message = stack_message()
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def exchanged() -> PatternStack:
    """Two images with each other's content, as no time stamp betrays."""
    message = stack_message()
    images = frames("precise").copy()
    images[[4, 5]] = images[[5, 4]]
    message.data = images.tobytes()
    return message


def disordered() -> PatternStack:
    message = stack_message()
    message.stamps[3] = message.stamps[2]
    return message


def test_a_stack_that_nobody_asked_for_becomes_a_cloud(works: Works) -> None:
    works.expect_plane()


def test_every_position_without_a_point_has_its_reason(works: Works) -> None:
    works.refusals.clear()
    works.reports.clear()
    works.expect_plane()
    image = wait(lambda: works.refusals and works.refusals[0], "the refusals")
    report = wait(lambda: works.reports and works.reports[0], "the report")
    cloud, codes = works.clouds[0], refusals_from_msg(image)
    assert image.header.stamp == cloud.header.stamp
    np.testing.assert_array_equal(codes == 0, np.isfinite(cloud_from_msg(cloud)["z"]))
    counted = {REFUSALS[Reason(code)]: np.count_nonzero(codes == code) for code in range(2, 12)}
    assert counted == {item.reason: item.count for item in report.refused}
    assert report.points + sum(counted.values()) == report.lit_positions
    image.height += 1
    with pytest.raises(StackError, match="121 x 128 with 15360 bytes"):
        refusals_from_msg(image)


def test_the_last_cloud_can_be_measured(works: Works) -> None:
    works.expect_plane()
    answer = works.graph.call(topics.MEASURE, Measure.Request(kind="plane"))
    assert answer.success, answer.message
    slope = dict(zip(answer.names, answer.values, strict=True))["a"]
    # Over 5 mm and more a tilt shifts the border by the plane's tolerance.
    assert slope == pytest.approx(SLOPE, abs=PLANE_TOLERANCE_M / 2.5e-3)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (PatternStack, "dmd_size"),
        (lambda: with_fields(data=b""), "0 bytes"),
        (lambda: with_fields(data=bytes(5_000_000)), "5000000 bytes"),
        (lambda: with_fields(encoding="rgb8"), "rgb8"),
        (lambda: with_fields(encoding="mono16"), "bytes"),
        (lambda: with_fields(width=2**32 - 1, height=2**32 - 1), "bytes"),
        (lambda: with_fields(width=160, height=240), "expected"),
        (lambda: with_fields(dmd_columns=1024, dmd_rows=768), "1024"),
        (lambda: with_fields(dmd_columns=0), "dmd_size"),
        (lambda: with_fields(patterns=[PatternMsg(kind="sine")]), "sine"),
        (lambda: with_fields(stamps=[]), "0 stamps"),
        (disordered, "stamps"),
        (exchanged, "image"),
        (lambda: with_fields(data=bytes(frames("precise").size)), "no points"),
    ],
)
def test_a_bad_stack_is_refused_with_a_word_and_the_next_one_is_right(
    works: Works, make: Callable[[], PatternStack], word: str
) -> None:
    works.expect_refusal(make(), word)
    works.expect_plane()


def set_calibration(works: Works, path: Path) -> tuple[bool, str]:
    request = SetParameters.Request(
        parameters=[Parameter("calibration_file", value=str(path)).to_parameter_msg()]
    )
    answer = works.graph.call(set_parameters("calibration"), request)
    return answer.results[0].successful, answer.results[0].reason


def test_a_calibration_cut_in_half_is_refused_and_the_old_one_stays(
    works: Works, tmp_path: Path
) -> None:
    text = dump_calibration(tiny_rig())
    half = tmp_path / "half.yaml"
    half.write_text(text[: len(text) // 2])
    before = works.node.health().values["calibration"]
    successful, reason = set_calibration(works, half)
    assert not successful
    assert "half.yaml" in reason
    assert works.node.health().values["calibration"] == before == rig_hash(tiny_rig())
    assert works.owner.health().values["calibration"] == before
    works.expect_plane()


def test_the_calibration_in_force_is_latched_for_who_comes_late(works: Works) -> None:
    found = works.graph.collect(topics.CALIBRATION)
    message = wait(lambda: found and found[0], "the latched calibration")
    assert works.graph.tester.count_publishers(topics.CALIBRATION.name) == 1
    assert message.hash == rig_hash(tiny_rig())
    assert (message.camera.width, message.camera.height) == (320, 120)
    assert message.projector.header.frame_id == "sl_projector_optical"
    assert list(message.camera.k[:3]) == [2400.0, 0.0, 159.5]


def test_a_false_calibration_message_changes_nothing(works: Works) -> None:
    rigs = works.graph.publisher(topics.CALIBRATION)
    for yaml in ("", "format: 1\ncamera: [", dump_calibration(tiny_rig())):
        before = works.refused()
        message = RigCalibration(hash="0" * 64, source="test", yaml=yaml)
        message.header.stamp = stamp_to_msg(time.time_ns())
        rigs.publish(message)
        wait(lambda b=before: works.refused() > b, "a refusal")
    works.graph.tester.destroy_publisher(rigs)
    works.expect_plane()


def test_without_a_calibration_a_node_says_so_until_its_file_is_there(tmp_path: Path) -> None:
    path = tmp_path / "later.yaml"
    path.write_text(dump_calibration(tiny_rig())[:500])
    with ros_graph.graph() as graph:
        owner = calibrated_by(graph, path)
        node = graph.add(ReconstructNode)
        stacks = graph.publisher(topics.STACK)
        clouds = graph.collect(topics.POINTS)
        stacks.publish(stack_message())
        wait(lambda: node.counts["synchronizer/stack refused"], "a refusal", 60.0)
        assert node.health().level == "warn"
        assert owner.health().level == "error"
        assert "later.yaml" in owner.health().message
        save_calibration(path, tiny_rig())
        wait(lambda: node.health().values["calibration"], "the calibration")
        stacks.publish(stack_message())
        assert_plane(wait(lambda: clouds and clouds[0], "the cloud", 60.0))
        assert node.health().level == "ok"
