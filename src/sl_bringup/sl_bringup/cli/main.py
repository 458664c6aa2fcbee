"""The command line: ``slrig COMMAND``.

Each command is a module: ``add_parser(subparsers)`` says what it is and what it takes,
``run(args)`` carries it out and returns the exit status. Only the module of the command that is
asked for is imported, so help is instant and no offline command needs ROS.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import textwrap
from collections.abc import Sequence
from typing import Any

from sl_bringup.graph.console import INTERRUPTED, complain
from sl_common.errors import SlError

#: One line about each command.
COMMANDS = {
    "up": "start the node graph and supervise it",
    "scan": "scan the part: cloud, height map, pictures",
    "calibrate": "calibrate the rig on the hole plate, with a verdict",
    "board": "calibrate from images of a chessboard in any poses",
    "doctor": "say what is missing on this machine, and what to do",
    "patterns": "write a sequence's file and its frames as PNG",
    "import": "make a recording of a folder of images",
    "record": "record what an evaluation needs",
    "replay": "publish a recording as the devices did",
    "repair": "make a complete recording of what is readable",
    "evaluate": "recordings to clouds, reports and pictures",
    "measure": "measure a cloud: planes, angles, steps, roughness, ...",
}
_WIDTH = 80


class _Parser(argparse.ArgumentParser):
    """Parser that wraps its description and leaves its epilog, the examples, as it is."""

    def __init__(self, description: str = "", **options: Any) -> None:
        options.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(description=textwrap.fill(description, _WIDTH), **options)


def module_of(command: str) -> str:
    """Module that a command lives in."""
    return f"sl_bringup.cli.{'import_images' if command == 'import' else command}"


def build_parser(command: str | None = None) -> argparse.ArgumentParser:
    """Build the parser; with a command, only that command's module is imported."""
    overview = "\n".join(f"  {name:<10} {line}" for name, line in COMMANDS.items())
    parser = _Parser(
        prog="slrig",
        description="Structured-light surface metrology.",
        epilog=f"commands:\n{overview}\n\n'slrig COMMAND --help' explains a command.",
    )
    subparsers = parser.add_subparsers(
        dest="command", required=True, metavar="COMMAND", help="one of the commands below"
    )
    for name in COMMANDS:
        if command == name:
            module = importlib.import_module(module_of(name))
            module.add_parser(subparsers)
            subparsers.choices[name].set_defaults(run=module.run)
        else:
            # A place holder keeps the name known, so that a misspelt one is answered with all.
            subparsers.add_parser(name, add_help=False)
    return parser


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse a command line, ``COMMAND [OPTION ...]``.

    A command that is a ROS client replaces its process by the client, which parses the same words:
    they are in ``words``, without the command.
    """
    command = next((word for word in arguments if word in COMMANDS), None)
    args = build_parser(command).parse_args(arguments)
    args.words = tuple(arguments[1:])
    return args


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; the exit status is 0 only when all is well.

    An error of ours is one line on standard error and status 1; wrong usage is status 2.
    """
    try:
        args = parse(sys.argv[1:] if argv is None else argv)
        return int(args.run(args))
    except BrokenPipeError:
        return 1
    except (SlError, OSError) as exc:  # ours; a full disk, a folder that is not the user's
        complain(f"slrig: error: {exc}")
        return 1
    except KeyboardInterrupt:
        complain("slrig: interrupted")
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
