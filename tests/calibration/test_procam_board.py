"""Somebody else's rig, images and calibration: a chessboard of 75 mm squares at 3.2 to 3.6 m.

shared/data/README: with ``calibration.json`` a row of corners 600 mm long comes out as 600.02 to
601.10 mm and the board as flat as its decoding allows; ``wrong_calibration.xml`` does not fit.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from plyfile import PlyData

from sl_bringup.cli.main import main
from sl_reconstruct.cloud.plane_fit import fit_plane
from sl_reconstruct.model.calibration_file import load_rig
from sl_reconstruct.model.rig import Rig
from support.paths import DATA, EXAMPLES

BOARD = DATA / "procam_board"
EXAMPLE = EXAMPLES / "procam_board.yaml"
CORNERS = (9, 7)
ROW_MM = 8 * 75.0
#: Half a square of the board in the image (75 mm at 3.4 m with f = 3442 px are 76 px).
ABOUT_PX = 40.0

pytestmark = pytest.mark.skipif(not BOARD.is_dir(), reason=f"no data in {BOARD}")


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("board") / "bag"
    assert main(["import", str(BOARD), "--sequence", str(EXAMPLE), "--output", str(path)]) == 0
    return path


def evaluate(bag: Path, calibration: str) -> tuple[int, Path, list[dict]]:
    out = bag.parent / calibration
    arguments = ["--calibration", str(BOARD / calibration), "--output", str(out), "--no-pictures"]
    status = main(["evaluate", str(bag), *arguments])
    reports = [json.loads(p.read_text()) for p in sorted(out.glob("scan_*/report.json"))]
    if "median_gap_px" not in reports[0].get("figures", {"median_gap_px": 0}):
        pytest.skip("the reconstruction does not use row patterns yet")
    return status, out, reports


@pytest.fixture(scope="module")
def true(bag: Path) -> tuple[int, Path, list[dict]]:
    return evaluate(bag, "calibration.json")


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(BOARD / "calibration.json", (1280, 1024), (1024, 768))


def corners_px(capture: int) -> np.ndarray:
    """Chessboard corners (7, 9, 2) in the white frame of a capture."""
    image = cv2.imread(str(BOARD / f"capture_{capture}" / "graycode_40.png"), 0)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(image, CORNERS, flags=flags)
    assert found
    corners = cv2.cornerSubPix(image, corners, (9, 9), (-1, -1), (3, 60, 1e-4))
    return corners.reshape(CORNERS[1], CORNERS[0], 2).astype(float)


def points_m(out: Path, capture: int) -> np.ndarray:
    ply = PlyData.read(str(out / f"scan_{capture + 1:04d}" / "cloud.ply"))["vertex"]
    return np.stack([ply[name] for name in "xyz"], axis=-1).astype(float)


def plane_rms_m(points: np.ndarray) -> float:
    """Root mean square distance of all points from their best plane, none set aside."""
    centred = points - points.mean(axis=0)
    return float(np.sqrt(np.linalg.eigvalsh(centred.T @ centred)[0] / len(points)))


@pytest.mark.parametrize("capture", [0, 1, 2])
def test_board_is_flat(true: tuple[int, Path, list[dict]], rig: Rig, capture: int) -> None:
    grid = corners_px(capture)
    hull = np.array([grid[0, 0], grid[0, -1], grid[-1, -1], grid[-1, 0]], np.int32)
    inside = np.zeros((1024, 1280), np.uint8)
    cv2.fillConvexPoly(inside, hull, 1)
    points = points_m(true[1], capture)
    u, v = np.rint(rig.camera.project(points)).astype(int).T
    on_image = (u >= 0) & (u < 1280) & (v >= 0) & (v < 1024)
    board = points[on_image][inside[v[on_image], u[on_image]] == 1]
    assert len(board) > 10_000
    assert plane_rms_m(board) < 1.0e-3


@pytest.mark.parametrize("capture", [0, 1, 2])
def test_rows_of_corners_have_their_length(
    true: tuple[int, Path, list[dict]], rig: Rig, capture: int
) -> None:
    """Each corner is where its camera ray meets the plane of the points about it."""
    points = points_m(true[1], capture)
    seen = rig.camera.project(points)
    grid = corners_px(capture)
    corners = np.empty((*grid.shape[:2], 3))
    for index in np.ndindex(grid.shape[:2]):
        plane = fit_plane(points[np.hypot(*(seen - grid[index]).T) < ABOUT_PX])
        assert plane is not None
        assert plane.used > 200
        ray = rig.camera.rays(grid[index])
        corners[index] = ray * (plane.point_m @ plane.normal) / (ray @ plane.normal)
    lengths_mm = 1e3 * np.linalg.norm(corners[:, -1] - corners[:, 0], axis=-1)
    assert np.abs(lengths_mm - ROW_MM).max() < 1.5


def test_right_calibration_is_called_good(true: tuple[int, Path, list[dict]]) -> None:
    status, _, reports = true
    assert status == 0
    assert [r["good"] for r in reports] == [True] * 3


def test_wrong_calibration_is_not_called_good(bag: Path) -> None:
    status, _, reports = evaluate(bag, "wrong_calibration.xml")
    assert status == 1
    assert [r["good"] for r in reports] == [False] * 3
    assert all("calibration" in "; ".join(r["reasons"]) for r in reports)
