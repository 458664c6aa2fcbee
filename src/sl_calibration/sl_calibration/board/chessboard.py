"""A chessboard in free poses under patterns: camera and projector without plate or stage.

Corners are the camera's points; the DMD coordinates there come from a homography between the
Gray codes about each corner and the camera's pixels (Moreno and Taubin, 3DIMPVT 2012): codes are
whole mirrors, hundreds of them average to some hundredths. A board that is not flat shows it
first where it leans most: corners off the model are left out, by the rule for holes, and named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_calibration.board.planar_target import (
    MIN_VIEWS,
    FreePair,
    FreeSolution,
    opencv_lens,
    solve_free_pair,
)
from sl_calibration.data.view_extraction import white_image
from sl_calibration.solve.linear_step import Sensor
from sl_common.errors import CalibrationError
from sl_projector.sequence.pattern_sequence import AXES, Axis, PatternSequence

Array = NDArray[np.float64]
Stack = NDArray[np.uint8] | NDArray[np.uint16]

#: Codes within this part of a square's side about a corner go into its homography.
PATCH_PART = 0.55
#: Step between the pixels of a patch that are looked at.
PATCH_STEP = 2
#: Distance in mirrors from which a code is wrong.
WRONG_CODE_PX = 2.0
#: White and black must differ by this part of the brightest difference where a code counts.
MIN_LIGHT = 0.08
MIN_CODES = 40
#: Corners beyond this many robust sigmas of either device are left out ...
OUTLIER_SIGMAS = 5.0
ROUNDS = 6
#: ... but not more than this part of all: then something else is wrong.
MAX_LEFT_OUT = 0.15


@dataclass(frozen=True)
class Board:
    """A chessboard: inner corners along both sides, and the side of a square in metres."""

    columns: int
    rows: int
    square_m: float

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or self.columns == self.rows or not self.square_m > 0:
            raise CalibrationError(
                f"board of {self.columns} x {self.rows} corners, square_m={self.square_m}; "
                "expected 3 or more, different along both sides, and a positive side"
            )

    @property
    def points_m(self) -> Array:
        """Corners (N, 2) on the board, row by row."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64) * self.square_m


@dataclass(frozen=True)
class BoardView:
    """Corners of the board in one view: ``camera_px`` and ``dmd_px``, (N, 2), in their order."""

    camera_px: Array
    dmd_px: Array


@dataclass(frozen=True)
class BoardSolution:
    """Rig from a board.

    Parameters
    ----------
    pair : FreePair
        The rig, from the corners that were used.
    used : ndarray, (V, N) bool
        Those corners.
    all_rms_px : float
        Stereo rms with every corner.
    """

    pair: FreePair
    used: NDArray[np.bool_]
    all_rms_px: float


def board_view(stack: Stack, sequence: PatternSequence, board: Board) -> BoardView:
    """Find the corners and the DMD coordinates there.

    Parameters
    ----------
    stack : ndarray, (V, H, W), uint8 or uint16
        Images in pattern order.
    sequence : PatternSequence
        Gray code of both axes, every pattern with its inverse.
    board : Board
        What to look for.

    Raises
    ------
    CalibrationError
        When the board is not seen whole, the sequence is another, or a corner is not lit.
    """
    white = white_image(stack, sequence)
    corners = _corners(white, board)
    dmd = np.stack([_decoded(stack, sequence, axis) for axis in AXES], axis=-1)
    dmd[_swing(stack, sequence) < MIN_LIGHT * white.max()] = np.nan
    grid = corners.reshape(board.rows, board.columns, 2)
    side = float(np.median(np.linalg.norm(np.diff(grid, axis=1), axis=-1)))
    reach = max(4, round(PATCH_PART * side))
    return BoardView(corners, np.array([_thrown(dmd, corner, reach) for corner in corners]))


def _corners(white: NDArray[np.float32], board: Board) -> Array:
    image = (255 * white / white.max()).clip(0, 255).astype(np.uint8)
    size = (board.columns, board.rows)
    found, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_ACCURACY)
    if not found:
        raise CalibrationError(
            f"no chessboard of {board.columns} x {board.rows} inner corners in the image; expected "
            "all of it in view, in focus and lit by the projector"
        )
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2)


def _pairs(sequence: PatternSequence, axis: Axis) -> list[tuple[int, int]]:
    """Index of each upright Gray pattern of an axis and of its inverse."""
    where = {p: i for i, p in enumerate(sequence.patterns) if p.kind == "gray" and p.axis == axis}
    pairs = [(i, where.get(p.inverse(), -1)) for p, i in where.items() if not p.inverted]
    if not pairs or min(j for _, j in pairs) < 0:
        raise CalibrationError(
            f"sequence {sequence.name!r} has no Gray code of the {axis}s in pairs; expected every "
            "pattern with its inverse, columns and rows"
        )
    return pairs


