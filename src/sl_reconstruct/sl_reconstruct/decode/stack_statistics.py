"""What a stack says about itself: full scale, direction and scale of the code, pixel noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sl_common.kernel_cache import kernel
from sl_reconstruct.decode.gray_code import PixelRow
from sl_reconstruct.decode.row_decoder import Decoding, decode_pixels
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.decode.types import Integers, Noise, Pixels

#: Significant bits that cameras have.
BITS = (8, 10, 12, 14, 16)
#: What 8 bits in the upper end of 16 are multiples of.
MAX_STEP = 256
#: Rows looked at, evenly spread over the image.
SURVEY_ROWS = 16
#: Distance over which the code's growth is measured, camera pixels.
LAG_PX = 32
NOISE_BINS = 8
#: The scatter of this many samples of one pixel and more counts.
MIN_SAMPLES = 4

Array = NDArray[np.float64]


def saturation_of(stack: Pixels, settings: Settings) -> int:
    """Value from which on pixels of a stack are saturated: as chosen, else its full scale.

    Parameters
    ----------
    stack : ndarray, (N, H, W)
        Images, DN.
    settings : Settings
        May name the value.
    """
    return settings.saturation_dn or full_scale_dn(stack)


def full_scale_dn(stack: Pixels) -> int:
    """Largest value that a pixel of these images can have, as far as they show it.

    Parameters
    ----------
    stack : ndarray of uint8 or uint16
        Images as the camera gave them.

    Returns
    -------
    int
        255 for uint8. For uint16 the end of the fewest bits of `BITS` that hold all values; of
        values that are all multiples of 2, 4, ... (bits put in the upper end), that multiple less.
        Too few bits are taken for images whose brightest pixel is below a quarter of the full
        scale: nothing is saturated there, whatever the number.

    Examples
    --------
    >>> full_scale_dn(np.array([17, 4095], np.uint16)), full_scale_dn(np.array([4096], np.uint16))
    (4095, 16383)
    >>> full_scale_dn(np.array([0x0110, 0xFFF0], np.uint16))  # 12 bits in the upper end
    65520
    """
    if stack.dtype == np.uint8:
        return 255
    used = int(np.bitwise_or.reduce(stack, axis=None))
    bits = next(bits for bits in BITS if used < 1 << bits)
    step = min(used & -used, MAX_STEP) if bits == BITS[-1] else 1
    return (1 << bits) - step


def survey_rows(height: int) -> NDArray[np.int64]:
    """Rows to look at: at most SURVEY_ROWS, evenly spread."""
    return np.unique(np.linspace(0, height - 1, min(SURVEY_ROWS, height) + 2)[1:-1].astype(int))


@kernel()
def code_growth(d: Decoding, ys: Integers, p: PixelRow) -> float:
    """DMD pixels that the code grows by per camera pixel, mean over lit pixels.

    Parameters
    ----------
    d : Decoding
        The stack.
    ys : ndarray, (n,)
        Rows to look at.
    p : PixelRow
        Scratch.

    Returns
    -------
    float
        NaN where nothing is lit.
    """
    t = d.tuning
    divisions = (t.size_px + t.division_px - 1) // t.division_px
    total, count = 0, 0
    for y in ys:
        decode_pixels(d, y, p)
        for x in range(p.code.size - LAG_PX):
            a, b = int(p.code[x]), int(p.code[x + LAG_PX])
            known = p.lit[x] and p.lit[x + LAG_PX] and max(a, b) < divisions
            if known and abs(b - a) * t.division_px <= 4 * LAG_PX:
                total += (b - a) * t.division_px
                count += 1
    return total / (count * LAG_PX) if count else np.nan


@kernel()
def _gather(d: Decoding, y: int, p: PixelRow, sums: Array) -> None:
    """Sum, sum of squares and count of each pixel's dark and bright samples far from edges."""
    sums[:] = 0
    n, reach = p.code.size, d.tuning.reach_px
    for i in d.plan.images:
        row = d.stack[i, y]
        for x in range(n):
            p.bit[x] = row[x] > p.middle[x]
        for x in range(reach, n - reach):
            b = p.bit[x]
            if p.lit[x] and p.bit[x - reach] == b and p.bit[x + reach] == b:
                off = np.float64(row[x]) - np.float64(p.middle[x])
                sums[b, x, 0] += off
                sums[b, x, 1] += off * off
                sums[b, x, 2] += 1


