"""Pictures of a calibration's report, drawn without a display."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sl_calibration.solve.point_uncertainty import EdgeNoise, sigma_map
from sl_calibration.solve.solution import metres_per_pixel
from sl_common.pages.figure_png import png

if TYPE_CHECKING:
    from sl_calibration.solve.solution import JudgedSolution

Array = NDArray[np.float64]

DPI = 110
_UM = 1e6
_MM = 1e3
#: Arrows of a vector plot; more would be a smear.
_MOST_ARROWS = 600


def _figure(width: float, height: float) -> Figure:
    return Figure((width, height), dpi=DPI, layout="constrained")


def pictures(solved: JudgedSolution) -> Iterator[tuple[str, bytes]]:
    """Caption and PNG of every picture of the report, in its order; fewer for a camera alone."""
    rig = len(solved.names) > 1
    holes = "holes and targets" if rig else "holes"
    made: list[tuple[str, Callable[[JudgedSolution], Figure]]] = [
        ("Residuals at each height, on the part (the paper's Fig. 6)", _residuals_by_height),
        ("Residual vectors", _residual_vectors),
        (f"Coverage: where {holes} were measured", _coverage),
    ]
    if rig:
        made.append(("Predicted 1-sigma of z of a triangulated point", _uncertainty))
        made.append(("Each height, predicted by the others", _left_out))
    for caption, draw in made:
        yield caption, png(draw(solved))


def _panels(solved: JudgedSolution, height: float) -> tuple[Figure, list[Any]]:
    """Figure with axes for each device."""
    count = len(solved.names)
    figure = _figure(5.25 * count, height)
    return figure, list(figure.subplots(1, count, squeeze=False)[0])


class _Group:
    """Holes or targets: where they are in their image, how far off, at which height."""

    def __init__(self, solved: JudgedSolution, index: int) -> None:
        joint = solved.bundle
        data = joint.problem.holes if index == 0 else joint.problem.targets
        rows = joint.used[joint.problem.groups[index]]
        device = joint.state.devices[index]
        self.name = ("camera", "projector")[index]
        self.unit = ("camera px", "DMD px")[index]
        self.size = device.image_size
        self.pixels = data.pixels[rows]
        self.residuals_px = joint.residuals_of(index)
        self.height_m = data.stage_m[rows, 2]
        self.metres = metres_per_pixel(device)
        self.sigma_px = float(np.sqrt(np.mean(data.sigma_px[rows] ** 2)) * joint.scales[index])

    @property
    def lengths_m(self) -> Array:
        """Lengths of the residuals on the part."""
        return np.asarray(np.hypot(*self.residuals_px.T) * self.metres)


def _residuals_by_height(solved: JudgedSolution) -> Figure:
    """Every residual's length over the height, with the rms of each height and the noise floor."""
    figure, panels = _panels(solved, 3.6)
    for i, axes in enumerate(panels):
        group = _Group(solved, i)
        heights = np.unique(group.height_m)
        step = float(np.min(np.diff(heights))) if len(heights) > 1 else 1e-3
        scatter = np.random.default_rng(0).uniform(-0.3, 0.3, len(group.height_m)) * step
        axes.plot((group.height_m + scatter) * _MM, group.lengths_m * _UM, ".", ms=2, color="0.6")
        rms = [np.sqrt(np.mean(group.lengths_m[group.height_m == h] ** 2)) for h in heights]
        axes.plot(heights * _MM, np.array(rms) * _UM, "o-", color="C3", label="rms of the height")
        floor = np.sqrt(2) * group.sigma_px * group.metres * _UM
        axes.axhline(floor, color="C0", ls="--", lw=1, label="stated noise")
        axes.set_title(f"{group.name}: {len(group.height_m):,} residuals")
        highest = 1.15 * float(np.quantile(group.lengths_m, 0.999)) * _UM
        axes.set(xlabel="stage height, mm", ylabel="residual on the part, µm", ylim=(0, highest))
        axes.legend(loc="upper right", fontsize=8)
    return figure


def _residual_vectors(solved: JudgedSolution) -> Figure:
    """Residuals as arrows in both images, coloured by height."""
    figure, panels = _panels(solved, 4.6)
    for i, axes in enumerate(panels):
        group = _Group(solved, i)
        few = slice(None, None, 1 + len(group.pixels) // _MOST_ARROWS)
        (u, v), (du, dv) = group.pixels[few].T, group.residuals_px[few].T
        rms = float(np.sqrt(np.mean(np.hypot(du, dv) ** 2)))
        arrow = 0.04 * group.size[0] / max(rms, 1e-12)
        style = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.0018}
        heights_mm = group.height_m[few] * _MM
        arrows = axes.quiver(u, v, du * arrow, dv * arrow, heights_mm, cmap="viridis", **style)
        _image_axes(axes, group.size)
        axes.set(
            title=f"{group.name}: rms {rms:.4f} {group.unit}",
            xlabel=f"u, px (arrows enlarged {arrow:,.0f} times)",
        )
        figure.colorbar(arrows, ax=axes, label="stage height, mm", shrink=0.8)
    return figure


