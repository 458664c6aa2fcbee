"""The synchronizer node: one stack per scan, or a refusal with its reason; then the next scan.

Real nodes in one process, drivers without devices, a private ROS domain.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from support import ros_graph

ros_graph.require_ros()

from geometry_msgs.msg import PoseStamped  # noqa: E402
from sensor_msgs.msg import Image  # noqa: E402
from sl_interfaces.msg import MatchedFrame, PatternTrigger  # noqa: E402

from sl_camera.synchronizer_node import SynchronizerNode  # noqa: E402
from sl_common import topics  # noqa: E402
from sl_common.messages import stamp_from_msg, stamp_to_msg  # noqa: E402
from sl_projector.sequence.messages import image_to_msg, pose_to_msg, trigger_to_msg  # noqa: E402
from sl_projector.sequence.stack import StagePose  # noqa: E402
from support.patience import wait  # noqa: E402
from support.ros_graph import Graph  # noqa: E402
from support.tiny_graph import HEIGHT, PERIOD_NS, SEQUENCE, WIDTH  # noqa: E402


class Feed:
    """Triggers, images and poses for a synchroniser, and what it says."""

    def __init__(self, graph: Graph) -> None:
        self.node = graph.add(SynchronizerNode, timeout_s=0.4, early_image_s=0.4)
        self.triggers = graph.publisher(topics.TRIGGER)
        self.images = graph.publisher(topics.IMAGE)
        self.poses = graph.publisher(topics.POSE)
        self.frames = graph.collect(topics.FRAME)
        self.stacks = graph.collect(topics.STACK)
        self.scan_id = 0
        self.clock_ns = time.time_ns()
        self.rng = np.random.default_rng(5)

    def scan(
        self,
        images: Callable[[list[Image]], list[Image]] = lambda x: x,
        triggers: Callable[[list[PatternTrigger]], list[PatternTrigger]] = lambda x: x,
        poses: Callable[[list[PoseStamped]], list[PoseStamped]] = lambda x: x,
    ) -> tuple[MatchedFrame, np.ndarray]:
        """Publish one scan, changed on the way, and wait for its verdict."""
        self.scan_id += 1
        self.frames.clear(), self.stacks.clear()
        # Scans are apart in time as real ones are, whatever the pace of the test.
        self.clock_ns += 2 * len(SEQUENCE) * PERIOD_NS
        start_ns = self.clock_ns
        stamps = [start_ns + i * PERIOD_NS for i in range(len(SEQUENCE))]
        pixels = self.rng.integers(0, 256, (len(SEQUENCE), HEIGHT, WIDTH), dtype=np.uint8)
        for message in poses([pose(start_ns - 1000), pose(stamps[-1] + PERIOD_NS)]):
            self.poses.publish(message)
        wanted = [
            trigger_to_msg(SEQUENCE, i, self.scan_id, stamp, 0.019)
            for i, stamp in enumerate(stamps)
        ]
        for message in triggers(wanted):
            self.triggers.publish(message)
        sent = [image_to_msg(p, s) for p, s in zip(pixels, stamps, strict=True)]
        for image in images(sent):
            self.images.publish(image)
        return wait(self.verdict, "a verdict of the synchronizer"), pixels

    def verdict(self) -> MatchedFrame | None:
        over = (MatchedFrame.STACK_COMPLETE, MatchedFrame.STACK_REFUSED)
        return next((f for f in list(self.frames) if f.status in over), None)


def pose(stamp_ns: int, x_m: float = 0.0) -> PoseStamped:
    return pose_to_msg(StagePose(stamp_ns, (x_m, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))


@pytest.fixture(scope="module")
def feed() -> Iterator[Feed]:
    with ros_graph.graph() as graph:
        yield Feed(graph)


def changed(index: int, **fields: object) -> Callable[[list[Image]], list[Image]]:
    """Change fields of one image."""

    def change(messages: list[Image]) -> list[Image]:
        for name, value in fields.items():
            setattr(messages[index], name, value)
        return messages

    return change


def shifted(messages: list[PatternTrigger]) -> list[PatternTrigger]:
    messages[2].pattern.bits = 0
    return messages


def test_a_good_scan_becomes_a_stack_of_the_same_bits(feed: Feed) -> None:
    verdict, pixels = feed.scan()
    assert verdict.status == MatchedFrame.STACK_COMPLETE
    stack = wait(lambda: feed.stacks and feed.stacks[0], "the stack")
    assert (stack.scan_id, stack.sequence) == (feed.scan_id, "precise")
    assert (stack.height, stack.width, stack.encoding) == (HEIGHT, WIDTH, "mono8")
    assert bytes(stack.data) == pixels.tobytes()
    assert [stamp_from_msg(s) for s in stack.stamps] == sorted(
        stamp_from_msg(s) for s in stack.stamps
    )
    assert stack.stage_pose.header.frame_id == "sl_world"


@pytest.mark.parametrize(
    ("part", "change", "word"),
    [
        ("images", changed(3, encoding="rgb8"), "encoding"),
        ("images", changed(3, width=WIDTH + 1), "bytes"),
        ("images", changed(3, data=b""), "0 bytes"),
        ("images", changed(3, data=bytes(3_000_000)), "3000000 bytes"),
        ("images", changed(3, height=2**32 - 1, width=2**32 - 1), "bytes"),
        ("images", lambda m: m[:3] + m[4:], "image"),
        ("images", lambda m: [*m[:3], m[4], m[3], *m[5:]], "order"),
        ("images", lambda m: m[:4] + m[3:], "twice"),
        ("images", lambda m: [], "image"),
        ("triggers", lambda m: m[:3] + m[4:], "trigger"),
        ("triggers", lambda m: m[:4] + m[3:], "twice"),
        ("triggers", shifted, "trigger"),
        ("poses", lambda m: [m[0], pose(stamp_from_msg(m[1].header.stamp), math.nan)], "number"),
        ("poses", lambda m: [m[0], pose(stamp_from_msg(m[1].header.stamp), 1e-3)], "moved"),
    ],
)
def test_a_spoilt_scan_is_refused_with_a_reason_and_the_next_one_is_right(
    feed: Feed, part: str, change: Callable[[list[object]], list[object]], word: str
) -> None:
    verdict, _ = feed.scan(**{part: change})  # type: ignore[arg-type]
    assert verdict.status == MatchedFrame.STACK_REFUSED
    reasons = " | ".join([verdict.reason, *(f.reason for f in feed.frames)])
    assert word in reasons
    assert not feed.stacks
    verdict, pixels = feed.scan()
    assert verdict.status == MatchedFrame.STACK_COMPLETE, verdict.reason
    stack = wait(lambda: feed.stacks and feed.stacks[0], "the stack")
    assert bytes(stack.data) == pixels.tobytes()


def test_another_makers_driver_serves_by_remapping_its_image() -> None:
    """A node of its own namespace and frame, best it can: stamps 3 ms late, rows padded."""
    from rclpy.node import Node

    with ros_graph.graph() as graph:
        graph.add(SynchronizerNode, timeout_s=0.4, require_pose=False)
        driver = Node(
            "pylon", namespace="maker", context=graph.context,
            cli_args=["--ros-args", "-r", "~/image_raw:=/sl/camera/image_raw"],
        )  # fmt: skip
        publisher = driver.create_publisher(Image, "~/image_raw", 30)
        assert publisher.topic_name == "/sl/camera/image_raw"
        stacks = graph.collect(topics.STACK)
        verdicts = graph.collect(topics.FRAME)
        triggers = graph.publisher(topics.TRIGGER)
        wait(publisher.get_subscription_count, "the synchroniser")
        pixels = np.random.default_rng(8).integers(0, 256, (len(SEQUENCE), 6, 7), np.uint8)

        def scan(scan_id: int, images: list[int]) -> None:
            start_ns = time.time_ns()
            for i in range(len(SEQUENCE)):
                stamp_ns = start_ns + i * PERIOD_NS
                triggers.publish(trigger_to_msg(SEQUENCE, i, scan_id, stamp_ns, 0.019))
            for i in images:
                padded = np.zeros((6, 10), np.uint8)
                padded[:, :7] = pixels[i]
                message = Image(height=6, width=7, step=10, encoding="mono8")
                message.data = padded.ravel().tobytes()
                message.header.stamp = stamp_to_msg(start_ns + i * PERIOD_NS + 3_000_000)
                message.header.frame_id = "pylon_camera"
                publisher.publish(message)

        scan(1, list(range(len(SEQUENCE))))
        stack = wait(lambda: stacks and stacks[0], "the stack")
        assert bytes(stack.data) == pixels.tobytes()
        scan(2, [0, 1, *range(3, len(SEQUENCE))])
        refused = (2, MatchedFrame.STACK_REFUSED)
        wait(lambda: [f for f in verdicts if (f.scan_id, f.status) == refused], "a refusal")
        assert len(stacks) == 1
        driver.destroy_node()
