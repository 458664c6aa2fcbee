"""``slrig evaluate``: recordings to clouds, reports and pictures, without ROS."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sl_bringup.bag.bags import open_bag
from sl_bringup.evaluation.evaluate_bag import (
    Choices,
    Crew,
    Pictures,
    Result,
    count_scans,
    evaluate_bag,
    is_good,
)
from sl_bringup.evaluation.settings_overrides import parse_choices
from sl_bringup.evaluation.sweep import Variant, variants, write_sweep
from sl_bringup.graph.console import ProgressLine, complain, say
from sl_bringup.results.evaluation_folder import live_line
from sl_common.errors import BagError, ConfigError, SlError


@dataclass(frozen=True)
class Task:
    """One bag to be evaluated: where it is, where its results go."""

    bag: Path
    output: Path


def tasks_of(bags: Sequence[Path], output: Path) -> list[Task]:
    """Give every bag its folder: the output itself for one, folders in it for several.

    Parameters
    ----------
    bags : sequence of Path
        Recordings.
    output : Path
        Folder of the results.

    Raises
    ------
    ConfigError
        When a bag is named twice.
    """
    if len({bag.resolve() for bag in bags}) < len(bags):
        raise ConfigError(f"a bag is named twice: {', '.join(map(str, bags))}")
    if len(bags) == 1:
        return [Task(bags[0], output)]
    names = [bag.resolve().name for bag in bags]
    return [
        Task(bag, output / (name if names.count(name) == 1 else f"{name}_{number}"))
        for number, (bag, name) in enumerate(zip(bags, names, strict=True), start=1)
    ]


def evaluate_all(
    tasks: Sequence[Task], choices: Choices, crew: Crew
) -> list[tuple[Task, Result | SlError]]:
    """Evaluate bags side by side; one that cannot be evaluated does not stop the others.

    Parameters
    ----------
    tasks : sequence of Task
        Bags with their folders.
    choices : Choices
        Settings that differ from the recordings'.
    crew : Crew
        Processes that do the work.

    Returns
    -------
    list of (Task, Result or SlError)
        In the order of the tasks.
    """

    def one(task: Task) -> Result | SlError:
        try:
            return evaluate_bag(task.bag, task.output, choices, crew)
        except SlError as error:
            return error

    if len(tasks) == 1 or crew.jobs == 1:
        return [(task, one(task)) for task in tasks]
    with ThreadPoolExecutor(min(crew.jobs, len(tasks)), "sl-bag") as pool:
        try:
            return list(zip(tasks, pool.map(one, tasks), strict=True))
        except BaseException:
            crew.stopped.set()
            raise


def add_parser(subparsers: Any) -> None:
    """Register ``slrig evaluate``."""
    parser = subparsers.add_parser(
        "evaluate",
        description="Evaluate recordings without ROS: for each scan a folder with cloud.ply, "
        "cloud.pcd, height.tiff, height.png, report.json, report.html and pictures. Settings and "
        "calibration are the recording's unless others are named. The exit status is 0 only when "
        "every scan is complete and good, and none differs from its live cloud.",
        epilog="examples:\n"
        "  slrig evaluate scan_bag --output results\n"
        "  slrig evaluate monday tuesday --output results --pictures first\n"
        "  slrig evaluate board_bag --calibration calibration.json --output results\n"
        "  slrig evaluate scan_bag --output cubic --set estimator=cubic\n"
        "  slrig evaluate scan_bag --output sweep --sweep estimator=matched,cubic\n"
        "  slrig evaluate foreign_bag --output results --set require_pose=false",
    )
    add = parser.add_argument
    add("bags", type=Path, nargs="+", metavar="BAG", help="rosbag2 directory, .mcap or .db3")
    text = "use this one (YAML, or OpenCV's XML, YAML, JSON), not the bag's"
    add("--calibration", type=Path, metavar="FILE", help=text)
    add("--output", required=True, type=Path, metavar="DIR", help="for the results")
    several = {"action": "append", "default": []}
    text = "change a setting of reconstruction or matching; may be repeated"
    add("--set", dest="assignments", metavar="NAME=VALUE", help=text, **several)
    text = "evaluate with each of these values, and compare them in one table; may be repeated"
    add("--sweep", metavar="NAME=A,B,C", help=text, **several)
    add("--namespace", help="namespace of the rig, where the bag has several")
    text = "of which scans there are pictures; none: no pages either (default: all; --sweep: first)"
    add("--pictures", choices=("none", "first", "all"), help=text)
    text = "as --pictures none"
    add("--no-pictures", action="store_const", const="none", dest="pictures", help=text)
    text = "scans evaluated at a time (default: one per core)"
    add("--jobs", type=int, default=len(os.sched_getaffinity(0)), metavar="N", help=text)


def run(args: argparse.Namespace) -> int:
    """Carry out ``slrig evaluate``."""
    if not 1 <= args.jobs <= 256:
        raise ConfigError(f"--jobs {args.jobs}; expected 1 to 256")
    found = list(variants(args.sweep))
    pictures: Pictures = args.pictures or ("first" if args.sweep else "all")
    for variant in found:
        parse_choices([*args.assignments, *variant.assignments])
    total = len(found) * sum(_scans_in(bag, args.namespace) for bag in args.bags)
    results = []
    with (
        ProgressLine("evaluating", total, "scans") as progress,
        Crew(args.jobs, progress.step) as crew,
    ):
        for variant in found:
            chosen = (*args.assignments, *variant.assignments)
            choices = Choices(args.calibration, chosen, args.namespace, pictures)
            tasks = tasks_of(args.bags, args.output / variant.folder)
            results.append((variant, evaluate_all(tasks, choices, crew)))
    faults = list(_tell(args, results))
    for fault in faults:
        complain(f"slrig: {fault}")
    if any(isinstance(outcome, Result) for _, outcomes in results for _, outcome in outcomes):
        say(f"results in {args.output}")
    return 1 if faults else 0


def _scans_in(path: Path, namespace: str | None) -> int:
    """Scans of a bag, for the progress; a bag that cannot be read is reported later."""
    try:
        with open_bag(path, namespace) as bag:
            return count_scans(bag)
    except BagError:
        return 0


def _tell(
    args: argparse.Namespace, results: Sequence[tuple[Variant, list[tuple[Task, Result | SlError]]]]
) -> Iterator[str]:
    """Say what came of it; yield what is wrong."""
    for variant, outcomes in results:
        if variant.assignments:
            say(f"-- {variant.title}")
        for task, outcome in outcomes:
            yield from _tell_bag(task, outcome, several=len(outcomes) > 1)
    if args.sweep:
        found = [(v, _reports(o)) for v, o in results]
        for line in write_sweep(args.output, found, args.assignments):
            say(line)


def _reports(outcomes: Sequence[tuple[Task, Result | SlError]]) -> list[tuple[Path, Any]]:
    return [
        (task.output, report)
        for task, outcome in outcomes
        if isinstance(outcome, Result)
        for report in outcome.reports
    ]


def _tell_bag(task: Task, outcome: Result | SlError, several: bool) -> Iterator[str]:
    if isinstance(outcome, SlError):
        yield f"error: {outcome}"
        return
    if several:
        say(f"{task.bag}:")
    for report in outcome.reports:
        say(scan_line(report))
    say(live_line(outcome.reports))
    for note in outcome.notes:
        complain(f"slrig: note: {note}")
    yield from (f"lost: {line}" for line in outcome.lost)
    if not is_good(outcome.reports):
        yield f"{task.bag}: not every scan is good"


def scan_line(report: Mapping[str, Any]) -> str:
    """One line about a scan."""
    name = f"scan {report['scan_id']}"
    if not report["good"]:
        return f"{name}: NOT GOOD: {'; '.join(report['reasons'])}"
    sigma_um = report["median_sigma_m"] * 1e6
    line = (
        f"{name}: good, {report['points']:,} points "
        f"({100 * report['present_fraction']:.2f} % of the lit positions), median sigma "
        f"{sigma_um:.3g} um"
    )
    differs = report["live"]["agrees"] is False
    return f"{line}; {report['live']['told'].upper()}" if differs else line
