"""Position and diameter of a round hole or dark disc, from edges in the organised cloud."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import StackError
from sl_reconstruct.cloud.height_map import typical_spacing_m
from sl_reconstruct.cloud.plane_fit import TRIM_SD, fit_plane
from sl_reconstruct.measure.region import Region, Selection
from sl_reconstruct.measure.result import Measurement, Quantity
from sl_reconstruct.measure.roughness import crop
from sl_reconstruct.measure.sphere_cylinder import Round, fit_rounds

Array = NDArray[np.float64]
Method = Literal["intensity", "presence"]

#: A hole's own light over the plate's: points that would show it are refused as too dark.
HOLE_LIGHT = (0.0, 0.04)
#: The edge lies half-way between the plate's light and the hole's.
EDGE_LEVEL = 0.5 + 0.25 * sum(HOLE_LIGHT)
U_EDGE_LEVEL = 0.5 * (HOLE_LIGHT[1] - HOLE_LIGHT[0]) / 12**0.5
#: Edges between two points that are needed to go by the light.
LEAST_EDGES = 8
#: Points are refused up to this many spacings beside an edge, as its blur mixes hole and plate.
REFUSED_SPACINGS = 3.0


@dataclass(frozen=True, kw_only=True)
class HoleMeasurement(Measurement):
    """A hole; the value is its diameter.

    Parameters
    ----------
    centre_m, u_centre_m : tuple of float
        x, y of the centre and standard uncertainties, metres.
    method : {"intensity", "presence"}
        "intensity": edges where the light halves between two neighbouring points. "presence":
        where points end, with too few of the former; the diameter then is too large by an unknown
        part of the strip in which points are refused, which is corrected and in its uncertainty.
    """

    kind: str = "hole"
    centre_m: tuple[float, float]
    u_centre_m: tuple[float, float]
    method: Method

    value_name: ClassVar[str] = "diameter"

    def _others(self) -> Iterator[Quantity]:
        for axis, c, u in zip("xy", self.centre_m, self.u_centre_m, strict=True):
            yield Quantity(f"centre_{axis}", c, u, "m")


def measure_hole(points: NDArray[Any], region: Region | None = None) -> HoleMeasurement:
    """Fit a circle to the edges of the one hole in a region.

    Parameters
    ----------
    points : ndarray, (H, K), structured
        Organised cloud with ``intensity``.
    region : Region, optional
        Around the hole, with some plate on all sides and no other hole; everywhere when left out.

    Raises
    ------
    StackError
        When there is no hole.
    """
    cut = crop(points, region)
    light = _light(cut)
    edges, blur = crossings(cut, light)
    method: Method = "intensity"
    spacing = typical_spacing_m(cut)
    strip, u_edge = 0.0, U_EDGE_LEVEL * blur
    found = _circle_through(edges, region)
    if not _is_hole(found, edges, spacing):
        edges, method = _ends(cut), "presence"
        strip = REFUSED_SPACINGS * spacing
        u_edge = strip / 12**0.5
        found = _circle_through(edges, region)
    if found is None or not _is_hole(found, edges, REFUSED_SPACINGS * spacing):
        off = "" if found is None else f", {1e6 * found.fit.rms_m:.3g} µm rms off a circle"
        raise StackError(
            f"{len(edges)} edges in the region{off}; expected one hole with plate around it"
        )
    (x, y, radius), (u_x, u_y, u_radius) = found.values.tolist(), found.fit.u.tolist()
    # The strip's width lies somewhere between 0 and `strip`: its middle, and that of a rectangle.
    return HoleMeasurement(
        value=2.0 * radius - strip,
        uncertainty=float(2.0 * np.hypot(u_radius, u_edge)),
        **found.fit.evidence(len(edges), region),
        centre_m=(x, y),
        u_centre_m=(u_x, u_y),
        method=method,
    )


def crossings(points: NDArray[Any], light: NDArray[Any]) -> tuple[Array, float]:
    """Where the light crosses `EDGE_LEVEL` between neighbours that are both there.

    Parameters
    ----------
    points : ndarray, (H, K), structured
        Organised cloud.
    light : ndarray, (H, K)
        Light over the plate's.

    Returns
    -------
    edges : ndarray, (n, 2)
        x, y, metres: along a row where the edge faces x, along a column where it faces y, so that
        no point counts twice.
    blur_m : float
        Way along which the light would go from the plate's to none, metres.
    """
    found, ways = [], []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        fa, fb = light[a] - EDGE_LEVEL, light[b] - EDGE_LEVEL
        crossed = np.isfinite(fa) & np.isfinite(fb) & (fa * fb < 0.0)
        fall = fa[crossed] - fb[crossed]
        pa, pb = (
            np.stack([points[at][crossed][n].astype(np.float64) for n in ("x", "y")], axis=-1)
            for at in (a, b)
        )
        found.append(pa + (fa[crossed] / fall)[:, None] * (pb - pa))
        ways.append(np.hypot(*(pb - pa).T) / np.abs(fall))
    edges = np.concatenate(found)
    if not len(edges):
        return edges, 0.0
    away = np.abs(edges - 0.5 * (edges.min(axis=0) + edges.max(axis=0)))
    along_row = np.arange(len(edges)) < len(found[0])
    kept = along_row == (away[:, 0] > away[:, 1])
    # Secants are flatter than the edge at its middle: the steep quarter is nearest to it.
    steep = np.quantile(np.concatenate(ways)[kept], 0.25) if kept.any() else 0.0
    return edges[kept], float(steep)


def _light(points: NDArray[Any]) -> Array:
    """Light over the plate's, (H, K): 0 where a point lies off the plate, NaN where is none."""
    there = np.isfinite(points["z"])
    xyz = np.stack([points[name].astype(np.float64) for name in "xyz"], axis=-1)
    intensity = np.where(there, points["intensity"], np.nan).astype(np.float64)
    plate = fit_plane(xyz[there])
    if plate is None:
        raise StackError("the plate around the hole has too few points; expected a plane")
    off = np.abs(plate.distances_m(xyz)) > TRIM_SD * max(plate.rms_m, 1e-9)
    level = float(np.nanmedian(intensity[there & ~off]))
    # Only dark points can lie in a hole without being noisy; bright outliers are just outliers.
    deep = off & (xyz[..., 2] < plate.point_m[2] - 10.0 * TRIM_SD * plate.rms_m)
    return np.asarray(np.where(deep, 0.0, intensity / level))


