"""The organised cloud: one row per camera row, one column per DMD column boundary."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_common.kernel_cache import kernel
from sl_reconstruct.cloud.refusals import REFUSALS, Reason

#: One point: metres, DN, metres. 20 bytes, as in ``reconstruct/points``.
CLOUD_DTYPE = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("sigma", "<f4")]
)


#: Of float32 numbers seen as integers.
_SIGN, _ALL, _INFINITE = np.uint32(0x80000000), np.uint32(0xFFFFFFFF), np.uint32(0x7F800000)
_LOWER, _HALF = np.uint32(0xFFFF), np.uint32(16)


@dataclass(frozen=True)
class Figures:
    """Quality figures of a stack; NaN where they could not be measured.

    Parameters
    ----------
    edge_blur_px : float
        Standard deviation of the edges' blur, camera pixels.
    scale_px : float
        Camera pixels per DMD pixel along a row; negative where k falls with u.
    noise_read_dn2, noise_shot_dn : float
        Pixel noise: variance = noise_read_dn2 + noise_shot_dn * level, DN^2.
    edge_sigma_px : float
        Median standard deviation of an edge position from noise alone, camera pixels.
    edge_bound_px : float
        Least standard deviation that an unbiased estimator can have on the same edges.
    order : float
        Median part of a row's boundaries that lie in order; 1 where all do.
    light_change : float
        Greatest part by which an image is brighter or darker than others of the same stripes.
    """

    edge_blur_px: float = float("nan")
    scale_px: float = float("nan")
    noise_read_dn2: float = float("nan")
    noise_shot_dn: float = float("nan")
    edge_sigma_px: float = float("nan")
    edge_bound_px: float = float("nan")
    order: float = float("nan")
    light_change: float = float("nan")

    @property
    def bound_ratio(self) -> float:
        """Edge noise over its bound."""
        return self.edge_sigma_px / self.edge_bound_px


@dataclass(frozen=True)
class Cloud:
    """A reconstructed stack: H camera rows by K column boundaries (u = k - 0.5).

    Parameters
    ----------
    points : ndarray, (H, K) of CLOUD_DTYPE
        World x, y, z in metres, intensity (DN under full light), sigma (1-sigma of z from the
        edge's noise and from what bends and uneven light may do to it, metres); NaN where there
        is no point.
    u_px : ndarray, (H, K) float32
        Camera column of the boundary, pixels; NaN where there is no point.
    reason : ndarray, (H, K) uint8
        ``Reason`` of every position.
    refused : dict of str to int
        Positions refused, by reason; every reason is named.
    lit : int
        Positions that the light reached and the sequence can give: present plus refused.
    figures : Figures
        Quality figures.
    v_px : ndarray, (H, K) float32, optional
        DMD row of the point, pixels, where the sequence has row patterns.
    gap_m, gap_px : ndarray, (H, K) float32, optional
        How far camera and projector ray miss each other (metres), and the residual of the four
        equations (pixels); with row patterns.
    """

    points: NDArray[np.void]
    u_px: NDArray[np.float32]
    reason: NDArray[np.uint8]
    refused: dict[str, int]
    lit: int
    figures: Figures = field(default_factory=Figures)
    v_px: NDArray[np.float32] | None = None
    gap_m: NDArray[np.float32] | None = None
    gap_px: NDArray[np.float32] | None = None

    @property
    def present(self) -> int:
        """Number of points."""
        return self.lit - sum(self.refused.values())

    @property
    def median_sigma_m(self) -> float:
        """Median 1-sigma of z, metres; NaN where there are no points."""
        return median(self.points["sigma"])

    @property
    def xyz_m(self) -> NDArray[np.float32]:
        """View of the coordinates, shape (H, K, 3)."""
        return self.points.view(np.float32).reshape(*self.points.shape, 5)[..., :3]


def median(values: NDArray[np.float32]) -> float:
    """Median of the finite values, whatever their shape; NaN where there are none.

    The same bits as numpy's, in a quarter of the time.
    """
    middle = np.array(_middle(values.reshape(-1).view(np.uint32)), np.uint64)
    if not middle.size:
        return float("nan")
    negative = middle < _SIGN
    bits = np.where(negative, ~middle, middle ^ _SIGN).astype(np.uint32)
    low, high = bits.view(np.float32)
    return float((low + high) / np.float32(2))


def count_reasons(reason: NDArray[np.uint8]) -> tuple[dict[str, int], int]:
    """Refused positions by name, and the number of lit positions."""
    counts = _histogram(reason, len(Reason))
    refused = {name: int(counts[code]) for code, name in REFUSALS.items()}
    return refused, int(reason.size - counts[Reason.UNLIT])


@kernel(error_model="python")
def _histogram(values: Any, size: int) -> Any:
    # Four counts side by side: the next one need not wait for the last.
    counts = np.zeros((4, size), np.int64)
    for y in range(values.shape[0]):
        row = values[y]
        for x in range(row.size):
            counts[x & 3, row[x]] += 1
    return counts.sum(axis=0)


@kernel(error_model="python")
def _middle(bits: Any) -> Any:
    """Keys of the two finite values in the middle, none where there is none; bits: of float32.

    A key grows with its value. Keys are counted by their upper halves, then those of the middle
    one's upper half by their lower halves.
    """
    keys, counts, n = np.empty(bits.size, np.uint32), np.zeros(1 << 16, np.int32), 0
    for b in bits:
        if (b & _INFINITE) != _INFINITE:
            key = np.uint32(b ^ (_SIGN if b < _SIGN else _ALL))
            keys[n] = key
            counts[key >> _HALF] += 1
            n += 1
    found = np.empty(2 if n else 0, np.uint32)
    for i in range(found.size):
        found[i] = _ranked(keys[:n], counts, (n - 1 + i) // 2)
    return found


@kernel(error_model="python")
def _ranked(keys: Any, counts: Any, rank: int) -> Any:
    """Key of a rank; counts: of the keys by their upper halves."""
    upper = 0
    while rank >= counts[upper]:
        rank -= counts[upper]
        upper += 1
    lower = np.zeros(1 << 16, np.int32)
    for key in keys:
        if key >> _HALF == upper:
            lower[key & _LOWER] += 1
    at = 0
    while rank >= lower[at]:
        rank -= lower[at]
        at += 1
    return (upper << _HALF) + at
