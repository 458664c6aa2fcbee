"""A measurement as it is asked for in one piece, with reference and tolerance, and its answer."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from sl_common.errors import ConfigError
from sl_reconstruct.cloud.cloud_reader import read_height_map
from sl_reconstruct.measure.deviation import map_reference, measure_deviation
from sl_reconstruct.measure.features import FEATURES, Numbers, Points
from sl_reconstruct.measure.region import Region
from sl_reconstruct.measure.result import Measurement, Quantity, Tolerance, Verdict

#: The one kind that needs a file beside the cloud, so it is not among `FEATURES`.
DEVIATION = "deviation"


@dataclass(frozen=True)
class MeasurementRequest:
    """What to measure.

    Parameters
    ----------
    kind : str
        One of `features.FEATURES`, or "deviation".
    region_m : tuple of float
        As the kind wants it, metres; empty is everywhere.
    reference_file : str
        Of a deviation: height map with its report.
    level : bool
        Of a deviation: take offset and tilt out.
    quantity : str
        Which quantity the tolerance is for; empty is the first.
    tolerance : tuple of float
        (low, high) in the quantity's unit; empty: no verdict.
    """

    kind: str
    region_m: Numbers = ()
    reference_file: str = ""
    level: bool = False
    quantity: str = ""
    tolerance: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in (*FEATURES, DEVIATION):
            raise ConfigError(
                f"no measurement is called {self.kind!r}; expected one of "
                f"{', '.join(FEATURES)}, {DEVIATION}"
            )
        if len(self.tolerance) not in (0, 2):
            raise ConfigError(f"tolerance {list(self.tolerance)}; expected [low, high] or nothing")
        if not all(math.isfinite(number) for number in self.region_m):
            raise ConfigError(f"region {list(self.region_m)}; expected finite numbers")
        if self.kind == DEVIATION and not self.reference_file:
            raise ConfigError("a deviation without reference_file; expected a height.tiff")


@dataclass(frozen=True)
class Answer:
    """What was measured.

    Parameters
    ----------
    found : Measurement
        The measurement.
    quantities : tuple of Quantity
        All its quantities, the value first.
    judged : Quantity
        The one that the tolerance is for.
    verdict : {"pass", "fail", "undecided", ""}
        On it; empty where no tolerance was given.
    """

    found: Measurement
    quantities: tuple[Quantity, ...]
    judged: Quantity
    verdict: Verdict | Literal[""]

    @property
    def text(self) -> str:
        """One line a person can act on."""
        first = self.quantities[0]
        line = f"{first.in_words()} (k = 1) from {self.found.points:,} points"
        if not self.verdict:
            return line
        judged = "tolerance" if self.judged == first else self.judged.in_words()
        return f"{line}; {judged}: {self.verdict}"


def measure_cloud(order: MeasurementRequest, points: Points) -> Answer:
    """Measure a cloud.

    Parameters
    ----------
    order : MeasurementRequest
        Kind, regions, reference and tolerance.
    points : Points
        Cloud or height map, metres.

    Raises
    ------
    ConfigError
        When the order cannot be carried out on any cloud.
    StackError
        When this cloud does not hold the feature.
    """
    # A wrong tolerance is refused before the measurement takes its time.
    limits = Tolerance(*order.tolerance) if order.tolerance else None
    found = _measure(order, points)
    judged = found.quantity(order.quantity)
    verdict = limits.verdict(judged.value, judged.uncertainty) if limits else ""
    return Answer(found, found.quantities(), judged, verdict)


def _measure(order: MeasurementRequest, points: Points) -> Measurement:
    if order.kind != DEVIATION:
        return FEATURES[order.kind].measure(points, order.region_m)
    reference = map_reference(read_height_map(order.reference_file))
    region = Region.of(order.region_m) if order.region_m else None
    return measure_deviation(points, reference, region, order.level)
