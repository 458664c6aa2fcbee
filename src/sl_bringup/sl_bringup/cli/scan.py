"""``slrig scan``: scan the part with the running graph, or with one started for it."""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from sl_bringup.cli.calibrate import calibrate_bench
from sl_bringup.graph.client_process import run_client
from sl_bringup.graph.graph import is_running
from sl_bringup.graph.graph_arguments import (
    add_graph_arguments,
    add_waiting_arguments,
    graph_options,
)
from sl_common.errors import ConfigError

CLIENT = "sl_bringup.scan_node"


def add_parser(subparsers: Any) -> None:
    """Register ``slrig scan``."""
    parser = subparsers.add_parser(
        "scan",
        description="Scan the part and write cloud.ply, cloud.pcd, height.tiff, height.png, "
        "pictures, report.json and report.html. The exit status is 0 only when the cloud is there.",
        epilog="examples:\n"
        "  slrig scan --output out\n"
        "  slrig scan --sequence paper --output out\n"
        "  slrig scan --up --bench --surface groove --measure groove --output out\n"
        "  slrig scan --up --bench --calibrate --output out",
    )
    add = parser.add_argument
    add("--output", required=True, type=Path, metavar="DIR", help="for the results")
    add("--sequence", default="", help="pattern sequence (default: the projector's)")
    add("--exposure", type=float, default=0.0, metavar="S", help="of each pattern, seconds")
    add("--repeats", type=int, metavar="N", help="repeat a spoilt scan up to N times")
    add("--measure", choices=["groove"], default="", help="measure a feature of the cloud")
    add("--no-pictures", action="store_true", help="neither pictures nor page")
    text = "with --up --bench: begin with an unknown rig and calibrate it on the hole plate"
    add("--calibrate", action="store_true", help=text)
    add_waiting_arguments(parser, 120.0)
    add_graph_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig scan``."""
    options = graph_options(args)
    if not args.calibrate:
        return run_client(CLIENT, args, options, args.output / "graph.log")
    if not (args.up and args.bench) or is_running(options.directory):
        raise ConfigError(
            "--calibrate exchanges the part, which only a bench started for it can; expected "
            "--up --bench and no running graph (on devices: put the plate on, slrig calibrate)"
        )
    options = replace(options, changes=replace(options.changes, uncalibrated=True))
    before = partial(calibrate_bench, options=options)
    return run_client(CLIENT, args, options, args.output / "graph.log", before)
