"""``slrig evaluate`` from end to end: images, recording, cloud, report; and all that spoils it."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from plyfile import PlyData

from sl_bringup.bag.bag_writer import new_bag
from sl_bringup.cli.main import main
from sl_bringup.evaluation.settings_overrides import parse_choices
from sl_common.errors import ConfigError
from sl_projector.sequence.pattern_sequence import PatternSequence
from sl_reconstruct.model.calibration_file import rig_hash, save_calibration
from sl_reconstruct.model.rig import Rig
from support.paths import DATA, EXAMPLES
from support.scenes.rigs import DMD_SIZE, tiny_rig
from support.scenes.tiny_bags import START_NS, record
from support.scenes.tiny_scans import HEIGHT_M, SLOPE, render, tiny_sequence, write_images

BOARD = DATA / "procam_board"
EXAMPLE = EXAMPLES / "procam_board.yaml"
needs_board = pytest.mark.skipif(not BOARD.is_dir(), reason=f"no data in {BOARD}")


@pytest.fixture(scope="module")
def sequence() -> PatternSequence:
    return tiny_sequence("precise")


@pytest.fixture(scope="module")
def frames(sequence: PatternSequence) -> np.ndarray:
    return render(sequence)


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cal") / "cal.yaml"
    save_calibration(path, tiny_rig())
    return path


def evaluate(bag: Path, output: Path, *arguments: str) -> tuple[int, list[dict]]:
    """Exit status and the reports of all scans."""
    status = main(["evaluate", str(bag), "--output", str(output), *arguments])
    return status, [json.loads(p.read_text()) for p in sorted(output.glob("scan_*/report.json"))]


def test_images_of_a_plane_become_that_plane(
    tmp_path: Path, frames: np.ndarray, calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The plane z = HEIGHT + SLOPE x, rendered by the tests' own renderer."""
    write_images(tmp_path / "shots", frames)
    size = "x".join(map(str, DMD_SIZE))
    arguments = ["--sequence", "precise", "--dmd-size", size, "--output", str(tmp_path / "bag")]
    assert main(["import", str(tmp_path / "shots"), *arguments]) == 0
    status, (report,) = evaluate(
        tmp_path / "bag", tmp_path / "out", "--calibration", str(calibration)
    )
    assert status == 0
    assert "good" in capsys.readouterr().out
    ply = PlyData.read(str(tmp_path / "out" / "scan_0001" / "cloud.ply"))["vertex"]
    assert len(ply) == report["points"] > 14_000
    z = ply["z"].astype(float)
    error = z - (HEIGHT_M + SLOPE * ply["x"].astype(float))
    # Stated uncertainty is the tolerance: the mean of n points, and single points by their sigma.
    z_score = error / ply["sigma"]
    assert abs(z_score.mean()) < 0.2
    assert 0.8 < z_score.std() < 1.2
    assert np.abs(z_score).max() < 6
    tilt = np.degrees(np.arctan(SLOPE))
    # The slope over 3 mm with 15000 points of 0.5 um is known to 0.5e-6 / (3e-3 / sqrt(12) *
    # sqrt(15000)) = 5e-6 rad = 3e-4 deg; five times that, since neighbours share pixels.
    assert report["plane"]["tilt_deg"] == pytest.approx(tilt, abs=1.5e-3)
    assert report["plane"]["rms_m"] == pytest.approx(error.std(), rel=0.1)


def test_report_and_files_agree(
    tmp_path: Path, sequence: PatternSequence, frames: np.ndarray, calibration: Path
) -> None:
    bag = record(tmp_path / "bag", sequence, frames, rig=tiny_rig())
    status, (report,) = evaluate(bag, tmp_path / "out")
    assert status == 0
    assert report["calibration_hash"] == rig_hash(tiny_rig())
    assert "recorded from true" in report["calibration_source"]
    assert report["points"] + sum(report["refused"].values()) == report["lit_positions"]
    folder = tmp_path / "out" / "scan_0001"
    height = cv2.imread(str(folder / "height.tiff"), cv2.IMREAD_UNCHANGED)
    grid = report["height_map"]
    assert height.shape == (grid["rows"], grid["columns"])
    x = grid["x0_m"] + np.arange(grid["columns"]) * grid["step_m"]
    error = height - (HEIGHT_M + SLOPE * x)
    # single points scatter by 0.5 um
    assert abs(np.nanmean(error)) < 0.1e-6
    assert np.nanstd(error) < 0.7e-6
    grey = cv2.imread(str(folder / "height.png"), cv2.IMREAD_UNCHANGED).astype(float)
    low, high = grid["png_value_1_m"], grid["png_value_65535_m"]
    decoded = low + (grey - 1) * (high - low) / 65534
    assert np.nanmax(np.abs(decoded - height)[grey > 0]) < (high - low) / 65534
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["scans"][0]["cloud_hash"] == report["cloud_hash"]
    assert report["cloud_hash"].encode() in (folder / "cloud.ply").read_bytes()[:600]


