"""DMD coordinates at camera pixels, on images that closed forms give the coordinates of."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from sl_common.errors import SequenceError, StackError
from sl_projector.sequence.pattern_sequence import PatternSequence, named
from sl_reconstruct.reconstruction.correspondence import correspondences

DMD = (256, 192)
CAMERA = (320, 240)
#: DMD (column, row) = MATRIX @ (u, v, 1): turned by 3 degrees, mirrored in neither axis.
SCALE, TURN = 0.74, np.deg2rad(3.0)
MATRIX = np.array([
    [SCALE * np.cos(TURN), -SCALE * np.sin(TURN), 8.3],
    [SCALE * np.sin(TURN), SCALE * np.cos(TURN), -2.6],
])  # fmt: skip
NOISE_DN = 1.5
#: Blur of an edge, camera pixels; the same in every direction, as the map turns and scales only.
BLUR_PX = 0.85
#: Samples of a DMD pixel; its boundaries lie between samples.
_FINE = 64
_MARGIN_PX = 100


def blurred(profile: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Light over the DMD coordinate, dark outside, sampled ``_FINE`` times a pixel."""
    padded = np.pad(profile.astype(np.float64), _MARGIN_PX)
    return np.asarray(gaussian_filter1d(np.repeat(padded, _FINE), BLUR_PX * SCALE * _FINE))


def stack_of(
    sequence: PatternSequence, matrix: NDArray[np.float64], seed: int
) -> NDArray[np.uint8]:
    """What a camera sees of a flat under an affine map: stripes with Gaussian edges, noise."""
    u, v = np.meshgrid(np.arange(CAMERA[0]), np.arange(CAMERA[1]))
    dmd = np.stack([u, v], axis=-1) @ matrix[:, :2].T + matrix[:, 2]
    rng = np.random.default_rng(seed)
    full = [np.ones(side, bool) for side in DMD]
    images = []
    for pattern in sequence.patterns:
        along = 0 if pattern.axis == "column" else 1
        profiles = [*full]
        profiles[along] = pattern.profile(DMD[along])
        light = np.ones(CAMERA[::-1])
        for i, profile in enumerate(profiles):
            line = blurred(profile)
            at = (np.arange(line.size) + 0.5) / _FINE - 0.5 - _MARGIN_PX
            light *= np.interp(dmd[..., i], at, line)
        image = 6.0 + 180.0 * light + rng.normal(0.0, NOISE_DN, light.shape)
        images.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return np.stack(images)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_coordinates_are_those_of_the_map(sign: float) -> None:
    """Also where rows count upwards. A patch holds 18 x 25 crossings of 0.03 px noise each; the
    constant of a quadratic has 9/4 the variance of a mean, so 0.002 px; 5 of them are allowed."""
    matrix = MATRIX.copy()
    if sign < 0:
        matrix[1] = -MATRIX[1] + [0.0, 0.0, DMD[1] - 1.0]
    sequence = named("precise-rows", DMD)
    found = correspondences(stack_of(sequence, matrix, 3), sequence)
    assert len(found) >= 24
    expected = found.camera_px @ matrix[:, :2].T + matrix[:, 2]
    error = found.dmd_px - expected
    assert np.abs(error).max() < 0.01
    assert np.abs(error.mean(axis=0)).max() < 0.002
    # Stated sigmas: z-scores near 1. 48 or more numbers know their spread to 10 %.
    assert 0.6 < np.sqrt(np.mean((error / found.sigma_px) ** 2)) < 1.6
    assert 0.005 < found.edge_sigma_px < 0.06


def test_nothing_is_decoded_in_the_dark_and_in_holes() -> None:
    sequence = named("precise-rows", DMD)
    stack = stack_of(sequence, MATRIX, 4)
    whole = correspondences(stack, sequence)
    hole = whole.camera_px[len(whole) // 2]
    u, v = hole.astype(int)
    stack[:, v - 9 : v + 10, u - 9 : u + 10] = 6
    pierced = correspondences(stack, sequence)
    assert not np.any(np.all(pierced.camera_px == hole, axis=1))
    assert len(pierced) >= len(whole) - 1
    assert len(correspondences(np.full_like(stack, 6), sequence)) == 0


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(SequenceError, match="precise-rows"):
        correspondences(np.zeros((25, 8, 8), np.uint8), named("precise", DMD))
    with pytest.raises(StackError, match="expected 44 images"):
        correspondences(np.zeros((3, 8, 8), np.uint8), named("precise-rows", DMD))
