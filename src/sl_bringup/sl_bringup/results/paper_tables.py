"""The paper's Table 1 and Table 2 with this rig's numbers beside them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sl_calibration.report.table_1 import PAPER_TABLE_1, table_1

#: Tsai & Hung (2005), Table 2: the developed system, and the stylus instrument (Talyscan-150).
PAPER_TABLE_2: Mapping[str, tuple[str, str]] = {
    "Plane 1, Z in mm": ("-0.2265X + 0.0016Y + 0.0044", "-0.2159X + 0.0035Y + 0.0014"),
    "Plane 2, Z in mm": ("0.2621X + 0.0013Y + 0.0033", "0.2102X - 0.0018Y - 0.0028"),
    "Standard deviation, um": ("3.817", "2.685"),
    "Included angle, degrees": ("152.49", "155.92"),
    "Measurement area, mm": ("12 x 9", "16.7 x 2.0"),
    "Measurement points": ("1,077,582", "1,321,082"),
    "Time consumed": ("2 min", "90 min"),
}


def table_1_lines(report: Mapping[str, Any]) -> Iterator[str]:
    """Lines of Table 1 from a calibration's ``report.json``."""
    yield from _lines(
        ("Table 1: parameters, +- 1 sigma", "projection device", "camera"),
        [row[:3] for row in table_1(report)],
    )
    yield "the paper's rig"
    for name, values in PAPER_TABLE_1.items():
        yield f"  {name:<34}{values[0]:<34}{values[1]}"


def table_2_lines(report: Mapping[str, Any]) -> Iterator[str]:
    """Lines of Table 2 from a scan's report with a groove found in it."""
    groove = report["groove"]
    sides = [groove["left"], groove["right"]]
    points = max(1, sum(side["points"] for side in sides))
    rms = math.sqrt(sum(side["rms_m"] ** 2 * side["points"] for side in sides) / points)
    width_m, height_m = report.get("area_m", (math.nan, math.nan))
    seconds = report["acquisition_s"] + report["processing_s"]
    ours = [
        _plane(sides[0]),
        _plane(sides[1]),
        f"{rms * 1e6:.3f}",
        f"{groove['included_angle_deg']:.3f}",
        f"{width_m * 1e3:.1f} x {height_m * 1e3:.1f}",
        f"{report['points']:,}",
        f"{seconds:.1f} s",
    ]
    rows = [
        (name, mine, *paper)
        for mine, (name, paper) in zip(ours, PAPER_TABLE_2.items(), strict=True)
    ]
    yield from _lines(("Table 2: V-groove", "this scan", "the paper", "Talyscan-150"), rows)


def _plane(side: Mapping[str, Any]) -> str:
    """``Z = AX + BY + C`` of a plane, millimetres."""
    nx, ny, nz = side["normal"]
    x, y, z = side["point_m"]
    a, b = -nx / nz, -ny / nz
    return f"{a:.4f}X {b:+.4f}Y {(z - a * x - b * y) * 1e3:+.4f}"


def _lines(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Columns of equal width; a cell may have several lines."""
    cells = [[cell.split("\n") for cell in row] for row in [head, *rows]]
    widths = [2 + max(len(line) for row in cells for line in row[i]) for i in range(len(head))]
    for row in cells:
        for k in range(max(map(len, row))):
            words = [cell[k] if k < len(cell) else "" for cell in row]
            yield "".join(f"{w:<{n}}" for w, n in zip(words, widths, strict=True)).rstrip()
