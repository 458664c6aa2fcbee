"""Kernels of a camera row against plain numpy and closed forms: crossings, tiles, medians."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from sl_projector.sequence.pattern_sequence import named
from sl_reconstruct.cloud.cloud import CLOUD_DTYPE, median
from sl_reconstruct.cloud.cloud_writer import present
from sl_reconstruct.decode.bit_words import padded
from sl_reconstruct.decode.edges import TILE, find_crossings, source_row
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.reconstruction.correspondence import decode_columns


@pytest.mark.parametrize(
    ("width", "first", "last"), [(64, 1, 62), (200, 8, 190), (129, 63, 65), (1600, 0, 1599)]
)
def test_crossings_are_where_numpy_finds_them(width: int, first: int, last: int) -> None:
    rng = np.random.default_rng(width)
    row, lit = source_row(width), padded(width, np.uint8)
    row.filtered[:] = rng.choice([-1.0, -0.0, 0.0, 1.0], width)
    lit[:] = rng.random(width) < 0.7
    count = find_crossings(lit, row.filtered, row.at, first, last)
    bright = row.filtered >= 0
    turns = (bright[:-1] != bright[1:]) & ((lit[:-1] | lit[1:]) != 0)
    expected = np.flatnonzero(turns)
    expected = expected[(expected >= first) & (expected < last)]
    assert row.at[:count].tolist() == expected.tolist()


def test_a_row_with_more_edges_than_a_tile_is_found_whole() -> None:
    """2048 columns in pairs: 256 edges in each image, every boundary where the lens puts it."""
    sequence, columns, rows, pitch, start = named("precise", (2048, 8)), 3000, 4, 1.4, 40.3
    at = (np.arange(columns) - start) / pitch
    frames = []
    for pattern in sequence.patterns:
        profile = pattern.profile(2048).astype(float)
        # No light falls outside of the DMD.
        steps = np.diff(profile, prepend=0.0, append=0.0)
        lit = np.zeros(columns)
        for k in np.flatnonzero(steps):
            lit += steps[k] * 0.5 * (1 + erf((at - (k - 0.5)) / (np.sqrt(2) * 0.7)))
        frames.append(np.tile(np.rint(8 + 180 * lit), (rows, 1)).astype(np.uint8))
    lines = decode_columns(np.array(frames), sequence, Settings())
    k = np.arange(4, 2044)
    edges_in_an_image = 2048 // 8
    assert edges_in_an_image > TILE
    error = lines.u_px[:, k] - (start + (k - 0.5) * pitch)
    # Rounded to whole DN, a step of 180 DN is known to about 1 / 180 px.
    assert np.abs(error).max() < 0.02


@pytest.mark.parametrize("size", [0, 1, 2, 3, 10, 1001, 20_000])
def test_the_median_is_numpys(size: int) -> None:
    rng = np.random.default_rng(size)
    values = rng.normal(0, 10.0 ** rng.integers(-30, 30, size), size).astype(np.float32)
    values[rng.random(size) < 0.2] = np.nan
    values[rng.random(size) < 0.1] = np.inf
    values[rng.random(size) < 0.2] = np.float32(0.25)
    there = values[np.isfinite(values)]
    expected = float(np.median(there)) if there.size else float("nan")
    np.testing.assert_equal(median(values), expected)


def test_points_that_are_there_are_kept_in_order() -> None:
    points = np.zeros((3, 4), CLOUD_DTYPE)
    for number, name in enumerate(CLOUD_DTYPE.names or ()):
        points[name] = np.arange(12).reshape(3, 4) + 100 * number
    points["z"][[0, 1, 2], [1, 3, 0]] = np.nan
    expected = points.reshape(-1)[[0, 2, 3, 4, 5, 6, 9, 10, 11]]
    assert present(points).tobytes() == expected.tobytes()
    assert present(points[:0]).size == 0
