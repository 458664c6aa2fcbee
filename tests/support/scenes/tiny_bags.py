"""Recordings of the tiny plane, and their evaluation."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sl_bringup.bag.bag_writer import BagWriter, new_bag
from sl_bringup.bag.bags import make_message
from sl_bringup.cli.main import main
from sl_common.topics import SETTINGS
from sl_projector.sequence.pattern_sequence import PatternSequence
from sl_reconstruct.messages import report_to_msg
from sl_reconstruct.model.calibration_file import Calibration
from sl_reconstruct.model.rig import Rig
from sl_reconstruct.scan.scan_summary import ScanSummary
from support.scenes.rigs import tiny_rig
from support.scenes.tiny_scans import tiny_sequence

START_NS = 1_700_000_000_000_000_000
FRAME_NS = 20_000_000
ORIGIN = (0.0, 0.0, 0.0)


def write_scan(
    bag: BagWriter, sequence: PatternSequence, frames: np.ndarray, scan: int,
    without: int | None = None, pose_m: tuple[float, float, float] | None = None,
) -> None:  # fmt: skip
    """One scan; an image may be missing, the stage may be elsewhere after the first pattern."""
    start_ns = START_NS + scan * 2_000_000_000
    bag.pose(ORIGIN, start_ns - FRAME_NS)
    for i, frame in enumerate(frames):
        stamp_ns = start_ns + i * FRAME_NS
        bag.trigger(sequence, i, scan, stamp_ns, 0.01)
        if i != without:
            bag.image(frame, stamp_ns, stamp_ns + 12_000_000)
        if pose_m is not None:
            bag.pose(pose_m, stamp_ns + 13_000_000)
    bag.pose(pose_m or ORIGIN, start_ns + len(frames) * FRAME_NS)


def write_scans(bag: BagWriter, stacks: Sequence[np.ndarray]) -> None:
    for scan, frames in enumerate(stacks, start=1):
        write_scan(bag, tiny_sequence("precise"), frames, scan)


def record_stacks(
    path: Path, stacks: Sequence[np.ndarray], rig: Rig | None = None, settings: str = ""
) -> Path:
    """A bag of `precise` scans, with the calibration and the settings of the live graph."""
    with new_bag(path) as bag:
        bag.calibration(Calibration(rig or tiny_rig()), "true", START_NS)
        if settings:
            message = make_message(SETTINGS.msgtype, data=settings)
            bag.write(SETTINGS, START_NS, message)
        write_scans(bag, stacks)
    return path


def record(
    path: Path, sequence: PatternSequence, frames: np.ndarray, scans: int = 1,
    without: tuple[int, int] | None = None, rig: Rig | None = None,
    pose_m: tuple[float, float, float] = ORIGIN,
) -> Path:  # fmt: skip
    """A bag that has the same scan several times; ``without`` is the scan and image that lacks."""
    with new_bag(path) as bag:
        if rig is not None:
            bag.calibration(Calibration(rig), "true", START_NS)
        for scan in range(1, scans + 1):
            lost = without[1] if without and without[0] == scan else None
            write_scan(bag, sequence, frames, scan, lost, pose_m)
    return path


def evaluate(*arguments: str | Path) -> int:
    return main(["evaluate", *map(str, arguments)])


def summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def live_report(scan_id: int, cloud_hash: str, settings_hash: str, calibration_hash: str) -> object:
    hashes = {"cloud_hash": cloud_hash, "settings_hash": settings_hash}
    summary = ScanSummary(scan_id, "precise", calibration_hash=calibration_hash, **hashes)
    return report_to_msg(summary, make_message)