@kernel()
def sample_scatter(d: Decoding, ys: Integers, p: PixelRow) -> Array:
    """Scatter of each pixel's dark and bright samples.

    Parameters
    ----------
    d, ys, p
        As in `code_growth`.

    Returns
    -------
    ndarray, (rows, 2, width, 3)
        Mean, variance and count of the dark and of the bright samples; count 0 is none.
    """
    width = d.stack.shape[2]
    out = np.zeros((ys.size, 2, width, 3))
    sums = np.zeros((2, width, 3))
    for i in range(ys.size):
        decode_pixels(d, ys[i], p)
        _gather(d, ys[i], p, sums)
        for b in range(2):
            for x in range(width):
                n = sums[b, x, 2]
                if n >= MIN_SAMPLES and not p.clipped[x]:
                    mean = sums[b, x, 0] / n
                    out[i, b, x, 0] = mean + p.middle[x]
                    out[i, b, x, 1] = (sums[b, x, 1] - n * mean * mean) / (n - 1)
                    out[i, b, x, 2] = n
    return out


def fit_noise(scatter: Array) -> Noise:
    """Noise model of the scatter of repeated samples; NaN where there are too few.

    The levels are put into bins of equal count; in each the mean variance without outliers
    (interreflections, moving parts) is taken, and a line is fitted that is nowhere negative.
    """
    flat = scatter.reshape(-1, 3)
    flat = flat[flat[:, 2] > 0]
    if len(flat) < 50 * NOISE_BINS:
        return Noise(np.nan, np.nan)
    flat = flat[np.argsort(flat[:, 0], kind="stable")]
    rows = [_bin_mean(part) for part in np.array_split(flat, NOISE_BINS)]
    level, variance, weight = np.array(rows).T
    weight = weight / np.maximum(variance, 1e-3) ** 2
    design = np.stack([np.ones_like(level), level], axis=1)
    root = np.sqrt(weight)[:, None]
    (a, b), *_ = np.linalg.lstsq(design * root, variance * root[:, 0], rcond=None)
    if b < 0:
        a, b = np.average(variance, weights=weight), 0.0
    elif a < 0:
        a, b = 0.0, np.average(variance / np.maximum(level, 1e-9), weights=weight * level**2)
    return Noise(float(a), float(b))


def _bin_mean(part: Array) -> tuple[float, float, float]:
    level, variance, count = part.T
    middle = (len(part) - 1) // 2, len(part) // 2
    low, high = np.partition(variance, middle)[list(middle)].tolist()
    good = variance <= 4 * (low + high) + 0.5
    level, variance, freedom = level[good], variance[good], count[good] - 1
    total = float(freedom.sum())
    return float(level.mean()), float((variance * freedom).sum()) / total, total


def edge_bound(scatter: Array, noise: Noise, blur_px: float) -> float:
    """Least standard deviation of an edge's position from one image, pixels.

    ``(sigma / A) sqrt(2 sqrt(pi) s)`` with the height A of a step between the median dark and
    bright level, blurred to s, and the noise sigma half-way up. NaN where it is not known.

    Parameters
    ----------
    scatter : ndarray, (rows, 2, width, 3)
        Of `sample_scatter`.
    noise : Noise
        The model fitted to it.
    blur_px : float
        Standard deviation s of the edges' blur, camera pixels.
    """
    dark, bright = (part[part[..., 2] > 0][:, 0] for part in np.moveaxis(scatter, 1, 0))
    if not (dark.size and bright.size and noise.read_dn2 >= 0):
        return float("nan")
    low, high = float(np.median(dark)), float(np.median(bright))
    sigma = np.sqrt(noise.variance((low + high) / 2))
    return float(sigma / (high - low) * np.sqrt(2 * np.sqrt(np.pi) * blur_px))
