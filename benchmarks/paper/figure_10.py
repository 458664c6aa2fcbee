"""The paper's Figs. 10 and 11 as pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sl_common.pages.figure_png import png

#: Part of a flank that is drawn enlarged, metres.
DETAIL_M = (1.0e-3, 1.25e-3)


def groove_picture(clouds: Sequence[tuple[str, NDArray[Any]]]) -> bytes:
    """Sections through the groove: all of it on the left, a part enlarged on the right.

    Parameters
    ----------
    clouds : sequence of (name, points)
        Organised clouds.
    """
    figure = Figure(figsize=(11, 2.6 * len(clouds)), layout="constrained")
    axes = figure.subplots(len(clouds), 2, sharex="col", width_ratios=(2, 1), squeeze=False)
    figure.suptitle("Fig. 10: V-groove, section along the middle camera row")
    for (name, points), (whole, detail) in zip(clouds, axes, strict=True):
        line = points[len(points) // 2]
        line = line[np.isfinite(line["z"])]
        x_mm, z_um = 1e3 * line["x"], 1e6 * line["z"].astype(np.float64)
        for part in (whole, detail):
            part.plot(x_mm, z_um, ".", markersize=2 if part is whole else 4, color="#0072B2")
            part.grid(True, alpha=0.3)
        near = (line["x"] > DETAIL_M[0]) & (line["x"] < DETAIL_M[1])
        detail.set_xlim(1e3 * DETAIL_M[0], 1e3 * DETAIL_M[1])
        if near.any():
            detail.set_ylim(z_um[near].min() - 4.0, z_um[near].max() + 4.0)
        whole.set(ylabel="z / µm", title=name)
        detail.set(title=f"{name}: {np.count_nonzero(near)} points in 0.25 mm")
    for part in axes[-1]:
        part.set_xlabel("x / mm")
    return png(figure)
