"""A look at a few rows before all are decoded: direction, scale, noise and blur of this stack."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_common.kernel_cache import kernel
from sl_reconstruct.decode.edges import Tuning
from sl_reconstruct.decode.gray_code import PixelRow
from sl_reconstruct.decode.row_decoder import decode_pixels
from sl_reconstruct.decode.types import Layout

#: Rows looked at, evenly spread over the image.
SURVEY_ROWS = 16
#: Distance over which the code's growth is measured, camera pixels.
LAG_PX = 32
NOISE_BINS = 8
#: Every so many surveyed rows the noise is measured.
NOISE_STEP = 5
#: Samples of one pixel must be at least so many before their scatter counts.
MIN_SAMPLES = 4

Array = NDArray[np.float64]


class Noise(NamedTuple):
    """Pixel noise: variance = ``read_dn2 + shot_dn * level``, DN^2."""

    read_dn2: float
    shot_dn: float

    def variance(self, level_dn: float) -> float:
        """Variance of a pixel at a level, DN^2."""
        return self.read_dn2 + self.shot_dn * level_dn


def survey_rows(height: int) -> NDArray[np.int64]:
    """Rows to look at: at most SURVEY_ROWS, evenly spread."""
    return np.unique(np.linspace(0, height - 1, min(SURVEY_ROWS, height) + 2)[1:-1].astype(int))


@kernel()
def code_growth(stack: Any, ys: Any, plan: Layout, t: Tuning, p: PixelRow) -> Any:
    """DMD pixels that the code grows by per camera pixel, mean over lit pixels, and their count."""
    divisions = (t.size_px + t.division_px - 1) // t.division_px
    total, count = 0, 0
    for y in ys:
        decode_pixels(stack, y, plan, t, p)
        for x in range(p.code.size - LAG_PX):
            a, b = int(p.code[x]), int(p.code[x + LAG_PX])
            known = p.lit[x] and p.lit[x + LAG_PX] and max(a, b) < divisions
            if known and abs(b - a) * t.division_px <= 4 * LAG_PX:
                total += (b - a) * t.division_px
                count += 1
    return total / (count * LAG_PX) if count else np.nan, count


@kernel()
def _gather(stack: Any, y: int, plan: Layout, reach: int, p: PixelRow, sums: Any) -> None:
    """Sum, sum of squares and count of each pixel's clean bright and dark samples."""
    sums[:] = 0
    n = p.code.size
    for i in plan.images:
        row = stack[i, y]
        for x in range(n):
            p.bit[x] = row[x] > p.middle[x]
        for x in range(reach, n - reach):
            b = p.bit[x]
            if p.lit[x] and p.bit[x - reach] == b and p.bit[x + reach] == b:
                d = np.float64(row[x]) - np.float64(p.middle[x])
                sums[b, x, 0] += d
                sums[b, x, 1] += d * d
                sums[b, x, 2] += 1


@kernel()
def sample_scatter(stack: Any, ys: Any, plan: Layout, t: Tuning, p: PixelRow) -> Any:
    """Mean, variance and count of clean samples, shape (rows, 2, width, 3); count 0 = none."""
    width = stack.shape[2]
    out = np.zeros((ys.size, 2, width, 3))
    sums = np.zeros((2, width, 3))
    for i in range(ys.size):
        decode_pixels(stack, ys[i], plan, t, p)
        _gather(stack, ys[i], plan, t.reach_px, p, sums)
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
    """Least standard deviation of an edge's position from one image, px (docs, design: noise).

    ``(sigma / A) sqrt(2 sqrt(pi) s)`` with the height A of a step between the median dark and
    bright level, blurred to s, and the noise sigma half-way up. NaN where it is not known.
    """
    dark, bright = (part[part[..., 2] > 0][:, 0] for part in np.moveaxis(scatter, 1, 0))
    if not (dark.size and bright.size and noise.read_dn2 >= 0):
        return float("nan")
    low, high = float(np.median(dark)), float(np.median(bright))
    sigma = np.sqrt(noise.variance((low + high) / 2))
    return float(sigma / (high - low) * np.sqrt(2 * np.sqrt(np.pi) * blur_px))
