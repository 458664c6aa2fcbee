"""What is written about a scan: JSON for programs, one self-contained page for people."""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sl_common.documents import write_text
from sl_reconstruct.measure.result import rounded

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2em auto; max-width: 64em; color: #222;
  background: #fff; padding: 0 1em }
h1 { font-size: 1.5em } h2 { font-size: 1.15em; margin-top: 2em }
.verdict { padding: .6em 1em; border-radius: .4em; font-weight: 600 }
.good { background: #e2f3e2; color: #145214 } .bad { background: #fbe3e0; color: #7a1708 }
table { border-collapse: collapse } td, th { padding: .2em 1.2em .2em 0; text-align: left;
  vertical-align: top; border-bottom: 1px solid #eee } td.n { text-align: right }
img { max-width: 100%; display: block; margin: 1em 0 } code { font-size: .85em }
"""


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a report as JSON; numbers that are not finite become null."""
    text = json.dumps(_plain(content), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(path, text + "\n")


def _plain(value: Any) -> Any:
    """Value as JSON knows it."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


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
    parts = [f"<h1>{_text(title)}</h1>", verdict_line(report)]
    parts += [_table(heading, rows) for heading, rows in _sections(report)]
    parts += [
        f'<h2>{_text(caption)}</h2><img alt="{_text(caption)}" '
        f'src="data:image/png;base64,{base64.b64encode(png).decode()}">'
        for caption, png in pictures.items()
    ]
    write_text(path, page(title, parts))


def page(title: str, parts: Sequence[str]) -> str:
    """HTML page of ready-made parts."""
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{_text(title)}'
        f"</title><style>{STYLE}</style></head><body>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def verdict_line(report: Mapping[str, Any]) -> str:
    """Banner: good, or not good and why; a live cloud that differs is never green."""
    if not report["good"]:
        return f'<p class="verdict bad">Not good: {_text("; ".join(report["reasons"]))}</p>'
    live = report.get("live", {})
    if live.get("agrees") is False:
        return f'<p class="verdict bad">Good by itself, but {_text(live["told"])}</p>'
    return '<p class="verdict good">Good</p>'


def _sections(report: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Tables of the page: heading and rows of name and value."""
    sections = [("Origin", _origin_rows(report))]
    if "points" in report:
        sections.insert(0, ("Result", _result_rows(report)))
        refused = [(k, f"{v:,}") for k, v in report["refused"].items() if v]
        if refused:
            sections.insert(1, ("Positions refused", refused))
    if report.get("groove", {}).get("found"):
        sections.insert(1, ("Groove (the paper's Table 2)", _groove_rows(report["groove"])))
    notes = [("Note", note) for note in report.get("notes", ())]
    return [*sections, ("Notes", notes)] if notes else sections


def _origin_rows(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Where the scan comes from, as far as is known: a live scan knows other things."""
    known = {
        "Sequence": report["sequence"],
        "Images": report.get("images"),
        "Saturated from": _with_unit(report.get("saturation_dn"), "DN"),
        "Acquisition": _with_unit(report.get("acquisition_s"), "s", ".2f"),
        "From the last image to the cloud": _with_unit(report.get("processing_s"), "s", ".2f"),
        "Attempts": report.get("attempts"),
        "Calibration": report.get("calibration_source"),
        "Live cloud": report.get("live", {}).get("told"),
        "Calibration hash": report.get("calibration_hash"),
        "Settings hash": report.get("settings_hash"),
        "Cloud hash": report.get("cloud_hash"),
        "Software": report.get("software"),
    }
    return [(name, str(value)) for name, value in known.items() if value not in (None, "")]


def _with_unit(value: float | None, unit: str, form: str = "") -> str | None:
    return None if value is None else f"{value:{form}} {unit}"


def _groove_rows(groove: Mapping[str, Any]) -> list[tuple[str, str]]:
    angle, u = groove["included_angle_deg"], groove["u_included_angle_deg"]
    rows = [("Included angle", f"{rounded(angle, u)} degrees (standard uncertainty, of noise)")]
    for side in ("left", "right"):
        plane = groove[side]
        normal = ", ".join(f"{n:+.5f}" for n in plane["normal"])
        told = f"rms {micrometres(plane['rms_m'])} of {plane['points']:,} points, normal ({normal})"
        rows.append((f"{side.capitalize()} flank", told))
    return rows


def _result_rows(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = [
        ("Points", f"{report['points']:,} of {report['lit_positions']:,} lit positions "
                   f"({100 * report['present_fraction']:.2f} %)"),
        ("Uncertainty of z, 1 sigma, median", micrometres(report["median_sigma_m"])),
    ]  # fmt: skip
    for name, (label, unit) in FIGURES.items():
        value = report["figures"].get(name)
        if value is not None and math.isfinite(value):
            rows.append((label, f"{value:.4g} {unit}".strip()))
    plane = report.get("plane")
    if plane:
        rows.append(
            ("Best plane", f"rms distance {micrometres(plane['rms_m'])}, "
                           f"tilted {plane['tilt_deg']:.3f}° off the world's z")
        )  # fmt: skip
    return rows


#: Figures that the page explains; all are in the JSON report.
FIGURES: Mapping[str, tuple[str, str]] = {
    "edge_sigma_px": ("Edge noise, 1 sigma", "camera px"),
    "edge_bound_px": ("Bound of the edge noise (Cramer-Rao, white noise)", "camera px"),
    "bound_ratio": ("Edge noise over that bound; the dark side is quieter than white noise", ""),
    "edge_blur_px": ("Blur of the edges", "camera px"),
    "light_change": ("Most uneven light of two images of the same stripes", "of 1"),
    "scale_px": ("Camera pixels per DMD column", "px"),
    "median_gap_m": ("Camera and projector rays miss each other by (median)", "m"),
    "median_gap_px": ("Residual of the four equations (median)", "px"),
}


def micrometres(length_m: float) -> str:
    """Length for people: micrometres below 1 mm, else millimetres."""
    if not math.isfinite(length_m):
        return "unknown"
    return f"{length_m * 1e6:.4g} µm" if abs(length_m) < 1e-3 else f"{length_m * 1e3:.4g} mm"


def _table(heading: str, rows: Sequence[tuple[str, str]]) -> str:
    body = "".join(
        f"<tr><th>{_text(name)}</th><td>{_text(value)}</td></tr>" for name, value in rows
    )
    return f"<h2>{_text(heading)}</h2><table>{body}</table>"


def _text(value: str) -> str:
    return html.escape(value, quote=True)
