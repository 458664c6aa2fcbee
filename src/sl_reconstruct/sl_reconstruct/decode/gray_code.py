"""Pixel work of one camera row: threshold, light, Gray code. All loops run along the row.

Every function fills rows of scratch; nothing is allocated here, and the loops are written so
that the compiler can turn them into vector instructions on the stack's own small integers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from sl_common.kernel_cache import kernel
from sl_reconstruct.decode.bit_words import padded
from sl_reconstruct.decode.types import Bytes, Floats, Integers, Layout, Pixels

#: Distance over which a threshold is carried to pixels that saw only bright or only dark.
CARRY_PX = 16
#: Clean samples that go into a threshold; their count must fit above the sum.
MAX_SAMPLES = 15
COUNT_SHIFT_8, COUNT_SHIFT_16 = 12, 20

#: Sums of grey values, with their count in the upper bits.
Sums = NDArray[np.uint16] | NDArray[np.uint32]


class PixelRow(NamedTuple):
    """Scratch for one camera row, all of the image's width.

    Parameters
    ----------
    low, high, middle : ndarray of the stack's type
        Dark and bright level (or darkest and brightest sample), and a threshold between them.
    light : ndarray
        Bright minus dark, DN.
    threshold : ndarray
        Threshold with fractions of a DN, NaN where unknown; of single images only.
    ratio : ndarray
        Dark over bright level.
    words, unknown : ndarray
        Where the ratio is not known, a byte each, and the same memory as words.
    bright, dark : ndarray
        Samples far from edges, their sum in the low bits and their count above; of single images.
    bit, clean, parity : ndarray
        A bit plane, where it is far from its edges, and the running parity.
    code : ndarray
        Number of the division.
    lit, clipped : ndarray
        1 where lit, 1 where saturated.
    any_clipped : ndarray, (1,)
        Whether any is saturated.
    """

    low: Pixels
    high: Pixels
    middle: Pixels
    light: Floats
    threshold: Floats
    ratio: Floats
    words: NDArray[np.uint64]
    unknown: Bytes
    bright: Sums
    dark: Sums
    bit: Bytes
    clean: Bytes
    parity: Bytes
    code: NDArray[np.uint16]
    lit: Bytes
    clipped: Bytes
    any_clipped: Bytes


def pixel_row(width: int, dtype: DTypeLike) -> PixelRow:
    """Return scratch for rows of ``width`` pixels of a stack of type ``dtype``.

    Parameters
    ----------
    width : int
        Pixels of a row.
    dtype : dtype
        Of the images.
    """
    sums = np.uint16 if dtype == np.uint8 else np.uint32
    bright, dark = np.zeros((2, width), sums)
    words = np.zeros((width + 7) // 8, np.uint64)
    low, high, middle = (np.zeros(width, dtype) for _ in range(3))
    light, threshold, ratio = (np.zeros(width, np.float32) for _ in range(3))
    bit, clean, parity, clipped = (np.zeros(width, np.uint8) for _ in range(4))
    unknown, code, lit = words.view(np.uint8), np.zeros(width, np.uint16), padded(width, np.uint8)
    levels = low, high, middle, light, threshold, ratio, words, unknown, bright, dark
    return PixelRow(*levels, bit, clean, parity, code, lit, clipped, np.zeros(1, np.uint8))


@kernel()
def _copy(source: Pixels, target: Pixels) -> None:
    for x in range(source.size):
        target[x] = source[x]


@kernel()
def _stretch(row: Pixels, low: Pixels, high: Pixels) -> None:
    for x in range(row.size):
        v = row[x]
        a = low[x]
        b = high[x]
        low[x] = v if v < a else a
        high[x] = v if v > b else b


@kernel()
def set_levels(stack: Pixels, y: int, plan: Layout, p: PixelRow) -> None:
    """Fill ``low``, ``high``, ``middle`` and ``light`` from white and black, or all images.

    Parameters
    ----------
    stack : ndarray, (N, H, W)
        The images.
    y : int
        The row.
    plan : Layout
        Says which images these are.
    p : PixelRow
        Written to.
    """
    images = plan.images
    if plan.white >= 0 and plan.black >= 0:
        _copy(stack[plan.white, y], p.high)
        _copy(stack[plan.black, y], p.low)
    else:
        _copy(stack[images[0], y], p.high)
        _copy(stack[images[0], y], p.low)
        for j in range(1, images.size):
            _stretch(stack[images[j], y], p.low, p.high)
    low, high, middle, light = p.low, p.high, p.middle, p.light
    for x in range(low.size):
        middle[x] = (low[x] >> 1) + (high[x] >> 1) + (low[x] & high[x] & 1)
        light[x] = np.float32(high[x]) - np.float32(low[x])


@kernel()
def set_code(stack: Pixels, y: int, plan: Layout, p: PixelRow) -> None:
    """Fill ``code``, the Gray code read as a binary number; parameters as in `set_levels`.

    Parameters
    ----------
    stack : ndarray, (N, H, W)
        Images, DN.
    y : int
        The row.
    plan : Layout
        Which image carries which bit.
    p : PixelRow
        Filled.
    """
    bits, parity, code = plan.bits, p.parity, p.code
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


@kernel()
def _find_clean(bit: Bytes, reach: int, clean: Bytes) -> None:
    """2 where bright and 0 where dark with no edge within ``reach`` pixels, else 1."""
    n = bit.size
    left, mid, right = bit[: n - 2 * reach], bit[reach : n - reach], bit[2 * reach :]
    inner = clean[reach : n - reach]
    for x in range(inner.size):
        inner[x] = (left[x] & mid[x] & right[x]) + (left[x] | mid[x] | right[x])


@kernel()
def _add(row: Pixels, clean: Bytes, shift: int, bright: Sums, dark: Sums) -> None:
    """Add sample and count to the bright sums where ``clean`` is 2, to the dark where it is 0."""
    for x in range(row.size):
        sample = row[x] + (1 << shift)
        bright[x] = bright[x] + sample * np.uint8(clean[x] == 2)
        dark[x] = dark[x] + sample * np.uint8(clean[x] == 0)


@kernel()
def _mean(sums: Sums, shift: int, out: Floats) -> None:
    """Mean of the summed samples; NaN where there are none."""
    for x in range(out.size):
        count = sums[x] >> shift
        out[x] = np.float32(sums[x] & ((1 << shift) - 1)) / np.float32(count)


@kernel()
def _carry(values: Floats, unknown: Bytes, words: NDArray[np.uint64]) -> None:
    """Carry values into gaps of at most CARRY_PX, on a straight line between their ends.

    ``unknown`` has a byte for each value, and is seen as ``words`` to pass over known ones.
    """
    n = values.size
    for x in range(n):
        unknown[x] = np.uint8(values[x] != values[x])
    done = 0
    for word in range(words.size):
        if words[word] == 0:
            continue
        for x in range(max(done, 8 * word), min(8 * word + 8, n)):
            if x < done or not unknown[x]:
                continue
            done = x + 1
            while done < n and unknown[done]:
                done += 1
            if x > 0 and done < n and done - x < CARRY_PX:
                a, b = values[x - 1], values[done]
                for i in range(x, done):
                    w = np.float32((i + 1 - x) / (done + 1 - x))
                    values[i] = a * (1 - w) + b * w


@kernel()
def _least_around(values: Floats, reach: int, out: Floats) -> None:
    """Minimum within about ``reach`` pixels on either side, in place; ``out`` is scratch."""
    n, step, covered = values.size, 1, 0
    while covered < reach:
        left, mid, right = values[: n - 2 * step], values[step : n - step], values[2 * step :]
        inner = out[step : n - step]
        for x in range(n):
            out[x] = values[x]
        for x in range(inner.size):
            a = left[x] if left[x] < mid[x] else mid[x]
            inner[x] = right[x] if right[x] < a else a
        for x in range(n):
            values[x] = out[x]
        covered += step
        step = min(2 * step + 1, max(1, reach - covered))


@kernel()
def set_middle(around: int, p: PixelRow) -> None:
    """Fill ``middle`` where every image of a pixel may be bright, as for some codes.

    Parameters
    ----------
    around : int
        Half the width of the finest stripes, camera pixels.
    p : PixelRow
        Has the levels.

    Notes
    -----
    The ratio of dark to bright is that of ambient light and pattern, so it changes slowly,
    whatever the albedo does: its least value nearby is used with the pixel's own bright level.
    """
    low, high, middle, ratio = p.low, p.high, p.middle, p.ratio
    for x in range(low.size):
        ratio[x] = np.float32(low[x]) / (np.float32(high[x]) + np.float32(1e-3))
    _least_around(ratio, around, p.threshold)
    half = np.float32(0.5)
    for x in range(low.size):
        middle[x] = np.int32(np.float32(high[x]) * (half + half * ratio[x]))


@kernel()
def set_threshold(stack: Pixels, y: int, images: Integers, reach: int, p: PixelRow) -> None:
    """Fill ``threshold`` and ``light``: the paper's dynamic threshold.

    Parameters
    ----------
    stack, y, p
        As in `set_levels`.
    images : ndarray, (n,)
        Images that are used.
    reach : int
        Samples this near to an edge of their image are left out, pixels.

    Notes
    -----
    The mean of the bright and the mean of the dark samples of the pixel, without samples near an
    edge of their image: means have no noise bias, as extremes have.
    """
    bright, dark, bit, middle, clean = p.bright, p.dark, p.bit, p.middle, p.clean
    shift = count_shift(bright.itemsize)
    for x in range(bright.size):
        bright[x] = 0
        dark[x] = 0
        clean[x] = 1
    for j in range(min(images.size, MAX_SAMPLES)):
        row = stack[images[j], y]
        for x in range(bit.size):
            bit[x] = np.uint8(row[x] > middle[x])
        _find_clean(bit, reach, clean)
        _add(row, clean, shift, bright, dark)
    _mean(bright, shift, p.light)
    _mean(dark, shift, p.threshold)
    missing = np.int32(0)
    threshold, light, ratio = p.threshold, p.light, p.ratio
    for x in range(threshold.size):
        d = threshold[x]
        ratio[x] = d / light[x]
        missing |= np.int32(d != d)
    if missing:
        _carry(ratio, p.unknown, p.words)
        for x in range(threshold.size):
            d = threshold[x]
            threshold[x] = light[x] * ratio[x] if d != d else d
    for x in range(threshold.size):
        b, d = light[x], threshold[x]
        threshold[x] = (b + d) * np.float32(0.5)
        light[x] = b - d
    _fill_light(p)


@kernel()
def _fill_light(p: PixelRow) -> None:
    """Plain contrast where a pixel was never clearly bright."""
    light, high, low = p.light, p.high, p.low
    for x in range(light.size):
        a = light[x]
        plain = np.float32(high[x]) - np.float32(low[x])
        light[x] = plain if a != a else a


@kernel()
def set_masks(p: PixelRow, lit_dn: float, saturation: int) -> None:
    """Fill ``lit``, ``clipped`` and ``any_clipped``.

    Parameters
    ----------
    p : PixelRow
        Has the levels.
    lit_dn, saturation : float, int
        Pixels with this much light are lit; with this bright level saturated.
    """
    light, high, lit, clipped = p.light, p.high, p.lit, p.clipped
    for x in range(lit.size):
        lit[x] = np.uint8(light[x] >= np.float32(lit_dn))
    found = np.uint8(0)
    for x in range(lit.size):
        clipped[x] = np.uint8(high[x] >= saturation)
        found |= clipped[x]
    p.any_clipped[0] = found


@kernel()
def count_shift(itemsize: int) -> int:
    """Bits of a sum of samples below their count, for sums of 2 or 4 bytes."""
    return COUNT_SHIFT_8 if itemsize == 2 else COUNT_SHIFT_16
