"""The folder of an evaluation: its summary, its index page, and the way back."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sl_bringup.results.scan_files import clear_scan
from sl_bringup.results.scan_page import banner
from sl_common.documents import write_text
from sl_common.errors import ConfigError
from sl_common.json_file import write_json
from sl_common.pages.page import render_page

_TEMPLATE = Path(__file__).parent / "templates" / "evaluation.html"
#: What the summary repeats of each scan's report.
SUMMARY_KEYS = (
    *("scan_id", "folder", "good", "complete", "reasons", "points", "median_sigma_m"),
    *("cloud_hash", "calibration_hash", "settings_hash", "live"),
)


def clear_results(output: Path) -> None:
    """Delete what an earlier evaluation wrote here, so that no old scan passes for a new one.

    Raises
    ------
    ConfigError
        When the folder's ``summary.json`` was not written by an evaluation.
    """
    summary = output / "summary.json"
    if not summary.is_file():
        return
    try:
        folders = [str(scan["folder"]) for scan in json.loads(summary.read_text())["scans"]]
    except (ValueError, KeyError, TypeError):
        raise ConfigError(f"{summary} is not of slrig; expected an empty or new folder") from None
    for name in folders:
        clear_scan(output / Path(name).name)
    for name in ("summary.json", "index.html"):
        (output / name).unlink(missing_ok=True)


def write_summary(
    output: Path,
    name: str,
    reports: Sequence[Mapping[str, Any]],
    lost: Sequence[str],
    notes: Sequence[str],
) -> None:
    """Write ``summary.json`` and ``index.html``.

    Parameters
    ----------
    output : Path
        The folder.
    name : str
        Of the bag.
    reports : sequence of mapping
        Of the scans.
    lost, notes : sequence of str
        What could not be read of the bag, and what is odd about it.
    """
    scans = [{key: report[key] for key in SUMMARY_KEYS if key in report} for report in reports]
    content = {"format": 1, "bag": name, "lost": lost, "notes": notes}
    write_json(output / "summary.json", {**content, "live": count_live(reports), "scans": scans})
    folders = [str(report["folder"]) for report in reports]
    has_page = [(output / folder / "report.html").is_file() for folder in folders]
    shown = zip(folders, has_page, map(banner, reports), strict=True)
    page = render_page(
        _TEMPLATE, title=name, live=live_line(reports), lost=lost, notes=notes, scans=shown
    )
    write_text(output / "index.html", page)


def count_live(reports: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Scans whose cloud has the live cloud's hash, another one, or none to compare with."""
    found = [report.get("live", {}).get("agrees") for report in reports]
    kinds = {"same": True, "different": False, "unknown": None}
    return {name: found.count(agrees) for name, agrees in kinds.items()}


def live_line(reports: Sequence[Mapping[str, Any]]) -> str:
    """Tell how the clouds compare with the live ones."""
    counts = count_live(reports)
    if not counts["same"] + counts["different"]:
        return "no cloud can be compared with a live one"
    line = f"{counts['same']} of {len(reports)} clouds are the live ones, bit for bit"
    return line + (f"; {counts['different']} DIFFER" if counts["different"] else "")
