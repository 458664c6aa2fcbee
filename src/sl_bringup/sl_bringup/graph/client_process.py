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


def add_client_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments that say which graph is meant."""
    parser.add_argument(
        "--namespace", type=lambda text: "/" + text.strip("/"), default=NAMESPACE,
        help="of the rig (default: /sl)",
    )  # fmt: skip
    parser.add_argument(
        "--domain", type=int, default=int(os.environ.get("ROS_DOMAIN_ID") or 0),
        help="ROS domain, 0 to 101 (default: ROS_DOMAIN_ID, else 0)",
    )  # fmt: skip
    parser.add_argument(
        "--network", action="store_true", help="open to other machines; else loopback only"
    )


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
