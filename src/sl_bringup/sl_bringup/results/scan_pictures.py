"""Pictures of a scan that a person understands: titles, units, and what is missing and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LightSource, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy import ndimage

from sl_common.pages.figure_png import png
from sl_reconstruct.cloud.height_map import HeightMap
from sl_reconstruct.measure.profile import ProfileMeasurement

#: Heights outside this part of all heights do not stretch the colours.
COLOUR_PERCENTILES = (0.5, 99.5)
#: Heights that span less than this are shown in micrometres, others in millimetres.
MICROMETRES_BELOW_M = 5e-3
MISSING_COLOUR = "#d9d9d9"
#: The same in a picture that is itself grey.
ABSENT_COLOUR = "#f6d9c4"
#: With more rows than this a single pixel would not be seen in a picture: it is enlarged.
ENLARGE_ABOVE_ROWS = 400
#: Where more than this part is refused, enlarged ones would hide the points between them.
ENLARGE_BELOW = 0.03
#: Distinguishable for colour-blind readers (Okabe and Ito, 2008); grey is "not lit".
REASON_COLOURS = (
    "#E69F00",
    "#56B4E9",
    "#D55E00",
    "#CC79A7",
    "#0072B2",
    "#F0E442",
    "#7A4FA3",
    "#8C510A",
    "#000000",
)
PRESENT_COLOUR = "#CFE8CF"
SATURATED_COLOUR = "#FF0000"
#: Of a section, and of the band of its uncertainty.
LINE_STYLE: dict[str, Any] = {"color": "#0072B2", "linewidth": 0.8}
BAND_STYLE: dict[str, Any] = {"color": "#56B4E9", "alpha": 0.6, "linewidth": 0}


def height_picture(height: HeightMap, title: str) -> bytes:
    """Height map in colours: axes in millimetres, colour bar in micrometres.

    Parameters
    ----------
    height : HeightMap
        Heights.
    title : str
        Heading of the picture.
    """
    return _map(height, height.z_m, title, "height z", "viridis", symmetric=False)


def residual_picture(height: HeightMap, residual_m: NDArray[Any], title: str) -> bytes:
    """Deviation from a reference, blue below and red above it.

    Parameters
    ----------
    height : HeightMap
        Gives the axes.
    residual_m : ndarray, (H, W)
        Deviation from the reference, metres.
    title : str
        Heading of the picture.
    """
    return _map(height, residual_m, title, "deviation", "RdBu_r", symmetric=True)


def relief_picture(height: HeightMap, title: str) -> bytes:
    """Shaded relief, lit from the upper left, steepened so that the surface shows.

    Parameters
    ----------
    height : HeightMap
        Heights.
    title : str
        Heading of the picture.
    """
    z = height.z_m.astype(np.float64)
    there = np.isfinite(z)
    slopes = np.hypot(*np.gradient(z, height.step_m)) if min(z.shape) > 1 else np.zeros(1)
    steep = float(np.nanpercentile(slopes, 90)) if np.isfinite(slopes).any() else 0.0
    exaggeration = min(1.0 / steep, 1000.0) if steep > 0 else 1.0
    filled = _filled_from_nearest(z, there)
    shade = LightSource(azdeg=315, altdeg=45).hillshade(
        filled, vert_exag=exaggeration, dx=height.step_m, dy=height.step_m
    )
    figure, axes = _map_axes(
        height,
        f"{title}\nrelief, heights {exaggeration:.3g} times exaggerated (tinted: not measured)",
    )
    axes.set_facecolor(ABSENT_COLOUR)
    axes.imshow(
        np.where(there, shade, np.nan), cmap="gray", vmin=0, vmax=1, extent=_extent_mm(height)
    )
    return png(figure)


def profile_picture(points: NDArray[Any], title: str) -> bytes:
    """Section along the middle camera row: height above, its stated uncertainty below.

    Parameters
    ----------
    points : ndarray (rows, columns), structured
        The cloud with ``x, z, sigma`` in metres.
    title : str
        What was scanned.
    """
    row = _fullest_middle_row(points)
    line = points[row]
    line = line[np.isfinite(line["z"])]
    line = line[np.argsort(line["x"], kind="stable")]
    x_mm = line["x"] * 1e3
    z_m, sigma_m = line["z"].astype(np.float64), line["sigma"].astype(np.float64)
    unit, factor = _unit(z_m)
    sigma_unit, sigma_factor = _unit(sigma_m)
    x_mm, z_m, sigma_m = broken_at_gaps(x_mm, z_m, sigma_m)
    figure = Figure(figsize=(9, 6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    bounds = ((z_m - 2 * sigma_m) * factor, (z_m + 2 * sigma_m) * factor)
    above.fill_between(x_mm, *bounds, **BAND_STYLE, label="± 2 sigma (stated)")
    above.plot(x_mm, z_m * factor, **LINE_STYLE, label="measured")
    above.set(ylabel=f"height z / {unit}", title=f"{title}\nsection along camera row {row}")
    # Outside: "best" knows nothing of lines with gaps, and lay over one.
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    below.plot(x_mm, 2 * sigma_m * sigma_factor, color="#D55E00", linewidth=0.8)
    below.set(xlabel="x / mm", ylabel=f"2 sigma of z / {sigma_unit}", ylim=(0, None))
    for axes in (above, below):
        axes.grid(True, alpha=0.3)
    return png(figure)


def section_picture(sections: Sequence[tuple[str, ProfileMeasurement]], title: str) -> bytes:
    """Sections over each other, each with a band of two standard uncertainties.

    Parameters
    ----------
    sections : sequence of (str, ProfileMeasurement)
        Name and section.
    title : str
        Heading of the picture.
    """
    figure = Figure(figsize=(11, 2.6 * len(sections)), layout="constrained")
    axes = figure.subplots(len(sections), 1, sharex=True, squeeze=False)[:, 0]
    figure.suptitle(title)
    for (name, s), part in zip(sections, axes, strict=True):
        x_mm, z_um, u_um = broken_at_gaps(1e3 * s.along_m, 1e6 * s.z_m, 1e6 * s.u_z_m)
        bounds = (z_um - 2 * u_um, z_um + 2 * u_um)
        part.fill_between(x_mm, *bounds, **BAND_STYLE, label="± 2 standard uncertainties")
        part.plot(x_mm, z_um, **LINE_STYLE, label=name)
        part.set_ylabel("z / µm")
        part.grid(True, alpha=0.3)
        part.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    axes[-1].set_xlabel("along the section / mm")
    return png(figure)


def refusal_picture(
    reasons: NDArray[np.uint8], names: Sequence[str], counts: Mapping[str, int], title: str
) -> bytes:
    """Map of the organised cloud that says why each missing point is missing.

    Parameters
    ----------
    reasons : ndarray (rows, columns), uint8
        0 where there is a point, 1 where none is expected (not lit), else 2 + index in ``names``.
    names : sequence of str
        The reasons.
    counts : mapping
        Positions for "points", "not lit" and each name.
    title : str
        What was scanned.
    """
    palette = [REASON_COLOURS[i % len(REASON_COLOURS)] for i in range(len(names))]
    colours = ListedColormap([PRESENT_COLOUR, MISSING_COLOUR, *palette])
    figure = Figure(figsize=(9, 6), layout="constrained")
    axes = figure.subplots()
    scale: dict[str, Any] = {"cmap": colours, "vmin": -0.5, "vmax": len(palette) + 1.5}
    axes.imshow(_enlarged(reasons), **scale, aspect="auto", interpolation="nearest")
    axes.set(xlabel="DMD column boundary", ylabel="camera row", title=title)
    entries = [
        ("points", PRESENT_COLOUR),
        ("not lit", MISSING_COLOUR),
        *zip(names, palette, strict=True),
    ]
    shown = [(name, colour) for name, colour in entries if counts.get(name)]
    handles = [Patch(color=colour, label=f"{name}: {counts[name]:,}") for name, colour in shown]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    return png(figure)


def contrast_picture(images: NDArray[Any], saturation_dn: int, title: str) -> bytes:
    """Contrast of the patterns in every camera pixel: brightest less darkest image.

    Parameters
    ----------
    images : ndarray, (N, H, W), uint8 or uint16
        Of one scan, DN.
    saturation_dn : int
        Full scale, DN; pixels that reach it are marked.
    title : str
        What was scanned.
    """
    bright, dark = images.max(axis=0), images.min(axis=0)
    full = bright >= saturation_dn
    contrast = (bright - dark) * np.float32(100.0 / saturation_dn)
    colours = colormaps["viridis"].with_extremes(bad=SATURATED_COLOUR)
    figure = Figure(figsize=(9, 1.2 + 7.2 * full.shape[0] / full.shape[1]), layout="constrained")
    axes = figure.subplots()
    caption = f"brightest less darkest image (red: saturated, {100 * full.mean():.2g} %)"
    image = axes.imshow(np.where(full, np.nan, contrast), cmap=colours, vmin=0.0, vmax=100.0)
    axes.set(xlabel="camera column / px", ylabel="camera row / px", title=f"{title}\n{caption}")
    figure.colorbar(image, ax=axes, shrink=0.9, label="contrast / % of full scale")
    return png(figure)


def _enlarged(reasons: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Let each refused position of a large map cover its neighbours that are present."""
    refused = np.where(reasons > 1, reasons, 0)
    if (
        len(reasons) < ENLARGE_ABOVE_ROWS
        or np.count_nonzero(refused) > ENLARGE_BELOW * refused.size
    ):
        return reasons
    spread = ndimage.maximum_filter(refused, size=5)
    return np.where((reasons == 0) & (spread > 0), spread, reasons)


