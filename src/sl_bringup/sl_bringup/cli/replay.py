"""``slrig replay``: publish a recording as the devices did, with its timing or faster."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from sl_bringup.graph.client_process import become_client
from sl_bringup.graph.graph_arguments import add_client_arguments, transport_of
from sl_common.errors import ConfigError

CLIENT = "sl_bringup.replay_node"


def add_parser(subparsers: Any) -> None:
    """Register ``slrig replay``."""
    parser = subparsers.add_parser(
        "replay",
        description="Publish triggers, images, poses and calibration of a recording with their "
        "timing, and the time on /clock. It begins when somebody listens. Nodes that are to live "
        "in the recording's time get use_sim_time. A calibration that is in force in the graph "
        "stays, and the recording's is not played. synchronizer and reconstruct make stacks and "
        "clouds of a replay as of a live scan; nobody asked for them by `slrig scan`, so "
        "reconstruct makes them only while somebody subscribes to reconstruct/points. Do not "
        "replay into a graph whose own devices run. The exit status is 0 only when the bag was "
        "complete and everything reached its listeners.",
        epilog="examples:\n"
        "  slrig replay bag\n"
        "  slrig replay bag --rate 4 --domain 7\n"
        "  slrig replay bag --all --wait 30",
    )
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="rosbag2 directory, .mcap or .db3")
    add("--rate", type=float, default=1.0, help="times as fast (default: 1)")
    add("--all", action="store_true", help="verdicts and reports as well, not only the devices'")
    text = (
        "longest wait for listeners at the start, and for their acknowledgements at the end; "
        "0: none (default: 10)"
    )
    add("--wait", type=float, default=10.0, metavar="S", help=text)
    add_client_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig replay``; the player takes this process's place."""
    if not 0.01 <= args.rate <= 1000:
        raise ConfigError(f"--rate {args.rate:g}; expected 0.01 to 1000")
    return become_client(CLIENT, args.words, transport_of(args), "camera")
