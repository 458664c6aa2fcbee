"""A calibration from its request to its folder, on a rig without devices; and every refusal."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sl_bench.world.optics import Optics
from sl_bench.world.surfaces import make_surface
from sl_bench.world.world import World
from sl_bringup.results.calibration_lines import outcome_lines
from sl_bringup.results.paper_tables import table_1_lines
from sl_calibration.data.observations import load_observations
from sl_calibration.data.run_store import CALIBRATION, OBSERVATIONS, Store
from sl_calibration.data.session import CalibrationProgress, CalibrationRequest, Place, Session
from sl_calibration.data.view_extraction import observe, white_image
from sl_calibration.solve.acceptance import Limits
from sl_calibration.solve.ray_midpoints import triangulate
from sl_calibration.target.hole_detection import find_plate
from sl_calibration.target.plate import DEFAULT_PLATE, Plate
from sl_calibration.workflow.conclusion import solve_stored
from sl_common.errors import CalibrationError, DeviceRefused, SequenceError
from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence, named
from sl_projector.sequence.stack import Stack
from sl_reconstruct.model.calibration_file import load_calibration, rig_hash
from support.devices.calibration_bench import HEIGHTS_M, PLACES, START, Bench, FakeRig
from support.scenes.calibration_scenes import RIG
from support.scenes.plate_scenes import drawn, pinhole


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path / "calibrations")


def test_an_accepted_run_is_in_force_with_all_its_evidence(bench: Bench) -> None:
    outcome = bench.calibrate()
    assert outcome.success, outcome.message
    assert bench.rig.moves == [*PLACES, START]
    file = bench.store.current()
    assert file == Path(outcome.calibration_file)
    stored = load_calibration(file)
    assert rig_hash(stored.rig) == outcome.hash
    assert stored.covariance is not None
    # 0.01 px of noise per coordinate; the length of a residual vector is sqrt(2) of that.
    assert outcome.camera_rms_px == pytest.approx(0.01 * np.sqrt(2), rel=0.1)
    assert outcome.projector_rms_px == pytest.approx(0.01 * np.sqrt(2), rel=0.1)
    assert (outcome.views, outcome.holes) == (5, 500)
    grid = np.stack(np.meshgrid(
        np.linspace(-6e-3, 6e-3, 7), np.linspace(-4.5e-3, 4.5e-3, 5), [-1e-3, 0.0, 1e-3],
    ), axis=-1).reshape(-1, 3)  # fmt: skip
    points, _ = triangulate(stored.rig, RIG.camera.project(grid), RIG.projector.project(grid))
    rms_m = float(np.sqrt(np.mean(np.sum((points - grid) ** 2, axis=1))))
    assert rms_m < 1e-6  # issue 3, "Shows"


def test_progress_grows_through_every_stage(bench: Bench) -> None:
    bench.calibrate()
    assert [p.stage for p in bench.told[:3]] == ["home", "planes", "plate"]
    assert [p.stage for p in bench.told[15:]] == ["solve", "check", "store", "store"]
    fractions = [p.fraction for p in bench.told]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert {p.view for p in bench.told} == {1, 2, 3, 4, 5}


def test_the_report_holds_everything_in_one_file(bench: Bench) -> None:
    outcome = bench.calibrate()
    page = Path(outcome.report).read_text()
    assert page.count("data:image/png;base64,") == 5
    assert "http" not in page
    for words in ("Accepted", "Table 1", "Image centre", "precise-rows", outcome.hash):
        assert words in page
    report = json.loads(Path(outcome.report).with_suffix(".json").read_text())
    assert report["accepted"] is True
    assert len(report["heights"]) == 5
    assert report["made_from"]["plate"]["pitch_m"] == Plate().pitch_m
    camera = report["camera"]
    off = abs(camera["focal_length_px"] - RIG.camera.focal_length_px[0])
    assert off < 5 * camera["sigma"]["focal_length_px"]
    # The paper's search comes first and lands near; J falls as the centre is found.
    assert camera["paper_search"]["cost_after_px2"] < camera["paper_search"]["cost_before_px2"]
    table = "\n".join(table_1_lines(report))
    assert "95.665" in table
    assert "192.792" in table
    assert any(outcome.report in line for line in outcome_lines(outcome))


def test_a_rejected_run_is_kept_beside_and_changes_nothing(bench: Bench) -> None:
    first = bench.calibrate()
    strict = replace(Limits(), hole_rms_px=0.02)
    outcome = bench.calibrate(limits=strict, noise_px=0.05)
    assert (outcome.success, outcome.accepted) == (False, False)
    assert "hole_rms_px is 0.0" in outcome.message
    assert Path(outcome.calibration_file).is_file()
    assert "Not accepted" in Path(outcome.report).read_text()
    assert bench.store.current() == Path(first.calibration_file)
    assert load_calibration(bench.store.current() or "").hash == first.hash


def test_stored_observations_solve_to_the_same_bits(bench: Bench, tmp_path: Path) -> None:
    outcome = bench.calibrate()
    again = solve_stored(Path(outcome.calibration_file).parent, tmp_path / "again")
    assert again.hash == outcome.hash
    assert (tmp_path / "again" / CALIBRATION).is_file()


def test_observations_that_are_cut_are_refused(bench: Bench, tmp_path: Path) -> None:
    folder = Path(bench.calibrate().calibration_file).parent
    whole = (folder / OBSERVATIONS).read_bytes()
    (tmp_path / OBSERVATIONS).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CalibrationError, match="no observations"):
        load_observations(tmp_path / OBSERVATIONS)
    with pytest.raises(CalibrationError, match="no observations"):
        solve_stored(tmp_path / "nowhere", tmp_path / "again")


# -- refusals -------------------------------------------------------------------------------------


def test_one_height_only() -> None:
    with pytest.raises(CalibrationError, match=r"1 different heights .* expected at least 3"):
        CalibrationRequest("both", (0.0, 1e-6, 0.0), Plate(), "precise-rows")
    with pytest.raises(CalibrationError, match="finite"):
        CalibrationRequest("both", (0.0, np.nan, 1e-3), Plate(), "precise-rows")


def test_a_height_outside_the_travel_is_refused_before_anything_moves(bench: Bench) -> None:
    outcome = bench.calibrate(heights_m=(0.0, 0.5e-3, 0.02))
    assert "does not reach 20.0000 mm" in outcome.message
    assert bench.rig.moves == []


def test_a_stage_that_says_it_does_not_move(bench: Bench) -> None:
    bench.rig.stuck = True
    outcome = bench.calibrate()
    assert "was sent to -1.0000 mm" in outcome.message
    assert not outcome.success


def test_a_stage_that_only_says_it_moves_is_known_by_the_images(bench: Bench) -> None:
    bench.rig.plate_m = 0.0
    outcome = bench.calibrate()
    assert "view 2 of 5" in outcome.message
    assert "does not move" in outcome.message
    assert bench.rig.place == START
    assert bench.store.current() is None


def test_a_cancelled_run_stops_the_stage_and_leaves_the_old_calibration(bench: Bench) -> None:
    first = bench.calibrate()
    bench.rig.moves.clear()
    bench.rig.cancel_after = 2
    outcome = bench.calibrate()
    assert (outcome.success, outcome.cancelled) == (False, True)
    assert bench.rig.halted
    assert bench.rig.moves == PLACES[:2]
    assert bench.store.current() == Path(first.calibration_file)


def test_a_view_is_looked_at_while_the_next_is_taken() -> None:
    moved_on = threading.Event()

    def look(stack: Stack, _: CalibrationRequest) -> Place:
        assert stack.place != PLACES[0] or moved_on.wait(15.0)
        return stack.place

    def tell(progress: CalibrationProgress) -> None:
        if progress.view == 2:
            moved_on.set()

    request = CalibrationRequest("both", HEIGHTS_M, Plate(), "precise-rows")
    assert Session(FakeRig(), request, look, tell).views() == tuple(PLACES)


def test_a_device_that_fails_is_the_answer_and_the_stage_goes_back(bench: Bench) -> None:
    def take(_: str) -> Stack:
        raise DeviceRefused("the projector is busy")

    bench.rig.take = take  # type: ignore[method-assign]
    outcome = bench.calibrate()
    assert outcome.message == "the projector is busy"
    assert bench.rig.moves == [PLACES[0], START]


def test_an_unknown_device_is_refused() -> None:
    with pytest.raises(CalibrationError, match="target='lens'"):
        CalibrationRequest("lens", HEIGHTS_M, Plate(), "precise-rows")


LIT = PatternSequence("lit", (64, 48), (Pattern("white"), Pattern("black")))
MARKED = Plate(9, 7, 1e-3, 0.4e-3, origin_diameter_m=0.6e-3)


def seen(white: NDArray[np.uint8]) -> None:
    black = np.full_like(white, 6)
    request = CalibrationRequest("both", HEIGHTS_M, MARKED, "lit")
    observe(Stack(np.stack([white, black]), LIT), request)


def test_a_dark_lamp_is_named() -> None:
    dark = np.random.default_rng(1).normal(6.0, 1.0, (300, 400)).astype(np.uint8)
    with pytest.raises(CalibrationError, match="lamp on"):
        seen(dark)


def test_a_missing_plate_is_named() -> None:
    bare = np.random.default_rng(1).normal(190.0, 1.0, (300, 400)).astype(np.uint8)
    with pytest.raises(CalibrationError, match="holes"):
        seen(bare)


def test_the_bench_s_plate_turned_over_is_named(tmp_path: Path) -> None:
    """The default plate, really turned over on the bench, by the default parameters."""
    surface = make_surface("hole_plate", turned_over=True)
    back = World(RIG, surface, Optics()).expose(
        [(np.ones(RIG.projector.image_size[::-1], np.uint8), 1 / 30)], 1 / 30, 0
    )
    with pytest.raises(CalibrationError, match=r"turned over.* with the mark at hole \(3, 2\)"):
        find_plate(back, DEFAULT_PLATE)
    # Without a mark nobody can tell.
    assert len(find_plate(back, Plate()).ids) >= 99


def test_a_mark_that_is_covered_is_asked_for() -> None:
    plate = replace(MARKED, origin_diameter_m=None)
    image = drawn(plate, pinhole(tilt_deg=20.0, scale=38e3))
    with pytest.raises(CalibrationError, match="none of 63 holes has the size of the origin mark"):
        find_plate(image, MARKED)


def test_which_marks_tell_a_plate_s_back() -> None:
    assert DEFAULT_PLATE.tells_its_back
    assert MARKED.tells_its_back  # a corner, but 9 x 7
    for origin in ((0, 0), (9, 0), (3, 6)):
        assert not replace(DEFAULT_PLATE, origin_id=origin).tells_its_back
    assert not replace(MARKED, origin_id=(4, 2)).tells_its_back
    assert not Plate().tells_its_back


def test_a_plate_turned_over_is_named() -> None:
    image = drawn(MARKED, pinhole(tilt_deg=20.0, scale=38e3))
    with pytest.raises(CalibrationError, match="turned over"):
        seen(np.ascontiguousarray(image[:, ::-1]))
    with pytest.raises(SequenceError, match="encodes"):  # the front is found; no patterns here
        seen(image)


def test_white_is_the_mean_of_all_pairs() -> None:
    """Each pair adds up to white and black: with noise-free images the mean is white itself."""
    sequence = named("precise", (64, 48))
    lit = [sequence.frame(i) // 2 for i in range(len(sequence))]
    stack = np.stack(lit) + np.uint8(6)
    assert white_image(stack, sequence) == pytest.approx(np.full((48, 64), 127.0 + 6.0))


# -- the folder -----------------------------------------------------------------------------------


def test_the_pointer_never_leads_out_of_the_folder(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    assert store.current() is None
    (tmp_path / "store").mkdir()
    (tmp_path / CALIBRATION).write_text("format: 1\n")
    for name in ("..", "../", "/etc", "", "missing"):
        (tmp_path / "store" / "current").write_text(name)
        with pytest.raises(CalibrationError, match="no run"):
            store.current()
    with pytest.raises(CalibrationError, match="no run"):
        store.put_in_force(tmp_path)


def test_runs_of_the_same_second_have_folders_of_their_own(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert len({store.new_run() for _ in range(5)}) == 5


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CalibrationError, match="writable"):
        Store(tmp_path / "file").new_run()
