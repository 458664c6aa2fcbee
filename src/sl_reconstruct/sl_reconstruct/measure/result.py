"""What every measurement returns, and how its standard uncertainty is made.

A feature is fitted by least squares to n points. The variance of a point is what it states itself
(sigma) plus what its residuals scatter beyond that: roughness, form, an optimistic sigma. It goes
through the fit by the law of propagation (GUM, JCGM 100:2008, 5.1). Errors that neighbours share
show in the means of residuals over blocks of the region: where these scatter more than independent
errors would, the uncertainty is enlarged by that factor (`Fitted.inflation`). A part of every
point's error stays however many points are averaged (`COMMON`). The uncertainty covers noise, form
and the edges' systematic errors; it does not cover the calibration, which shifts and bends all
points alike.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Literal, NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import ConfigError, StackError
from sl_reconstruct.measure.region import Region

Array = NDArray[np.float64]
Verdict = Literal["pass", "fail", "undecided"]

#: Blocks along a side of the region at most, and the least number of points in a block.
BLOCKS, BLOCK_POINTS = 10, 25
#: Part of a point's standard deviation that no averaging takes away: errors of the edges that are
#: the same over the field. From the bench with its true calibration (docs/measure.md): groove
#: angles of 460,000 points are off by 0.00004 degrees, where noise alone explains 0.00003.
COMMON = 0.002
#: Means of blocks count as correlated when they scatter by this many standard errors too much.
SIGNIFICANT = 2.0
#: One-sided 95 %: the guard band of ISO 14253-1:2017 in standard uncertainties.
GUARD = 1.6449


class Quantity(NamedTuple):
    """One quantity of a measurement; NaN where its standard uncertainty is not known."""

    name: str
    value: float
    uncertainty: float
    unit: str

    def in_words(self) -> str:
        """For people: lengths in millimetres from 1 mm on, else in micrometres.

        Examples
        --------
        >>> Quantity("radius", 50.00083e-3, 1.1e-6, "m").in_words()
        'radius 50.0008 ± 0.0011 mm'
        >>> Quantity("a", -0.21328, 1.2e-6, "1").in_words()
        'a -0.2132800 ± 0.0000012'
        """
        factor, unit = 1.0, "" if self.unit == "1" else f" {self.unit}"
        if self.unit == "m":
            factor, unit = (1e3, " mm") if abs(self.value) >= 1e-3 else (1e6, " µm")
        return f"{self.name} {rounded(factor * self.value, factor * self.uncertainty)}{unit}"


def rounded(value: float, u: float) -> str:
    """Value and uncertainty, the latter with two digits, the former to the same place.

    Parameters
    ----------
    value, u : float
        In one unit; u may be NaN.

    Examples
    --------
    >>> rounded(155.920213, 0.000123), rounded(12.5, float("nan"))
    ('155.92021 ± 0.00012', '12.5')
    """
    if not (math.isfinite(u) and u > 0.0 and math.isfinite(value)):
        return f"{value:.6g}"
    places = max(0, 1 - math.floor(math.log10(u)))
    return f"{value:.{places}f} ± {u:.{places}f}"


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """A measured quantity.

    Parameters
    ----------
    kind : str
        What was measured; each class has its own.
    value, uncertainty : float
        In `unit`; the uncertainty is a standard one (k = 1).
    unit : {"m", "deg", "1"}
        Of value and uncertainty; each class has its own.
    points, set_aside : int
        Points used, and points further off than the stated threshold, which were not.
    rms_m : float
        Root mean square of the residuals, metres.
    dof : int
        Degrees of freedom: points less fitted parameters.
    inflation : float
        Factor by which errors shared by neighbours enlarged the uncertainty; 1 is none.
    region : Region or None
        Where the points were taken from; None is everywhere.
    """

    kind: str = ""
    value: float
    uncertainty: float
    unit: str = "m"
    points: int
    set_aside: int
    rms_m: float
    dof: int
    inflation: float
    region: Region | None

    #: What the value is called.
    value_name: ClassVar[str] = "value"

    def quantities(self) -> tuple[Quantity, ...]:
        """All that was measured, the value first."""
        return (Quantity(self.value_name, self.value, self.uncertainty, self.unit), *self._others())

    def quantity(self, name: str | None = None) -> Quantity:
        """One quantity by its name, the value without.

        Raises
        ------
        ConfigError
            When it has none of this name.
        """
        named = {quantity.name: quantity for quantity in self.quantities()}
        if name and name not in named:
            raise ConfigError(
                f"{self.kind} has no quantity {name!r}; expected one of {', '.join(named)}"
            )
        return named[name or self.value_name]

    def _others(self) -> Iterator[Quantity]:
        """Quantities beside the value; a kind that has some says them."""
        yield from ()

    def to_dict(self) -> dict[str, Any]:
        """Plain values by name, for files."""
        return asdict(self)


@dataclass(frozen=True)
class Tolerance:
    """Limits of a value, in its unit.

    Parameters
    ----------
    low, high : float
        Either may be infinite.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ConfigError(f"tolerance {self.low} to {self.high}; expected low < high")

    def verdict(self, value: float, uncertainty: float) -> Verdict:
        """Decide by ISO 14253-1:2017: conformance needs 95 % probability, so does its opposite.

        Parameters
        ----------
        value, uncertainty : float
            Measured value and its standard uncertainty, in the tolerance's unit.

        Examples
        --------
        >>> [Tolerance(9.0, 11.0).verdict(value, 0.1) for value in (10.0, 11.1, 12.0)]
        ['pass', 'undecided', 'fail']
        """
        guard = GUARD * uncertainty
        if self.low + guard <= value <= self.high - guard:
            return "pass"
        if value < self.low - guard or value > self.high + guard:
            return "fail"
        return "undecided"


