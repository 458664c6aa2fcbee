"""``slrig up``: start the node graph on one configuration file and supervise it."""

from __future__ import annotations

import argparse
import asyncio
from contextlib import suppress
from typing import Any

from sl_bringup.graph.client_process import until_signal
from sl_bringup.graph.console import complain, say
from sl_bringup.graph.graph import Graph, GraphOptions
from sl_bringup.graph.graph_arguments import add_graph_arguments, graph_options


async def supervise(options: GraphOptions) -> int:
    """Run a graph until a signal ends it; 0 when it had been ready and ended cleanly."""
    was_ready = False

    async def watch(graph: Graph) -> None:
        nonlocal was_ready
        was_ready = await graph.ready(timeout_s=0.0)
        if was_ready:
            say(f"graph ready (domain {options.domain}, {options.directory}); Ctrl-C ends it")
        await asyncio.Event().wait()

    async with Graph(options, say) as graph:
        with suppress(asyncio.CancelledError):
            await until_signal(watch(graph))
        say("stopping")
    for reason in graph.supervisor.unclean:
        complain(f"slrig up: {reason}")
    return 0 if was_ready and not graph.supervisor.unclean else 1


def add_parser(subparsers: Any) -> None:
    """Register ``slrig up``."""
    parser = subparsers.add_parser(
        "up",
        description="Start every node as a process of its own on one configuration file, restart "
        "one that dies, stop all on Ctrl-C. The exit status is 0 when the graph had been ready "
        "and everything ended cleanly.",
        epilog="examples:\n"
        "  slrig up --bench --surface coin\n"
        "  slrig up --config my_rig.yaml --calibration my_rig_calibration.yaml\n"
        "  slrig up --bench --domain 7 --ros-args --log-level debug",
    )
    add_graph_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig up``."""
    return asyncio.run(supervise(graph_options(args)))
