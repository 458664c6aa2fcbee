"""From electrons to DN: shot noise, read noise, clip, quantise; seeded by counter.

Every random number is a hash of (seed, frame, pixel), so a frame is the same whatever the order
and number of threads that make it.
"""

from __future__ import annotations

from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_common.kernel_cache import kernel

Image = NDArray[np.float32]
Digital = NDArray[np.uint8] | NDArray[np.uint16]

#: Above this mean, a Poisson number is taken as a Gaussian of the same mean and variance.
GAUSSIAN_FROM_E = 30.0

_GOLDEN = 0x9E3779B97F4A7C15
_TO_UNIT = 1.0 / 4294967296.0
#: Bits of a float32's mantissa that pick an entry of the normal table; 16 interpolate.
_ENTRY_BITS = 7
_BETWEEN_BITS = 23 - _ENTRY_BITS


def _normal_table() -> NDArray[np.float32]:
    """Upper tail of the normal distribution: z that a share of n / 2^32 exceeds.

    Entries are spaced as floating-point numbers n from 1 to 2^31 are, 128 to an octave, so the
    tail is as fine as the middle: linear between them, z is within 1e-5.
    """
    ends = np.array([1.0, 2.0**31], dtype=np.float32).view(np.int32) >> _BETWEEN_BITS
    bits = np.arange(ends[0], ends[1] + 2, dtype=np.int32) << _BETWEEN_BITS
    shares = np.minimum(bits.view(np.float32).astype(np.float64) * _TO_UNIT, 0.5)
    return np.array([-NormalDist().inv_cdf(share) for share in shares], dtype=np.float32)


_NORMAL = _normal_table()
_FIRST_ENTRY = int(np.float32(1.0).view(np.int32)) >> _BETWEEN_BITS


class Sensor(NamedTuple):
    """Gain, read noise and top of the scale of the sensor."""

    dn_per_e: float
    read_noise_e: float
    max_dn: float


@kernel()
def mix(x: np.uint64) -> np.uint64:
    """Hash a 64-bit number (splitmix64's finaliser: Steele, Lea and Flood, 2014)."""
    x = np.uint64(x)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.uint64(x ^ (x >> np.uint64(31)))


@kernel()
def frame_key(seed: np.uint64, frame_number: np.uint64) -> np.uint64:
    """Start of a frame's random numbers.

    Parameters
    ----------
    seed, frame_number : uint64
        Equal numbers give equal frames.
    """
    return mix(
        mix(np.uint64(seed) + np.uint64(_GOLDEN)) + np.uint64(frame_number) * np.uint64(_GOLDEN)
    )


@kernel()
def _poisson(mean: float, uniform: float) -> float:
    """Poisson number by inversion, for small means."""
    term = np.exp(-mean)
    total, count = term, 0
    while uniform > total and count < 200:
        count += 1
        term *= mean / count
        total += term
    return float(count)


@kernel()
def _normal(bits: np.uint32) -> np.float32:
    """Normal number of 32 random bits, by inversion: a sign, and the share of its tail."""
    share = np.float32(np.int32(bits >> np.uint32(1))) + np.float32(1.0)
    place = np.float32(share).view(np.int32)
    entry = (place >> _BETWEEN_BITS) - _FIRST_ENTRY
    between = np.float32(place & ((1 << _BETWEEN_BITS) - 1)) * np.float32(2.0**-_BETWEEN_BITS)
    z = _NORMAL[entry] + between * (_NORMAL[entry + 1] - _NORMAL[entry])
    return np.float32(-z if bits & np.uint32(1) else z)


@kernel()
def _normals(key: np.uint64, first: int, z: Image) -> None:
    """Fill an even number of normal numbers; each pair is that of its counter."""
    for pair in range(z.size // 2):
        bits = mix(key + np.uint64(first + pair) * np.uint64(_GOLDEN))
        z[2 * pair] = _normal(np.uint32(bits))
        z[2 * pair + 1] = _normal(np.uint32(bits >> np.uint64(32)))


@kernel()
def _read_out(mean_e: Image, z: Image, sensor: Sensor, out: Digital) -> bool:
    """Write a row of DN; whether some mean is too small to be taken as a Gaussian."""
    dn_per_e, top = np.float32(sensor.dn_per_e), np.float32(sensor.max_dn)
    read_e2 = np.float32(sensor.read_noise_e * sensor.read_noise_e)
    lowest = np.float32(np.inf)
    for x in range(out.size):
        e = max(mean_e[x], np.float32(0.0))
        dn = np.rint((e + np.sqrt(e + read_e2) * z[x]) * dn_per_e)
        out[x] = np.int32(min(max(dn, np.float32(0.0)), top))
        lowest = min(lowest, e)
    return bool(lowest < GAUSSIAN_FROM_E)


@kernel()
def _count_few(
    mean_e: Image, z: Image, sensor: Sensor, key: np.uint64, first: int, out: Digital
) -> None:
    """Write the DN of a row's small means: a Poisson number plus Gaussian read noise."""
    dn_per_e, read_e, top = sensor
    for x in range(out.size):
        if mean_e[x] < GAUSSIAN_FROM_E:
            bits = mix(~(key + np.uint64(first + x) * np.uint64(_GOLDEN)))
            uniform = ((bits >> np.uint64(32)) + 0.5) * _TO_UNIT
            e = _poisson(max(mean_e[x], 0.0), uniform) + read_e * z[x]
            out[x] = min(max(np.rint(e * dn_per_e), 0.0), top)


@kernel()
def digitise(
    electrons: Image, rows: tuple[int, int], sensor: Sensor, key: np.uint64, out: Digital
) -> None:
    """Write some rows of the DN image of the mean electrons, rounded and clipped.

    Parameters
    ----------
    electrons : ndarray, (H, W) float32
        Mean number of electrons at the end of the exposure.
    rows : tuple of int
        First row and the one behind the last.
    sensor : Sensor
        Its numbers.
    key : uint64
        From `frame_key`.
    out : ndarray, (H, W) uint8 or uint16
        Receives the image.
    """
    width = electrons.shape[1]
    pairs = (width + 1) // 2
    z = np.empty(2 * pairs, dtype=np.float32)
    for y in range(rows[0], rows[1]):
        _normals(key, y * pairs, z)
        if _read_out(electrons[y], z, sensor, out[y]):
            _count_few(electrons[y], z, sensor, key, 2 * y * pairs, out[y])
