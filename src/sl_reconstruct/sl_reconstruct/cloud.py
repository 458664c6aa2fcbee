"""The organised cloud: one row per camera row, one column per DMD column boundary."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sl_reconstruct.reasons import REFUSALS, Reason

#: One point: metres, DN, metres. 20 bytes, as in ``reconstruct/points``.
CLOUD_DTYPE = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("sigma", "<f4")]
)


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
        Median stated standard deviation of an edge position, camera pixels.
    edge_bound_px : float
        Least standard deviation that an unbiased estimator can have on the same edges.
    order : float
        Median part of a row's boundaries that lie in order; 1 where all do.
    """

    edge_blur_px: float = float("nan")
    scale_px: float = float("nan")
    noise_read_dn2: float = float("nan")
    noise_shot_dn: float = float("nan")
    edge_sigma_px: float = float("nan")
    edge_bound_px: float = float("nan")
    order: float = float("nan")

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
        edge noise, metres); NaN where there is no point.
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
    def xyz_m(self) -> NDArray[np.float32]:
        """View of the coordinates, shape (H, K, 3)."""
        return self.points.view(np.float32).reshape(*self.points.shape, 5)[..., :3]


def count_reasons(reason: NDArray[np.uint8]) -> tuple[dict[str, int], int]:
    """Refused positions by name, and the number of lit positions."""
    counts = _histogram(reason, len(Reason))
    refused = {name: int(counts[code]) for code, name in REFUSALS.items()}
    return refused, int(reason.size - counts[Reason.UNLIT])


@njit(cache=True, nogil=True)
def _histogram(values: Any, size: int) -> Any:
    counts = np.zeros(size, np.int64)
    for y in range(values.shape[0]):
        row = values[y]
        for code in range(size):
            n = 0
            for x in range(row.size):
                n += row[x] == code
            counts[code] += n
    return counts
