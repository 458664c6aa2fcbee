"""Clouds and height maps on disk, read back by foreign readers or by their specification."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from plyfile import PlyData

from sl_common.errors import StackError
from sl_reconstruct.cloud.cloud_writer import POINT_FIELDS, save_pcd, save_ply
from sl_reconstruct.cloud.height_map import (
    HeightMap,
    make_height_map,
    save_png,
    save_tiff,
    typical_spacing_m,
)

TYPE = np.dtype([(name, "<f4") for name in POINT_FIELDS])
ROWS, COLUMNS = 40, 60
SPACING_X, SPACING_Y = 12e-6, 8e-6


def tilted(missing: bool = True) -> np.ndarray:
    """An organised cloud on the plane z = 0.1 x - 0.05 y, y falling with the row."""
    row, column = np.mgrid[0:ROWS, 0:COLUMNS]
    cloud = np.zeros((ROWS, COLUMNS), TYPE)
    cloud["x"] = (column - COLUMNS / 2) * SPACING_X + row * 1e-7
    cloud["y"] = (ROWS / 2 - row) * SPACING_Y
    cloud["z"] = 0.1 * cloud["x"] - 0.05 * cloud["y"]
    cloud["intensity"] = row
    cloud["sigma"] = 1e-7 * (1 + column)
    if missing:
        for name in POINT_FIELDS:
            cloud[name][10:15, 20:30] = np.nan
    return cloud


def parse_pcd(path: Path) -> tuple[dict[str, str], np.ndarray]:
    """Read a PCD file as its specification says, independently of our writer."""
    content = path.read_bytes()
    head, _, body = content.partition(b"DATA binary\n")
    fields = dict(
        line.split(" ", 1) for line in head.decode().splitlines() if not line.startswith("#")
    )
    assert fields["SIZE"] == "4 4 4 4 4"
    assert fields["TYPE"] == "F F F F F"
    assert fields["COUNT"] == "1 1 1 1 1"
    dtype = np.dtype([(name, "<f4") for name in fields["FIELDS"].split()])
    assert len(body) == int(fields["POINTS"]) * dtype.itemsize
    return fields, np.frombuffer(body, dtype)


def same(a: np.ndarray, b: np.ndarray) -> None:
    assert a.shape == b.shape
    for name in POINT_FIELDS:
        assert np.array_equal(a[name], b[name], equal_nan=True), name


def test_ply_has_the_points_that_are_there(tmp_path: Path) -> None:
    cloud = tilted()
    count = save_ply(tmp_path / "cloud.ply", cloud, {"calibration": "abc", "note": "two\nlines"})
    ply = PlyData.read(str(tmp_path / "cloud.ply"))
    assert ply.byte_order == "<"
    assert not ply.text
    assert count == len(ply["vertex"]) == ROWS * COLUMNS - 5 * 10
    assert [p.name for p in ply["vertex"].properties] == list(POINT_FIELDS)
    same(ply["vertex"].data, cloud[np.isfinite(cloud["z"])])
    assert ply.comments == ["lengths in metres", "calibration: abc", "note: two lines"]


def test_pcd_has_the_points_that_are_there(tmp_path: Path) -> None:
    cloud = tilted()
    count = save_pcd(tmp_path / "cloud.pcd", cloud, {"calibration": "abc"})
    fields, points = parse_pcd(tmp_path / "cloud.pcd")
    assert (fields["VERSION"], fields["HEIGHT"], fields["WIDTH"]) == ("0.7", "1", str(count))
    assert fields["VIEWPOINT"] == "0 0 0 1 0 0 0"
    same(points, cloud[np.isfinite(cloud["z"])])


def test_pcd_can_keep_rows_and_columns(tmp_path: Path) -> None:
    cloud = tilted()
    save_pcd(tmp_path / "cloud.pcd", cloud, organised=True)
    fields, points = parse_pcd(tmp_path / "cloud.pcd")
    assert (fields["WIDTH"], fields["HEIGHT"]) == (str(COLUMNS), str(ROWS))
    same(points.reshape(ROWS, COLUMNS), cloud)


def test_an_empty_cloud_is_a_file_without_points(tmp_path: Path) -> None:
    cloud = tilted()
    cloud["z"] = np.nan
    assert save_ply(tmp_path / "cloud.ply", cloud) == 0
    assert save_pcd(tmp_path / "cloud.pcd", cloud) == 0
    assert len(PlyData.read(str(tmp_path / "cloud.ply"))["vertex"]) == 0
    assert len(parse_pcd(tmp_path / "cloud.pcd")[1]) == 0


def test_a_failed_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "cloud.pcd"
    path.write_text("old")

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken, pytest.raises(OSError, match="No space"):
        broken.setattr(Path, "open", full)
        save_pcd(path, tilted())
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["cloud.pcd"]


def test_height_map_of_a_plane_is_the_plane() -> None:
    height = make_height_map(tilted(), 10e-6)
    rows, columns = height.z_m.shape
    x = height.x0_m + np.arange(columns) * height.step_m
    y = height.y0_m - np.arange(rows) * height.step_m
    expected = 0.1 * x[np.newaxis, :] - 0.05 * y[:, np.newaxis]
    there = np.isfinite(height.z_m)
    # Linear interpolation is exact on a plane; the points are float32: |x| < 4e-4, half an ulp
    # 1.5e-11 times slopes below 0.12, and z itself 4e-5 with half an ulp of 1.8e-12.
    assert np.abs(height.z_m - expected)[there].max() < 1e-11
    # The hole of 5 x 10 points takes out the nodes between its neighbours: 11 x 6 spacings.
    hole_m2 = 11 * SPACING_X * 6 * SPACING_Y
    whole_m2 = (COLUMNS - 1) * SPACING_X * (ROWS - 1) * SPACING_Y
    expected_nodes = (whole_m2 - hole_m2) / height.step_m**2
    # The border of the region crosses cells: off by up to a node per node of border length.
    border = 2 * (columns + rows) + 2 * (14 + 5)
    assert abs(there.sum() - expected_nodes) < border


def test_height_map_does_not_bridge_gaps() -> None:
    cloud = tilted(missing=False)
    cloud["x"][:, COLUMNS // 2 :] += 20 * SPACING_X
    height = make_height_map(cloud, 12e-6)
    left = (-COLUMNS / 2 + COLUMNS // 2 - 1) * SPACING_X + 4e-6
    gap = (np.array([left + 2 * SPACING_X, left + 18 * SPACING_X]) - height.x0_m) / height.step_m
    inside = height.z_m[:, int(np.ceil(gap[0])) : int(gap[1])]
    assert inside.size > 100
    assert np.isnan(inside).all()


def test_first_row_is_the_top() -> None:
    cloud = tilted(missing=False)
    cloud["z"] = cloud["y"]
    height = make_height_map(cloud)
    column = height.z_m[:, height.z_m.shape[1] // 2]
    column = column[np.isfinite(column)]
    assert (np.diff(column) < 0).all()
    left, right, bottom, top = height.extent_m
    assert top - bottom == pytest.approx((height.z_m.shape[0] - 1) * height.step_m)
    assert left == height.x0_m < right


def test_step_is_the_typical_spacing() -> None:
    # Along rows (dx, dy) = (12, 0) um, along columns (0.1, 8) um: the larger is 12 um.
    # The points are float32, |x| < 4e-4: differences are good to 6e-11 of 12e-6.
    assert typical_spacing_m(tilted()) == pytest.approx(12e-6, rel=1e-5)
    assert make_height_map(tilted()).step_m == pytest.approx(12e-6, rel=1e-5)


def test_no_surface_is_refused() -> None:
    cloud = tilted()
    cloud["z"] = cloud["x"] = np.nan
    with pytest.raises(StackError, match="no two neighbouring points"):
        make_height_map(cloud)


def test_a_point_far_off_does_not_eat_all_memory() -> None:
    cloud = tilted()
    cloud["x"][0, 0] = 1e3
    with pytest.raises(StackError, match="too large"):
        make_height_map(cloud)


def test_tiff_holds_metres(tmp_path: Path) -> None:
    height = make_height_map(tilted())
    save_tiff(tmp_path / "height.tiff", height)
    back = cv2.imread(str(tmp_path / "height.tiff"), cv2.IMREAD_UNCHANGED)
    assert back.dtype == np.float32
    assert np.array_equal(back, height.z_m, equal_nan=True)


def test_png_spans_lowest_to_highest(tmp_path: Path) -> None:
    z = np.array([[0.0, 1e-6, np.nan], [2e-6, 3e-6, 4e-6]], np.float32)
    low, high = save_png(tmp_path / "height.png", HeightMap(z, 0.0, 0.0, 1e-6))
    back = cv2.imread(str(tmp_path / "height.png"), cv2.IMREAD_UNCHANGED)
    assert back.dtype == np.uint16
    assert (low, high) == (pytest.approx(0.0), pytest.approx(4e-6))
    assert back[0, 2] == 0
    decoded = low + (back.astype(float) - 1) * (high - low) / 65534
    there = np.isfinite(z)
    # half a grey value, and float32 of the heights
    assert np.abs(decoded - z)[there].max() <= 0.5 * (high - low) / 65534 + 1e-12


def test_png_of_nothing_and_of_a_level(tmp_path: Path) -> None:
    nothing = HeightMap(np.full((2, 3), np.nan, np.float32), 0, 0, 1)
    assert save_png(tmp_path / "a.png", nothing) == (0.0, 0.0)
    assert not cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED).any()
    save_png(tmp_path / "b.png", HeightMap(np.full((2, 3), 0.5, np.float32), 0, 0, 1))
    assert (cv2.imread(str(tmp_path / "b.png"), cv2.IMREAD_UNCHANGED) == 1).all()
