"""``slrig repair``: what can be read of a damaged recording, copied into a complete one."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, ConnectionExtRosbag2, Qos

from sl_bringup.bag.bag_recorder import BagRecorder
from sl_bringup.bag.bag_writer import topic_qos
from sl_bringup.bag.bags import Bag, open_bag
from sl_bringup.graph.console import StatusLine, complain, say
from sl_bringup.graph.version import software_version
from sl_common.errors import BagError
from sl_common.topics import Topic


def add_parser(subparsers: Any) -> None:
    """Register ``slrig repair``."""
    parser = subparsers.add_parser(
        "repair",
        description="Copy everything that can be read of a recording, whose recorder was killed "
        "or whose files are damaged, into a new one, which any reader of rosbag2 takes. The old "
        "one is not touched. `slrig evaluate` needs no repair: it reads what is there. The exit "
        "status is 0 when the new recording is written, whatever the old one had lost.",
        epilog="example:\n  slrig repair killed_bag --output whole_bag",
    )
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="rosbag2 directory, .mcap or .db3")
    add("--output", required=True, type=Path, metavar="BAG", help="bag to be made")


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig repair``."""
    with open_bag(args.bag, "") as bag:
        if args.output.exists():
            raise BagError(f"{args.output} exists already; expected a name that is free")
        messages = repair(bag, args.output)
    say(f"{args.output}: {messages} messages")
    for line in bag.notes:
        complain(f"slrig repair: note: {line}")
    for line in bag.lost:
        complain(f"slrig repair: lost: {line}")
    return 0


def repair(bag: Bag, output: Path) -> int:
    """Copy what is readable of a bag; what cannot be copied is added to ``bag.lost``.

    Parameters
    ----------
    bag : Bag
        Open.
    output : Path
        The new directory.

    Returns
    -------
    int
        Messages copied.

    Raises
    ------
    BagError
        When nothing can be read, or the new bag cannot be written.
    """
    messages = bag.everything()
    first = next(messages, None)
    if first is None:
        raise BagError(
            f"{bag.path} has no readable message: {'; '.join(bag.lost) or 'it is empty'}"
        )
    custom = {"software": software_version(), "repaired_from": bag.path.resolve().name}
    status, count = StatusLine("copying"), 0
    with BagRecorder(output, custom) as new:
        for connection, received_ns, data in _known(bag, new, chain([first], messages)):
            new.write(connection.topic, received_ns, received_ns, bytes(data))
            new.tick()
            count += 1
            status.show(f"{count} messages, {new.size / 1e6:.1f} MB")
    return count


_Packet = tuple[Connection, int, bytes | memoryview]


def _known(bag: Bag, new: BagRecorder, messages: Iterator[_Packet]) -> Iterator[_Packet]:
    """Messages of topics whose type is known; each topic is announced to the new bag first."""
    refused: set[str] = set()
    for packet in messages:
        connection = packet[0]
        if connection.topic in refused:
            continue
        if connection.topic not in new.counts:
            try:
                new.add_topic(connection.topic, connection.msgtype, _qos(connection))
            except BagError as error:
                refused.add(connection.topic)
                bag.lose(str(error))
                continue
        yield packet


def _qos(connection: Connection) -> Qos:
    """As recorded; a depth that would lose the end of a burst on replay becomes ours."""
    ext = connection.ext
    offered = ext.offered_qos_profiles if isinstance(ext, ConnectionExtRosbag2) else []
    latched = any(qos.durability.name == "TRANSIENT_LOCAL" for qos in offered)
    if offered and offered[0].depth:
        return offered[0]
    return topic_qos(Topic(connection.topic, connection.msgtype, latched))