def _circle_through(edges: Array, region: Region | None) -> Round | None:
    """Circle (x, y, radius) through edges; None where there are too few."""
    if len(edges) < LEAST_EDGES:
        return None
    flat = Selection(np.column_stack([edges, np.zeros(len(edges))]), np.zeros(len(edges)), region)
    middle = 0.5 * (edges.min(axis=0) + edges.max(axis=0))
    start = np.append(middle, np.median(np.hypot(*(edges - middle).T)))
    return fit_rounds(_circle, flat, start)


def _is_hole(found: Round | None, edges: Array, scatter_m: float) -> bool:
    """Whether edges scatter little enough, and a circle's centre lies among them: parts of several
    holes do not make one.
    """
    if found is None or not np.isfinite(found.values).all() or found.fit.rms_m > scatter_m:
        return False
    centre, low, high = found.values[:2], edges.min(axis=0), edges.max(axis=0)
    return bool(((centre > low) & (centre < high)).all())


def _ends(points: NDArray[Any]) -> Array:
    """Last points before gaps and first behind them, along rows and columns, (n, 2) metres."""
    there = np.isfinite(points["z"])
    found = []
    for axis in (0, 1):
        before = np.logical_or.accumulate(there, axis=axis)
        behind = np.flip(np.logical_or.accumulate(np.flip(there, axis), axis=axis), axis)
        gap = ~there & before & behind
        near = np.roll(gap, 1, axis) | np.roll(gap, -1, axis)
        end = points[there & near]
        found.append(np.column_stack([end["x"], end["y"]]).astype(np.float64))
    return np.concatenate(found)


def _circle(values: Array, xyz_m: Array) -> tuple[Array, Array, Array]:
    offset = xyz_m[:, :2] - values[:2]
    distance = np.hypot(*offset.T)
    jacobian = np.column_stack([-offset / distance[:, None], -np.ones(len(xyz_m))])
    return distance - values[2], jacobian, np.zeros(len(xyz_m))
