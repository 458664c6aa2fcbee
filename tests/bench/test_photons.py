"""The photon chain against the closed forms of its statistics."""

import numpy as np
import pytest
from scipy.stats import norm, poisson

from sl_bench.world.photons import Sensor, digitise, frame_key

SHAPE = (400, 1001)  # an odd width: the last pixel of a row has no partner
PIXELS = SHAPE[0] * SHAPE[1]


def key(seed: int = 0, frame: int = 0) -> np.uint64:
    return np.uint64(frame_key(np.uint64(seed), np.uint64(frame)))


def read(mean_e, sensor, k=None, dtype=np.uint16):
    electrons = np.full(SHAPE, mean_e, dtype=np.float32)
    out = np.empty(SHAPE, dtype=dtype)
    digitise(electrons, (0, SHAPE[0]), Sensor(*sensor), key() if k is None else k, out)
    return out.astype(np.float64)


@pytest.mark.parametrize("mean_e", [2.0, 12.0, 29.0, 31.0, 500.0, 15_000.0])
def test_mean_and_variance_are_those_of_light_plus_read_noise(mean_e):
    read_e, gain = 3.0, 2.0
    dn = read(mean_e + 20.0 * (mean_e < 30), (gain, read_e, 65535.0))
    expected = mean_e + 20.0 * (mean_e < 30)  # far enough from 0 that nothing is clipped
    variance = expected + read_e**2 + 1.0 / (12.0 * gain**2)
    # Four standard errors of a mean and of a variance (kurtosis of a Poisson: 1 / mean).
    assert abs(dn.mean() / gain - expected) < 4 * np.sqrt(variance / PIXELS)
    assert dn.var() / gain**2 == pytest.approx(
        variance, rel=4 * np.sqrt((2 + 1 / expected) / PIXELS)
    )


@pytest.mark.parametrize("mean_e", [0.3, 4.0, 20.0])
def test_small_counts_are_poisson(mean_e):
    counts = read(mean_e, (1.0, 0.0, 255.0))
    k = np.arange(int(counts.max()) + 1)
    share = np.bincount(counts.astype(int).ravel()) / PIXELS
    expected = poisson.pmf(k, mean_e)
    sigma = np.sqrt(expected * (1 - expected) / PIXELS)
    assert np.all(np.abs(share - expected) < 5 * sigma + 1 / PIXELS)


def test_darkness_is_read_noise_cut_off_at_zero():
    dn = read(0.0, (1.0, 0.5, 255.0))
    # Rounding to 0 takes everything below 0.5 DN, which is one sigma here.
    for value, share in ((0, norm.cdf(1)), (1, norm.cdf(3) - norm.cdf(1))):
        assert np.mean(dn == value) == pytest.approx(share, abs=4 * np.sqrt(0.25 / PIXELS))
    assert read(0.0, (1.0, 0.0, 255.0)).max() == 0


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (10, np.uint16), (12, np.uint16)])
def test_beyond_the_full_well_is_the_top_of_the_scale(bits, dtype):
    top = float((1 << bits) - 1)
    assert np.all(read(30_000.0, (top / 20_000.0, 40.0, top), dtype=dtype) == top)


def test_numbers_depend_on_seed_and_frame_and_pixel_only():
    sensor = (1.0, 3.0, 65535.0)
    whole = read(1000.0, sensor)
    electrons = np.full(SHAPE, 1000.0, dtype=np.float32)
    parts = np.empty(SHAPE, dtype=np.uint16)
    for rows in ((250, 400), (0, 99), (99, 250)):
        digitise(electrons, rows, Sensor(*sensor), key(), parts)
    assert np.array_equal(whole, parts)
    assert not np.array_equal(whole, read(1000.0, sensor, key(seed=1)))
    assert not np.array_equal(whole, read(1000.0, sensor, key(frame=1)))


def test_noise_is_independent_between_frames_and_neighbours():
    sensor = (1.0, 3.0, 65535.0)
    a, b = (read(1000.0, sensor, key(frame=f)) - 1000.0 for f in (7, 8))
    pairs = [(a, b), (a[:, :-1], a[:, 1:]), (a[:-1], a[1:])]
    pairs += [(x**2, y**2) for x, y in pairs]  # the two of a pair share a hash
    for x, y in pairs:
        correlation = np.corrcoef(x.ravel(), y.ravel())[0, 1]
        assert abs(correlation) < 4 / np.sqrt(x.size)
