"""A chessboard under Gray code: corners and mirrors against closed forms, and foreign captures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sl_bringup.cli.main import main
from sl_calibration.board.chessboard import Board, BoardView, board_view, solve_board
from sl_calibration.solve.linear_step import Sensor
from sl_calibration.solve.ray_midpoints import triangulate
from sl_common.errors import CalibrationError
from sl_projector.sequence.pattern_sequence import AXES, Pattern, PatternSequence, named
from sl_projector.sequence.sequence_file import load_sequence
from sl_reconstruct.model.calibration_file import load_rig
from sl_reconstruct.model.rig import BrownConrady, Device
from support.paths import DATA, EXAMPLES

PROCAM = DATA / "procam_board"
EXAMPLE = EXAMPLES / "procam_board.yaml"

BOARD = Board(7, 5, 0.02)
NO_LENS = BrownConrady((0.0, 0.0, 0.0, 0.0, 0.0))
TURN = cv2.Rodrigues(np.array([0.02, 0.25, 0.01]))[0]
EYE = Device((480, 360), (900.0, 900.0), (240.0, 180.0), 5e-6, np.eye(3), np.zeros(3), NO_LENS)
LAMP = Device((320, 256), (650.0, 650.0), (160.0, 130.0), 1e-5, TURN,
              np.array([-0.12, 0.0, 0.03]), NO_LENS)  # fmt: skip


LEAN = (0.2, -0.15, 0.03)


def paired(size: tuple[int, int] = (320, 256), division: int = 1) -> PatternSequence:
    """Gray code of both axes in pairs, white and black."""
    patterns = [Pattern("white"), Pattern("black")]
    for axis in AXES:
        for bit in range(9):
            p = Pattern("gray", axis, bit, 9, division)
            patterns += [p, p.inverse()]
    return PatternSequence("pairs", size, tuple(patterns))


def pose(turn: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    middle = np.append(BOARD.points_m.mean(axis=0), 0.0)
    rotation = cv2.Rodrigues(np.array(turn))[0]
    return rotation, np.array([0.0, 0.0, 0.55]) - rotation @ middle


def drawn(rotation: np.ndarray, shift: np.ndarray, sequence: PatternSequence) -> np.ndarray:
    """Stack (N, H, W): ray, board, mirror and square at 2 x 2 points of each pixel."""
    u, v = ((np.arange(2 * n) + 0.5) / 2 - 0.5 for n in EYE.image_size)
    rays = EYE.rays(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    points = rays * ((shift @ rotation[:, 2]) / (rays @ rotation[:, 2]))[:, None]
    squares = np.floor(((points - shift) @ rotation)[:, :2] / BOARD.square_m).astype(int)
    albedo = np.where(squares.sum(axis=1) % 2 == 0, 0.9, 0.15)
    # white beyond the outermost squares: the board's border
    albedo[np.any((squares < -1) | (squares >= [BOARD.columns, BOARD.rows]), axis=1)] = 0.9
    columns, rows = np.rint(LAMP.project(points)).astype(int).T
    inside = (columns >= 0) & (rows >= 0) & (columns < 320) & (rows < 256)
    assert inside.mean() > 0.8
    columns, rows = columns.clip(0, 319), rows.clip(0, 255)
    rng, shape = np.random.default_rng(3), (EYE.image_size[1], 2, EYE.image_size[0], 2)
    stack = []
    for i in range(len(sequence)):
        light = sequence.frame(i)[rows, columns] / 255 * inside
        fine = (10 + 200 * albedo * light).reshape(shape).mean(axis=(1, 3))
        image = cv2.GaussianBlur(fine, (0, 0), 0.7) + rng.normal(0, 1, fine.shape)
        stack.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return np.array(stack)


@pytest.fixture(scope="module")
def scene() -> tuple[np.ndarray, np.ndarray]:
    """A stack, and the corners (N, 3) in the camera's frame."""
    rotation, shift = pose(LEAN)
    corners = np.pad(BOARD.points_m, ((0, 0), (0, 1))) @ rotation.T + shift
    return drawn(rotation, shift, paired()), corners


def test_corners_and_mirrors_are_where_they_are(scene) -> None:  # type: ignore[no-untyped-def]
    """Corners are OpenCV's, to some tenths; mirrors are asked for at the pixels that were found.

    Hundreds of codes of whole mirrors (uniform: 0.29 px) about a corner leave 0.02 px; the light's
    edges on dark squares and the half-lit pixels between two codes a little more.
    """
    stack, corners = scene
    view = board_view(stack, paired(), BOARD)
    seen = EYE.project(corners)
    if np.linalg.norm(view.camera_px[0] - seen[0]) > 5:  # found from the other end
        seen = seen[::-1]
    assert np.sqrt(np.mean((view.camera_px - seen) ** 2)) < 0.1
    rotation, shift = pose(LEAN)
    rays = EYE.rays(view.camera_px)
    points = rays * ((shift @ rotation[:, 2]) / (rays @ rotation[:, 2]))[:, None]
    off = view.dmd_px - LAMP.project(points)
    assert np.sqrt(np.mean(off**2)) < 0.04
    assert np.abs(off.mean(axis=0)).max() < 0.02


def test_divisions_of_several_mirrors_are_decoded_to_their_middle(scene) -> None:  # type: ignore[no-untyped-def]
    stack, _ = scene
    sequence = paired()
    fine = board_view(stack, sequence, BOARD)
    kept = [i for i, p in enumerate(sequence.patterns) if p.kind != "gray" or p.bit < 7]
    coarse = PatternSequence("coarse", (320, 256), tuple(sequence.patterns[i] for i in kept))
    view = board_view(stack[kept], coarse, BOARD)
    # codes of 4 mirrors: uniform, 1.2 px, over the root of the few divisions in a patch
    assert np.sqrt(np.mean((view.dmd_px - fine.dmd_px) ** 2)) < 0.4
    assert np.abs(np.mean(view.dmd_px - fine.dmd_px)) < 0.1


