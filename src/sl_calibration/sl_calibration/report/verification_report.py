"""The report of a check of the calibration in force: a page and JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sl_calibration.data.run_store import PAGE, REPORT
from sl_calibration.report.calibration_report import banner, page, picture, table, write_json
from sl_calibration.report.report_pictures import off_planes, png
from sl_calibration.verify.rig_check import Findings, VerifyLimits
from sl_common.documents import write_text

#: What each figure is, the factor and the unit in which people read it.
_FIGURES: Mapping[str, tuple[str, float, str]] = {
    "rms_m": ("All lengths below but the steps, in quadrature", 1e6, "µm"),
    "flatness_m": ("Points off their plane, rms, worst height", 1e6, "µm"),
    "ray_gap_m": ("Camera and projector rays miss each other, rms, worst height", 1e6, "µm"),
    "lattice_m": ("Holes off the plate's lattice, rms, worst height", 1e6, "µm"),
    "pitch_error": ("Pitch of the holes off by, worst height", 1e6, "ppm"),
    "step_m": ("Planes off the stage's steps, worst", 1e6, "µm"),
}


def write_verify_report(
    folder: Path, findings: Findings, limits: VerifyLimits, message: str, recalibrate: bool,
    calibration_hash: str,
) -> None:  # fmt: skip
    """Write ``report.json`` and ``report.html`` of a check."""
    heights = _heights(findings)
    content = {
        "format": 1,
        "target": findings.checks[0].target,
        "recalibrate": recalibrate,
        "message": message,
        "figures": findings.figures,
        "limits": asdict(limits),
        "z_scale_error": findings.z_scale_error,
        "heights": heights,
        "calibration_hash": calibration_hash,
    }
    write_json(folder / REPORT, content)
    title = f"Check of the calibration in force on the {content['target']}"
    layers = [(c.height_m, c.points_m, c.off_plane_m) for c in findings.checks]
    parts = [
        f"<h1>{title}</h1>",
        banner(not recalibrate, message),
        table("Verdict", ("Figure", "Found", "Limit"), _rows(content)),
        table("Heights", *_height_rows(heights)),
        picture("Points off the best plane", png(off_planes(layers))),
        table("Checked", ("", ""), [("calibration hash", calibration_hash)]),
    ]
    write_text(folder / PAGE, page(title, parts))


def _heights(findings: Findings) -> list[dict[str, Any]]:
    names = ("height_m", "flatness_m", "ray_gap_m", "lattice_m", "pitch_error")
    return [
        {**{name: getattr(check, name) for name in names}, "points": len(check.points_m),
         "step_error_m": float(step)}
        for check, step in zip(findings.checks, findings.step_errors_m, strict=True)
    ]  # fmt: skip


def _rows(content: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    rows = []
    for name, (label, factor, unit) in _FIGURES.items():
        found, limit = content["figures"][name] * factor, content["limits"][name] * factor
        told = f"{found:.4g} {unit}" if math.isfinite(found) else "not told by this check"
        rows.append((label, told, f"{limit:.4g} {unit}"))
    return rows


def _height_rows(heights: list[dict[str, Any]]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    head = ("Stage height, mm", "Points", "Off the plane, µm", "Rays miss, µm",
            "Off the lattice, µm", "Pitch off, ppm", "Off the stage's step, µm")  # fmt: skip
    names = ("flatness_m", "ray_gap_m", "lattice_m", "pitch_error", "step_error_m")
    rows = [
        (f"{h['height_m'] * 1e3:.4f}", str(h["points"]), *(f"{h[n] * 1e6:.4f}" for n in names))
        for h in heights
    ]
    return head, [tuple("" if cell == "nan" else cell for cell in row) for row in rows]
