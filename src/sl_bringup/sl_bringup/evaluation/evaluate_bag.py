"""The evaluation of recordings, without ROS and without DDS: the core of ``slrig evaluate``.

The stacks come from the matcher that the live graph uses, the clouds from the reconstruction that
it uses: same data and settings, same bits. One thread reads and matches; others reconstruct,
measure and write. What is under way at once is bounded, so the memory does not grow with the bag.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sl_bringup.bag.bag_matching import decisions
from sl_bringup.bag.bags import Bag, open_bag, topic_names
from sl_bringup.bag.recorded_calibrations import Calibrations, InForce
from sl_bringup.bag.recorded_settings import read_settings
from sl_bringup.evaluation.live_comparison import LiveResults
from sl_bringup.evaluation.settings_overrides import parse_choices
from sl_bringup.graph.version import software_version
from sl_bringup.results.evaluation_folder import clear_results, write_summary
from sl_bringup.results.scan_files import write_scan
from sl_bringup.results.scan_page import write_report
from sl_camera.sync.match_events import FrameDecision, Status
from sl_camera.sync.matching import StackMatcher
from sl_common.errors import BagError, CalibrationError, SlError
from sl_common.topics import TRIGGER
from sl_projector.sequence.stack import Stack
from sl_reconstruct.cloud.cloud import Cloud
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.decode.stack_statistics import saturation_of
from sl_reconstruct.reconstruction.reconstructor_cache import Workshop
from sl_reconstruct.reconstruction.scan_quality import verdict
from sl_reconstruct.scan.scan_summary import ScanSummary

VERDICTS = (Status.STACK_COMPLETE, Status.STACK_REFUSED)
#: Workshops kept with their scratch memory, where calibrations change.
MAX_WORKSHOPS = 2

Pictures = Literal["none", "first", "all"]
Report = dict[str, Any]


@dataclass(frozen=True)
class Choices:
    """What the user chose.

    Parameters
    ----------
    calibration : Path or None
        Used instead of the bag's.
    assignments : tuple of str
        ``name=value``: changes to the settings that the bag was recorded with.
    namespace : str or None
        Of the rig, where the bag has several.
    pictures : {"none", "first", "all"}
        Of which scans pictures are drawn; "none": no pages either.
    """

    calibration: Path | None = None
    assignments: tuple[str, ...] = ()
    namespace: str | None = None
    pictures: Pictures = "all"


@dataclass(frozen=True)
class Result:
    """What became of one bag: a report per scan, refused ones included, and what was lost of it."""

    reports: list[Report]
    lost: list[str]
    notes: list[str]


class Crew:
    """Threads that evaluate scans, for any number of bags.

    Parameters
    ----------
    jobs : int
        Scans at a time; 1: everything in the caller's thread.
    step : callable
        Called after each scan.
    """

    def __init__(self, jobs: int, step: Callable[[], object] = lambda: None) -> None:
        self.jobs = jobs
        self.step = step
        self.stopped = threading.Event()
        self._pool = ThreadPoolExecutor(jobs, "sl-scan") if jobs > 1 else None

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, *_: object) -> None:
        self.stopped.set()
        if self._pool:
            self._pool.shutdown(cancel_futures=True)

    def submit(self, work: Callable[[], Report]) -> Future[Report]:
        """Have a scan evaluated."""
        if self._pool:
            return self._pool.submit(work)
        done: Future[Report] = Future()
        done.set_result(work())
        return done


def evaluate_bag(path: Path, output: Path, choices: Choices, crew: Crew) -> Result:
    """Evaluate all scans of a recording and write their folders.

    Parameters
    ----------
    path : Path
        The recording.
    output : Path
        Folder for ``scan_NNNN`` folders, ``summary.json`` and ``index.html``.
    choices : Choices
        Of the user.
    crew : Crew
        Does the work.

    Raises
    ------
    BagError
        When the recording cannot be read or holds no scan.
    CalibrationError
        When there is no usable calibration.
    """
    with open_bag(path, choices.namespace) as bag:
        clear_results(output)
        if not count_scans(bag):
            raise BagError(
                f"{path} has no triggers on {bag.namespace}/{TRIGGER.name}{_lost(bag)}; its topics "
                f"are {', '.join(topic_names(bag)) or 'none'}"
            )
        reports = _BagRun(bag, output, choices, crew).run()
        write_summary(output, path.name, reports, bag.lost, bag.notes)
        if not reports:
            raise BagError(f"{path} holds no scan{_lost(bag)}; expected triggers and images")
        return Result(reports, bag.lost, bag.notes)


def count_scans(bag: Bag) -> int:
    """Scans that were begun."""
    return len({m.message.scan_id for m in bag.messages(TRIGGER, quick=True)})


def _lost(bag: Bag) -> str:
    return f" ({'; '.join(bag.lost)})" if bag.lost else ""


class _BagRun:
    """One bag being evaluated."""

    def __init__(self, bag: Bag, output: Path, choices: Choices, crew: Crew) -> None:
        self._bag, self._output, self._choices, self._crew = bag, output, choices, crew
        self._recorded = read_settings(bag)
        self._notes(self._recorded.notes)
        settings, matching = parse_choices(
            choices.assignments, self._recorded.of(""), self._recorded.matching
        )
        self._notes(self._recorded.differences(settings, matching))
        self._matcher = StackMatcher(matching)
        self._calibrations = Calibrations(bag, choices.calibration)
        self._live = LiveResults(bag)
        self._workshops = Workshops()
        self._names: list[int] = []

    def run(self) -> list[Report]:
        """Read; at most one scan more than there are threads is under way."""
        reports: list[Report] = []
        waiting: deque[tuple[FrameDecision, Future[Report]]] = deque()
        for decision in self._verdicts():
            if len(waiting) > self._crew.jobs:
                reports.append(self._collect(*waiting.popleft()))
            waiting.append((decision, self._begin(decision)))
        reports += [self._collect(*item) for item in waiting]
        return reports

    def _verdicts(self) -> Iterator[FrameDecision]:
        for decision in decisions(self._bag, self._matcher):
            if self._crew.stopped.is_set():
                return
            if decision.status in VERDICTS:
                yield decision

    def _begin(self, decision: FrameDecision) -> Future[Report]:
        first = not self._names
        folder = self._output / self._folder_name(decision.scan_id)
        return self._crew.submit(lambda: self._evaluate(decision, folder, first))

    def _collect(self, decision: FrameDecision, future: Future[Report]) -> Report:
        report = future.result()
        if decision.stack is not None:
            self._matcher.recycle(decision.stack)
        self._notes(report.get("notes", ()))
        self._crew.step()
        return report

    def _notes(self, lines: Iterable[str]) -> None:
        self._bag.notes += [line for line in lines if line not in self._bag.notes]

    def _folder_name(self, scan_id: int) -> str:
        """Name by the scan's number; a number that came before gets a suffix."""
        times = self._names.count(scan_id)
        self._names.append(scan_id)
        return f"scan_{scan_id:04d}" + (f"_{times + 1}" if times else "")

    def _evaluate(self, decision: FrameDecision, folder: Path, first: bool) -> Report:
        """Report on one verdict; a scan that cannot be evaluated is reported, not raised."""
        report: Report = {
            "format": 1,
            "bag": self._bag.path.name,
            "scan_id": decision.scan_id,
            "folder": folder.name,
            "good": False,
            "complete": decision.stack is not None,
            "reasons": [decision.reason] if decision.reason else [],
            "sequence": "",
            "software": software_version(),
            "matching": self._matcher.settings.to_dict(),
        }
        cloud = None
        try:
            settings = self._settings_of(decision.scan_id)
            report |= {"settings": settings.to_dict(), "settings_hash": settings.hash()}
            if decision.stack is not None:
                cloud = self._measure(report, decision.stack, settings)
        except CalibrationError:
            raise
        except SlError as exc:
            report["reasons"].append(str(exc))
        pictures = self._choices.pictures
        wanted = pictures == "all" or (pictures == "first" and first)
        images = decision.stack.images if decision.stack else None
        drawn = write_scan(folder, report, cloud, wanted, images)
        write_report(folder, report, drawn if pictures != "none" else None)
        return report

    def _settings_of(self, scan_id: int) -> Settings:
        """Settings of a scan: its live cloud's where the recording has them, with the changes."""
        recorded = self._recorded.of(self._live.settings_hash(scan_id))
        return parse_choices(self._choices.assignments, recorded)[0]

    def _measure(self, report: Report, stack: Stack, settings: Settings) -> Cloud:
        """Reconstruct a stack and put what was found into the report."""
        in_force = self._calibrations.of(stack)
        report.update(_origin(stack, in_force))
        report["saturation_dn"] = saturation_of(stack.images, settings)
        notes = in_force.mismatch, _guessed(stack, settings, report["saturation_dn"])
        report["notes"] = [note for note in notes if note]
        workshop = self._workshops.of(in_force, settings)
        product = workshop(stack.images, stack.sequence, report["saturation_dn"])
        good, reasons = verdict(product.cloud)
        report.update(ScanSummary.of(product, stack).to_dict(), good=good, reasons=reasons)
        report["live"] = self._live.compare(report)
        return product.cloud


