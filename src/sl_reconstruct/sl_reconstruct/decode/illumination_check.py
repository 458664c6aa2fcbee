"""Whether every image of a stack was taken under the same light.

Edges of a pattern and its inverse cross where they should only when both had the same light: an
image that is brighter by a part g moves them by about ``g / 4 * sqrt(2 pi) s`` for a blur s, twice
that where a single image meets a threshold. Nothing else of the stack shows it.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import StackError
from sl_projector.sequence.pattern_sequence import Axis, Kind, PatternSequence
from sl_reconstruct.decode.settings import Settings

#: Rows and pixels looked at, evenly spread over the image.
LIGHT_ROWS, LIGHT_PIXELS = 16, 2400
#: A pixel of a single image is lit from this part of the way from its dark to its bright level on.
LIT_PART = 0.7
#: Half a stripe, D, over the edges' blur from which on the stripe's middle has its full light:
#: half of its lit pixels lie beyond 2.7 blurs of an edge, where a blurred edge lacks 0.3 %.
WIDE = 5.0
#: Blur from which on its measurement ends, px: it may be any larger one.
MAX_BLUR_PX = 3.9
#: Fewer lit pixels of an image say nothing about its light.
MIN_PIXELS = 64
#: Standard errors of an image's light that are allowed on top of the limit.
ALLOWED_ERRORS = 4.0
#: Images with others of the same stripes have the limit; images of one kind of stripes this many
#: times that (glare and interreflection differ by what is lit); white and black, which move no
#: edge, four times (projectors droop at full load).
OTHERS, FULL = 2.0, 4.0

Group = tuple[Kind, Axis, int, bool]


class Level(NamedTuple):
    """Light of an image over the stack's; NaN where it cannot be seen."""

    light: float
    error: float


class Reference(NamedTuple):
    """Second largest and second smallest value of every pixel, and the values of the images.

    The second, not the first: one image alone may be wrong.
    """

    images: NDArray[np.float32]
    bright: NDArray[np.float32]
    dark: NDArray[np.float32]


class Roles(NamedTuple):
    """What the images of a sequence can be compared with.

    ``partner``: index of each image's inverse, -1 for none. ``alike``: images of the same stripes,
    shifted or inverted, at least two. ``single``: Gray images without an inverse, and white.
    """

    partner: tuple[int, ...]
    alike: tuple[tuple[int, ...], ...]
    single: tuple[int, ...]
    white: tuple[int, ...]
    black: tuple[int, ...]


@functools.lru_cache(maxsize=16)
def roles_of(sequence: PatternSequence) -> Roles:
    """Sort the images of a sequence by what they can be compared with."""
    index = {p: i for i, p in enumerate(sequence.patterns)}
    partner, groups, full = [], dict[Group, list[int]](), ([], [])  # type: ignore[var-annotated]
    for i, p in enumerate(sequence.patterns):
        if p.kind == "gray":
            partner.append(index.get(p.inverse(), -1))
            key = (p.kind, p.axis, p.half_period_px, partner[i] >= 0)
            groups.setdefault(key, []).append(i)
        else:
            partner.append(-1)
            full[(p.kind == "white") == p.inverted].append(i)
    alike = tuple(tuple(g) for g in groups.values() if len(g) > 1)
    single = [i for i, other in enumerate(partner) if other < 0 and i not in full[1]]
    return Roles(tuple(partner), alike, tuple(single), tuple(full[0]), tuple(full[1]))


def check_illumination(
    stack: NDArray[Any], sequence: PatternSequence, settings: Settings, saturation: int,
    blur_px: float, scale_px: float,
) -> float:  # fmt: skip
    """Refuse a stack of which one image was taken under other light.

    Parameters
    ----------
    stack : ndarray, (N, H, W)
        Images in pattern order, DN.
    sequence : PatternSequence
        What was projected.
    settings : Settings
        ``max_light_change`` is the limit, ``min_contrast_dn`` what counts as lit.
    saturation : int
        Pixels that reach it in two images or more are left out, DN.
    blur_px, scale_px : float
        Standard deviation of the edges' blur, and camera pixels per DMD pixel. Stripes that the
        blur fills are compared with the same stripes only, none where the blur is not known.

    Returns
    -------
    float
        Greatest deviation of an image from those of the same stripes, as a part of its light; of
        all images where none has such; NaN where too little is lit.

    Raises
    ------
    StackError
        Naming the image, what was found and what was expected.

    Notes
    -----
    Not seen: light that changes for all images of the same stripes alike, slow drift below the
    limit from image to image, and a change that saturation cuts off below the limit.
    """
    contrast_dn = settings.min_contrast_dn or 0.03 * saturation
    roles = roles_of(sequence)
    reference = _sample(stack, contrast_dn, saturation)
    levels = [_level(reference, i, roles) for i in range(len(stack))]
    light = np.array([level.light for level in levels])
    error = np.array([level.error for level in levels])
    light[_blurred(sequence, roles, blur_px, scale_px)] = np.nan
    off, near = _deviations(light, roles)
    limit = settings.max_light_change * np.where(near, 1.0, OTHERS)
    limit[[*roles.white, *roles.black]] = settings.max_light_change * FULL
    excess = np.abs(off) - limit - ALLOWED_ERRORS * error
    if np.nanmax(excess, initial=-np.inf) > 0:
        worst = int(np.nanargmax(excess))
        raise StackError(_told(worst, float(off[worst]), float(limit[worst]), worst in roles.black))
    shown = off[near] if np.isfinite(off[near]).any() else off
    return float(np.nanmax(np.abs(shown))) if np.isfinite(shown).any() else float("nan")


