"""What can be measured, by name: the one table behind the command and the service."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from numpy.typing import NDArray

from sl_common.errors import ConfigError
from sl_reconstruct.measure.groove import measure_groove
from sl_reconstruct.measure.hole import measure_hole
from sl_reconstruct.measure.plane_angle import measure_angle, measure_plane
from sl_reconstruct.measure.profile import measure_profile
from sl_reconstruct.measure.region import Region, Selection, select
from sl_reconstruct.measure.result import Measurement
from sl_reconstruct.measure.roughness import measure_roughness
from sl_reconstruct.measure.sphere_cylinder import measure_cylinder, measure_sphere
from sl_reconstruct.measure.step import measure_step

#: Width of the strip that a section averages where none is given, as a part of its length.
SECTION_WIDTH = 0.01
RECTANGLE = "X0,Y0,X1,Y1"

Points = NDArray[Any]
#: Metres; what they mean is the feature's.
Numbers = tuple[float, ...]


class Feature(NamedTuple):
    """A kind of measurement: what it measures of a cloud from the numbers of a region."""

    help: str
    metavar: str
    measure: Callable[[Points, Numbers], Measurement]


def _region(numbers: Numbers) -> Region | None:
    return Region.of(numbers) if numbers else None


def _chosen(points: Points, numbers: Numbers) -> Selection:
    return select(points, _region(numbers))


def _angle(points: Points, numbers: Numbers) -> Measurement:
    if len(numbers) != 8:
        raise ConfigError(f"an angle with {len(numbers)} numbers; expected two rectangles, so 8")
    return measure_angle(_chosen(points, numbers[:4]), _chosen(points, numbers[4:]))


def _groove(points: Points, numbers: Numbers) -> Measurement:
    if numbers:
        points = points.copy()
        points["z"][~Region.of(numbers).contains(points["x"], points["y"])] = math.nan
    return measure_groove(points)


def _profile(points: Points, numbers: Numbers) -> Measurement:
    if len(numbers) not in (4, 5):
        raise ConfigError(f"a profile of {len(numbers)} numbers; expected X0,Y0,X1,Y1[,WIDTH]")
    x0, y0, x1, y1 = numbers[:4]
    width = numbers[4] if len(numbers) == 5 else SECTION_WIDTH * math.hypot(x1 - x0, y1 - y0)
    return measure_profile(points, (x0, y0), (x1, y1), width)


FEATURES: dict[str, Feature] = {
    "plane": Feature(
        "plane and its flatness", RECTANGLE, lambda p, n: measure_plane(_chosen(p, n))
    ),
    "angle": Feature("included angle of two planes", "RECTANGLE,RECTANGLE", _angle),
    "groove": Feature("included angle of a groove whose flanks are found", "", _groove),
    "step": Feature(
        "height of a step across x, ISO 5436-1", RECTANGLE, lambda p, n: measure_step(_chosen(p, n))
    ),
    "step-y": Feature(
        "height of a step across y", RECTANGLE, lambda p, n: measure_step(_chosen(p, n), "y")
    ),
    "sphere": Feature(
        "radius and centre of a sphere", RECTANGLE, lambda p, n: measure_sphere(_chosen(p, n))
    ),
    "cylinder": Feature(
        "radius and axis of a cylinder", RECTANGLE, lambda p, n: measure_cylinder(_chosen(p, n))
    ),
    "hole": Feature(
        "centre and diameter of the hole in a region",
        RECTANGLE,
        lambda p, n: measure_hole(p, _region(n)),
    ),
    "roughness": Feature(
        "areal roughness, ISO 25178", RECTANGLE, lambda p, n: measure_roughness(p, _region(n))
    ),
    "profile": Feature("section along a line; see --csv", "X0,Y0,X1,Y1[,WIDTH]", _profile),
}
