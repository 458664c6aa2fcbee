"""``slrig board``: calibrate camera and projector from a recording of a chessboard."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sl_bringup.bag.bag_matching import decisions
from sl_bringup.bag.bags import open_bag
from sl_bringup.bag.recorded_settings import read_settings
from sl_bringup.graph.console import complain, say
from sl_camera.sync.match_events import Status
from sl_camera.sync.matching import StackMatcher
from sl_common.errors import CalibrationError, ConfigError
from sl_projector.sequence.stack import Stack


def add_parser(subparsers: Any) -> None:
    """Register ``slrig board``."""
    parser = subparsers.add_parser(
        "board",
        description="Calibrate camera and projector, without plate and stage, from a recording of "
        "Gray code (columns and rows, every pattern with its inverse) on a chessboard in three or "
        "more poses. The lenses are OpenCV's (k1, k2); the camera's frame is the world. Corners "
        "that the model does not meet, as on a board that is not flat, are left out and named.",
        epilog="example:\n"
        "  slrig import board --sequence examples/procam_board.yaml --output board_bag\n"
        "  slrig board board_bag --corners 9x7 --square-mm 75 --output rig.yaml\n"
        "  slrig evaluate board_bag --calibration rig.yaml --output results",
    )
    add = parser.add_argument
    add("bag", type=Path, metavar="BAG", help="rosbag2 directory, .mcap or .db3")
    add("--corners", required=True, type=_corners, metavar="CxR", help="inner corners, as 9x7")
    add("--square-mm", required=True, type=float, help="side of a square")
    add("--output", required=True, type=Path, metavar="FILE", help="calibration")
    text = "of each lens: none; k1, k2; with p1, p2; with k3 (default: 2)"
    add("--coefficients", type=int, choices=(0, 2, 4, 5), default=2, help=text)
    text = "pixel pitches; they only turn pixels into millimetres in reports (default: 5 10)"
    pair = ("CAMERA", "DMD")
    add("--pitch-um", type=float, nargs=2, default=(5.0, 10.0), metavar=pair, help=text)
    add("--namespace", help="namespace of the rig, where the bag has several")


def _corners(text: str) -> tuple[int, int]:
    columns, _, rows = text.partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r}; expected two numbers, as 9x7")
    return int(columns), int(rows)


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig board``."""
    # Imported late: OpenCV and the solver are slow to import, and help needs neither.
    from sl_calibration.board.chessboard import Board, board_view, solve_board
    from sl_calibration.solve.linear_step import Sensor
    from sl_reconstruct.model.calibration_file import Calibration, save_calibration

    if not (args.square_mm > 0 and min(args.pitch_um) > 0):
        raise ConfigError(f"--square-mm {args.square_mm}, --pitch-um {args.pitch_um}; expected > 0")
    board = Board(args.corners[0], args.corners[1], args.square_mm * 1e-3)
    views, names, sizes = [], [], ((0, 0), (0, 0))
    for stack in _stacks(args.bag, args.namespace):
        try:
            views.append(board_view(stack.images, stack.sequence, board))
        except CalibrationError as error:
            raise CalibrationError(f"scan {stack.scan_id}: {error}") from error
        names.append(stack.scan_id)
        sizes = (stack.image_size, stack.sequence.dmd_size)
        say(f"scan {stack.scan_id}: {len(views[-1].camera_px)} corners")
    camera, dmd = (Sensor(size, p * 1e-6) for size, p in zip(sizes, args.pitch_um, strict=True))
    solution = solve_board(views, board, (camera, dmd), args.coefficients)
    pair = solution.pair
    residuals = {"stereo_rms_px": pair.rms_px, "stereo_rms_all_corners_px": solution.all_rms_px}
    made_from = {"bag": args.bag.name, "corners": list(args.corners), "square_m": board.square_m}
    save_calibration(args.output, Calibration(pair.rig, None, residuals, made_from))
    for scan, used in zip(names, solution.used, strict=True):
        rows, columns = divmod((~used).nonzero()[0], args.corners[0])
        if off := ", ".join(f"({c}, {r})" for c, r in zip(columns, rows, strict=True)):
            say(f"scan {scan}: left out, off the model: corners (column, row) {off}")
    say(
        f"stereo rms {pair.rms_px:.3f} px ({solution.all_rms_px:.3f} with every corner), camera "
        f"{pair.camera.rms_px:.3f} px, projector {pair.projector.rms_px:.3f} px: {args.output}"
    )
    return 0


def _stacks(path: Path, namespace: str | None) -> Iterator[Stack]:
    """Yield the complete stacks of a recording; their memory is used again afterwards."""
    with open_bag(path, namespace) as bag:
        matcher = StackMatcher(read_settings(bag).matching)
        for decision in decisions(bag, matcher):
            if decision.status == Status.STACK_REFUSED:
                complain(f"slrig board: scan {decision.scan_id} is left out: {decision.reason}")
            if decision.status == Status.STACK_COMPLETE and decision.stack is not None:
                yield decision.stack
                matcher.recycle(decision.stack)
        for line in bag.lost:
            complain(f"slrig board: lost: {line}")
