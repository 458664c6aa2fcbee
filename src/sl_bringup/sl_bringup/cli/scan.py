"""``slrig scan``: scan the part with the running graph, or with one started for it."""

from __future__ import annotations

import argparse
import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

from sl_bringup.cli.calibrate import calibrate_bench
from sl_bringup.cli.up import add_graph_arguments, graph_options, run_once
from sl_bringup.graph.client_process import become_client
from sl_bringup.graph.console import say
from sl_bringup.graph.graph import Graph, GraphOptions, client_command, is_running
from sl_common.errors import ConfigError

CLIENT = "sl_bringup.scan_node"


def add_parser(subparsers: Any) -> None:
    """Register ``slrig scan``."""
    parser = subparsers.add_parser(
        "scan",
        help="scan the part: cloud, height map, pictures",
        description="Scan the part and write cloud.ply, cloud.pcd, height.tiff, height.png, "
        "pictures, report.json and report.html. The exit status is 0 only when the cloud is there.",
        epilog="examples:\n"
        "  slrig scan --output out\n"
        "  slrig scan --sequence paper --output out\n"
        "  slrig scan --up --bench --surface groove --measure groove --output out\n"
        "  slrig scan --up --bench --calibrate --output out",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--output", required=True, type=Path, metavar="DIR", help="for the results")
    parser.add_argument(
        "--sequence", default="", help="pattern sequence (default: the projector's)"
    )
    parser.add_argument(
        "--exposure", type=float, default=0.0, metavar="S", help="of each pattern, seconds"
    )
    parser.add_argument("--repeats", type=int, metavar="N", help="repeat a spoilt scan so often")
    parser.add_argument(
        "--measure", choices=["groove"], default="", help="measure a feature of the cloud"
    )
    parser.add_argument("--no-pictures", action="store_true", help="neither pictures nor page")
    parser.add_argument(
        "--timeout", type=float, default=120.0, metavar="S", help="for the scan (default: 120)"
    )
    parser.add_argument(
        "--up", action="store_true", help="start the graph for this scan where none is running"
    )
    parser.add_argument(
        "--calibrate",
        action="store_true",
        help="with --up --bench: begin with an unknown rig and calibrate it on the hole plate",
    )
    parser.add_argument(
        "--ready-timeout",
        type=float,
        default=240.0,
        metavar="S",
        help="with --up: for the graph to get ready, compiling apart (default: 240)",
    )
    parser.add_argument("--verbose", action="store_true", help="with --up: show the graph's log")
    add_graph_arguments(parser)
    parser.set_defaults(run=run)


async def scan_once(args: argparse.Namespace, options: GraphOptions) -> int:
    """Start a graph, calibrate where it is to, scan, stop it; 0 only when all went well.

    Parameters
    ----------
    args : Namespace
        The command line.
    options : GraphOptions
        Domain, namespace and configuration.
    """
    log: Path = args.output / "graph.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as file:

        def tell(line: str) -> None:
            file.write(line + "\n")
            if args.verbose:
                say(line)

        async def work(graph: Graph) -> int:
            if not await graph.ready(args.ready_timeout):
                return 1
            if options.changes.uncalibrated and (status := await calibrate_bench(graph, options)):
                return status
            return await graph.run_client(client_command(CLIENT, *args.words))

        say(f"starting the graph{' on the bench' if options.bench else ''} (log: {log})")
        return await run_once(options, tell, work, "scan")


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig scan``."""
    options = graph_options(args)
    if args.calibrate:
        if not (args.up and args.bench) or is_running(options.directory):
            raise ConfigError(
                "--calibrate exchanges the part, which only a bench started for it can; expected "
                "--up --bench and no running graph (on devices: put the plate on, slrig calibrate)"
            )
        options = replace(options, changes=replace(options.changes, uncalibrated=True))
    if args.up and not is_running(options.directory):
        return asyncio.run(scan_once(args, options))
    return become_client(CLIENT, args.words, options.transport)