def _blurred(
    sequence: PatternSequence, roles: Roles, blur_px: float, scale_px: float
) -> list[int]:  # fmt: skip
    """Images whose stripes are filled by the blur and which have no others to compare with."""
    known = blur_px < MAX_BLUR_PX and abs(scale_px) > 0
    least = WIDE * blur_px / abs(scale_px) if known else np.inf
    others = {i for group in roles.alike for i in group} | set(roles.white)
    half = [p.half_period_px for p in sequence.patterns]
    return [i for i in roles.single if i not in others and half[i] < least]


def _told(image: int, off: float, limit: float, black: bool) -> str:
    if black:
        found = f"the black image has {off:.1%} of the full light more than the darkest others"
    else:
        found = f"{abs(off):.1%} {'brighter' if off > 0 else 'darker'} than the other images"
    return (
        f"image {image}: {found}; expected at most {limit:.1%}: the lamp, the exposure or the gain "
        "changed during the scan"
    )


def _sample(stack: NDArray[Any], contrast_dn: float, saturation: int) -> Reference:
    """Some pixels of all images, those that are lit and not saturated."""
    _, height, width = stack.shape
    ys = np.unique(np.linspace(0, height - 1, min(LIGHT_ROWS, height) + 2)[1:-1].astype(int))
    step = max(1, round(width * ys.size / LIGHT_PIXELS))
    images = stack[:, ys, ::step].reshape(len(stack), -1)
    bright, dark = _second(images, np.maximum, np.minimum), _second(images, np.minimum, np.maximum)
    lit = (bright < saturation) & (bright > dark + contrast_dn)
    return Reference(*(part[..., lit].astype(np.float32) for part in (images, bright, dark)))


def _second(images: NDArray[Any], outer: np.ufunc, inner: np.ufunc) -> NDArray[Any]:
    """Second largest value of every pixel (``outer`` the maximum), or second smallest."""
    if len(images) < 2:
        return np.asarray(images[0])
    first, second = outer(images[0], images[1]), inner(images[0], images[1])
    for image in images[2:]:
        outer(second, inner(first, image), out=second)
        outer(first, image, out=first)
    return np.asarray(second)


def _level(reference: Reference, image: int, roles: Roles) -> Level:
    """Light of an image over the reference's, at the pixels it lights.

    Pattern and inverse together are bright and dark together, blurred or not; so the brighter of
    the two is compared with what the other leaves. For black it is what black adds to the dark.
    """
    values, bright, dark = reference.images[image], reference.bright, reference.dark
    other = roles.partner[image]
    if image in roles.black:
        part = 1 + (values - dark) / bright
    elif other >= 0:
        lit = values > reference.images[other]
        left = (bright + dark - reference.images[other])[lit]
        part = values[lit] / np.maximum(left, 0.1 * bright[lit])
    else:
        lit = values > dark + LIT_PART * (bright - dark)
        part = values[lit] / bright[lit]
    return _centre(part)


def _centre(part: NDArray[np.float32]) -> Level:
    """Mean between two quantiles: robust as a median, without its steps of whole DN.

    Both lie above the lower side, which edges blur.
    """
    n = part.size
    if n < MIN_PIXELS:
        return Level(float("nan"), float("nan"))
    lower, upper = int(0.45 * n), int(0.75 * n)
    ordered = np.partition(part, (lower, upper))
    light = float(ordered[lower : upper + 1].mean())
    return Level(light, 3.0 * (float(ordered[upper]) - light) / np.sqrt(n))


def _deviations(light: NDArray[np.float64], roles: Roles) -> tuple[Any, NDArray[np.bool_]]:
    """How far each image lies from the ones it is compared with; which have others of its stripes.

    Of two images the one nearer to all others is the reference.
    """
    off, near = light / _middle(light) - 1, np.zeros(light.size, bool)
    if len(roles.single) > 2:
        single = list(roles.single)
        off[single] = light[single] / _middle(light[single]) - 1
    for group in map(list, roles.alike):
        if np.isfinite(light[group]).sum() < 2:
            continue
        apart = np.abs(off[group])
        nearest = light[group][np.nanargmin(apart)]
        centre = nearest if len(group) == 2 else _middle(light[group])
        off[group], near[group] = light[group] / centre - 1, True
    off[list(roles.black)] = light[list(roles.black)] - 1
    return off, near


def _middle(light: NDArray[np.float64]) -> float:
    known = light[np.isfinite(light)]
    return float(np.median(known)) if known.size else float("nan")
