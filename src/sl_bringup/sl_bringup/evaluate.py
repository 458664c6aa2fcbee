"""``slrig evaluate``: a recording to clouds, reports and pictures, without ROS and without DDS.

The stacks come from the matcher that the live graph uses, the clouds from the reconstruction that
it uses: same data and settings, same bits.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from sl_bringup.bags import TRIGGER, Bag, open_bag, topic_names
from sl_bringup.calibrations import Calibrations
from sl_bringup.progress import Progress, complain, say
from sl_bringup.stacks import decisions
from sl_bringup.report import page, verdict_line, write_json, write_page
from sl_bringup.scan_files import clear_scan, write_scan
from sl_camera.matching import FrameDecision, MatchedStack, MatcherSettings, StackMatcher, Status
from sl_projector.documents import write_text
from sl_projector.errors import BagError, CalibrationError, ConfigError, SlError
from sl_reconstruct.cloud import Cloud
from sl_reconstruct.cloud_files import cloud_hash
from sl_reconstruct.quality import verdict
from sl_reconstruct.settings import Settings
from sl_reconstruct.workshop import Workshop

VERDICTS = (Status.STACK_COMPLETE, Status.STACK_REFUSED)


@dataclass(frozen=True)
class Choices:
    """What the user chose.

    Parameters
    ----------
    calibration : Path or None
        Used instead of the bag's.
    settings : Settings
        Of the reconstruction.
    matching : MatcherSettings
        Of the matching.
    namespace : str or None
        Of the rig, where the bag has several.
    pictures : bool
        Whether pictures and pages are made.
    """

    calibration: Path | None = None
    settings: Settings = field(default_factory=Settings)
    matching: MatcherSettings = field(default_factory=MatcherSettings)
    namespace: str | None = None
    pictures: bool = True


def evaluate_bag(path: Path, output: Path, choices: Choices) -> list[dict[str, Any]]:
    """Evaluate all scans of a recording and write their folders.

    Parameters
    ----------
    path : Path
        The recording.
    output : Path
        Folder for ``scan_NNNN`` folders, ``summary.json`` and ``index.html``.
    choices : Choices
        Of the user.

    Returns
    -------
    list of dict
        One report per scan, those that were refused included.

    Raises
    ------
    BagError
        When the recording cannot be read or holds no scan.
    CalibrationError
        When no usable calibration is at hand.
    """
    with open_bag(path, choices.namespace) as bag:
        _clear(output)
        total = _count_scans(bag)
        calibrations = Calibrations(bag, choices.calibration)
        matcher = StackMatcher(choices.matching)
        workshop = Workshop(choices.settings)
        reports: list[dict[str, Any]] = []
        with Progress("evaluating", total, "scans") as progress:
            for decision in _verdicts(bag, matcher):
                folder = output / _folder_name(decision.scan_id, output, reports)
                report = _evaluate(decision, folder, bag, workshop, calibrations, choices)
                reports.append(report)
                if decision.stack is not None:
                    matcher.recycle(decision.stack)
                progress.step()
        _write_summary(output, bag, reports)
        if not reports:
            raise BagError(f"{path} holds no scan{_lost(bag)}; expected triggers and images")
    return reports


def _clear(output: Path) -> None:
    """Take away what an earlier evaluation wrote here, so that no old scan passes for a new one."""
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


def _count_scans(bag: Bag) -> int:
    """Scans that were begun; refuses a bag without triggers, and says what it has instead."""
    scans = {m.message.scan_id for m in bag.messages(TRIGGER, quick=True)}
    if not scans:
        raise BagError(
            f"{bag.path} has no triggers on {bag.namespace}/{TRIGGER.name}{_lost(bag)}; its topics "
            f"are {', '.join(topic_names(bag)) or 'none'}"
        )
    return len(scans)


def _lost(bag: Bag) -> str:
    return f" ({'; '.join(bag.lost)})" if bag.lost else ""


def _verdicts(bag: Bag, matcher: StackMatcher) -> Iterator[FrameDecision]:
    return (d for d in decisions(bag, matcher) if d.status in VERDICTS)


def _folder_name(scan_id: int, output: Path, reports: Sequence[Mapping[str, Any]]) -> str:
    """Name by the scan's number; a number that came before gets a suffix."""
    name = f"scan_{scan_id:04d}"
    times = sum(report["scan_id"] == scan_id for report in reports)
    return f"{name}_{times + 1}" if times else name


