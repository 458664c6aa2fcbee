"""Filters of the edge estimators, and what noise and blur make of them, in closed form."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from sl_reconstruct.decode.decode_plan import AxisPlan
from sl_reconstruct.decode.edges import PHASES, SQRT_2PI, Filter

#: Widest kernel on either side, camera pixels.
MAX_RADIUS_PX = 12
#: A kernel wider than this part of a stripe would mix neighbouring edges.
STRIPE_PART = 0.22

Array = NDArray[np.float64]


def gaussian_taps(sd_px: float, radius_px: int) -> Array:
    """Half of a sampled Gaussian of unit sum, shape (1 + radius,).

    Parameters
    ----------
    sd_px : float
        Standard deviation, pixels.
    radius_px : int
        Where it is cut off, pixels.
    """
    taps = np.exp(-0.5 * (np.arange(radius_px + 1) / sd_px) ** 2)
    return np.asarray(taps / (taps[0] + 2 * taps[1:].sum()))


def tap_variance(taps: Array) -> float:
    """Variance of a symmetric kernel, px^2."""
    return float(2 * np.sum(taps[1:] * np.arange(1, taps.size) ** 2))


@cache
def cubic_weights(phase: float) -> Array:
    """Weights of the samples -1, 0, 1, 2 in the cubic through them, at a phase in [0, 1]."""
    powers = np.vander([-1.0, 0.0, 1.0, 2.0], 4, increasing=True)
    return np.asarray(np.linalg.solve(powers.T, phase ** np.arange(4)))


def stripe_slope(width_px: float, blur_px: float) -> float:
    """Slope at the edges of stripes of unit height, ``width_px`` wide, blurred, per pixel.

    Parameters
    ----------
    width_px, blur_px : float
        Width of a stripe, and the blur's standard deviation, pixels.
    """
    j = np.arange(-40, 41)
    terms = (-1.0) ** np.abs(j) * np.exp(-0.5 * (j * width_px / blur_px) ** 2)
    return float(terms.sum() / (SQRT_2PI * blur_px))


def bar_slope(width_px: float, blur_px: float) -> float:
    """Slope of BR8, Eq. (6), at the centre of a stripe of unit height, per pixel.

    Parameters
    ----------
    width_px, blur_px : float
        Width of a stripe, and the blur's standard deviation, pixels.
    """
    j = np.arange(1, 5)
    edge = np.exp(-0.5 * ((width_px / 2 - j) / blur_px) ** 2) / (SQRT_2PI * blur_px)
    return float(2 * edge.sum())


def noise_gain(taps: Array, blur_px: float) -> Array:
    """Sum of squared weights on the raw signal at each sub-pixel phase, shape (PHASES + 1, 2).

    The second column weights with the squared profile of a unit blurred step.

    Parameters
    ----------
    taps : ndarray, (1 + radius,)
        Half of the symmetric filter.
    blur_px : float
        Standard deviation of the edge's blur, pixels.
    """
    radius = taps.size - 1
    phases = np.linspace(0, 1, PHASES + 1)
    shifted = np.zeros((4, taps.size * 2 + 2))
    for i, row in enumerate(shifted):
        row[i : i + 2 * radius + 1] = np.concatenate([taps[:0:-1], taps])
    weights = np.array([cubic_weights(phase) for phase in phases.tolist()]) @ shifted
    x = np.arange(shifted.shape[1]) - 1 - radius - phases[:, None]
    profile = erf(x / (np.sqrt(2) * max(blur_px, 1e-3)))
    return np.stack([np.sum(weights**2, 1), np.sum((weights * profile) ** 2, 1)], axis=1)


@cache
def bar_gain() -> Array:
    """Like ``noise_gain`` for BR8."""
    kernel = np.array([1.0, 1, 1, 1, 0, -1, -1, -1, -1])
    out = np.zeros((PHASES + 1, 2))
    for i, phase in enumerate(np.linspace(0, 1, PHASES + 1).tolist()):
        weights = np.convolve(cubic_weights(phase), kernel)
        out[i] = np.sum(weights**2)
    return out


def edge_filter(plan: AxisPlan, matched: bool, blur_px: float, scale: float) -> Filter:
    """Build the filters of every source for edges of the given blur.

    Parameters
    ----------
    plan : AxisPlan
        The axis.
    matched : bool
        Matched filter, or the paper's cubic fit on raw samples.
    blur_px : float
        Standard deviation of the edges, camera pixels.
    scale : float
        Camera pixels per DMD pixel.
    """
    stripes = [2 * s.half_period_px * scale for s in plan.sources]
    kernels = [
        gaussian_taps(sd, min(MAX_RADIUS_PX, int(np.ceil(3 * sd)))) if matched else np.ones(1)
        for sd in (max(0.4, min(blur_px, STRIPE_PART * w)) for w in stripes)
    ]
    taps = np.zeros((len(kernels), max(k.size for k in kernels)), np.float32)
    for row, k in zip(taps, kernels, strict=True):
        row[: k.size] = k
    different = {k.tobytes(): k for k in kernels}
    gains = {key: noise_gain(k, blur_px) for key, k in different.items()}
    gain = [gains[k.tobytes()] for k in kernels] + [bar_gain()]
    total = [float(np.sqrt(blur_px**2 + tap_variance(k))) for k in kernels]
    slope = [stripe_slope(w, s) for w, s in zip(stripes, total, strict=True)]
    slope.append(bar_slope(min(stripes), blur_px))
    return Filter(taps, np.array(gain, np.float32), np.array(slope, np.float32))
