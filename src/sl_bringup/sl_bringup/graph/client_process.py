"""Commands that are clients of the graph, as ROS nodes in a process of their own.

Where the graph runs already, a client takes the place of the process that was started: signals then
reach it directly, and the middleware finds its environment from the first instruction on.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import signal
import sys
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import NoReturn, TypeVar

from sl_bringup.graph.console import INTERRUPTED, complain, say
from sl_bringup.graph.graph import Graph, GraphOptions, client_command, is_running
from sl_bringup.graph.transport import Transport, process_environment

_ResultT = TypeVar("_ResultT")


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
        Of a parser with `add_waiting_arguments`.
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


def become_client(
    module: str, words: Sequence[str], transport: Transport, segment: str = ""
) -> NoReturn:
    """Replace this process by a client of the graph.

    Parameters
    ----------
    module : str
        With `main`, which parses the words as `sl_bringup.cli.main.parse` does.
    words : sequence of str
        The command's options.
    transport : Transport
        Of the graph.
    segment : str
        Node whose shared memory the client needs, where it publishes large messages.
    """
    environment = process_environment(transport.environment(segment))
    sys.stdout.flush()
    os.execve(sys.executable, [sys.executable, "-m", module, *words], environment)
