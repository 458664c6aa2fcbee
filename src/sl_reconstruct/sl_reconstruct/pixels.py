"""Pixel work of one camera row: threshold, light, Gray code. All loops run along the row.

Every function fills rows of scratch; nothing is allocated here, and the loops are written so
that the compiler can turn them into vector instructions on the stack's own small integers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

#: Samples that a dynamic threshold may be carried to where a pixel saw only bright or only dark.
CARRY_PX = 16


class PixelRow(NamedTuple):
    """Scratch for one camera row, all of the image's width.

    ``low``, ``high``: dark and bright level (or darkest and brightest sample), stack type.
    ``middle``: integer threshold between them. ``light``: bright minus dark, DN.
    ``threshold``: sub-DN threshold, NaN where unknown (dynamic only). ``bright``, ``dark``:
    number of clean samples (dynamic only). ``bright_sum``, ``dark_sum``: their sums.
    ``bit``, ``parity``: a bit plane and the running parity. ``code``: division number.
    ``flat``: 1 where lit; ``clipped``: 1 where some wanted sample saturates.
    """

    low: NDArray[Any]
    high: NDArray[Any]
    middle: NDArray[Any]
    light: NDArray[np.float32]
    threshold: NDArray[np.float32]
    bright: NDArray[np.uint8]
    dark: NDArray[np.uint8]
    bright_sum: NDArray[Any]
    dark_sum: NDArray[Any]
    bit: NDArray[np.uint8]
    parity: NDArray[np.uint8]
    code: NDArray[np.uint16]
    lit: NDArray[np.uint8]
    clipped: NDArray[np.uint8]


@njit(cache=True, nogil=True, error_model="numpy")
def pixel_row(width: int, like: NDArray[Any], sums: NDArray[Any]) -> PixelRow:
    """Return scratch for rows of ``width`` pixels; ``like`` and ``sums`` give the types."""
    return PixelRow(
        np.zeros(width, like.dtype), np.zeros(width, like.dtype), np.zeros(width, like.dtype),
        np.zeros(width, np.float32), np.zeros(width, np.float32),
        np.zeros(width, np.uint8), np.zeros(width, np.uint8),
        np.zeros(width, sums.dtype), np.zeros(width, sums.dtype),
        np.zeros(width, np.uint8), np.zeros(width, np.uint8), np.zeros(width, np.uint16),
        np.zeros(width, np.uint8), np.zeros(width, np.uint8),
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _copy(source: Any, target: Any) -> None:
    for x in range(source.size):
        target[x] = source[x]


@njit(cache=True, nogil=True, error_model="numpy")
def _stretch(row: Any, low: Any, high: Any) -> None:
    for x in range(row.size):
        v = row[x]
        a = low[x]
        b = high[x]
        low[x] = v if v < a else a
        high[x] = v if v > b else b


@njit(cache=True, nogil=True, error_model="numpy")
def set_levels(stack: Any, y: int, white: int, black: int, images: Any, p: PixelRow) -> None:
    """Fill ``low``, ``high``, ``middle`` and ``light`` from white and black, or all images."""
    if white >= 0 and black >= 0:
        _copy(stack[white, y], p.high)
        _copy(stack[black, y], p.low)
    else:
        _copy(stack[images[0], y], p.high)
        _copy(stack[images[0], y], p.low)
        for j in range(1, images.size):
            _stretch(stack[images[j], y], p.low, p.high)
    low, high, middle, light = p.low, p.high, p.middle, p.light
    for x in range(low.size):
        middle[x] = (low[x] >> 1) + (high[x] >> 1) + (low[x] & high[x] & 1)
        light[x] = np.float32(high[x]) - np.float32(low[x])


@njit(cache=True, nogil=True, error_model="numpy")
def set_code(stack: Any, y: int, bits: Any, p: PixelRow) -> None:
    """Fill ``code``: the Gray code read as a binary number. bits: (n, 3) image, inverse, flip."""
    parity, code = p.parity, p.code
    for x in range(code.size):
        parity[x] = 0
        code[x] = 0
    for j in range(bits.shape[0]):
        row = stack[bits[j, 0], y]
        other = p.middle if bits[j, 1] < 0 else stack[bits[j, 1], y]
        flip = np.uint8(bits[j, 2])
        for x in range(code.size):
            b = np.uint8(row[x] > other[x]) ^ flip
            parity[x] = parity[x] ^ b
            code[x] = (code[x] << np.uint16(1)) | np.uint16(parity[x])


@njit(cache=True, nogil=True, error_model="numpy")
def _add_clean(row: Any, p: PixelRow, reach: int) -> None:
    """Add one image to the sums where no edge of it lies within ``reach`` pixels."""
    bit, middle = p.bit, p.middle
    n = row.size
    for x in range(n):
        bit[x] = np.uint8(row[x] > middle[x])
    left, right = bit[: n - 2 * reach], bit[2 * reach :]
    mid, values = bit[reach : n - reach], row[reach : n - reach]
    bright, dark = p.bright[reach : n - reach], p.dark[reach : n - reach]
    bright_sum, dark_sum = p.bright_sum[reach : n - reach], p.dark_sum[reach : n - reach]
    for x in range(n - 2 * reach):
        b = left[x] & mid[x] & right[x]
        d = (left[x] | mid[x] | right[x]) ^ np.uint8(1)
        bright[x] += b
        dark[x] += d
        bright_sum[x] += values[x] * b
        dark_sum[x] += values[x] * d


@njit(cache=True, nogil=True, error_model="numpy")
def _carry(threshold: Any, light: Any) -> None:
    """Carry thresholds to pixels that saw only bright or only dark, from the nearest on a side."""
    n = threshold.size
    last = -CARRY_PX - 1
    for x in range(n):
        if not np.isnan(threshold[x]):
            gap = x - last
            if 1 < gap <= CARRY_PX and last >= 0:
                for i in range(last + 1, x):
                    w = np.float32((i - last) / gap)
                    threshold[i] = threshold[last] * (1 - w) + threshold[x] * w
                    light[i] = light[last] * (1 - w) + light[x] * w
            last = x


@njit(cache=True, nogil=True, error_model="numpy")
def set_threshold(stack: Any, y: int, images: Any, reach: int, p: PixelRow) -> None:
    """Fill ``threshold`` and ``light``: the paper's dynamic threshold.

    The mean of the bright and the mean of the dark samples of the pixel, without samples near an
    edge of their image: means have no noise bias, as extremes have.
    """
    for x in range(p.bright.size):
        p.bright[x] = 0
        p.dark[x] = 0
        p.bright_sum[x] = 0
        p.dark_sum[x] = 0
    for j in range(images.size):
        _add_clean(stack[images[j], y], p, reach)
    missing = 0
    threshold, light, bright, dark = p.threshold, p.light, p.bright, p.dark
    for x in range(threshold.size):
        b = np.float32(p.bright_sum[x]) / np.float32(bright[x])
        d = np.float32(p.dark_sum[x]) / np.float32(dark[x])
        known = (bright[x] > 0) & (dark[x] > 0)
        threshold[x] = (b + d) * np.float32(0.5) if known else np.float32(np.nan)
        light[x] = b - d if known else light[x]
        missing += not known
    if missing:
        _carry(threshold, light)


@njit(cache=True, nogil=True, error_model="numpy")
def set_masks(p: PixelRow, lit_dn: float, saturation: int) -> None:
    """Fill ``lit`` and ``clipped``."""
    light, high, lit, clipped = p.light, p.high, p.lit, p.clipped
    for x in range(lit.size):
        lit[x] = np.uint8(light[x] >= np.float32(lit_dn))
        clipped[x] = np.uint8(high[x] >= saturation)
