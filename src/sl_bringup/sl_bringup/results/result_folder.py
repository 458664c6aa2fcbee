"""The folder of an evaluation: its summary, its index page, and the way back."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sl_bringup.results.report import page, verdict_line, write_json
from sl_bringup.results.scan_files import clear_scan
from sl_common.documents import write_text
from sl_common.errors import ConfigError

SUMMARY_KEYS = (
    "scan_id", "folder", "good", "complete", "reasons", "points", "median_sigma_m", "cloud_hash",
    "calibration_hash", "settings_hash", "live",
)  # fmt: skip


def clear_results(output: Path) -> None:
    """Take away what an earlier evaluation wrote here, so that no old scan passes for a new one.

    Raises
    ------
    ConfigError
        When the folder's ``summary.json`` is somebody else's.
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
    parts = [f"<h1>{html.escape(name)}</h1>", f"<p>{html.escape(live_line(reports))}</p>"]
    parts += [f'<p class="verdict bad">Lost: {html.escape(line)}</p>' for line in lost]
    parts += [f"<p>Note: {html.escape(line)}</p>" for line in notes]
    for report in reports:
        title = report["folder"]
        if (output / title / "report.html").is_file():
            title = f'<a href="{title}/report.html">{title}</a>'
        parts.append(f"<h2>{title}</h2>")
        parts.append(verdict_line(report))
    write_text(output / "index.html", page(name, parts))


def count_live(reports: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Scans whose cloud has the live cloud's hash, another one, or none to compare with."""
    found = [report.get("live", {}).get("agrees") for report in reports]
    return {
        "same": found.count(True), "different": found.count(False), "unknown": found.count(None)
    }  # fmt: skip


def live_line(reports: Sequence[Mapping[str, Any]]) -> str:
    """Tell how the clouds compare with the live ones."""
    counts = count_live(reports)
    if not counts["same"] + counts["different"]:
        return "no cloud can be compared with a live one"
    line = f"{counts['same']} of {len(reports)} clouds are the live ones, bit for bit"
    return line + (f"; {counts['different']} DIFFER" if counts["different"] else "")
