"""``slrig up``: start the node graph on one configuration file and supervise it."""

from __future__ import annotations

import argparse
import asyncio
import signal
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from sl_bringup.graph.client_process import add_domain_arguments, become_client
from sl_bringup.graph.console import INTERRUPTED, complain, say
from sl_bringup.graph.graph import Graph, GraphOptions, client_command, is_running
from sl_bringup.graph.graph_config import Changes
from sl_common.errors import ConfigError

_ResultT = TypeVar("_ResultT")


def add_graph_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments that say which graph is meant and how it is started."""
    add = parser.add_argument
    add("--bench", action="store_true", help="simulated bench, no hardware")
    add("--config", type=Path, metavar="FILE", help="ROS parameter file")
    add("--calibration", type=Path, metavar="FILE", help="calibration of the rig")
    add("--surface", default="", help="part on the bench (groove, coin, plate, ...)")
    add_domain_arguments(parser)
    text = "all that follows is passed on to every node"
    add("--ros-args", nargs=argparse.REMAINDER, default=[], metavar="...", help=text)


def add_client_options(parser: argparse.ArgumentParser, timeout_s: float) -> None:
    """Arguments of a command that asks the graph for something, and may start one for it.

    Parameters
    ----------
    parser : ArgumentParser
        Of the command.
    timeout_s : float
        How long the command takes at most by default, seconds.
    """
    add = parser.add_argument
    text = f"longest time for the work itself (default: {timeout_s:g})"
    add("--timeout", type=float, default=timeout_s, metavar="S", help=text)
    add("--up", action="store_true", help="start a graph for this where none is running")
    text = "with --up: for the graph to get ready, compiling apart (default: 240)"
    add("--ready-timeout", type=float, default=240.0, metavar="S", help=text)
    add("--verbose", action="store_true", help="with --up: show the graph's log")


def graph_options(args: argparse.Namespace) -> GraphOptions:
    """Options of the graph, from parsed arguments.

    Raises
    ------
    ConfigError
        When they contradict each other.
    """
    if args.surface and not args.bench:
        raise ConfigError("--surface is a part on the bench; expected --bench beside it")
    for file in (args.config, args.calibration):
        if file is not None and not file.is_file():
            raise ConfigError(f"no file {file}")
    ros_args = tuple(a for a in args.ros_args if a not in ("--ros-args", "--"))
    changes = Changes(args.calibration, args.surface, ros_args)
    return GraphOptions(args.bench, args.config, changes, args.domain, args.network)


async def until_signal(work: Awaitable[_ResultT]) -> _ResultT | None:
    """Await something until SIGINT or SIGTERM comes; it is cancelled then, and None returned."""
    loop = asyncio.get_running_loop()
    task = asyncio.ensure_future(work)
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, task.cancel)
    try:
        return await task
    except asyncio.CancelledError:
        return None
    finally:
        # From here on the stop is under way; another Ctrl-C must not leave processes behind.
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, lambda: None)


def run_client(
    client: str,
    args: argparse.Namespace,
    options: GraphOptions,
    log: Path,
    before: Callable[[Graph], Awaitable[int]] | None = None,
) -> int:
    """Run a client of the graph: of the running one, or with ``--up`` of one started for it.

    Parameters
    ----------
    client : str
        Module of the client, which parses the user's words again.
    args : Namespace
        Of a parser with `add_client_options`.
    options : GraphOptions
        Which graph is meant, and how it is started.
    log : Path
        For every line of a graph that is started.
    before : callable, optional
        Work that comes before the client when the graph is ready; a status other than 0 ends all.

    Returns
    -------
    int
        Exit status: 0 when the work went well and the graph ended cleanly, 130 after a signal.
    """
    if not args.up or is_running(options.directory):
        return become_client(client, args.words, options.transport)

    async def work(graph: Graph) -> int:
        if not await graph.ready(args.ready_timeout):
            return 1
        if before is not None and (status := await before(graph)):
            return status
        return await graph.run_client(client_command(client, *args.words))

    log.parent.mkdir(parents=True, exist_ok=True)
    say(f"starting the graph{' on the bench' if options.bench else ''} (log: {log})")
    with log.open("w") as file:

        def tell(line: str) -> None:
            file.write(line + "\n")
            if args.verbose:
                say(line)

        return asyncio.run(_with_graph(options, tell, work, args.command))


async def _with_graph(
    options: GraphOptions,
    tell: Callable[[str], object],
    work: Callable[[Graph], Awaitable[int]],
    command: str,
) -> int:
    """Start a graph, do something with it, stop it."""
    async with Graph(options, tell) as graph:
        status = await until_signal(work(graph))
    if status is None:
        return INTERRUPTED
    for reason in graph.supervisor.unclean:
        complain(f"slrig {command}: at the end, {reason}")
    return status or int(bool(graph.supervisor.unclean))


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