class Page(HTMLParser):
    """What a page refers to and says."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [v or "" for k, v in attrs if k in ("src", "href")]

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_holds_everything_in_itself(
    tmp_path: Path, sequence: PatternSequence, frames: np.ndarray
) -> None:
    bag = record(tmp_path / "<b>&bag", sequence, frames, rig=tiny_rig())
    evaluate(bag, tmp_path / "out")
    page = Page((tmp_path / "out" / "scan_0001" / "report.html").read_text())
    assert len(page.sources) == 6
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert "Scan 1 of <b>&bag" in page.text
    assert "Good" in page.text
    pictures = sorted(p.name for p in (tmp_path / "out" / "scan_0001").glob("picture_*.png"))
    assert len(pictures) == 6


def test_the_same_bag_gives_the_same_bits(
    tmp_path: Path, sequence: PatternSequence, frames: np.ndarray, calibration: Path
) -> None:
    bag = record(tmp_path / "bag", sequence, frames, scans=3, rig=tiny_rig())
    _, first = evaluate(bag, tmp_path / "1", "--no-pictures")
    _, second = evaluate(bag, tmp_path / "2", "--calibration", str(calibration), "--no-pictures")
    hashes = {r["cloud_hash"] for r in first + second}
    assert len(first) == len(second) == 3
    assert len(hashes) == 1
    assert [r["scan_id"] for r in first] == [1, 2, 3]
    assert not list(tmp_path.glob("*/scan_*/*.html"))


def test_a_dropped_image_refuses_its_scan_alone(
    tmp_path: Path,
    sequence: PatternSequence,
    frames: np.ndarray,
    calibration: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bag = record(tmp_path / "bag", sequence, frames, scans=3, without=(2, 5), rig=tiny_rig())
    status, reports = evaluate(bag, tmp_path / "out", "--no-pictures")
    assert status == 1
    assert [r["good"] for r in reports] == [True, False, True]
    assert "6 of 22" in reports[1]["reasons"][0]  # the sixth image, counted as people do
    assert "scan 2: NOT GOOD" in capsys.readouterr().out
    assert [p.name for p in (tmp_path / "out" / "scan_0002").iterdir()] == ["report.json"]


def test_images_that_make_no_cloud_are_shown(
    tmp_path: Path, sequence: PatternSequence, frames: np.ndarray
) -> None:
    """Two images exchanged: no cloud, but a page with what the camera saw of the patterns."""
    exchanged = frames[[0, 2, 1, *range(3, len(frames))]]
    bag = record(tmp_path / "bag", sequence, exchanged, rig=tiny_rig())
    status, (report,) = evaluate(bag, tmp_path / "out")
    assert (status, report["good"], report["complete"]) == (1, False, True)
    folder = tmp_path / "out" / "scan_0001"
    assert [p.name for p in folder.glob("*.png")] == ["picture_contrast.png"]
    page = Page((folder / "report.html").read_text())
    assert len(page.sources) == 1 and "Pattern contrast" in page.text
    assert not (folder / "cloud.ply").exists()


def test_a_stage_that_moved_refuses_the_scan(
    tmp_path: Path, sequence: PatternSequence, frames: np.ndarray
) -> None:
    bag = record(tmp_path / "bag", sequence, frames, rig=tiny_rig(), pose_m=(0.0, 0.0, 50e-6))
    status, (report,) = evaluate(bag, tmp_path / "out", "--no-pictures")
    assert (status, report["good"], report["complete"]) == (1, False, False)
    assert "moved" in report["reasons"][0]


def test_old_files_do_not_survive_a_refused_scan(
    tmp_path: Path, sequence: PatternSequence, frames: np.ndarray
) -> None:
    evaluate(record(tmp_path / "a", sequence, frames, rig=tiny_rig()), tmp_path / "out")
    assert (tmp_path / "out" / "scan_0001" / "cloud.ply").is_file()
    bag = record(tmp_path / "b", sequence, frames, without=(1, 0), rig=tiny_rig())
    evaluate(bag, tmp_path / "out", "--no-pictures")
    assert [p.name for p in (tmp_path / "out" / "scan_0001").iterdir()] == ["report.json"]


def test_old_scans_do_not_pass_for_new_ones(
    tmp_path: Path, sequence: PatternSequence, frames: np.ndarray
) -> None:
    out = tmp_path / "out"
    evaluate(record(tmp_path / "a", sequence, frames, scans=2, rig=tiny_rig()), out)
    (out / "scan_0002" / "mine.txt").write_text("not slrig's")
    evaluate(record(tmp_path / "b", sequence, frames, rig=tiny_rig()), out, "--no-pictures")
    assert [p.name for p in (out / "scan_0002").iterdir()] == ["mine.txt"]
    assert len(json.loads((out / "summary.json").read_text())["scans"]) == 1


def test_an_unwritable_place_is_one_line(
    tmp_path: Path,
    sequence: PatternSequence,
    frames: np.ndarray,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bag = record(tmp_path / "bag", sequence, frames, rig=tiny_rig())
    (tmp_path / "file").write_text("")
    assert evaluate(bag, tmp_path / "file" / "out")[0] == 1
    error = capsys.readouterr().err
    assert error.startswith("slrig: error: ")
    assert error.count("\n") == 1


def test_no_calibration_is_refused(
    tmp_path: Path,
    sequence: PatternSequence,
    frames: np.ndarray,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bag = record(tmp_path / "bag", sequence, frames)
    assert evaluate(bag, tmp_path / "out") == (1, [])
    error = capsys.readouterr().err
    assert "no calibration" in error
    assert "--calibration FILE" in error


def test_half_a_calibration_file_is_refused(
    tmp_path: Path,
    sequence: PatternSequence,
    frames: np.ndarray,
    calibration: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bag = record(tmp_path / "bag", sequence, frames, rig=tiny_rig())
    text = calibration.read_text()
    (tmp_path / "half.yaml").write_text(text[: len(text) // 2])
    arguments = ("--calibration", str(tmp_path / "half.yaml"))
    assert evaluate(bag, tmp_path / "out", *arguments) == (1, [])
    assert "half.yaml" in capsys.readouterr().err


def test_a_calibration_of_another_rig_is_refused(
    tmp_path: Path, sequence: PatternSequence, frames: np.ndarray
) -> None:
    rig = tiny_rig()
    other = Rig(replace(rig.camera, image_size=(640, 480)), rig.projector)
    bag = record(tmp_path / "bag", sequence, frames, rig=other)
    status, (report,) = evaluate(bag, tmp_path / "out", "--no-pictures")
    assert (status, report["good"], report["complete"]) == (1, False, True)
    assert "640x480" in report["reasons"][0]


def test_a_bag_without_scans_says_what_it_has(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with new_bag(tmp_path / "bag") as bag:
        bag.pose((0.0, 0.0, 0.0), START_NS)
    (tmp_path / "out").mkdir()
    assert evaluate(tmp_path / "bag", tmp_path / "out") == (1, [])
    told = capsys.readouterr()
    assert "no triggers on /sl/projector/trigger" in told.err
    assert "results in" not in told.out  # the folder is not of this evaluation


def test_a_cut_recording_is_not_called_good(
    tmp_path: Path,
    sequence: PatternSequence,
    frames: np.ndarray,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """rosbags closes a chunk after 1 MiB: the first scan of three is in whole chunks."""
    bag = record(tmp_path / "bag", sequence, frames, scans=4, rig=tiny_rig())
    file = tmp_path / "bag" / "bag.mcap"
    file.write_bytes(file.read_bytes()[: int(0.8 * file.stat().st_size)])
    status, reports = evaluate(bag, tmp_path / "out", "--no-pictures")
    assert status == 1
    assert reports[0]["good"]
    assert "lost: bag.mcap: the end is missing" in capsys.readouterr().err


def test_settings_are_used_and_told(
    tmp_path: Path, sequence: PatternSequence, frames: np.ndarray
) -> None:
    bag = record(tmp_path / "bag", sequence, frames, rig=tiny_rig())
    _, (plain,) = evaluate(bag, tmp_path / "1", "--no-pictures")
    _, (cubic,) = evaluate(bag, tmp_path / "2", "--no-pictures", "--set", "estimator=cubic")
    assert cubic["settings"]["estimator"] == "cubic"
    assert cubic["settings_hash"] != plain["settings_hash"]
    assert cubic["cloud_hash"] != plain["cloud_hash"]


def test_assignments() -> None:
    settings, matching = parse_choices(
        ["estimator=cubic", "min_contrast_dn=1e1", "edge_blur_px=null", "require_pose=false"]
    )
    assert (settings.estimator, settings.min_contrast_dn, settings.edge_blur_px) == (
        "cubic", 10.0, None,
    )  # fmt: skip
    assert matching.require_pose is False
    for wrong in ("estimator", "speed=9", "estimator=best", "min_light=high", "timeout_s=-1"):
        with pytest.raises(ConfigError, match=re.escape(wrong.split("=")[0])):
            parse_choices([wrong])


@needs_board
def test_board_images_become_three_complete_scans(tmp_path: Path) -> None:
    """Somebody else's images, sequence and lens model, without a line written for them."""
    arguments = ["import", str(BOARD), "--sequence", str(EXAMPLE)]
    assert main([*arguments, "--output", str(tmp_path / "bag")]) == 0
    calibration = str(BOARD / "calibration.json")
    _, reports = evaluate(
        tmp_path / "bag", tmp_path / "out", "--calibration", calibration, "--no-pictures"
    )
    assert [r["scan_id"] for r in reports] == [1, 2, 3]
    for report in reports:
        assert report["complete"]
        assert report["images"] == "42 of 1280 x 1024, mono8"
        assert report["points"] > 200_000
        # The board stands at 3.2 to 3.6 m (shared/data/README); the camera's frame is the world.
        assert 3.0 < report["plane"]["point_m"][2] < 4.0