def _evaluate(
    decision: FrameDecision,
    folder: Path,
    bag: Bag,
    workshop: Workshop,
    calibrations: Calibrations,
    choices: Choices,
) -> dict[str, Any]:
    """Report on one verdict; a scan that cannot be evaluated is reported, not raised."""
    report: dict[str, Any] = {
        "format": 1,
        "bag": bag.path.name,
        "scan_id": decision.scan_id,
        "folder": folder.name,
        "good": False,
        "complete": decision.stack is not None,
        "reasons": [decision.reason] if decision.reason else [],
        "sequence": "",
        "software": _version(),
        "settings": choices.settings.to_dict(),
        "settings_hash": choices.settings.hash(),
    }
    cloud = None
    if decision.stack is not None:
        try:
            cloud = _measure(report, decision.stack, workshop, calibrations)
        except SlError as exc:
            if isinstance(exc, CalibrationError):
                raise
            report["reasons"] = [str(exc)]
    pictures = write_scan(folder, report, cloud, choices.pictures)
    write_json(folder / "report.json", report)
    if choices.pictures:
        write_page(folder / "report.html", report, pictures)
    return report


def _measure(
    report: dict[str, Any],
    stack: MatchedStack,
    workshop: Workshop,
    calibrations: Calibrations,
) -> Cloud:
    """Reconstruct a stack and put what was found into the report."""
    in_force = calibrations.of(stack)
    count, height, width = stack.data.shape
    report.update(
        sequence=stack.sequence.name,
        dmd_size=stack.sequence.dmd_size,
        images=f"{count} of {width} x {height}, {stack.encoding}",
        stamp_ns=stack.image_stamps_ns[0],
        exposure_s=stack.exposure_s,
        calibration_hash=in_force.calibration.hash,
        calibration_source=in_force.source,
    )
    if workshop.calibration_hash != in_force.calibration.hash:
        workshop.calibrate(in_force.calibration)
    cloud = workshop(stack.data, stack.sequence).cloud
    good, reasons = verdict(cloud)
    report.update(
        good=good,
        reasons=reasons,
        cloud_hash=cloud_hash(cloud.points),
        points=cloud.present,
        lit_positions=cloud.lit,
        present_fraction=cloud.present / cloud.lit if cloud.lit else 0.0,
        refused=dict(cloud.refused),
        figures=_figures(cloud),
        median_sigma_m=_median(cloud.points["sigma"]),
    )
    return cloud


def _figures(cloud: Cloud) -> dict[str, float]:
    """All quality figures by name, the residuals of the rays where there are any."""
    figures = {f.name: getattr(cloud.figures, f.name) for f in fields(cloud.figures)}
    figures["bound_ratio"] = cloud.figures.bound_ratio
    for name in ("gap_m", "gap_px"):
        if (gap := getattr(cloud, name)) is not None:
            figures[f"median_{name}"] = _median(gap)
    return figures


def _median(values: NDArray[Any]) -> float:
    there = values[np.isfinite(values)]
    return float(np.median(there)) if there.size else float("nan")


def _version() -> str:
    try:
        return f"slrig {metadata.version('slrig')}"
    except metadata.PackageNotFoundError:
        return "slrig (not installed)"


def _write_summary(output: Path, bag: Bag, reports: Sequence[Mapping[str, Any]]) -> None:
    keys = ("scan_id", "folder", "good", "complete", "reasons", "points", "median_sigma_m",
            "cloud_hash", "calibration_hash", "settings_hash")  # fmt: skip
    scans = [{key: report[key] for key in keys if key in report} for report in reports]
    content = {"format": 1, "bag": bag.path.name, "lost": bag.lost, "notes": bag.notes}
    write_json(output / "summary.json", {**content, "scans": scans})
    parts = [f"<h1>{bag.path.name}</h1>"]
    parts += [f'<p class="verdict bad">Lost: {line}</p>' for line in bag.lost]
    for report in reports:
        parts.append(f'<h2><a href="{report["folder"]}/report.html">{report["folder"]}</a></h2>')
        parts.append(verdict_line(report["good"], report["reasons"]))
    write_text(output / "index.html", page(bag.path.name, parts))


