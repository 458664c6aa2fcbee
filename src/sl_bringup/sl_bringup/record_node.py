"""The recorder: raw messages of the graph into a `BagRecorder`, without looking into them."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from sl_bringup.bag.bag_recorder import BagRecorder
from sl_bringup.bag.bag_writer import topic_qos
from sl_bringup.cli.main import parse
from sl_bringup.cli.record import size_bytes
from sl_bringup.graph.console import StatusLine, complain, say
from sl_bringup.graph.version import software_version
from sl_common.base_node import GraphNode, qos_profile
from sl_common.errors import BagError, SlError
from sl_common.messages import interface_class
from sl_common.topics import (
    EVALUATED_TOPICS,
    IMAGE,
    LARGE,
    POINTS,
    RECORDED_TOPICS,
    STACK,
    TRIGGER,
    Topic,
)

#: Messages that may wait while the disk does: two seconds of images at 100 Hz.
DEPTH = 256
#: Stacks and clouds, with ``--all``: each is 20 to 100 MB.
LARGE_TYPES = (STACK.msgtype, POINTS.msgtype)
FLUSH_S, LOOK_S, SHOW_S, SILENCE_S, SETTLE_S = 0.1, 0.5, 1.0, 5.0, 1.0
#: At the end, what has arrived already is still taken.
DRAIN_S = 0.3


class RecordNode(GraphNode):
    """Subscribes raw and writes.

    Parameters
    ----------
    namespace : str
        Of the rig.
    bag : BagRecorder
        Open; whoever opened it closes it.
    everything : bool
        All topics of the graph, not only those that an evaluation needs.
    """

    def __init__(self, namespace: str, bag: BagRecorder, everything: bool) -> None:
        super().__init__("recorder", namespace=namespace)
        self._bag = bag
        self._refused: set[str] = set()
        self._images, self._triggers = (f"{namespace}/{t.name}" for t in (IMAGE, TRIGGER))
        self._needed = [f"{namespace}/{topic.name}" for topic in EVALUATED_TOPICS]
        self.lost: Counter[str] = Counter()
        #: Why nothing can be written any more; empty while all is well.
        self.fault = ""
        for topic in RECORDED_TOPICS:
            self._subscribe(f"{namespace}/{topic.name}", topic)
        self.create_timer(FLUSH_S, self._flush)
        if everything:
            self.create_timer(LOOK_S, self._look)
            self._look()

    @property
    def images(self) -> int:
        """Images recorded."""
        return self._bag.counts[self._images]

    @property
    def triggers(self) -> int:
        """Triggers recorded."""
        return self._bag.counts[self._triggers]

    def told(self) -> str:
        """One line: what has been recorded."""
        count = sum(self._bag.counts.values())
        line = f"{count} messages, {self.images} images, {self._bag.size / 1e6:.1f} MB"
        return f"{line}, {sum(self.lost.values())} lost" if self.lost else line

    def silent(self) -> list[str]:
        """Topics without a publisher that an evaluation needs."""
        return [name for name in self._needed if not self.count_publishers(name)]

    def _subscribe(self, name: str, topic: Topic) -> None:
        kind = interface_class(topic.msgtype)
        self._bag.add_topic(name, topic.msgtype, topic_qos(topic))
        events = SubscriptionEventCallbacks(
            message_lost=lambda event: self._count_lost(name, event.total_count_change),
            incompatible_qos=lambda _: complain(f"slrig record: {name} offers an unfit QoS"),
        )
        write = partial(self._write, name)
        # Deep enough that the disk may pause.
        depth = LARGE if topic.msgtype in LARGE_TYPES else DEPTH
        qos = qos_profile(replace(topic, depth=depth))
        self.create_subscription(kind, name, write, qos, event_callbacks=events, raw=True)

    def _write(self, name: str, data: bytes, info: Mapping[str, int]) -> None:
        now_ns = time.time_ns()
        try:
            self._bag.write(
                name, info["received_timestamp"] or now_ns, info["source_timestamp"] or now_ns, data
            )
        except (OSError, SlError) as error:
            self._fail(error)

    def _flush(self) -> None:
        try:
            self._bag.tick()
        except OSError as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Nothing can be written any more: the disk is full, or gone."""
        self.fault = self.fault or str(error)

    def _count_lost(self, name: str, lost: int) -> None:
        self.lost[name] += lost

    def _look(self) -> None:
        """Subscribe to topics that appeared since; hidden ones are left out."""
        for name, kinds in self.get_topic_names_and_types():
            if name in self._bag.counts or name in self._refused or "/_" in name:
                continue
            try:
                latched, reliable = self._offered(name)
                if not reliable and not latched:
                    complain(f"slrig record: {name} is best effort; some of it may be lost")
                self._subscribe(name, Topic(name, kinds[0], latched=latched))
            except (BagError, ImportError, AttributeError) as error:
                self._refused.add(name)
                complain(f"slrig record: not recorded: {error}")

    def _offered(self, name: str) -> tuple[bool, bool]:
        """Whether all publishers are latched, and whether all are reliable."""
        profiles = [p.qos_profile for p in self.get_publishers_info_by_topic(name)]
        latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
        reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
        return bool(profiles) and latched, reliable


