"""The page of one scan, and its verdict."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sl_common.documents import write_text
from sl_common.pages.page import render_page
from sl_reconstruct.measure.result import rounded

_TEMPLATE = Path(__file__).parent / "templates" / "scan.html"


def write_page(path: Path, report: Mapping[str, Any], pictures: Mapping[str, bytes]) -> None:
    """Write the page of one scan, its pictures inside it.

    Parameters
    ----------
    path : Path
        The page.
    report : mapping
        The scan's report.
    pictures : mapping
        PNG by caption.
    """
    live = report["bag"] == "live"
    title = f"Scan {report['scan_id']}" + (", live" if live else f" of {report['bag']}")
    page = render_page(
        _TEMPLATE,
        title=title,
        report=report,
        banner=banner(report),
        pictures=pictures,
        angle=included_angle(report),
    )
    write_text(path, page)


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
