"""Several bags, several threads, several settings; and the comparison with the live clouds."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sl_bringup.bag.bag_writer import new_bag
from sl_bringup.evaluation.sweep import variants
from sl_common.errors import ConfigError
from sl_common.topics import REPORT
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.model.calibration_file import Calibration, save_calibration
from sl_reconstruct.model.rig import Rig
from support.scenes.rigs import tiny_rig
from support.scenes.tiny_bags import (
    START_NS,
    evaluate,
    live_report,
    record_stacks,
    summary,
    write_scans,
)
from support.scenes.tiny_scans import render, tiny_sequence

SEEDS = (1, 2, 3, 4)


@pytest.fixture(scope="module")
def stacks() -> list[np.ndarray]:
    """Four different scans."""
    return [render(tiny_sequence("precise"), seed) for seed in SEEDS]


def test_threads_change_nothing(tmp_path: Path, stacks: list[np.ndarray]) -> None:
    bag = record_stacks(tmp_path / "bag", stacks)
    for jobs in (1, 3):
        out = tmp_path / f"{jobs}"
        assert evaluate(bag, "--output", out, "--pictures", "none", "--jobs", jobs) == 0
    assert summary(tmp_path / "1") == summary(tmp_path / "3")
    scans = summary(tmp_path / "1")["scans"]
    assert [s["scan_id"] for s in scans] == [1, 2, 3, 4]
    assert len({s["cloud_hash"] for s in scans}) == 4
    for number in (1, 4):
        clouds = [(tmp_path / jobs / f"scan_000{number}" / "cloud.ply").read_bytes()
                  for jobs in ("1", "3")]  # fmt: skip
        assert clouds[0] == clouds[1]


def test_several_bags_and_one_that_is_none(
    tmp_path: Path, stacks: list[np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = (
        record_stacks(tmp_path / "a", stacks[:2]),
        record_stacks(tmp_path / "b", stacks[2:]),
    )
    bad = tmp_path / "c.mcap"
    bad.write_bytes(b"no bag")
    out = tmp_path / "out"
    assert evaluate(first, bad, second, "--output", out, "--pictures", "none") == 1
    assert "c.mcap" in capsys.readouterr().err
    single = tmp_path / "single"
    for bag, folder in ((first, out / "a"), (second, out / "b")):
        assert evaluate(bag, "--output", single, "--pictures", "none") == 0
        assert summary(folder)["scans"] == summary(single)["scans"]


def test_a_bag_named_twice_is_refused(tmp_path: Path, stacks: list[np.ndarray]) -> None:
    bag = record_stacks(tmp_path / "a", stacks[:1])
    assert evaluate(bag, bag, "--output", tmp_path / "out") == 1
    assert not (tmp_path / "out").exists()


def test_pictures_of_the_first_scan_only(tmp_path: Path, stacks: list[np.ndarray]) -> None:
    bag = record_stacks(tmp_path / "bag", stacks[:2])
    assert evaluate(bag, "--output", tmp_path / "out", "--pictures", "first") == 0
    pictures = sorted(p.parent.name for p in tmp_path.glob("out/scan_*/picture_*.png"))
    assert pictures == ["scan_0001"] * 6
    assert len(list(tmp_path.glob("out/scan_*/report.html"))) == 2


def test_a_sweep_compares_settings(
    tmp_path: Path, stacks: list[np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    bag, out = record_stacks(tmp_path / "bag", stacks[:2]), tmp_path / "out"
    assert evaluate(bag, "--output", out, "--sweep", "estimator=matched,cubic") == 0
    table = json.loads((out / "sweep.json").read_text())["variants"]
    assert [row["settings"] for row in table] == [["estimator=matched"], ["estimator=cubic"]]
    assert all(row["scans"] == row["good"] == 2 for row in table)
    for row, estimator in zip(table, ("matched", "cubic"), strict=True):
        alone = tmp_path / estimator
        arguments = ("--set", f"estimator={estimator}", "--pictures", "none")
        assert evaluate(bag, "--output", alone, *arguments) == 0
        assert row["cloud_hashes"] == [s["cloud_hash"] for s in summary(alone)["scans"]]
        assert row["settings_hash"] == Settings(estimator=estimator).hash()
    # The paper's fit is noisier than the matched filter on the same images.
    assert table[1]["plane_rms_m"] > table[0]["plane_rms_m"]
    # Two estimates from the same images err together: they differ by less than each errs.
    assert 0 == table[0]["z_off_first_m"] < table[1]["z_off_first_m"] < table[1]["plane_rms_m"]
    assert "estimator=cubic" in capsys.readouterr().out
    page = (out / "sweep.html").read_text()
    assert page.count("data:image/png") == 4
    assert json.loads((out / "sweep.json").read_text())["common"] == []


def test_sweeps_multiply() -> None:
    found = [v.assignments for v in variants(["a=1,2", "b=x,y"])]
    assert found == [("a=1", "b=x"), ("a=1", "b=y"), ("a=2", "b=x"), ("a=2", "b=y")]
    assert [v.assignments for v in variants([])] == [()]


TOO_MANY = "a=" + ",".join(map(str, range(70)))


@pytest.mark.parametrize(
    "sweeps", [["a"], ["=1"], ["a=1,,2"], ["a=1,1"], ["a=1", "a=2"], [TOO_MANY]]
)
def test_sweeps_that_make_no_sense(sweeps: list[str]) -> None:
    with pytest.raises(ConfigError, match="sweep"):
        list(variants(sweeps))


def test_a_sweep_of_an_unknown_setting_begins_nothing(
    tmp_path: Path, stacks: list[np.ndarray]
) -> None:
    bag = record_stacks(tmp_path / "bag", stacks[:1])
    assert evaluate(bag, "--output", tmp_path / "out", "--sweep", "estimator=matched,best") == 1
    assert not (tmp_path / "out").exists()


def test_live_hashes_prove_or_disprove(
    tmp_path: Path, stacks: list[np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    """A scan with the live hash, one with another, one made with other settings, one unknown."""
    plain = record_stacks(tmp_path / "plain", stacks)
    evaluate(plain, "--output", tmp_path / "0", "--pictures", "none")
    known = summary(tmp_path / "0")["scans"]
    assert summary(tmp_path / "0")["live"] == {"same": 0, "different": 0, "unknown": 4}
    with new_bag(tmp_path / "bag") as bag:
        bag.calibration(Calibration(tiny_rig()), "true", START_NS)
        write_scans(bag, stacks)
        settings, calibration = known[0]["settings_hash"], known[0]["calibration_hash"]
        for report in (
            live_report(1, known[0]["cloud_hash"], settings, calibration),
            live_report(2, known[0]["cloud_hash"], settings, calibration),
            live_report(3, known[0]["cloud_hash"], "other", calibration),
        ):
            bag.write(REPORT, START_NS + 30_000_000_000, report)
    assert evaluate(tmp_path / "bag", "--output", tmp_path / "1", "--pictures", "none") == 1
    scans = summary(tmp_path / "1")["scans"]
    assert [s["live"]["agrees"] for s in scans] == [True, False, None, None]
    assert "other settings" in scans[2]["live"]["told"]
    assert "1 DIFFER" in capsys.readouterr().out
    index = (tmp_path / "1" / "index.html").read_text()
    assert index.count(">Good<") == 3 and index.count("but the live cloud differs") == 1


def test_the_recorded_settings_hold_unless_changed(
    tmp_path: Path, stacks: list[np.ndarray]
) -> None:
    recorded = json.dumps({**Settings(estimator="cubic", min_light=0.2).to_dict()})
    bag = record_stacks(tmp_path / "bag", stacks[:1], settings=recorded)
    evaluate(bag, "--output", tmp_path / "1", "--pictures", "none")
    evaluate(bag, "--output", tmp_path / "2", "--pictures", "none", "--set", "estimator=matched")
    hashes = [summary(tmp_path / n)["scans"][0]["settings_hash"] for n in ("1", "2")]
    assert hashes == [
        Settings(estimator="cubic", min_light=0.2).hash(), Settings(min_light=0.2).hash()
    ]  # fmt: skip


def test_recorded_settings_of_another_version_are_told(
    tmp_path: Path, stacks: list[np.ndarray]
) -> None:
    bag = record_stacks(tmp_path / "bag", stacks[:1], settings='{"quantum_level": 3}')
    assert evaluate(bag, "--output", tmp_path / "out", "--pictures", "none") == 0
    found = summary(tmp_path / "out")
    assert found["scans"][0]["settings_hash"] == Settings().hash()
    assert any("quantum_level" in note for note in found["notes"])


def test_another_calibration_than_the_bags_is_said_aloud(
    tmp_path: Path, stacks: list[np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    rig = tiny_rig()
    projector = replace(rig.projector, translation_m=rig.projector.translation_m + 1e-6)
    moved = Rig(rig.camera, projector)
    bag = record_stacks(tmp_path / "bag", stacks[:1], rig=moved)
    save_calibration(tmp_path / "cal.yaml", rig)
    arguments = ("--output", tmp_path / "out", "--pictures", "none")
    evaluate(bag, *arguments, "--calibration", tmp_path / "cal.yaml")
    assert "another calibration" in capsys.readouterr().err
    evaluate(bag, *arguments)
    assert "another calibration" not in capsys.readouterr().err
