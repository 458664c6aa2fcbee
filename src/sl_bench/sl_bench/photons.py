"""From electrons to DN: shot noise, read noise, clip, quantise; seeded by counter.

Every random number is a hash of (seed, frame, pixel), so a frame is the same whatever the order
and number of threads that make it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, uint64

#: Above this mean, a Poisson number is taken as a Gaussian of the same mean and variance.
GAUSSIAN_FROM_E = 30.0

_GOLDEN = 0x9E3779B97F4A7C15
_TO_UNIT = 1.0 / 4294967296.0


@njit(cache=True, nogil=True, error_model="numpy")
def mix(x: Any) -> Any:
    """Hash a 64-bit number (splitmix64's finaliser: Steele, Lea and Flood, 2014)."""
    x = uint64(x)
    x = (x ^ (x >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> uint64(27))) * uint64(0x94D049BB133111EB)
    return x ^ (x >> uint64(31))


@njit(cache=True, nogil=True, error_model="numpy")
def frame_key(seed: int, frame_number: int) -> Any:
    """Start of a frame's random numbers."""
    return mix(mix(uint64(seed) + uint64(_GOLDEN)) + uint64(frame_number) * uint64(_GOLDEN))


@njit(cache=True, nogil=True, error_model="numpy")
def _poisson(mean: float, uniform: float) -> Any:
    """Poisson number by inversion, for small means."""
    term = np.exp(-mean)
    total, count = term, 0
    while uniform > total and count < 200:
        count += 1
        term *= mean / count
        total += term
    return float(count)


@njit(cache=True, nogil=True, error_model="numpy")
def _read_out(mean_e: float, normal: float, read_e: float, bits: Any) -> Any:
    """Electrons that are read: Poisson of the mean plus Gaussian read noise."""
    if mean_e >= GAUSSIAN_FROM_E:
        return mean_e + np.sqrt(mean_e + read_e * read_e) * normal
    uniform = ((mix(bits) >> uint64(32)) + 0.5) * _TO_UNIT
    return _poisson(max(mean_e, 0.0), uniform) + read_e * normal


@njit(cache=True, nogil=True, error_model="numpy")
def _quantise(dn: float, max_dn: float) -> Any:
    return min(max(np.rint(dn), 0.0), max_dn)


@njit(cache=True, nogil=True, error_model="numpy")
def digitise(electrons: Any, rows: Any, sensor: Any, key: Any, out: Any) -> None:
    """Write some rows of the DN image of the mean electrons, rounded and clipped.

    Parameters
    ----------
    electrons : ndarray, (H, W) float32
        Mean number of electrons at the end of the exposure.
    rows : tuple of int
        First row and the one behind the last.
    sensor : tuple of float
        Gain in DN per electron, read noise in electrons, top of the scale in DN.
    key : uint64
        From `frame_key`.
    out : ndarray, (H, W) uint8 or uint16
        Receives the image.
    """
    dn_per_e, read_e, max_dn = sensor
    width = electrons.shape[1]
    pairs = (width + 1) // 2
    for y in range(rows[0], rows[1]):
        for pair in range(pairs):
            bits = mix(key + uint64(y * pairs + pair) * uint64(_GOLDEN))
            u1 = ((bits & uint64(0xFFFFFFFF)) + 1.0) * _TO_UNIT
            angle = (bits >> uint64(32)) * (2.0 * np.pi * _TO_UNIT)
            radius = np.sqrt(-2.0 * np.log(u1))  # Box and Muller (1958): two numbers at once
            x = 2 * pair
            e = _read_out(electrons[y, x], radius * np.cos(angle), read_e, bits)
            out[y, x] = _quantise(e * dn_per_e, max_dn)
            if x + 1 < width:
                e = _read_out(electrons[y, x + 1], radius * np.sin(angle), read_e, ~bits)
                out[y, x + 1] = _quantise(e * dn_per_e, max_dn)
