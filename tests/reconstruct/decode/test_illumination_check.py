"""A stack of which one image was taken under other light is refused, and the image is named.

The images are closed forms times a factor; what is expected is that factor.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sl_common.errors import ConfigError, StackError
from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence, named
from sl_reconstruct.decode.illumination_check import check_illumination
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.reconstruction.reconstructor import Reconstructor
from support.scenes.rigs import STRIP, small_rig
from support.scenes.stripe_scenes import WHITE_DN, Plane, expose, noiseless

#: Gray images, all of which can be judged, white where there is one, fine ones with and without
#: an inverse.
IMAGES = {"paper": (0, 5, 7, 9, 10), "precise": (0, 2, 6, 9, 10, 24)}
CASES = [(name, image) for name, images in IMAGES.items() for image in images]
#: Camera pixels per DMD pixel: 700 pixels see 490 columns or so.
SCALE_PX = 1.4
SEQUENCES = ("paper", "precise", "paper-rows")


@cache
def images(name: str, blur_px: float = 1.14) -> np.ndarray:
    height = 120 if "rows" in name else 48
    return noiseless(Plane(small_rig((*STRIP[:3], height))), named(name), blur_px)


def flickered(name: str, image: int, factor: float, seed: int = 1) -> np.ndarray:
    """The stack of one image under ``factor`` times the light."""
    mean = images(name).copy()
    mean[image] *= factor
    return expose(mean, seed)


def check(stack: np.ndarray, name: str, blur_px: float = 1.14, **settings: float) -> float:
    return check_illumination(stack, named(name), Settings(**settings), 255, blur_px, SCALE_PX)


@pytest.mark.parametrize(("name", "image"), CASES)
def test_a_doubled_exposure_is_named(name: str, image: int) -> None:
    """Twice 190 DN ends at the full scale, 255 / 190 = 1.34; beside edges it is twice the light."""
    with pytest.raises(StackError, match=rf"image {image}: [3-9]\d\.\d% brighter") as caught:
        check(flickered(name, image, 2.0), name)
    assert "expected at most" in str(caught.value)


@pytest.mark.parametrize("factor", [1.1, 0.9])
@pytest.mark.parametrize(("name", "image"), [c for c in CASES if c != ("precise", 0)])
def test_a_flicker_of_ten_percent_is_named(name: str, image: int, factor: float) -> None:
    word = "brighter" if factor > 1 else "darker"
    with pytest.raises(StackError, match=rf"image {image}: (8|9|10|11)\.\d% {word}"):
        check(flickered(name, image, factor), name)


@pytest.mark.parametrize("factor", [1.15, 0.85])
def test_white_may_deviate_more_for_it_moves_no_edge(factor: float) -> None:
    """Four times the limit, and the standard error; so 10 % pass and 15 % do not."""
    assert check(flickered("precise", 0, 1.1), "precise") < 0.01
    with pytest.raises(StackError, match=r"image 0: 1[3-6]"):
        check(flickered("precise", 0, factor), "precise")


def test_light_on_the_black_image_is_named() -> None:
    mean = images("precise").copy()
    mean[1] += 0.3 * WHITE_DN
    with pytest.raises(StackError, match=r"image 1: the black image has (29|30|31)\.\d% of"):
        check(expose(mean, 1), "precise")


@pytest.mark.parametrize(("name", "image"), [("paper", 9), ("precise", 12)])
def test_the_limit_is_the_one_of_the_settings(name: str, image: int) -> None:
    """5 % brighter among eight or four of the same stripes; limits far from it on either side."""
    stack = flickered(name, image, 1.05)
    with pytest.raises(StackError, match=f"image {image}: "):
        check(stack, name)
    assert check(stack, name, max_light_change=0.08) == pytest.approx(0.05, abs=0.012)
    with pytest.raises(ConfigError, match="max_light_change=0"):
        Settings(max_light_change=0)


@pytest.mark.parametrize(("name", "image"), [("paper", 9), ("precise", 12)])
def test_the_reconstruction_refuses_it(name: str, image: int) -> None:
    reconstructor = Reconstructor(small_rig(STRIP), named(name))
    with pytest.raises(StackError, match=f"image {image}: "):
        reconstructor(flickered(name, image, 1.1))
    light = reconstructor(expose(images(name), 2)).figures.light_change
    assert 0 <= light < 0.012  # two DN of 190


@pytest.mark.parametrize("name", SEQUENCES)
def test_good_stacks_pass(name: str) -> None:
    """Over seeds; much ambient light, little light, blur, steps, shadows, metal, black parts."""
    mean, rng = images(name), np.random.default_rng(5)
    blotches = np.kron(rng.uniform(0.05, 1.3, (mean.shape[1] // 24 + 1, 30)), np.ones((24, 24)))
    blotches = blotches[: mean.shape[1], :700]
    half, patch = np.ones(700), np.zeros(700)
    half[300:], patch[:40] = 4.0, 1.0
    stacks = [expose(mean, seed) for seed in range(4)]
    stacks += [expose(mean + add, 7) for add in (20.0, 60.0)]
    stacks += [expose(part * mean, 8) for part in (0.15, 0.0, blotches, half, patch)]
    shifted = np.roll(mean, 23, axis=2)
    shifted[:, :, :23] = 5
    stacks.append(expose(np.where(np.arange(700) < 350, mean, shifted), 10))
    for stack in stacks:
        assert not check(stack, name) > 0.03


@pytest.mark.parametrize("name", ["paper", "precise"])
@pytest.mark.parametrize("blur_px", [0.3, 2.5, 4.0, 7.0])
def test_blur_is_no_change_of_light(name: str, blur_px: float) -> None:
    """Measured blur ends at 4 px; at 7 px the stripes of 10 px are as weak as a few DN."""
    found = check(expose(images(name, blur_px), 9), name, min(blur_px, 4.0))
    assert not found > (0.03 if blur_px <= 4 else 0.1)


def test_pairs_alone_have_no_white_to_compare_with() -> None:
    """Ten Gray bits in pairs, no white, no black: the finest are blurred, yet pairs agree."""
    gray = [Pattern("gray", "column", bit, 9, 2) for bit in range(9)]
    sequence = PatternSequence("g", (1024, 768), tuple(q for p in gray for q in (p, p.inverse())))
    mean = noiseless(Plane(small_rig(STRIP)), sequence, 2.5)
    known = sequence, Settings(), 255, 2.5, SCALE_PX
    assert check_illumination(expose(mean, 1), *known) < 0.01
    for image in (5, 16):
        spoilt = mean.copy()
        spoilt[image] *= 1.1
        with pytest.raises(StackError, match=rf"image {image}: \d+\.\d% brighter"):
            check_illumination(expose(spoilt, 1), *known)
