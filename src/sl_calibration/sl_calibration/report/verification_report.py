"""The report of a check of the calibration in force: a page and JSON."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from sl_calibration.data.run_store import PAGE, REPORT
from sl_calibration.report.report_pictures import off_planes
from sl_calibration.verify.rig_check import Findings, VerifyLimits
from sl_common.documents import write_text
from sl_common.json_file import write_json
from sl_common.pages.figure_png import png
from sl_common.pages.page import render_page

_TEMPLATE = Path(__file__).parent / "templates" / "verification.html"


def write_verify_report(
    folder: Path,
    findings: Findings,
    limits: VerifyLimits,
    message: str,
    recalibrate: bool,
    calibration_hash: str,
) -> None:
    """Write ``report.json`` and ``report.html`` of a check.

    Parameters
    ----------
    folder : Path
        Of the check.
    findings : Findings
        What was found at each height.
    limits : VerifyLimits
        What was allowed.
    message : str
        The verdict in words.
    recalibrate : bool
        Whether a figure is beyond its limit.
    calibration_hash : str
        Of the calibration that was checked.
    """
    target = findings.checks[0].target
    report = {
        "format": 1,
        "target": target,
        "recalibrate": recalibrate,
        "message": message,
        "figures": findings.figures,
        "limits": asdict(limits),
        "z_scale_error": findings.z_scale_error,
        "heights": _heights(findings),
        "calibration_hash": calibration_hash,
    }
    write_json(folder / REPORT, report)
    layers = [(c.height_m, c.points_m, c.off_plane_m) for c in findings.checks]
    title = f"Check of the calibration in force on the {target}"
    page = render_page(_TEMPLATE, title=title, report=report, planes=png(off_planes(layers)))
    write_text(folder / PAGE, page)


def _heights(findings: Findings) -> list[dict[str, Any]]:
    names = ("height_m", "flatness_m", "ray_gap_m", "lattice_m", "pitch_error")
    return [
        {
            **{name: getattr(check, name) for name in names},
            "points": len(check.points_m),
            "step_error_m": float(step),
        }
        for check, step in zip(findings.checks, findings.step_errors_m, strict=True)
    ]