def parse_choices(assignments: Sequence[str]) -> tuple[Settings, MatcherSettings]:
    """Read ``name=value`` assignments: settings of the reconstruction and of the matching.

    Raises
    ------
    ConfigError
        When a name is unknown or a value cannot be used.
    """
    of_settings = {f.name for f in fields(Settings)}
    of_matching = {f.name for f in fields(MatcherSettings)}
    values: dict[str, Any] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or name not in of_settings | of_matching:
            raise ConfigError(
                f"--set {assignment!r}; expected name=value with one of "
                f"{', '.join(sorted(of_settings))} (reconstruction), "
                f"{', '.join(sorted(of_matching))} (matching)"
            )
        values[name] = _value(text)
    try:
        settings = Settings.from_dict({k: v for k, v in values.items() if k in of_settings})
        matching = MatcherSettings(**{k: v for k, v in values.items() if k in of_matching})
    except (TypeError, ConfigError) as exc:
        raise ConfigError(f"--set {' '.join(assignments)}: {exc}") from None
    return settings, matching


def _value(text: str) -> Any:
    """A number, true, false, null or a word."""
    try:
        value = yaml.safe_load(text)
        return float(value) if isinstance(value, str) else value  # YAML 1.1 has no 1e1
    except (ValueError, yaml.YAMLError):
        return text


def add_parser(subparsers: Any) -> None:
    """Register ``slrig evaluate``."""
    parser = subparsers.add_parser(
        "evaluate",
        help="recording to clouds, reports and pictures",
        description="Evaluate a recording without ROS: for each scan a folder with cloud.ply, "
        "cloud.pcd, height.tiff, height.png, report.json, report.html and pictures. The exit "
        "status is 0 only when every scan is complete and good.",
        epilog="examples:\n"
        "  slrig evaluate scan_bag --output results\n"
        "  slrig evaluate board_bag --calibration calibration.json --output results\n"
        "  slrig evaluate scan_bag --output cubic --set estimator=cubic\n"
        "  slrig evaluate foreign_bag --output results --set require_pose=false",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("bag", type=Path, metavar="BAG", help="rosbag2 directory, .mcap or .db3")
    parser.add_argument(
        "--calibration", type=Path, metavar="FILE",
        help="use this one (YAML, or OpenCV's XML, YAML, JSON), not the bag's",
    )  # fmt: skip
    parser.add_argument("--output", required=True, type=Path, metavar="DIR", help="for the results")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", dest="assignments",
        help="change a setting of reconstruction or matching; may be repeated",
    )  # fmt: skip
    parser.add_argument("--namespace", help="namespace of the rig, where the bag has several")
    parser.add_argument("--no-pictures", action="store_true", help="neither pictures nor pages")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig evaluate``; 0 only when every scan is complete and good."""
    settings, matching = parse_choices(args.assignments)
    choices = Choices(args.calibration, settings, matching, args.namespace, not args.no_pictures)
    reports = evaluate_bag(args.bag, args.output, choices)
    for report in reports:
        say(_line(report))
    lost = json.loads((args.output / "summary.json").read_text())["lost"]
    for line in lost:
        complain(f"slrig: lost: {line}")
    say(f"results in {args.output}")
    return 0 if all(report["good"] for report in reports) and not lost else 1


def _line(report: Mapping[str, Any]) -> str:
    name = f"scan {report['scan_id']}"
    if not report["good"]:
        return f"{name}: NOT GOOD: {'; '.join(report['reasons'])}"
    sigma_um = report["median_sigma_m"] * 1e6
    return (
        f"{name}: good, {report['points']:,} points "
        f"({100 * report['present_fraction']:.2f} % of the lit positions), median sigma "
        f"{sigma_um:.3g} um"
    )