class Workshops:
    """A workshop for each calibration and settings, so that scans of two do not disturb each other.

    The workshops that were used last are kept.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._made: OrderedDict[tuple[str, str], Workshop] = OrderedDict()

    def of(self, in_force: InForce, settings: Settings) -> Workshop:
        """Workshop with this calibration in force, and these settings.

        Parameters
        ----------
        in_force : InForce
            The calibration.
        settings : Settings
            Of the reconstruction.
        """
        with self._lock:
            key = in_force.calibration.hash, settings.hash()
            if key not in self._made:
                self._made[key] = Workshop(settings)
                self._made[key].calibrate(in_force.calibration)
            self._made.move_to_end(key)
            while len(self._made) > MAX_WORKSHOPS:
                self._made.popitem(last=False)
            return self._made[key]


def _origin(stack: Stack, in_force: InForce) -> Report:
    count, height, width = stack.images.shape
    return {
        "sequence": stack.sequence.name,
        "dmd_size": stack.sequence.dmd_size,
        "images": f"{count} of {width} x {height}, {stack.encoding}",
        "stamp_ns": stack.stamps_ns[0],
        "exposure_s": stack.exposure_s,
        "calibration_hash": in_force.calibration.hash,
        "calibration_source": in_force.source,
    }


def _guessed(stack: Stack, settings: Settings, saturation_dn: int) -> str:
    """Say where saturation begins when only the values show it; empty when it is known."""
    if settings.saturation_dn or stack.encoding == "mono8":
        return ""
    return (
        "nothing says how many of the 16 bits the camera used; as the values show, pixels count "
        f"as saturated from {saturation_dn} DN on (--set saturation_dn=N says otherwise)"
    )


def is_good(reports: Sequence[Mapping[str, Any]]) -> bool:
    """Whether every scan is good and none contradicts its live result."""
    return all(r["good"] and r.get("live", {}).get("agrees") is not False for r in reports)
