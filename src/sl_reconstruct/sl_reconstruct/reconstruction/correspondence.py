"""Which DMD coordinates camera pixels see, without a calibration: what calibrates a projector.

The stack's column boundaries are found along camera rows, its row boundaries along camera
columns, as in a reconstruction. In a small patch around a pixel a quadratic through the
boundaries that cross it gives the DMD coordinate there; averaging over the patch leaves a few
thousandths of a pixel of noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import SequenceError, StackError
from sl_common.kernel_cache import kernel
from sl_common.row_threads import share_rows
from sl_projector.sequence.pattern_sequence import PatternSequence
from sl_reconstruct.cloud.cloud import median
from sl_reconstruct.decode.axis_decoder import AxisDecoder
from sl_reconstruct.decode.decode_plan import DecodePlan
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.decode.stack_statistics import saturation_of
from sl_reconstruct.decode.types import Floats, Lines, Pixels, contiguous

Array = NDArray[np.float64]

#: Coefficients of a quadratic in two variables.
_TERMS = 6
#: A patch counts when it holds this part of the boundary crossings that a full one holds.
MIN_FILL = 0.9
#: A patch is refused when its scatter is this many times the median patch's.
MAX_SCATTER = 3.0


@dataclass(frozen=True)
class Correspondences:
    """Camera pixels and the DMD coordinates that light them.

    Parameters
    ----------
    camera_px : ndarray, (N, 2)
        Pixels (u, v); exact, they are chosen.
    dmd_px : ndarray, (N, 2)
        (column, row) seen there, DMD pixels, (0, 0) in the middle of the upper left mirror.
    sigma_px : ndarray, (N, 2)
        1-sigma of ``dmd_px`` from the scatter of the boundaries, DMD pixels.
    edge_sigma_px : float
        Median stated 1-sigma of a single column boundary, camera pixels; NaN where there is none.
    """

    camera_px: Array
    dmd_px: Array
    sigma_px: Array
    edge_sigma_px: float = float("nan")

    def __len__(self) -> int:
        return len(self.camera_px)


def correspondences(
    stack: Pixels,
    sequence: PatternSequence,
    step_px: int = 40,
    half_px: int = 12,
    settings: Settings | None = None,
) -> Correspondences:
    """Find the DMD coordinates at a grid of camera pixels.

    Parameters
    ----------
    stack : ndarray, (N, H, W), uint8 or uint16
        Images in pattern order.
    sequence : PatternSequence
        What was projected; it must encode both axes.
    step_px, half_px : int
        Spacing of the grid and half width of the patches, camera pixels.
    settings : Settings, optional
        How edges are found.

    Returns
    -------
    Correspondences
        Only pixels whose whole patch was decoded on both axes; N may be 0 (dark, holes, shadow).

    Raises
    ------
    SequenceError
        When the sequence does not encode both axes.
    StackError
        When the stack does not fit the sequence.
    """
    if sequence.axes() != ("column", "row"):
        raise SequenceError(
            f"sequence {sequence.name!r} encodes {sequence.axes()}; expected columns and rows "
            "(precise-rows, paper-rows)"
        )
    if stack.ndim != 3 or len(stack) != len(sequence):
        raise StackError(f"stack.shape={stack.shape}; expected {len(sequence)} images")
    height, width = stack.shape[1:]
    grid = _grid(width, height, step_px, half_px)
    settings = settings or Settings()
    columns = decode_columns(contiguous(stack), sequence, settings)
    column, sigma_c = _seen(columns, grid, half_px)
    images, flat = _rows_as_columns(stack, sequence)
    rows = decode_columns(images, flat, settings)
    row, sigma_r = _seen(rows, np.ascontiguousarray(grid[:, ::-1]), half_px)
    good = np.isfinite(column) & np.isfinite(row)
    return Correspondences(
        grid[good],
        np.stack([column[good], row[good]], axis=1),
        np.stack([sigma_c[good], sigma_r[good]], axis=1),
        median(columns.sigma_px[columns.reason == 0]),
    )


def decode_columns(stack: Pixels, sequence: PatternSequence, settings: Settings) -> Lines:
    """Find all column boundaries along all image rows, as the reconstruction does.

    Parameters
    ----------
    stack : ndarray, (N, H, W)
        Images in pattern order.
    sequence : PatternSequence
        What was projected.
    settings : Settings
        How edges are found.
    """
    decoder = AxisDecoder(DecodePlan.of(sequence).column, settings)
    return decoder(stack, saturation_of(stack, settings)).lines


def _grid(width: int, height: int, step_px: int, half_px: int) -> Array:
    """Pixels whose patch lies in the image, (N, 2)."""

    def axis(size: int) -> NDArray[np.int64]:
        spare = (size - 1 - 2 * half_px) % step_px
        return np.arange(half_px + spare // 2, size - half_px, step_px)

    u, v = np.meshgrid(axis(width), axis(height))
    return np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)


def _rows_as_columns(stack: Pixels, sequence: PatternSequence) -> tuple[Pixels, PatternSequence]:
    """Turn images and patterns so that rows are decoded as columns are."""
    wanted = [i for i, p in enumerate(sequence.patterns) if p.kind != "gray" or p.axis == "row"]
    patterns = tuple(replace(sequence.patterns[i], axis="column") for i in wanted)
    turned = contiguous(stack[wanted].transpose(0, 2, 1))
    return turned, PatternSequence(sequence.name, sequence.dmd_size[::-1], patterns)


class Patches(NamedTuple):
    """What is found around the pixels of a grid, each (n,).

    Parameters
    ----------
    value : ndarray
        DMD coordinate of the pixel, NaN where there is none.
    sigma : ndarray
        Its 1-sigma.
    scatter : ndarray
        Standard deviation of the boundaries about the fit, DMD pixels.
    crossings : ndarray
        Boundary crossings in the patch.
    """

    value: Array
    sigma: Array
    scatter: Array
    crossings: NDArray[np.int64]


def _seen(lines: Lines, grid: Array, half_px: int) -> tuple[Array, Array]:
    """DMD coordinate and its 1-sigma at pixels (along the line, line); NaN where there is none."""
    value, sigma, scatter = np.full((3, len(grid)), np.nan)
    count = np.zeros(len(grid), np.int64)

    def work(first: int, last: int) -> None:
        here = slice(first, last)
        part = Patches(value[here], sigma[here], scatter[here], count[here])
        _fit_patches(lines.u_px, grid[here], half_px, part)

    share_rows(work, len(grid))
    full = np.median(count[count > 0]) if (count > 0).any() else 0
    typical = np.nanmedian(scatter) if np.isfinite(scatter).any() else np.nan
    with np.errstate(invalid="ignore"):
        bad = (count < MIN_FILL * full) | ~(scatter <= MAX_SCATTER * typical)
    value[bad] = np.nan
    return value, sigma


@kernel()
def _fit_patches(lines_px: Floats, grid: Array, half_px: int, out: Patches) -> None:
    """Fit ``k - 0.5 = quadratic(du, dv)`` over each patch; its constant is what is wanted."""
    for i in range(len(grid)):
        u, v = grid[i, 0], int(grid[i, 1])
        normal, right = np.zeros((_TERMS, _TERMS)), np.zeros(_TERMS)
        n, squares, reference = 0, 0.0, np.nan
        for y in range(max(0, v - half_px), min(lines_px.shape[0], v + half_px + 1)):
            line, dv = lines_px[y], (y - v) / half_px
            for k in range(line.size):
                du = (line[k] - u) / half_px
                if not abs(du) <= 1.0:
                    continue
                if n == 0:
                    reference = float(k)
                c = k - reference
                terms = (1.0, du, dv, du * du, du * dv, dv * dv)
                for a in range(_TERMS):
                    right[a] += terms[a] * c
                    for b in range(_TERMS):
                        normal[a, b] += terms[a] * terms[b]
                squares += c * c
                n += 1
        out.crossings[i] = n
        if n < 4 * _TERMS:
            continue
        inverse = np.linalg.inv(normal + 1e-9 * np.eye(_TERMS))
        fit = inverse @ right
        rest = squares - fit @ right
        variance = (rest if rest > 0 else 0.0) / (n - _TERMS)
        out.value[i] = reference + fit[0] - 0.5
        out.scatter[i] = np.sqrt(variance)
        out.sigma[i] = np.sqrt(variance * inverse[0, 0])
