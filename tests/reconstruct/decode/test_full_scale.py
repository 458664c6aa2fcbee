"""Where pixels end: 10, 12 and 14 bits in 16-bit images, from the values alone."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sl_projector.sequence.pattern_sequence import named
from sl_reconstruct.cloud.cloud import Cloud
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.decode.stack_statistics import full_scale_dn, saturation_of
from sl_reconstruct.reconstruction.reconstructor import Reconstructor
from support.scenes.rigs import STRIP, small_rig
from support.scenes.stripe_scenes import WHITE_DN, Plane, expose, noiseless


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_low_bits_end_at_the_last_value(bits: int) -> None:
    """Values as they are: n bits end at 2^n - 1, seen or not."""
    values = np.random.default_rng(bits).integers(0, 1 << bits, (3, 40, 50)).astype(np.uint16)
    assert full_scale_dn(values) == (1 << bits) - 1


@pytest.mark.parametrize("bits", [8, 10, 12, 14])
def test_high_bits_end_below_the_type(bits: int) -> None:
    """Bits in the upper end, as V4L2's and many ROS drivers' mono16: 2^16 - 2^(16 - n)."""
    values = np.random.default_rng(bits).integers(0, 1 << bits, (3, 40, 50)).astype(np.uint16)
    assert full_scale_dn(values << (16 - bits)) == (1 << 16) - (1 << (16 - bits))


def test_eight_bits_and_darkness() -> None:
    assert full_scale_dn(np.full((2, 3, 4), 7, np.uint8)) == 255
    assert full_scale_dn(np.zeros((2, 3, 4), np.uint16)) == 255
    assert saturation_of(np.zeros((2, 3, 4), np.uint16), Settings(saturation_dn=4000)) == 4000


@cache
def overexposed(shift: int) -> tuple[np.ndarray, Cloud]:
    """A 12-bit stack at twice the full scale's light in its left half, and its cloud."""
    mean = noiseless(Plane(small_rig(STRIP)), named("precise"))
    mean[:, :, : mean.shape[2] // 2] *= 2 * 255 / WHITE_DN
    stack = expose(mean, 3, full_scale=4095) << shift
    return stack, Reconstructor(small_rig(STRIP), named("precise"))(stack)


@pytest.mark.parametrize("shift", [0, 4])
def test_saturated_stripes_of_twelve_bits_are_refused(shift: int) -> None:
    """Without being told the bits; with 65535 for the full scale they would pass for edges."""
    stack, cloud = overexposed(shift)
    told = Settings(saturation_dn=4095 << shift)
    same = Reconstructor(small_rig(STRIP), named("precise"), told)(stack)
    assert cloud.points.tobytes() == same.points.tobytes()
    assert cloud.refused["saturation"] > 0.4 * cloud.lit  # the left half
    blind = Settings(saturation_dn=65535)
    assert not Reconstructor(small_rig(STRIP), named("precise"), blind)(stack).refused["saturation"]
