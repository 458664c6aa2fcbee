"""Settings that a recording holds: they are used, and what is chosen otherwise is said aloud."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from sl_bringup.bag.bag_writer import BagWriter, new_bag
from sl_bringup.bag.bags import make_message
from sl_camera.sync.match_events import MatcherSettings
from sl_common.errors import ConfigError
from sl_common.topics import CAMERA_SETTINGS, MATCHING, REPORT, SETTINGS, Topic
from sl_reconstruct.decode import stack_statistics
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.model.calibration_file import Calibration
from support.scenes.rigs import tiny_rig
from support.scenes.tiny_bags import START_NS, evaluate, live_report, summary, write_scans
from support.scenes.tiny_scans import render, tiny_sequence


@pytest.fixture(scope="module")
def stacks() -> list[np.ndarray]:
    return [render(tiny_sequence("precise"), seed) for seed in (1, 2)]


def latch(bag: BagWriter, topic: Topic, values: dict, stamp_ns: int = START_NS) -> None:
    bag.write(topic, stamp_ns, make_message(topic.msgtype, data=json.dumps(values)))


def record(
    path: Path, stacks: Sequence[np.ndarray], *latched: tuple[Topic, dict], reports: tuple = ()
) -> Path:
    with new_bag(path) as bag:
        bag.calibration(Calibration(tiny_rig()), "true", START_NS)
        for topic, values in latched:
            latch(bag, topic, values)
        write_scans(bag, stacks)
        for report in reports:
            bag.write(REPORT, START_NS + 30_000_000_000, report)
    return path


def reports(folder: Path) -> list[dict]:
    return [json.loads(p.read_text()) for p in sorted(folder.glob("scan_*/report.json"))]


def test_settings_of_the_matching_survive_a_file() -> None:
    settings = MatcherSettings(tolerance_fraction=0.1, require_pose=False)
    assert MatcherSettings.from_dict(json.loads(json.dumps(settings.to_dict()))) == settings
    for bad in ({"tolerance": 1}, {"settle_s": "soon"}, {"tolerance_fraction": 0.7}):
        with pytest.raises(ConfigError, match=r"expected|wrong type"):
            MatcherSettings.from_dict(bad)


def test_the_live_matching_holds_offline_unless_changed(
    tmp_path: Path, stacks: list[np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    """Stacks of 21 patterns where at most 10 were allowed: refused live, hence refused here."""
    strict = MatcherSettings(max_patterns=10)
    bag = record(tmp_path / "bag", stacks[:1], (MATCHING, strict.to_dict()))
    out = "--output", tmp_path / "1", "--pictures", "none"
    assert evaluate(bag, *out) == 1
    assert "is used, the recording has" not in capsys.readouterr().err
    (report,) = reports(tmp_path / "1")
    assert report["matching"] == strict.to_dict() and not report["complete"]
    out = "--output", tmp_path / "2", "--pictures", "none"
    assert evaluate(bag, *out, "--set", "max_patterns=64") == 0
    assert "max_patterns=64 is used, the recording has 10" in capsys.readouterr().err


def test_a_changed_reconstruction_is_said_aloud(
    tmp_path: Path, stacks: list[np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    bag = record(tmp_path / "bag", stacks[:1], (SETTINGS, Settings(min_light=0.2).to_dict()))
    out = "--output", tmp_path / "1", "--pictures", "none"
    assert evaluate(bag, *out, "--set", "estimator=cubic", "--set", "min_light=0.2") == 0
    told = capsys.readouterr().err
    assert "estimator=cubic is used, the recording has matched" in told
    assert "min_light=0.2 is used" not in told


def test_each_scan_gets_the_settings_of_its_live_cloud(
    tmp_path: Path, stacks: list[np.ndarray]
) -> None:
    """The graph was started anew, with other settings, while the recorder ran on."""
    first, second = Settings(estimator="cubic"), Settings(min_light=0.2)
    bag = record(
        tmp_path / "bag", stacks, (SETTINGS, first.to_dict()), (SETTINGS, second.to_dict()),
        reports=(live_report(1, "a", first.hash(), ""), live_report(2, "b", second.hash(), "")),
    )  # fmt: skip
    evaluate(bag, "--output", tmp_path / "out", "--pictures", "none")
    scans = summary(tmp_path / "out")["scans"]
    assert [s["settings_hash"] for s in scans] == [first.hash(), second.hash()]


def test_a_change_that_fits_only_some_of_the_settings_spoils_only_their_scans(
    tmp_path: Path, stacks: list[np.ndarray]
) -> None:
    """min_slope=1.2 fits the settings in force at the end, not those of the first scan."""
    first, second = Settings(max_slope=1.1), Settings(max_slope=1.7)
    bag = record(
        tmp_path / "bag", stacks[:2], (SETTINGS, first.to_dict()), (SETTINGS, second.to_dict()),
        reports=(live_report(1, "a", first.hash(), ""), live_report(2, "b", second.hash(), "")),
    )  # fmt: skip
    out = "--output", tmp_path / "out", "--pictures", "none"
    assert evaluate(bag, *out, "--set", "min_slope=1.2") == 1
    one, two = reports(tmp_path / "out")
    assert not one["good"] and "min_slope=1.2, max_slope=1.1" in one["reasons"][-1]
    assert two["settings"]["min_slope"] == 1.2 and "points" in two


def wide(stack: np.ndarray) -> np.ndarray:
    """8 bits as 12 in 16."""
    return stack.astype(np.uint16) * 16 + 15


@pytest.mark.parametrize("told", [True, False])
def test_twelve_bits_need_no_setting(
    tmp_path: Path, stacks: list[np.ndarray], capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch, told: bool,
) -> None:  # fmt: skip
    """The camera's settings say where its pixels end; without them the values do, aloud."""
    looked: list[int] = []
    look = stack_statistics.full_scale_dn
    monkeypatch.setattr(stack_statistics, "full_scale_dn", lambda s: looked.append(1) or look(s))
    camera = ((CAMERA_SETTINGS, {"pixel_format": "mono12", "full_scale_dn": 4095}),)
    bag = record(tmp_path / "bag", [wide(stacks[0])], *(camera if told else ()))
    assert evaluate(bag, "--output", tmp_path / "out", "--pictures", "none") == 0
    (report,) = reports(tmp_path / "out")
    assert report["saturation_dn"] == 4095
    assert len(looked) == (not told)  # a pass over all pixels: once is enough
    assert report["settings"]["saturation_dn"] == (4095 if told else None)
    assert ("16 bits" in capsys.readouterr().err) is not told


def test_nonsense_in_the_bag_is_told_and_the_defaults_hold(
    tmp_path: Path, stacks: list[np.ndarray]
) -> None:
    bag = record(
        tmp_path / "bag", stacks[:1], (MATCHING, {"tolerance_fraction": 7}),
        (CAMERA_SETTINGS, {"full_scale_dn": "many"}),
    )  # fmt: skip
    assert evaluate(bag, "--output", tmp_path / "out", "--pictures", "none") == 0
    notes = " ".join(summary(tmp_path / "out")["notes"])
    assert "tolerance_fraction=7" in notes and "full_scale_dn='many'" in notes
