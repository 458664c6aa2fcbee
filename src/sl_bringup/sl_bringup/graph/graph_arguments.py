"""Arguments of commands that say which graph is meant, how it is started, and how long to wait."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from sl_bringup.graph.graph import GraphOptions
from sl_bringup.graph.graph_config import Changes, runtime_directory
from sl_bringup.graph.transport import Transport
from sl_common.errors import ConfigError
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


def add_waiting_arguments(parser: argparse.ArgumentParser, timeout_s: float) -> None:
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
