"""A scan's summary: the live message, the live report and the offline report say the same."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from sl_bringup.bag.bags import make_message
from sl_bringup.cli.main import main
from sl_bringup.results.live_scan import live_report
from sl_common.json_file import plain_value
from sl_projector.sequence.stack import Stack
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.messages import EDGE_FIGURES, report_from_msg, report_to_msg
from sl_reconstruct.model.calibration_file import Calibration
from sl_reconstruct.reconstruction.reconstructor_cache import Workshop
from sl_reconstruct.scan.scan_summary import ScanSummary
from support.scenes.rigs import tiny_rig
from support.scenes.tiny_bags import record
from support.scenes.tiny_scans import render, tiny_sequence


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    return render(tiny_sequence())


@pytest.fixture(scope="module")
def live(frames: np.ndarray) -> ScanSummary:
    workshop = Workshop(Settings())
    workshop.calibrate(Calibration(tiny_rig()))
    stack = Stack(frames, tiny_sequence(), 1)
    times = {"acquisition_s": 1.5, "processing_s": 0.25}
    tries = {"attempts": 2, "attempt_messages": ("image 3 is lost",)}
    return ScanSummary.of(workshop(frames, stack.sequence), stack, **times, **tries)


def test_a_message_carries_all_but_the_figures_of_rays(live: ScanSummary) -> None:
    back = report_from_msg(report_to_msg(live, make_message))
    assert back.figures == {n: live.figures[n] for n in (*EDGE_FIGURES, "bound_ratio")}
    assert replace(back, figures=live.figures) == live


def test_a_failed_scan_is_zeros_in_its_message() -> None:
    failed = ScanSummary(7, attempts=1, attempt_messages=())
    back = report_from_msg(report_to_msg(failed, make_message))
    zeros = {"acquisition_s": 0.0, "processing_s": 0.0, "figures": dict.fromkeys(EDGE_FIGURES, 0.0)}
    assert back == replace(failed, **zeros)
    report = live_report(back, False, "the camera is lost")
    assert (report["good"], report["reasons"]) == (False, ["the camera is lost"])
    assert report["present_fraction"] == 0.0


def test_live_and_offline_reports_say_the_same(
    tmp_path: Path, live: ScanSummary, frames: np.ndarray
) -> None:
    bag = record(tmp_path / "bag", tiny_sequence(), frames, rig=tiny_rig())
    assert main(["evaluate", str(bag), "--output", str(tmp_path / "out"), "--no-pictures"]) == 0
    offline = json.loads((tmp_path / "out" / "scan_0001" / "report.json").read_text())
    known = live_report(report_from_msg(report_to_msg(live, make_message)), True, "good")
    known = plain_value(known)
    names = {item.name for item in fields(ScanSummary)} | {"present_fraction", "good", "reasons"}
    only_live = {"attempts", "attempt_messages", "acquisition_s", "processing_s"}
    assert not only_live & offline.keys()
    for name in names - only_live - {"figures"}:
        assert offline[name] == known[name], name
    assert known["figures"].items() <= offline["figures"].items()
    assert {"median_gap_m", "median_gap_px"} <= offline["figures"].keys()
