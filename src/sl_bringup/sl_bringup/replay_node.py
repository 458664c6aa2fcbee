"""The player: a recording's messages as they were, at their times, with ``/clock``."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence

import rclpy
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rosgraph_msgs.msg import Clock

from sl_bringup.bag.bags import Bag, Raw, open_bag
from sl_bringup.cli.main import parse
from sl_bringup.graph.console import StatusLine, complain, say
from sl_common.base_node import GraphNode
from sl_common.errors import BagError, SlError
from sl_common.messages import stamp_to_msg
from sl_common.topics import CALIBRATION, CLOCK, RAW_TOPICS, RECORDED_TOPICS, Topic

CLOCK_S, SHOW_S = 0.01, 1.0
#: Listeners of one process are discovered one after the other.
SETTLE_S = 0.5


class ReplayNode(GraphNode):
    """Publishes what a bag holds.

    Parameters
    ----------
    namespace : str
        Of the rig that shall hear it; the bag's may be another.
    topics : sequence of Topic
        What is published, as far as the bag has it.
    """

    def __init__(self, namespace: str, topics: Sequence[Topic]) -> None:
        super().__init__("player", namespace=namespace)
        self._clock_topic = self.advertise(CLOCK)
        self._to = {topic: self.advertise(topic) for topic in topics}
        self._calibrated = False
        self.listen(CALIBRATION, self._on_calibration)
        self.count = 0

    def _on_calibration(self, _: object) -> None:
        self._calibrated = True

    def await_listeners(self, patience_s: float) -> bool:
        """Wait until somebody listens to a topic that is no latched one."""
        end_s = time.monotonic() + patience_s
        while not any(p.get_subscription_count() for t, p in self._to.items() if not t.latched):
            if time.monotonic() >= end_s:
                return False
            rclpy.spin_once(self, timeout_sec=0.05)
        settled_s = time.monotonic() + min(SETTLE_S, patience_s)
        while (left_s := settled_s - time.monotonic()) > 0:
            rclpy.spin_once(self, timeout_sec=left_s)
        return True

    @property
    def calibrated(self) -> bool:
        """Whether the graph has a calibration of its own; ask before `play`."""
        return self._calibrated

    def play(self, messages: Iterator[Raw], rate: float) -> None:
        """Publish at the times of the recording.

        Parameters
        ----------
        messages : iterator of Raw
            In order of time.
        rate : float
            Speed; 1 is the recording's own.
        """
        status = StatusLine("replaying")
        begun: tuple[float, int] | None = None
        for message in messages:
            begun = begun or (time.monotonic(), message.received_ns)
            self._sleep_until(begun, message.received_ns, rate)
            self._to[message.topic].publish(bytes(message.data))
            self.count += 1
            status.show(f"{(message.received_ns - begun[1]) * 1e-9:.1f} s, {self.count} messages")

    def await_acknowledged(self, patience_s: float) -> bool:
        """Wait until every listener has everything; what was sent is lost when the sender ends."""
        end_s = time.monotonic() + patience_s
        return all(
            p.wait_for_all_acked(Duration(seconds=max(0.0, end_s - time.monotonic())))
            for p in self._to.values()
        )

    def _sleep_until(self, begun: tuple[float, int], due_ns: int, rate: float) -> None:
        """Let time pass until a message is due, and tell the time meanwhile."""
        due_s = begun[0] + (due_ns - begun[1]) * 1e-9 / rate
        while (left_s := due_s - time.monotonic()) > 0:
            self._tell_time(due_ns - int(left_s * rate * 1e9))
            time.sleep(min(left_s, CLOCK_S))
        self._tell_time(due_ns)

    def _tell_time(self, now_ns: int) -> None:
        self._clock_topic.publish(Clock(clock=stamp_to_msg(now_ns)))


def main(argv: Sequence[str] | None = None) -> int:
    """Play a bag; exit status 0 when all of it was there and reached its listeners."""
    args = parse(["replay", *(sys.argv[1:] if argv is None else argv)])
    try:
        with open_bag(args.bag) as bag:
            return _play(args, bag)
    except SlError as error:
        complain(f"slrig replay: {error}")
        return 1
    except (KeyboardInterrupt, ExternalShutdownException):
        return 130
    finally:
        rclpy.try_shutdown()


def _play(args: argparse.Namespace, bag: Bag) -> int:
    wanted = RECORDED_TOPICS if args.all else RAW_TOPICS
    topics = [topic for topic in wanted if bag.has(topic)]
    if not topics:
        raise BagError(f"{bag.path} has nothing to replay below {bag.namespace}")
    rclpy.init(args=[])
    node = ReplayNode(args.namespace, topics)
    heard = node.await_listeners(args.wait) if args.wait else True
    if not heard:
        complain("slrig replay: nobody listens; playing all the same")
    if node.calibrated and CALIBRATION in topics:
        topics.remove(CALIBRATION)
        say("the calibration of the graph stays in force; the recording's is not played")
    node.play(bag.raw(*topics), args.rate)
    reached = node.await_acknowledged(args.wait) if args.wait else True
    say(f"{node.count} messages of {len(topics)} topics")
    for line in bag.lost:
        complain(f"slrig replay: lost: {line}")
    if not reached:
        complain(f"slrig replay: not everything was acknowledged within {args.wait:g} s")
    return 0 if heard and reached and not bag.lost else 1


if __name__ == "__main__":
    raise SystemExit(main())
