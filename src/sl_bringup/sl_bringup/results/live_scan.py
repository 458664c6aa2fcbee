"""What becomes of a live scan: its report, its files, and the lines that its user reads."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_bringup.graph.version import software_version
from sl_bringup.results.paper_tables import table_2_lines
from sl_bringup.results.scan_files import write_scan
from sl_bringup.results.scan_page import included_angle, write_report
from sl_common.errors import StackError
from sl_common.pages.page import length
from sl_reconstruct.cloud.cloud import CLOUD_DTYPE, Cloud
from sl_reconstruct.cloud.cloud_writer import cloud_hash
from sl_reconstruct.cloud.refusals import Reason
from sl_reconstruct.measure.groove import measure_groove
from sl_reconstruct.scan.scan_summary import ScanSummary

MEASURES = ("groove",)


def live_report(summary: ScanSummary, success: bool, message: str) -> dict[str, Any]:
    """Report of a live scan.

    Parameters
    ----------
    summary : ScanSummary
        What the action's result says.
    success : bool
        Whether there is a cloud.
    message : str
        What the graph said about it.
    """
    return {
        "format": 1,
        "bag": "live",
        "good": success,
        "reasons": [] if success else [message],
        "message": message,
        **summary.to_dict(),
        "software": software_version(),
    }


def write_result(
    folder: Path,
    report: dict[str, Any],
    points: NDArray[Any] | None,
    measure: str,
    pictures: bool,
    reason: NDArray[np.uint8] | None = None,
) -> None:
    """Write cloud, height map, pictures, ``report.json`` and ``report.html``.

    Parameters
    ----------
    folder : Path
        For the files.
    report : dict
        From `live_report`; gets what is measured here.
    points : ndarray or None
        Organised cloud as published; None when there is none.
    measure : str
        Feature that is looked for, one of `MEASURES`, or empty.
    pictures : bool
        Whether pictures and the page are made.
    reason : ndarray, (rows, columns), uint8, optional
        Map of the refusals as published; without it, it is not drawn.
    """
    cloud = None if points is None else _cloud(points, report, reason)
    with ThreadPoolExecutor(1) as beside:
        found = beside.submit(_measured, points, measure)
        drawn = write_scan(folder, report, cloud, pictures)
    report.update(found.result())
    write_report(folder, report, drawn if pictures else None)


def _measured(points: NDArray[Any] | None, measure: str) -> dict[str, Any]:
    """Fields of the report that are measured on the cloud."""
    if points is None:
        return {}
    extents = [float(np.nanmax(v) - np.nanmin(v)) for v in (points["x"], points["y"])]
    groove = {"groove": _groove(points)} if measure == "groove" else {}
    return {"area_m": extents, **groove}


def check_cloud(points: NDArray[Any], report: Mapping[str, Any]) -> str:
    """Empty when the cloud is the one that the report is about, else what is wrong.

    Parameters
    ----------
    points : structured ndarray, (H, W)
        The cloud as received.
    report : mapping
        The scan's report.
    """
    found = cloud_hash(points)
    if found == report["cloud_hash"]:
        return ""
    return f"cloud received has the hash {found[:12]}, the report {report['cloud_hash'][:12]}"


def _cloud(
    points: NDArray[Any], report: Mapping[str, Any], reason: NDArray[np.uint8] | None
) -> Cloud:
    """Cloud with what the messages carry; the columns of the edges are not in them."""
    if reason is None or reason.shape != points.shape:
        there = np.isfinite(points["z"])
        reason = np.where(there, Reason.PRESENT, Reason.UNLIT).astype(np.uint8)
    nothing = np.full(points.shape, np.nan, np.float32)
    points = points.astype(CLOUD_DTYPE, copy=False)
    return Cloud(points, nothing, reason, dict(report["refused"]), report["lit_positions"])


def _groove(points: NDArray[Any]) -> dict[str, Any]:
    try:
        found = measure_groove(points)
    except StackError:
        return {"found": False}
    planes = {
        name: {"normal": p.normal, "point_m": p.point_m, "rms_m": p.rms_m, "points": p.points}
        for name, p in (("left", found.first), ("right", found.second))
    }
    return {
        "found": True,
        "included_angle_deg": found.value,
        "u_included_angle_deg": found.uncertainty,
        **planes,
    }


def summary(report: Mapping[str, Any]) -> Iterator[str]:
    """Lines that tell a person what was measured."""
    if not report["good"]:
        yield f"no cloud: {report['message']}"
        return
    yield (
        f"points            {report['points']:,} of {report['lit_positions']:,} lit positions "
        f"({100 * report['present_fraction']:.2f} %)"
    )
    yield f"sigma of z        {length(report['median_sigma_m'])} (median of the stated ones)"
    if "bound_ratio" in report["figures"]:
        ratio = report["figures"]["bound_ratio"]
        yield f"edge noise        {ratio:.3f} x the bound for white noise"
    refused = {k: v for k, v in report["refused"].items() if v}
    listed = ", ".join(f"{count:,} {reason}" for reason, count in refused.items())
    yield f"refused           {listed or 'none'}"
    yield (
        f"time              {report['acquisition_s']:.2f} s acquisition, "
        f"{report['processing_s']:.2f} s from the last image to the cloud, "
        f"{report['attempts']} attempt{'s' if report['attempts'] > 1 else ''}"
    )
    for number, why in enumerate(report["attempt_messages"], start=1):
        yield f"  attempt {number}       thrown away: {why}"
    yield from _groove_lines(report)


def _groove_lines(report: Mapping[str, Any]) -> Iterator[str]:
    groove = report.get("groove")
    if groove is None:
        return
    if not groove["found"]:
        yield "groove            none found: no two flanks of different slope"
        return
    for side in ("left", "right"):
        plane = groove[side]
        x, y, z = plane["normal"]
        yield (
            f"{side + ' flank':<18}normal ({x:+.5f}, {y:+.5f}, {z:+.5f}), "
            f"rms {length(plane['rms_m'])}, {plane['points']:,} points"
        )
    yield f"included angle    {included_angle(report)}"
    yield ""
    yield from table_2_lines(report)
