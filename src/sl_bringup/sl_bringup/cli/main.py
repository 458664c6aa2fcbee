"""The command line: ``slrig COMMAND``.

Each command lives in a module of its own with ``add_parser(subparsers)``, which sets ``run`` to a
function of the parsed arguments that returns the exit status. Only the module of the command that
is asked for is imported, so help is instant and no offline command needs ROS.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from typing import Any

from sl_bringup.graph.console import complain
from sl_common.errors import SlError

#: Command, module with its ``add_parser``, and one line for the overview.
COMMANDS: tuple[tuple[str, str, str], ...] = (
    ("up", "sl_bringup.cli.up", "start the node graph and supervise it"),
    ("scan", "sl_bringup.cli.scan", "scan the part: cloud, height map, pictures"),
    (
        "calibrate",
        "sl_bringup.cli.calibrate",
        "calibrate the rig on the hole plate, with a verdict",
    ),
    ("board", "sl_bringup.cli.board", "calibrate from a chessboard held anyhow"),
    ("doctor", "sl_bringup.cli.doctor", "say what is missing on this machine, and what to do"),
    ("patterns", "sl_bringup.cli.patterns", "write a sequence's file and its frames as PNG"),
    ("import", "sl_bringup.cli.import_images", "make a recording of a folder of images"),
    ("record", "sl_bringup.cli.record", "record what an evaluation needs"),
    ("replay", "sl_bringup.cli.replay", "publish a recording as the devices did"),
    ("repair", "sl_bringup.cli.repair", "make a whole recording of what is readable"),
    ("evaluate", "sl_bringup.cli.evaluate", "recordings to clouds, reports and pictures"),
    ("measure", "sl_bringup.cli.measure", "measure a cloud: planes, angles, steps, roughness, ..."),
)

OVERVIEW = "\n".join(f"  {name:<10} {line}" for name, _, line in COMMANDS)


def build_parser(command: str | None = None) -> argparse.ArgumentParser:
    """Build the parser; with a command, only that command's module is imported."""
    parser = argparse.ArgumentParser(
        prog="slrig",
        description="Structured-light surface metrology.",
        epilog=f"commands:\n{OVERVIEW}\n\n'slrig COMMAND --help' explains a command.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    subparsers = parser.add_subparsers(
        dest="command", required=True, metavar="COMMAND", help="one of the commands below"
    )
    for name, module, _ in COMMANDS:
        if command == name:
            importlib.import_module(module).add_parser(subparsers)
        else:
            # A place holder keeps the name known, so that a misspelt one is answered with all.
            _add_placeholder(subparsers, name)
    return parser


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse a command line, ``COMMAND [OPTION ...]``.

    A command that is a ROS client replaces its process by the client, which parses the same words:
    they are in ``words``, without the command.
    """
    known = {name for name, _, _ in COMMANDS}
    command = next((word for word in arguments if word in known), None)
    args = build_parser(command).parse_args(arguments)
    args.words = tuple(arguments[1:])
    return args


def _add_placeholder(subparsers: Any, name: str) -> None:
    subparsers.add_parser(name, add_help=False)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; the exit status is 0 only when all is well.

    An error of ours is one line on standard error and status 1; wrong usage is status 2.
    """
    try:
        args = parse(sys.argv[1:] if argv is None else argv)
        return int(args.run(args))
    except SlError as exc:
        complain(f"slrig: error: {exc}")
        return 1
    except KeyboardInterrupt:
        complain("slrig: interrupted")
        return 130
    except BrokenPipeError:
        return 1
    except OSError as exc:  # a full disk, a folder that is not ours
        complain(f"slrig: error: {exc}")
        return 1


if __name__ == "__main__":
    sys.exit(main())
