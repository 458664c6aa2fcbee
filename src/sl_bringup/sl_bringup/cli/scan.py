"""``slrig scan``: scan the part with the running graph, or with one started for it."""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from sl_bringup.cli.calibrate import calibrate_bench
from sl_bringup.cli.up import add_graph_arguments, graph_options, until_signal
from sl_bringup.graph.console import complain, say
from sl_bringup.graph.graph import Graph, GraphOptions, exec_client, is_running
from sl_common.errors import ConfigError

CLIENT = "sl_bringup.scan_node"
INTERRUPTED = 130


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
        "--calibrate", action="store_true",
        help="with --up --bench: begin with an unknown rig and calibrate it on the hole plate",
    )  # fmt: skip
    parser.add_argument(
        "--ready-timeout", type=float, default=240.0, metavar="S",
        help="with --up: for the graph to get ready, compiling apart (default: 240)",
    )  # fmt: skip
    parser.add_argument("--verbose", action="store_true", help="with --up: show the graph's log")
    add_graph_arguments(parser)
    parser.set_defaults(run=run)


def client_arguments(args: argparse.Namespace) -> list[str]:
    """Arguments of the ROS client."""
    words = ["--output", str(args.output), "--timeout", f"{args.timeout}"]
    words += ["--exposure", f"{args.exposure}"]
    for name in ("sequence", "measure"):
        if value := getattr(args, name):
            words += [f"--{name}", value]
    if args.repeats is not None:
        words += ["--repeats", f"{args.repeats}"]
    return [*words, "--no-pictures"] if args.no_pictures else words


async def scan_once(
    options: GraphOptions, client: Sequence[str], ready_timeout_s: float, log: Path, verbose: bool
) -> int:
    """Start a graph, calibrate where it is to, scan, stop it; 0 only when all went well."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as file:

        def tell(line: str) -> None:
            file.write(line + "\n")
            if verbose:
                say(line)

        async def work(graph: Graph) -> int:
            if not await graph.ready(ready_timeout_s):
                return 1
            if options.changes.uncalibrated and (status := await calibrate_bench(graph, options)):
                return status
            return await graph.run_client(CLIENT, *client)

        say(f"starting the graph{' on the bench' if options.bench else ''} (log: {log})")
        async with Graph(options, tell) as graph:
            status = await until_signal(work(graph))
    if status is None:
        return INTERRUPTED
    for reason in graph.supervisor.unclean:
        complain(f"slrig scan: at the end, {reason}")
    return status or int(bool(graph.supervisor.unclean))


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig scan``."""
    options = graph_options(args)
    client = client_arguments(args)
    if args.calibrate:
        if not (args.up and args.bench) or is_running(options.directory):
            raise ConfigError(
                "--calibrate exchanges the part, which only a bench started for it can; expected "
                "--up --bench and no running graph (on devices: put the plate on, slrig calibrate)"
            )
        options = replace(options, changes=replace(options.changes, uncalibrated=True))
    if args.up and not is_running(options.directory):
        log = args.output / "graph.log"
        return asyncio.run(scan_once(options, client, args.ready_timeout, log, args.verbose))
    return exec_client(CLIENT, options, *client)