def _coverage(solved: JudgedSolution) -> Figure:
    """Where both devices were measured, all heights together."""
    figure, panels = _panels(solved, 4.3)
    for i, axes in enumerate(panels):
        group = _Group(solved, i)
        dots = axes.scatter(*group.pixels.T, c=group.height_m * _MM, s=5, cmap="viridis")
        axes.set(title=f"{group.name}: {len(group.pixels):,} points")
        centre = solved.bundle.state.devices[i].centre_px
        axes.plot(*centre, "r+", ms=12, label="image centre C")
        axes.legend(loc="lower right", fontsize=8)
        _image_axes(axes, group.size)
        figure.colorbar(dots, ax=axes, label="stage height, mm", shrink=0.8)
    return figure


def _image_axes(axes: Any, size: tuple[int, int]) -> None:
    axes.set(xlim=(0, size[0]), ylim=(size[1], 0), xlabel="u, px", ylabel="v, px", aspect="equal")


def _uncertainty(solved: JudgedSolution) -> Figure:
    """Maps of sigma z at the lowest, the middle and the highest height: calibration, with noise."""
    volume = solved.solution.lit_volume
    figure = _figure(11, 5.6)
    from_calibration = sigma_map(solved.bundle, volume, EdgeNoise(0.0))
    with_noise = sigma_map(solved.bundle, volume, solved.edge_noise)
    rows = ((from_calibration, "calibration"), (with_noise, "calibration and edge noise"))
    for line, ((grid, sigma), name) in zip(figure.subplots(2, 3), rows, strict=True):
        z_um = sigma[..., 2] * _UM
        for axes, layer in zip(line, range(3), strict=True):
            x, y = grid[layer, 0, :, 0] * _MM, grid[layer, :, 0, 1] * _MM
            shown = axes.contourf(
                x, y, z_um[layer], np.linspace(np.nanmin(z_um), np.nanmax(z_um) * 1.0001, 12)
            )
            height = grid[layer, 0, 0, 2] * _MM
            axes.set(
                title=f"{name}, z = {height:.2f} mm", xlabel="x, mm", ylabel="y, mm", aspect="equal"
            )
            axes.title.set_fontsize(9)
        figure.colorbar(shown, ax=list(line), label="sigma z, µm", shrink=0.9)
    return figure


def _left_out(solved: JudgedSolution) -> Figure:
    """Error of z at each height when the calibration is made without it."""
    figure = _figure(6, 3)
    axes = figure.subplots()
    checks = solved.solution.left_out
    names = [f"{c.height_m * _MM:g}" for c in checks]
    axes.bar(names, [c.z_rms_m * _UM for c in checks], width=0.5)
    limit = solved.limits.left_out_z_m * _UM
    highest = max((c.z_rms_m * _UM for c in checks), default=0.0)
    if highest > 0.2 * limit:
        axes.axhline(limit, color="C3", ls="--", label="limit")
        axes.legend()
    axes.set(xlabel="stage height left out, mm", ylabel="rms error of z, µm")
    return figure


def off_planes(layers: Sequence[tuple[float, Array, Array]]) -> Figure:
    """Distances (N,) from the best plane over x and y (N, 3) at each height, of a check."""
    figure = _figure(1 + 4.2 * len(layers), 3.8)
    most = float(np.quantile(np.abs(np.concatenate([off for _, _, off in layers])), 0.99)) * _UM
    panels = figure.subplots(1, len(layers), squeeze=False)[0]
    for axes, (height_m, points_m, off_m) in zip(panels, layers, strict=True):
        x_mm, y_mm = points_m[:, :2].T * _MM
        scale = {"cmap": "RdBu", "vmin": -most, "vmax": most}
        dots = axes.scatter(x_mm, y_mm, c=off_m * _UM, s=10, **scale)
        title = f"off the best plane, stage at {height_m * _MM:.3f} mm"
        axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal", title=title)
        axes.title.set_fontsize(9)
    figure.colorbar(dots, ax=list(panels), label="µm")
    return figure
