"""The page of one scan, and its verdict."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sl_common.documents import write_text
from sl_common.json_file import write_json
from sl_common.pages.page import render_page
from sl_reconstruct.measure.result import rounded

_TEMPLATE = Path(__file__).parent / "templates" / "scan.html"


def write_report(
    folder: Path, report: Mapping[str, Any], pictures: Mapping[str, bytes] | None
) -> None:
    """Write ``report.json`` and the page ``report.html`` of one scan.

    Parameters
    ----------
    folder : Path
        The scan's.
    report : mapping
        The scan's report.
    pictures : mapping, optional
        PNG by caption, for the page; without them there is no page.
    """
    write_json(folder / "report.json", report)
    if pictures is None:
        return
    live = report["bag"] == "live"
    title = f"Scan {report['scan_id']}" + (", live" if live else f" of {report['bag']}")
    found = {"banner": banner(report), "angle": included_angle(report)}
    page = render_page(_TEMPLATE, title=title, report=report, pictures=pictures, **found)
    write_text(folder / "report.html", page)


def banner(report: Mapping[str, Any]) -> tuple[bool, str]:
    """Whether all is well, and in words; a live cloud that differs is never well."""
    if not report["good"]:
        return False, f"Not good: {'; '.join(report['reasons'])}"
    live = report.get("live", {})
    if live.get("agrees") is False:
        return False, f"Good by itself, but {live['told']}"
    return True, "Good"


def included_angle(report: Mapping[str, Any]) -> str:
    """Angle of the scan's groove with its uncertainty; empty where none was found."""
    groove = report.get("groove", {})
    if not groove.get("found"):
        return ""
    angle = rounded(groove["included_angle_deg"], groove["u_included_angle_deg"])
    return f"{angle} degrees (standard uncertainty, of noise)"
