"""``slrig record``: what an evaluation needs, from the running graph into a rosbag2."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

from sl_bringup.graph.client_process import become_client
from sl_bringup.graph.graph_arguments import add_client_arguments, transport_of
from sl_common.errors import ConfigError

CLIENT = "sl_bringup.record_node"
_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9}


def add_parser(subparsers: Any) -> None:
    """Register ``slrig record``."""
    parser = subparsers.add_parser(
        "record",
        description="Record triggers, images, poses, calibration, settings and results of the "
        "running graph until Ctrl-C, as rosbag2 (mcap). What is older than a second is safe even "
        "when the recorder is killed; `slrig repair` makes a complete recording of what it left. "
        "The exit status is 0 only when nothing was lost.",
        epilog="examples:\n"
        "  slrig record --output bag\n"
        "  slrig record --output bag --split 2GB\n"
        "  slrig record --output everything --all",
    )
    add = parser.add_argument
    add("--output", required=True, type=Path, metavar="BAG", help="bag to be made")
    text = "every topic, stacks and clouds included: 2.5 times as much"
    add("--all", action="store_true", help=text)
    add(
        "--split",
        default="0",
        metavar="SIZE",
        help="begin another file after this much: 500MB, 2GB",
    )
    text = (
        "images too (zstd): 10 %% smaller where all is lit, 40 %% where half is not, for 7 ms of a "
        "core per 2 MB; small messages always are"
    )
    add("--compress", action="store_true", help=text)
    add_client_arguments(parser)


#: Smaller files would hold one message or two each.
LEAST_SPLIT = 1_000_000


def size_bytes(words: str) -> int:
    """Bytes of ``500MB``, ``2GB``, ``1000000``.

    Raises
    ------
    ConfigError
        When it is no size.
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kmg]?)i?b?", words.strip().lower())
    if not found:
        raise ConfigError(f"{words!r} is no size; expected something like 500MB or 2GB")
    return int(float(found[1]) * _UNITS[found[2]])


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig record``; the recorder takes this process's place."""
    if 0 < (split := size_bytes(args.split)) < LEAST_SPLIT:
        raise ConfigError(f"--split {args.split} is {split} bytes; expected 1MB at least, or 0")
    return become_client(CLIENT, args.words, transport_of(args))