class _Stop:
    """Set by a signal. rclpy's own handlers would end the context with messages still in it."""

    def __init__(self) -> None:
        self.asked = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._ask)

    def _ask(self, *_: object) -> None:
        self.asked = True


def _spin(node: RecordNode, stop: _Stop, path: Path) -> None:
    """Record until a signal comes, or nothing can be written any more."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    _await_publishers(node, executor, stop)
    say(f"recording to {path}; Ctrl-C ends it")
    status = StatusLine("recording")
    show_s = 0.0
    while not (stop.asked or node.fault):
        executor.spin_once(timeout_sec=FLUSH_S)
        now_s = time.monotonic()
        if now_s >= show_s:
            show_s = now_s + SHOW_S
            status.show(node.told())
    end_s = time.monotonic() + DRAIN_S
    while time.monotonic() < end_s and not node.fault:
        executor.spin_once(timeout_sec=0.01)


def _await_publishers(node: RecordNode, executor: SingleThreadedExecutor, stop: _Stop) -> None:
    """Record on until all publishers are found, so that a scan that begins then is whole."""
    end_s = time.monotonic() + SILENCE_S
    while node.silent() and time.monotonic() < end_s and not stop.asked:
        executor.spin_once(timeout_sec=FLUSH_S)
    if silent := node.silent():
        complain(f"slrig record: nobody publishes {', '.join(silent)} yet")
        return
    settled_s = time.monotonic() + SETTLE_S  # they must find this subscriber as well
    while time.monotonic() < settled_s and not stop.asked:
        executor.spin_once(timeout_sec=FLUSH_S)


def _outcome(node: RecordNode, path: Path) -> Iterator[str]:
    """Say everything that is wrong with the recording."""
    if node.fault:
        yield f"stopped, for nothing can be written any more: {node.fault}"
    for name, lost in node.lost.items():
        yield f"{lost} messages of {name} were lost in transport"
    if not node.images:
        yield f"{path} has no image"


def main(argv: Sequence[str] | None = None) -> int:
    """Record until SIGINT or SIGTERM; exit status 0 when nothing was lost."""
    args = parse(["record", *(sys.argv[1:] if argv is None else argv)])
    custom = {"software": software_version(), "namespace": args.namespace}
    try:
        with BagRecorder(args.output, custom, size_bytes(args.split), args.compress) as bag:
            return _record(args, bag)
    except (SlError, OSError) as error:
        complain(f"slrig record: {error}")
        return 1


def _record(args: argparse.Namespace, bag: BagRecorder) -> int:
    stop = _Stop()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = RecordNode(args.namespace, bag, args.all)
    _spin(node, stop, args.output)
    faults = list(_outcome(node, args.output))
    say(f"{args.output}: {node.told()}")
    if node.images < node.triggers:
        complain(f"slrig record: note: {node.triggers} triggers, but {node.images} images came")
    for fault in faults:
        complain(f"slrig record: {fault}")
    node.destroy_node()
    rclpy.try_shutdown()
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
