"""Commands that are ROS nodes themselves: they take the place of the process that was started.

Signals then reach them directly, and the middleware finds its environment from the first
instruction on.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from sl_bringup.graph.graph_config import runtime_directory
from sl_bringup.graph.transport import Transport, process_environment
from sl_common.topics import NAMESPACE


def add_domain_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments that say where a graph can be reached."""
    domain = int(os.environ.get("ROS_DOMAIN_ID") or 0)
    text = "ROS domain, 0 to 101 (default: ROS_DOMAIN_ID, else 0)"
    parser.add_argument("--domain", type=int, default=domain, help=text)
    text = "open to other machines; else loopback only"
    parser.add_argument("--network", action="store_true", help=text)


def add_client_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments that say which graph is meant."""
    parser.add_argument(
        "--namespace", type=_namespace, default=NAMESPACE, help="of the rig (default: /sl)"
    )
    add_domain_arguments(parser)


def _namespace(text: str) -> str:
    return "/" + text.strip("/")


def transport_of(args: argparse.Namespace) -> Transport:
    """Transport of the graph that parsed arguments mean."""
    return Transport(runtime_directory(args.domain), args.domain, args.network)


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
