"""``slrig patterns``: a sequence's file and its frames as images, for any other projector."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

import cv2

from sl_bringup.graph.console import ProgressLine, say
from sl_common.documents import written_atomically
from sl_common.errors import SequenceError, SlError
from sl_projector.sequence.pattern_sequence import NAMED, Pattern, PatternSequence
from sl_projector.sequence.sequence_file import find_sequence, save_sequence


def dmd_size(text: str) -> tuple[int, int]:
    """Read ``1024x768`` as (columns, rows)."""
    found = re.fullmatch(r"(\d+)[xX](\d+)", text)
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} is no size; expected WxH such as 1024x768")
    return int(found[1]), int(found[2])


def frame_name(index: int, pattern: Pattern) -> str:
    """File name of a frame; the number comes first, so names sort in order of projection.

    Parameters
    ----------
    index : int
        Number of the pattern, from 0.
    pattern : Pattern
        Gives the rest of the name.
    """
    if pattern.kind != "gray":
        lit = (pattern.kind == "white") != pattern.inverted
        return f"{index:03d}_{'white' if lit else 'black'}.png"
    shift = f"_shift{pattern.shift_px}" if pattern.shift_px else ""
    inverse = "_inverse" if pattern.inverted else ""
    return f"{index:03d}_{pattern.axis}_bit{pattern.bit}{shift}{inverse}.png"


def write_patterns(sequence: PatternSequence, folder: Path) -> list[Path]:
    """Write ``sequence.yaml`` and one 8-bit PNG per pattern (0 or 255).

    Parameters
    ----------
    sequence : PatternSequence
        What to write.
    folder : Path
        Made when missing; frames of another sequence in it are refused.

    Returns
    -------
    list of Path
        The frames, in order.

    Raises
    ------
    SequenceError
        When the folder holds other images, which would be taken for frames.
    """
    names = [frame_name(i, p) for i, p in enumerate(sequence.patterns)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as exc:
        raise SequenceError(f"cannot write to {folder}: {exc.strerror or exc}") from None
    foreign = sorted(p.name for p in folder.glob("*.png") if p.name not in names)
    if foreign:
        raise SequenceError(
            f"{folder} already has {len(foreign)} other images ({foreign[0]}, ...); expected an "
            "empty folder"
        )
    with ProgressLine("writing", len(names), "frames") as progress:
        for index, name in enumerate(names):
            _write_frame(folder / name, sequence, index)
            progress.step()
    save_sequence(folder / "sequence.yaml", sequence, names)
    return [folder / name for name in names]


def _write_frame(path: Path, sequence: PatternSequence, index: int) -> None:
    with written_atomically(path) as partial:
        if not cv2.imwrite(str(partial), sequence.frame(index)):
            raise SlError(f"cannot write {path}")


def add_parser(subparsers: Any) -> None:
    """Register ``slrig patterns``."""
    parser = subparsers.add_parser(
        "patterns",
        description="Write a sequence's file (sequence.yaml) and its frames as PNG, numbered in "
        "order of projection, for use with any projector.",
        epilog="examples:\n"
        "  slrig patterns precise --output frames\n"
        "  slrig patterns paper-rows --output frames --dmd-size 1920x1080\n"
        "  slrig patterns examples/procam_board.yaml --output frames",
    )
    add = parser.add_argument
    add("sequence", metavar="NAME|FILE", help=f"{', '.join(sorted(NAMED))}, or a sequence file")
    add("--output", required=True, type=Path, metavar="DIR", help="folder for them")
    text = "DMD columns x rows of a built-in sequence (default 1024x768)"
    add("--dmd-size", type=dmd_size, metavar="WxH", help=text)


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig patterns``."""
    sequence = find_sequence(args.sequence, args.dmd_size).sequence
    frames = write_patterns(sequence, args.output)
    columns, rows = sequence.dmd_size
    say(f"{args.output}: {len(frames)} frames of {columns} x {rows} pixels, and sequence.yaml")
    return 0