class Evidence(TypedDict):
    """The fields of a `Measurement` that say what its value rests on."""

    points: int
    set_aside: int
    rms_m: float
    dof: int
    inflation: float
    region: Region | None


@dataclass(frozen=True)
class Fitted:
    """Covariance of fitted parameters, and what it was made from.

    Parameters
    ----------
    covariance : ndarray, (p, p)
        Of the parameters, inflation included.
    rms_m : float
        Root mean square of the residuals.
    dof : int
        Points less parameters.
    inflation : float
        Factor on standard uncertainties.
    variance_m2 : ndarray, (n,)
        Of every point.
    """

    covariance: Array
    rms_m: float
    dof: int
    inflation: float
    variance_m2: Array

    @property
    def u(self) -> Array:
        """Standard uncertainties of the parameters, (p,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def evidence(self, offered: int, region: Region | None) -> Evidence:
        """What a measurement by this fit rests on.

        Parameters
        ----------
        offered : int
            Points there were; those that the fit did not use were set aside.
        region : Region or None
            Where they were taken from.
        """
        used = len(self.variance_m2)
        return Evidence(
            points=used,
            set_aside=offered - used,
            rms_m=self.rms_m,
            dof=self.dof,
            inflation=self.inflation,
            region=region,
        )


def uncertainties(jacobian: Array, residual_m: Array, sigma_m: Array, xy_m: Array) -> Fitted:
    """Covariance of an ordinary least squares fit's parameters.

    Parameters
    ----------
    jacobian : ndarray, (n, p)
        Derivatives of the residuals by the parameters, at the solution.
    residual_m, sigma_m : ndarray, (n,)
        Residuals and the stated standard deviation of each, metres; 0 where none is known.
    xy_m : ndarray, (n, 2)
        Where the points lie: for errors that neighbours share.

    Raises
    ------
    StackError
        When there are not more points than parameters, or they do not determine the parameters.
    """
    n, p = jacobian.shape
    if n <= p:
        raise StackError(f"{n} points; expected more than the {p} parameters of the feature")
    sum_squares = float(residual_m @ residual_m)
    excess = max(0.0, sum_squares / (n - p) - float(np.mean(sigma_m**2)))
    variance = sigma_m**2 + excess
    # Columns of one size, so that metres beside radians do not look singular.
    scale = np.sqrt(np.einsum("ij,ij->j", jacobian, jacobian))
    scaled = jacobian / np.where(scale > 0.0, scale, 1.0)
    normal = scaled.T @ scaled
    if not np.linalg.cond(normal) < 1e13:
        raise StackError("the points do not determine the feature (too few, or on a line)")
    bread = np.linalg.inv(normal)
    meat = scaled.T @ (scaled * variance[:, None])
    factor = inflation(residual_m, variance, xy_m, p)
    common = 1.0 + n * COMMON**2
    covariance = common * factor**2 * (bread @ meat @ bread) / np.outer(scale, scale)
    return Fitted(covariance, float(np.sqrt(sum_squares / n)), n - p, factor, variance)


def inflation(residual_m: Array, variance_m2: Array, xy_m: Array, parameters: int) -> float:
    """Factor by which means over blocks scatter more than independent errors would; at least 1.

    Parameters
    ----------
    residual_m, variance_m2 : ndarray, (n,)
        Residuals of a fit and the variance of each.
    xy_m : ndarray, (n, 2)
        Where the points lie.
    parameters : int
        Of the fit; each takes a degree of freedom from the blocks.
    """
    block = block_numbers(xy_m)
    sums = np.bincount(block, residual_m)
    variances = np.bincount(block, variance_m2)
    used = variances > 0.0
    free = int(np.count_nonzero(used)) - parameters
    if free < 2 * parameters:
        return 1.0
    ratio = float(np.sum(sums[used] ** 2 / variances[used])) / free
    return float(np.sqrt(ratio)) if ratio > 1.0 + SIGNIFICANT * np.sqrt(2.0 / free) else 1.0


def block_numbers(xy_m: Array) -> NDArray[np.int64]:
    """Number the blocks of a regular division of the points' rectangle, (n,)."""
    side = int(np.clip(np.sqrt(len(xy_m) / BLOCK_POINTS), 1, BLOCKS))
    low, span = xy_m.min(axis=0), np.ptp(xy_m, axis=0)
    cell = np.floor((xy_m - low) / np.where(span > 0.0, span, 1.0) * side).astype(np.int64)
    cell = np.minimum(cell, side - 1)
    return np.asarray(cell[:, 0] * side + cell[:, 1])