def _filled_from_nearest(z: NDArray[Any], there: NDArray[np.bool_]) -> NDArray[Any]:
    """Heights with holes filled from the nearest node, so that their borders cast no light."""
    if not there.any():
        return np.zeros_like(z)
    nearest = ndimage.distance_transform_edt(~there, return_distances=False, return_indices=True)
    return np.asarray(z[tuple(nearest)])


def _map(
    height: HeightMap, values_m: NDArray[Any], title: str, label: str, colours: str, symmetric: bool
) -> bytes:
    """Draw values on the grid of a height map with a colour bar in a fitting unit."""
    finite = values_m[np.isfinite(values_m)].astype(np.float64)
    low, high = np.percentile(finite, COLOUR_PERCENTILES) if finite.size else (0.0, 0.0)
    if symmetric:
        high = max(abs(low), abs(high))
        low = -high
    unit, factor = _unit(np.array([low, high]))
    missing = "" if np.isfinite(values_m).all() else " (grey: not measured)"
    figure, axes = _map_axes(height, title + missing)
    axes.set_facecolor(MISSING_COLOUR)
    scale: dict[str, Any] = {"cmap": colours, "vmin": low * factor, "vmax": high * factor}
    image = axes.imshow(values_m * factor, extent=_extent_mm(height), **scale)
    bar = figure.colorbar(image, ax=axes, extend="both", shrink=0.9)
    bar.set_label(f"{label} / {unit}")
    return png(figure)


