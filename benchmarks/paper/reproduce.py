"""``make paper``: the paper's Table 2 and Figs. 10 and 11 on the bench, beside the paper's numbers.

Tsai & Hung, Measurement 38 (2005) 236-247, section 4.3. The rig is the true one: what is compared
is the projection, the decoding and the triangulation, not the calibration.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from figure_10 import groove_picture
from naive_decoding import GRAY_BITS, naive
from sl_bench.world.optics import Optics
from sl_bench.world.reference_rig import reference_rig
from sl_bench.world.surfaces import make_surface
from sl_bench.world.world import World
from sl_bringup.graph.console import complain, say
from sl_bringup.results.scan_pictures import relief_picture, section_picture
from sl_common.documents import written_atomically
from sl_common.errors import SlError, StackError
from sl_common.json_file import write_json
from sl_projector.sequence.pattern_sequence import PatternSequence, named
from sl_reconstruct.cloud.height_map import make_height_map
from sl_reconstruct.measure.groove import measure_groove
from sl_reconstruct.measure.plane_angle import AngleMeasurement, measure_angle
from sl_reconstruct.measure.profile import ProfileMeasurement, measure_profile
from sl_reconstruct.measure.region import Region, select
from sl_reconstruct.reconstruction.reconstructor import Reconstructor

FRAME_S = 1.0 / 30.0
TRUE_ANGLE_DEG = 155.92
#: The flanks, well inside the groove (6 mm wide), for clouds too coarse to find them.
FLANKS = (Region.rectangle(-2.8e-3, -4e-3, -0.2e-3, 4e-3),
          Region.rectangle(0.2e-3, -4e-3, 2.8e-3, 4e-3))  # fmt: skip
#: Fig. 11: 3.5 x 3.5 mm of the coin with its topmost character, and a section through that.
CHARACTER = Region.rectangle(-1.75e-3, 0.9e-3, 1.75e-3, 4.4e-3)
CHARACTER_MM2 = 3.5 * 3.5
SECTION = ((-0.85e-3, 2.8e-3), (0.85e-3, 2.8e-3))
#: About one camera row.
SECTION_WIDTH_M = 8e-6
#: Table 2 and section 4.3: points, area (mm), standard deviation (um), angle, seconds.
PAPER: dict[str, Any] = {
    "points": 1_077_582,
    "area": (12.0, 9.0),
    "sd_um": 3.817,
    "angle": 152.49,
    "time_s": 120.0,
}
PAPER_PLANES = ("Z = -0.2265 X +0.0016 Y", "Z = +0.2621 X +0.0013 Y")
PAPER_COIN = {"points": 137_033, "height_um": 50.0}


@dataclass(frozen=True)
class Row:
    """One column of the table: a cloud, and how long it took from the call.

    Parameters
    ----------
    name : str
        How it was made.
    points : ndarray, structured
        The cloud.
    time_s : float
        Frames at 30 a second, and the processing as measured here.
    """

    name: str
    points: NDArray[Any]
    time_s: float

    @property
    def count(self) -> int:
        """Number of points."""
        return int(np.count_nonzero(np.isfinite(self.points["z"])))

    @property
    def area_mm(self) -> tuple[float, float]:
        """Extent in x and y, millimetres."""
        x, y = (float(np.nanmax(self.points[n]) - np.nanmin(self.points[n])) for n in "xy")
        return 1e3 * x, 1e3 * y


def expose(world: World, sequence: PatternSequence) -> NDArray[Any]:
    """Images of one scan, (N, H, W)."""
    count = len(sequence)
    return np.stack([world.expose([(sequence.frame(i), FRAME_S)], FRAME_S, i)
                     for i in range(count)])  # fmt: skip


def scan(surface: str, name: str) -> tuple[Row, NDArray[Any]]:
    """Scan a surface of the bench; the images as well."""
    rig, sequence = reference_rig(), named(name)
    stack = expose(World(rig, make_surface(surface), Optics()), sequence)
    reconstructor = Reconstructor(rig, sequence)
    reconstructor(stack)  # compiled and warm, as in a graph that is up
    start = time.perf_counter()
    cloud = reconstructor(stack)
    taken = time.perf_counter() - start
    return Row(name, cloud.points, len(sequence) * FRAME_S + taken), stack


def _angle(row: Row) -> AngleMeasurement:
    with contextlib.suppress(StackError):
        if row.name != "naive":
            return measure_groove(row.points)
    return measure_angle(*(select(row.points, flank) for flank in FLANKS))


def table(rows: Sequence[Row], angles: Sequence[AngleMeasurement]) -> Iterator[str]:
    """Table 2 side by side."""
    columns = ["the paper's", *(row.name for row in rows)]
    yield _line("", columns)
    for index, attribute in enumerate(("first", "second")):
        planes = (getattr(angle, attribute) for angle in angles)
        cells = (f"Z = {p.a:+.4f} X {p.b:+.4f} Y" for p in planes)
        yield _line(f"plane {index + 1}", [PAPER_PLANES[index], *cells])
    yield _line("standard deviation", [f"{PAPER['sd_um']} µm",
                *(f"{1e6 * a.rms_m:.3f} µm" for a in angles)])  # fmt: skip
    yield _line(
        "included angle", [f"{PAPER['angle']} deg", *(f"{a.value:.5f} deg" for a in angles)]
    )
    yield _line("  off 155.92 by", ["3.43 deg",
                *(f"{a.value - TRUE_ANGLE_DEG:+.5f} deg" for a in angles)])  # fmt: skip
    yield _line("  uncertainty", ["", *(f"{a.uncertainty:.5f} deg" for a in angles)])
    yield _line("area", ["12 x 9 mm", *("{:.1f} x {:.1f} mm".format(*r.area_mm) for r in rows)])
    yield _line("points", [f"{PAPER['points']:,}", *(f"{r.count:,}" for r in rows)])
    yield _line("time", ["120 s", *(f"{r.time_s:.2f} s" for r in rows)])


def _line(name: str, cells: Sequence[str]) -> str:
    return f"{name:<20}" + "".join(f"{cell:<28}" for cell in cells).rstrip()


def _groove(folder: Path) -> dict[str, Any]:
    """Table 2 and Fig. 10."""
    precise, _ = scan("groove", "precise")
    paper, stack = scan("groove", "paper")
    start = time.perf_counter()
    coarse = naive(reference_rig(), stack)
    spent = time.perf_counter() - start
    rows = [paper, precise, Row("naive", coarse, GRAY_BITS * FRAME_S + spent)]
    angles = [_angle(row) for row in rows]
    say("V-groove: Table 2 and Fig. 10")
    for line in table(rows, angles):
        say(line)
    _write(folder / "fig10_groove.png", groove_picture([(r.name, r.points) for r in rows]))
    return {
        row.name: {
            "points": row.count, "area_mm": row.area_mm, "time_s": row.time_s,
            "standard_deviation_m": angle.rms_m, "included_angle_deg": angle.value,
            "u_included_angle_deg": angle.uncertainty,
        }
        for row, angle in zip(rows, angles, strict=True)
    }  # fmt: skip


def _coin(folder: Path) -> dict[str, Any]:
    """Fig. 11."""
    say("\nCoin: Fig. 11, 3.5 x 3.5 mm with a character")
    say(_line("", ["points", "points per mm²", "height of the section", "time"]))
    theirs = PAPER_COIN["points"]
    height = f"about {PAPER_COIN['height_um']} µm"
    say(_line("the paper's", [f"{theirs:,}", f"{theirs / CHARACTER_MM2:,.0f}", height]))
    # Its groove's density says what this rig's paper twin gives on that area at most.
    groove = PAPER["points"] / math.prod(PAPER["area"])
    say(_line("  at its groove's", [f"{groove * CHARACTER_MM2:,.0f}", f"{groove:,.0f}"]))
    results, sections = {}, []
    for name in ("paper", "precise"):
        row, _ = scan("coin", name)
        character = select(row.points, CHARACTER)
        section: ProfileMeasurement = measure_profile(row.points, *SECTION, SECTION_WIDTH_M)
        height = f"{1e6 * section.value:.2f} ± {1e6 * section.uncertainty:.2f} µm"
        density = f"{len(character) / CHARACTER_MM2:,.0f}"
        say(_line(name, [f"{len(character):,}", density, height, f"{row.time_s:.2f} s"]))
        inside = CHARACTER.contains(row.points["x"], row.points["y"])
        part = row.points.copy()
        for axis in "xyz":
            part[axis][~inside] = np.nan
        picture = relief_picture(make_height_map(part), f"Fig. 11(a): coin, {name}")
        _write(folder / f"fig11a_coin_{name}.png", picture)
        sections.append((name, section))
        results[name] = {"points": len(character), "height_m": section.value,
                         "u_height_m": section.uncertainty, "time_s": row.time_s}  # fmt: skip
    _write(folder / "fig11b_section.png", section_picture(sections, "Fig. 11(b): section"))
    return results


def _write(path: Path, png: bytes) -> None:
    with written_atomically(path) as partial:
        partial.write_bytes(png)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the tables, write pictures and ``paper.json``."""
    parser = argparse.ArgumentParser(prog="make paper", description=main.__doc__)
    parser.add_argument("--output", type=Path, default=Path("output/paper"), metavar="DIR")
    args = parser.parse_args(argv)
    try:
        results = {"groove": _groove(args.output), "coin": _coin(args.output)}
        write_json(args.output / "paper.json", {"format": 1, **results})
    except (SlError, OSError) as exc:
        complain(f"paper: error: {exc}")
        return 1
    say(f"\npictures: {args.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
