"""A coin-like relief drawn with strokes: rim, letters, figures and a low dome."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEP_M = 5e-6
SIDE_M = 9e-3
RIM_RADIUS_M = 4.05e-3
RIM_WIDTH_M = 0.35e-3
TEXT_RADIUS_M = 2.8e-3
LETTER_M = 1.1e-3
STROKE_M = 0.16e-3
DOME_RADIUS_M = 1.5e-3
#: Height of the dome relative to that of the rim.
DOME_HEIGHT = 0.8

#: Strokes on a unit cell, x right and y up: polylines separated by spaces.
LETTERS = {
    "S": "02 20 50 72 73 55 25 06 07 29 59 77",
    "L": "09 00 70",
    "T": "09 79|49 40",
    "M": "00 09 44 89 80",
    "I": "40 49",
    "2": "08 29 59 77 75 00 70",
    "0": "20 02 07 29 59 77 72 50 20",
    "5": "79 09 05 45 73 71 50 00",
}
TEXT = "MITSLS2005"


def _strokes(letter: str) -> list[tuple[Array, Array]]:
    """Segments (start, end) of a letter, on a cell that is 1 high and centred on the origin."""
    segments = []
    for line in LETTERS[letter].split("|"):
        points = [np.array([int(p[0]) - 4.0, int(p[1]) - 4.5]) / 9.0 for p in line.split()]
        segments += list(itertools.pairwise(points))
    return segments


def _placed_segments() -> list[tuple[Array, Array]]:
    """Segments of the whole text around the coin, metres, letters upright at the top."""
    placed = []
    for i, letter in enumerate(TEXT):
        angle = np.pi / 2 - 2 * np.pi * i / len(TEXT)
        out = np.array([np.cos(angle), np.sin(angle)])
        right = np.array([out[1], -out[0]])
        for a, b in _strokes(letter):
            ends = [TEXT_RADIUS_M * out + LETTER_M * (p[0] * right + p[1] * out) for p in (a, b)]
            placed.append((ends[0], ends[1]))
    return placed


def _draw_segment(depth: Array, axis: Array, a: Array, b: Array, reach_m: float) -> None:
    """Raise ``depth`` to the distance inside the stroke a-b, in the window that it can reach."""
    low = np.searchsorted(axis, np.minimum(a, b) - reach_m)
    high = np.searchsorted(axis, np.maximum(a, b) + reach_m)
    x, y = axis[low[0] : high[0]][np.newaxis, :], axis[low[1] : high[1]][:, np.newaxis]
    e = b - a
    along = np.clip(((x - a[0]) * e[0] + (y - a[1]) * e[1]) / (e @ e), 0.0, 1.0)
    inside = STROKE_M / 2 - np.hypot(x - a[0] - along * e[0], y - a[1] - along * e[1])
    window = depth[low[1] : high[1], low[0] : high[0]]
    np.maximum(window, inside, out=window)


def coin_heights(height_m: float, flank_m: float) -> tuple[Array, float]:
    """Heights (N, N), row 0 at the smallest y, and the grid's step, metres.

    Flanks are ``flank_m`` wide, half of it outside the outline, in the form 3 s^2 - 2 s^3.

    Parameters
    ----------
    height_m, flank_m : float
        Height of the relief, and width of its flanks, metres.
    """
    n = round(SIDE_M / STEP_M) + 1
    axis = (np.arange(n, dtype=np.float64) - (n - 1) / 2) * STEP_M
    radius = np.hypot(axis[np.newaxis, :], axis[:, np.newaxis])
    depth = RIM_WIDTH_M / 2 - np.abs(radius - RIM_RADIUS_M)
    for a, b in _placed_segments():
        _draw_segment(depth, axis, a, b, STROKE_M / 2 + flank_m)
    s = np.clip(depth / flank_m + 0.5, 0.0, 1.0)
    dome = DOME_HEIGHT * np.sin(np.clip(1.0 - radius / DOME_RADIUS_M, 0.0, 1.0) * np.pi / 2) ** 2
    return height_m * np.maximum(s * s * (3 - 2 * s), dome), STEP_M