def _map_axes(height: HeightMap, title: str) -> tuple[Figure, Any]:
    """Axes in millimetres whose figure has the part's proportions."""
    left, right, bottom, top = height.extent_m
    ratio = float(np.clip((top - bottom) / max(right - left, 1e-12), 0.35, 1.6))
    figure = Figure(figsize=(9, 1.2 + 7.2 * ratio), layout="constrained")
    axes = figure.subplots()
    axes.set(xlabel="x / mm", ylabel="y / mm", title=title)
    return figure, axes


def _extent_mm(height: HeightMap) -> tuple[float, float, float, float]:
    """Outer borders of the nodes' cells, millimetres."""
    left, right, bottom, top = (1e3 * value for value in height.extent_m)
    half = 0.5e3 * height.step_m
    return left - half, right + half, bottom - half, top + half


def _unit(values_m: NDArray[Any]) -> tuple[str, float]:
    """Unit that suits a range of lengths, and units per metre."""
    spread = float(np.ptp(values_m)) if values_m.size else 0.0
    return ("µm", 1e6) if spread < MICROMETRES_BELOW_M else ("mm", 1e3)


def _fullest_middle_row(points: NDArray[Any]) -> int:
    """Row in the middle third with the most points; the one nearest to the middle of these."""
    rows = len(points)
    first, last = rows // 3, max(rows // 3 + 1, rows - rows // 3)
    filled = np.isfinite(points["z"][first:last]).sum(axis=1)
    best = np.flatnonzero(filled == filled.max()) + first
    return int(best[np.argmin(np.abs(best - rows / 2))])


def broken_at_gaps(x: NDArray[Any], *values: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Put a NaN wherever the points are far apart, so that no line bridges a gap.

    Parameters
    ----------
    x : ndarray, (N,)
        Ascending coordinate.
    *values : ndarray, (N,)
        What is drawn over it.
    """
    apart = np.diff(x)
    if not apart.size:
        return (x, *values)
    gaps = np.flatnonzero(apart > 5 * np.median(apart)) + 1
    return tuple(np.insert(v.astype(np.float64), gaps, np.nan) for v in (x, *values))