def test_what_is_no_board_is_refused(scene) -> None:  # type: ignore[no-untyped-def]
    stack, _ = scene
    with pytest.raises(CalibrationError, match="no chessboard of 9 x 4"):
        board_view(stack, paired(), Board(9, 4, 0.02))
    single = named("paper-rows", (320, 256))
    with pytest.raises(CalibrationError, match=r"white nor a pattern|in pairs"):
        board_view(stack[: len(single)], single, BOARD)
    with pytest.raises(CalibrationError, match="different along both sides"):
        Board(5, 5, 0.02)
    with pytest.raises(CalibrationError, match="decoded about the corner"):
        dark = stack.copy()
        dark[2:20] = dark[1]  # no light changes with the columns' patterns
        board_view(dark, paired(), BOARD)


SENSORS = (Sensor(EYE.image_size, 5e-6), Sensor(LAMP.image_size, 1e-5))
TURNS = [(0.4, 0.1, 0.0), (-0.4, 0.2, 0.1), (0.1, 0.5, -0.1), (0.1, -0.5, 0.2), (0.3, -0.3, 0.0)]


def ideal(seed: int, bend_m: float = 0.0) -> list[BoardView]:
    """Views with 0.03 px of noise; the board's last corner may stand up."""
    rng = np.random.default_rng(seed)
    flat = np.pad(BOARD.points_m, ((0, 0), (0, 1)))
    flat[-1, 2] = bend_m
    views = []
    for turn in TURNS:
        rotation, shift = pose(turn)
        points = flat @ rotation.T + shift
        noise = 0.03 * rng.standard_normal((2, len(flat), 2))
        views.append(BoardView(EYE.project(points) + noise[0], LAMP.project(points) + noise[1]))
    return views


def test_a_flat_board_keeps_all_corners() -> None:
    solution = solve_board(ideal(1), BOARD, SENSORS)
    # Rayleigh: 5 sigma of 350 lengths in six rounds is passed by less than one in a thousand
    assert solution.used.all()
    assert solution.pair.rms_px == pytest.approx(0.03 * np.sqrt(2), rel=0.15)
    assert solution.all_rms_px == solution.pair.rms_px


def test_a_bent_corner_is_left_out_and_the_rest_is_right() -> None:
    """2 mm, seen at up to 0.5 rad, are some pixels."""
    solution = solve_board(ideal(2, bend_m=2e-3), BOARD, SENSORS)
    assert not solution.used[:, -1].any()
    assert solution.used[:, :-1].mean() > 0.99
    assert solution.pair.rms_px == pytest.approx(0.03 * np.sqrt(2), rel=0.15)
    assert solution.all_rms_px > 3 * solution.pair.rms_px
    assert solution.pair.rig.projector.translation_m == pytest.approx(LAMP.translation_m, abs=2e-3)


def test_nonsense_is_refused() -> None:
    with pytest.raises(CalibrationError, match="2 views of the board; expected at least 3"):
        solve_board(ideal(3)[:2], BOARD, SENSORS)
    views = ideal(3)
    rng = np.random.default_rng(4)
    for view in views:
        bad = rng.random(len(view.dmd_px)) < 0.3
        view.dmd_px[bad] += rng.uniform(3, 9, (int(bad.sum()), 2))
    with pytest.raises(CalibrationError, match="of the corners are off"):
        solve_board(views, BOARD, SENSORS)


@pytest.mark.skipif(not PROCAM.is_dir(), reason="no ../shared/data/procam_board beside the project")
def test_foreign_captures_calibrate_by_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At most 0.30 px with every corner (the issue; the data's README: 0.266), and 600 mm rows.

    The board's lower left part stands off its plane: left out there, the rest is met to 0.11 px.
    """
    bag, output = tmp_path / "bag", tmp_path / "rig.yaml"
    assert main(["import", str(PROCAM), "--sequence", str(EXAMPLE), "--output", str(bag)]) == 0
    arguments = ["--corners", "9x7", "--square-mm", "75", "--output", str(output)]
    assert main(["board", str(bag), *arguments]) == 0
    told = capsys.readouterr().out
    assert "scan 2: left out, off the model: corners (column, row) (0, 5)" in told
    words = told.splitlines()[-1].split()
    assert float(words[2]) < 0.15
    assert float(words[4].strip("(")) <= 0.30
    rig, published = load_rig(output), load_rig(PROCAM / "calibration.json", (1280, 1024),
                                                (1024, 768))  # fmt: skip
    for found, true in ((rig.camera, published.camera), (rig.projector, published.projector)):
        assert found.focal_length_px[0] == pytest.approx(true.focal_length_px[0], rel=0.01)
    # the first five rows are used in all views: 600 mm each, and the noise of both devices
    for capture in range(3):
        files = sorted((PROCAM / f"capture_{capture}").glob("*.png"))
        stack = np.stack([cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files])
        view = board_view(stack, load_sequence(EXAMPLE), Board(9, 7, 0.075))
        points = triangulate(rig, view.camera_px, view.dmd_px)[0].reshape(7, 9, 3)
        lengths_m = np.linalg.norm(points[:5, -1] - points[:5, 0], axis=1)
        assert lengths_m == pytest.approx(0.6, abs=1e-3)
