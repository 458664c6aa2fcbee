"""Pictures say what the data say: colours where they belong, gaps as gaps, units that fit."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import to_hex, to_rgb

from sl_bringup.results.scan_pictures import (
    ABSENT_COLOUR,
    MISSING_COLOUR,
    PRESENT_COLOUR,
    REASON_COLOURS,
    SATURATED_COLOUR,
    contrast_picture,
    height_picture,
    profile_picture,
    refusal_picture,
    relief_picture,
    residual_picture,
)
from sl_common.pages.page import length
from sl_reconstruct.cloud.cloud_writer import POINT_FIELDS
from sl_reconstruct.cloud.height_map import HeightMap
from support.png_files import pixels

SHAPE = (120, 160)


def share(image: np.ndarray, colour: str) -> float:
    """Part of the picture that has a colour, to within rounding."""
    rgb = np.round(255 * np.array(to_rgb(colour)))
    return float((np.abs(image.astype(int) - rgb).max(axis=-1) <= 1).mean())


def ramp(missing: float = 0.0) -> HeightMap:
    """Heights that rise to the right by 100 um; the left part may be missing."""
    z = np.tile(np.linspace(0, 1e-4, SHAPE[1], dtype=np.float32), (SHAPE[0], 1))
    z[:, : int(missing * SHAPE[1])] = np.nan
    return HeightMap(z, -1e-3, 1e-3, 1e-5)


def cloud() -> np.ndarray:
    points = np.zeros(SHAPE, [(name, "<f4") for name in POINT_FIELDS])
    points["x"] = np.linspace(-6e-3, 6e-3, SHAPE[1])
    points["z"] = 1e-4 * np.sin(1e3 * points["x"])
    points["sigma"] = 2e-5
    return points


@pytest.mark.parametrize(
    ("draw", "colour"), [(height_picture, MISSING_COLOUR), (relief_picture, ABSENT_COLOUR)]
)
def test_missing_parts_have_the_colour_of_missing_parts(draw: object, colour: str) -> None:
    whole, half = (share(pixels(draw(ramp(part), "t")), colour) for part in (0.0, 0.5))
    assert whole < 0.01
    # Half of the axes, which fill most of the figure.
    assert 0.2 < half < 0.5


def test_deviations_are_red_above_and_blue_below() -> None:
    height = ramp()
    deviation = height.z_m - 5e-5
    image = pixels(residual_picture(height, deviation, "t")).astype(int)
    middle = image[image.shape[0] // 2]
    red = np.flatnonzero((middle[:, 0] > 120) & (middle[:, 2] < 80))
    blue = np.flatnonzero((middle[:, 2] > 120) & (middle[:, 0] < 80))
    inside = red < 0.8 * image.shape[1]  # beyond lies the colour bar
    assert blue.size > 20
    assert red[inside].size > 20
    assert blue.mean() < red[inside].mean()


def test_relief_is_lit_from_the_left() -> None:
    x = np.linspace(-1, 1, SHAPE[1], dtype=np.float32)
    ridge = HeightMap(np.tile(-np.abs(x) * 1e-4, (SHAPE[0], 1)), 0.0, 1e-3, 1e-5)
    image = pixels(relief_picture(ridge, "t"))
    row = image[image.shape[0] // 2, 100:800].mean(axis=-1)
    assert row[:250].mean() > row[-250:].mean() + 100


def test_every_reason_has_its_colour_and_place() -> None:
    names = ("contrast", "saturation", "shadow")
    reasons = np.zeros(SHAPE, np.uint8)
    reasons[:, :40] = 1
    reasons[:30, 40:80] = 2
    reasons[30:60, 40:80] = 4
    counts = {"points": int((reasons == 0).sum()), "not lit": int((reasons == 1).sum())}
    counts |= {name: int((reasons == i + 2).sum()) for i, name in enumerate(names)}
    image = pixels(refusal_picture(reasons, names, counts, "t"))
    shares = {
        "points": share(image, PRESENT_COLOUR),
        "not lit": share(image, MISSING_COLOUR),
        **{name: share(image, REASON_COLOURS[i]) for i, name in enumerate(names)},
    }
    assert shares["saturation"] < 1e-3  # nothing of it, so not in the legend either
    total = sum(shares.values())
    for name, count in counts.items():
        # The legend's patches (1 %) come on top of the map.
        assert shares[name] / total == pytest.approx(count / reasons.size, abs=0.02)


def test_single_refused_points_can_be_seen_in_a_large_map() -> None:
    reasons = np.zeros((1200, 1024), np.uint8)
    reasons[::100, ::100] = 2
    counts = {"points": int((reasons == 0).sum()), "contrast": int((reasons == 2).sum())}
    image = pixels(refusal_picture(reasons, ("contrast",), counts, "t"))
    axes = image[40:490, 80:890]
    assert share(axes, REASON_COLOURS[0]) * axes[..., 0].size > 100


#: #56B4E9 at 60 % on white.
BAND = "#9ad2f2"


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_contrast_is_that_of_the_images_and_marks_what_is_saturated(dtype: type) -> None:
    """Left no contrast, middle all of it but one step, a quarter on the right saturated."""
    full = int(np.iinfo(dtype).max)
    images = np.full((3, 120, 160), full // 2, dtype)
    images[0, :, 40:120], images[2, :, 40:120] = 0, full - 1
    images[1, :, 120:] = full
    picture = pixels(contrast_picture(images, full, "t"))
    levels = [to_hex(colormaps["viridis"](part)) for part in (0.0, (full - 1) / full)]
    none, most, red = (share(picture, colour) for colour in (*levels, SATURATED_COLOUR))
    # A quarter, a half and a quarter of the axes; the colour bar has little of each.
    assert none == pytest.approx(red, rel=0.05)
    assert most == pytest.approx(2 * red, rel=0.05)
    assert red > 0.1


def test_profile_shows_its_band() -> None:
    points = cloud()
    plain = share(pixels(profile_picture(points, "t")), BAND)
    points["sigma"] = 0
    none = share(pixels(profile_picture(points, "t")), BAND)
    assert plain > 5 * max(none, 1e-4)


def test_profile_survives_gaps_and_emptiness() -> None:
    points = cloud()
    for name in ("x", "z", "sigma"):
        points[name][:, 50:90] = np.nan
    assert pixels(profile_picture(points, "t")).shape[2] == 3
    points["z"][:, 1:] = np.nan
    assert pixels(profile_picture(points, "t")).shape[2] == 3


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_level_and_empty_maps_are_drawn(value: float) -> None:
    height = HeightMap(np.full(SHAPE, value, np.float32), 0.0, 1e-3, 1e-5)
    for png in (
        height_picture(height, "t"),
        relief_picture(height, "t"),
        residual_picture(height, height.z_m, "t"),
    ):
        assert min(pixels(png).shape[:2]) > 200


def test_lengths_for_people() -> None:
    assert length(1.23456e-7) == "0.1235 µm"
    assert length(2.5e-3) == "2.5 mm"
    assert length(float("nan")) == "unknown"