def _decoded(stack: Stack, sequence: PatternSequence, axis: Axis) -> Array:
    """DMD coordinate (H, W) of every pixel: the mean of those that show its word."""
    pairs = _pairs(sequence, axis)
    size = sequence.dmd_size[AXES.index(axis)]
    word = np.zeros(stack.shape[1:], dtype=np.int64)
    shown = np.zeros(size, dtype=np.int64)
    for bit, (upright, inverse) in enumerate(pairs):
        word += (stack[upright] > stack[inverse]).astype(np.int64) << bit
        shown += sequence.patterns[upright].profile(size).astype(np.int64) << bit
    count = np.bincount(shown, minlength=1 << len(pairs))
    total = np.bincount(shown, weights=np.arange(size), minlength=1 << len(pairs))
    with np.errstate(invalid="ignore"):
        return np.asarray((total / count)[word])


def _swing(stack: Stack, sequence: PatternSequence) -> NDArray[np.float32]:
    """Light that the coarsest pattern of the columns adds or takes, (H, W)."""
    upright, inverse = _pairs(sequence, "column")[0]
    swing: NDArray[np.float32] = np.abs(stack[upright].astype(np.float32) - stack[inverse])
    return swing


def _thrown(dmd: Array, corner: Array, reach: int) -> Array:
    """DMD coordinate (2,) at a corner."""
    (u, v), (height, width) = np.round(corner).astype(int), dmd.shape[:2]
    rows = np.arange(max(v - reach, 0), min(v + reach + 1, height), PATCH_STEP)
    columns = np.arange(max(u - reach, 0), min(u + reach + 1, width), PATCH_STEP)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
    codes = dmd[np.ix_(rows, columns)].reshape(-1, 2)
    good = np.isfinite(codes).all(axis=1)
    if good.sum() >= MIN_CODES:
        matrix, _ = cv2.findHomography(
            pixels[good] - corner, codes[good], cv2.RANSAC, WRONG_CODE_PX, maxIters=300
        )
        if matrix is not None:
            return np.asarray(matrix[:2, 2] / matrix[2, 2])
    raise CalibrationError(
        f"{int(good.sum())} pixels are decoded about the corner at ({u}, {v}); expected at least "
        f"{MIN_CODES}: does the projector light the whole board?"
    )


def solve_board(
    views: Sequence[BoardView], board: Board, sensors: tuple[Sensor, Sensor], coefficients: int = 2
) -> BoardSolution:
    """Calibrate camera and projector.

    Parameters
    ----------
    views : sequence of BoardView
        Three or more, the board leaning differently in each.
    board : Board
        The board.
    sensors : tuple of Sensor
        Camera's and projector's.
    coefficients : {0, 2, 4, 5}
        Of each lens, as in `planar_target.solve_free`.

    Raises
    ------
    CalibrationError
        When there are too few views, nothing fits, or too many corners are off.
    """
    if len(views) < MIN_VIEWS:
        raise CalibrationError(f"{len(views)} views of the board; expected at least {MIN_VIEWS}")

    def solved(used: NDArray[np.bool_]) -> FreePair:
        points = [board.points_m[rows] for rows in used]
        seen = [view.camera_px[rows] for view, rows in zip(views, used, strict=True)]
        thrown = [view.dmd_px[rows] for view, rows in zip(views, used, strict=True)]
        return solve_free_pair(points, seen, thrown, sensors, coefficients)

    used = np.ones((len(views), len(board.points_m)), dtype=bool)
    first = pair = solved(used)
    for _ in range(ROUNDS):
        keep = _near(pair.camera, [v.camera_px for v in views], board, used)
        keep &= _near(pair.projector, [v.dmd_px for v in views], board, used)
        if np.array_equal(keep, used):
            break
        used = keep
        if np.mean(~used) > MAX_LEFT_OUT:
            raise CalibrationError(
                f"{np.mean(~used):.0%} of the corners are off; expected at most "
                f"{MAX_LEFT_OUT:.0%}: is the board flat, and are its squares what was said?"
            )
        pair = solved(used)
    return BoardSolution(pair, used, first.rms_px)


def _near(
    solution: FreeSolution, pixels: Sequence[Array], board: Board, used: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Corners (V, N) that a device's model meets, its pose from the used ones."""
    device, points = solution.device, np.pad(board.points_m, ((0, 0), (0, 1)))
    lens = opencv_lens(device)
    off = np.empty(used.shape)
    for i, (seen, rows) in enumerate(zip(pixels, used, strict=True)):
        _, turn, shift = cv2.solvePnP(points[rows], seen[rows], *lens)
        expected = cv2.projectPoints(points, turn, shift, *lens)[0].reshape(-1, 2)
        off[i] = np.linalg.norm(seen - expected, axis=1)
    # |off| is Rayleigh distributed: its median is 1.18 sigma
    return np.asarray(off < OUTLIER_SIGMAS * np.median(off[used]) / 1.18)
