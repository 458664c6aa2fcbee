"""One device calibrated and the other kept; views aside; a run solved again from a recording."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import sl_calibration.workflow.conclusion
from sl_bench.world.mounting import Mounting
from sl_bringup.bag.bag_writer import new_bag
from sl_bringup.bag.bags import make_message
from sl_bringup.cli.main import main
from sl_bringup.evaluation.calibrate_bag import solve_recorded
from sl_calibration.bundle.parameters import lens_values
from sl_calibration.data.run_store import CAMERA
from sl_calibration.report.camera_file import load_fixed_lens
from sl_calibration.solve.fixed_intrinsics import fixed_lens_of
from sl_calibration.solve.ray_midpoints import triangulate
from sl_common.errors import CalibrationError
from sl_common.topics import CALIBRATION_RUN
from sl_projector.sequence.pattern_sequence import named
from sl_projector.sequence.stack import Stack
from sl_reconstruct.model.calibration_file import Calibration, Covariance
from sl_reconstruct.model.rig import BrownConrady, Device, Rig
from support.devices.calibration_bench import HEIGHTS_M, PITCHES, SEQUENCE, START, Bench, look_with
from support.scenes.calibration_scenes import RIG, Scene

GRID = np.stack(np.meshgrid(
    np.linspace(-6e-3, 6e-3, 7), np.linspace(-4.5e-3, 4.5e-3, 5), [-1e-3, 0.0, 1e-3],
), axis=-1).reshape(-1, 3)  # fmt: skip


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    # Recorded images are small, and nobody looks at them.
    monkeypatch.setattr(Stack, "image_size", property(lambda _: RIG.camera.image_size))
    # The pages are looked at elsewhere; drawing them takes longer than all the rest.
    monkeypatch.setattr(sl_calibration.workflow.conclusion, "write_report", lambda *_: None)
    return Bench(tmp_path / "calibrations")


def error_m(rig: Rig, true: Rig) -> float:
    """Rms distance of triangulated points from the truth, nothing aligned."""
    points, _ = triangulate(rig, true.camera.project(GRID), true.projector.project(GRID))
    return float(np.sqrt(np.mean(np.sum((points - GRID) ** 2, axis=1))))


def refocused(device: Device, factor: float) -> Device:
    focal = device.focal_length_px[0] * factor
    return replace(device, focal_length_px=(focal, focal))


# -- one device, the other kept ---------------------------------------------------------------


@pytest.mark.parametrize(("target", "kept"), [("camera", "projector"), ("projector", "camera")])
def test_one_device_alone_keeps_the_lens_of_the_other(bench: Bench, target: str, kept: str) -> None:
    assert bench.calibrate().accepted
    before = getattr(bench.in_force.calibration.rig, kept)
    # Another day: the plate lies a little otherwise, the noise is another.
    bench.seed = 11
    bench.scene = Scene(Mounting(tilt_rad=(0.01, -0.02, 0.3), offset_m=(2e-4, -1e-4, 3e-5)))
    outcome = bench.calibrate(target=target)
    assert outcome.success, outcome.message
    assert f"the {kept} keeps its lens" in outcome.message
    rig = outcome.calibration.rig
    # Held to 1e-5 px in f and C: the solver's tolerance of what is held.
    assert lens_values(getattr(rig, kept))[:3] == pytest.approx(lens_values(before)[:3], abs=1e-4)
    assert error_m(rig, bench.scene.rig) < 1e-6
    assert bench.store.current() == Path(outcome.calibration_file)
    # Its own uncertainty is not lost: the kept lens is no better known than it was.
    sigma = [
        np.sqrt(np.diag(c.covariance.matrix))[c.covariance.parameters.index(f"{kept}.kappa")]
        for c in (outcome.calibration, bench.in_force.calibration)
    ]
    assert sigma[0] == pytest.approx(sigma[1])


def test_a_kept_lens_that_does_not_fit_any_more_is_refused(bench: Bench) -> None:
    bench.calibrate()
    first = bench.store.current()
    # The projector was refocused since: half a per cent of 6 993 px is 25 of its sigmas (1.4 px).
    wrong = bench.in_force.calibration
    rig = Rig(wrong.rig.camera, refocused(wrong.rig.projector, 1.005))
    bench.in_force = replace(bench.in_force, calibration=replace(wrong, rig=rig))
    outcome = bench.calibrate(target="camera")
    assert not outcome.success
    assert "kept_lens_sigmas is" in outcome.message
    # The camera itself is good: it waits for its projector, and what is in force stays.
    assert "The camera alone is good" in outcome.message
    assert bench.store.current() == first
    assert bench.store.camera() == first.parent.parent / bench.store.camera().parent.name / CAMERA
    following = bench.calibrate(target="projector")
    assert following.success, following.message
    assert bench.store.camera() is None
    assert error_m(following.calibration.rig, Scene().rig) < 1e-6


def test_a_camera_comes_first_and_its_projector_next(bench: Bench) -> None:
    camera = bench.calibrate(target="camera")
    assert camera.success, camera.message
    assert "calibrate the 'projector' next" in camera.message
    assert bench.store.current() is None
    assert camera.calibration_file.endswith(CAMERA)
    assert (camera.projector_rms_px, camera.hash) == (0.0, "")
    kept = load_fixed_lens(Path(camera.calibration_file), "camera")
    # 3.9 px of 16 912 is what five heights tell (docs/calibration.md); here with the stage's lean.
    assert abs(kept.values[0] - RIG.camera.focal_length_px[0]) < 5 * np.sqrt(kept.covariance[0, 0])
    rig = bench.calibrate(target="projector")
    assert rig.success, rig.message
    assert error_m(rig.calibration.rig, Scene().rig) < 1e-6
    assert bench.store.current() == Path(rig.calibration_file)


def test_a_projector_without_a_camera_is_refused_before_anything_moves(bench: Bench) -> None:
    outcome = bench.calibrate(target="projector")
    assert "no calibrated camera is in force or named" in outcome.message
    assert bench.rig.moves == []


def test_a_lens_of_another_kind_cannot_be_kept(bench: Bench, tmp_path: Path) -> None:
    camera = replace(RIG.camera, lens=BrownConrady((0.1, 0.0, 0.0, 0.0, 0.0)))
    with pytest.raises(CalibrationError, match="expected the paper's lens"):
        fixed_lens_of(Calibration(Rig(camera, RIG.projector)), "camera", "a file")
    named = bench.calibrate(target="camera", keep=str(tmp_path / "missing.yaml"))
    assert "cannot read" in named.message
    assert bench.rig.moves == []


def test_a_camera_file_has_no_projector_to_keep(bench: Bench) -> None:
    camera = bench.calibrate(target="camera")
    outcome = bench.calibrate(target="camera", keep=camera.calibration_file)
    assert "holds a camera alone; expected a file with a projector" in outcome.message


def test_an_unknown_uncertainty_of_a_kept_lens_counts_as_none() -> None:
    kept = fixed_lens_of(
        Calibration(RIG, Covariance(("camera.kappa",), np.eye(1))), "camera", "a file"
    )
    assert not kept.covariance.any()


# -- the stage ------------------------------------------------------------------------------------


def test_views_aside_tell_a_stage_out_of_square_from_a_plate_that_leans(bench: Bench) -> None:
    tilt, square, scale = np.deg2rad(2.0), np.deg2rad(0.2), 1.001
    bench.scene = Scene(Mounting(
        scale=(1.0, 1.0, scale), squareness_rad=(0.0, square, 0.0), tilt_rad=(tilt, 0.0, 0.0)
    ))  # fmt: skip
    outcome = bench.calibrate(travel_m=0.5e-3)
    assert outcome.success, outcome.message
    assert outcome.views == 7
    # Scale of z: 1.3e-4 by docs/calibration.md; squareness: 0.1 um of a plate's place over 0.5 mm
    # of travel is 2e-4 rad, five of them are 0.06 degrees.
    assert outcome.stage_z_scale == pytest.approx(scale, abs=5 * 1.3e-4)
    xy, xz, yz = outcome.stage_squareness_rad
    assert (xy, yz) == pytest.approx((0.0, 0.0), abs=1e-3)
    assert xz == pytest.approx(square, abs=1e-3)
    # Lean against the plate's normal is both together: the plate is turned about x, so that z
    # leans towards its y by the tilt, and towards its x by the stage's own angle.
    lean_x, lean_y = outcome.stage_z_lean_rad
    assert lean_x == pytest.approx(square, abs=1e-3)
    assert abs(lean_y) == pytest.approx(tilt, abs=1e-3)
    assert error_m(outcome.calibration.rig, bench.scene.rig) < 1.5e-6  # issue 3, "Shows"
    assert bench.rig.moves[-1] == START
    assert [place[:2] for place in bench.rig.moves[3:5]] == [(0.5e-3, 0.0), (0.0, 0.5e-3)]


def test_a_stage_of_z_only_is_calibrated_without_views_aside(bench: Bench) -> None:
    bench.rig.only_z = True
    outcome = bench.calibrate(travel_m=0.5e-3)
    assert outcome.success, outcome.message
    assert outcome.views == 5
    assert np.isnan(outcome.stage_squareness_rad).all()
    assert "does not reach" in outcome.calibration.made_from["not_square"]


# -- again, from a recording ----------------------------------------------------------------------


def record(path: Path, run: dict[str, object] | None, places: list[tuple[float, ...]]) -> None:
    """Write a recording of black images: what is seen of them is computed."""
    sequence = named("precise-rows")
    black = np.zeros((4, 6), np.uint8)
    stamp_ns = 10**18
    with new_bag(path, "mcap") as bag:
        for number, place in enumerate(places, start=1):
            for index in range(len(sequence)):
                bag.trigger(sequence, index, number, stamp_ns, 0.03)
                bag.pose(place, stamp_ns)
                bag.image(black, stamp_ns, stamp_ns + 10**7)
                stamp_ns += 40_000_000
            bag.pose(place, stamp_ns + 10**7)
            stamp_ns += 10**9
        if run is not None:
            text = make_message(CALIBRATION_RUN.msgtype, data=json.dumps(run))
            bag.write(CALIBRATION_RUN, stamp_ns, text)


def test_a_recorded_run_is_solved_to_the_same_bits(bench: Bench, tmp_path: Path) -> None:
    live = bench.calibrate(travel_m=0.5e-3)
    (run,) = bench.runs
    assert run["scan_ids"] == [1, 2, 3, 4, 5, 6, 7]
    # A scan of something else comes first in the recording; the run says which are its own.
    shifted = {**run, "scan_ids": [number + 1 for number in run["scan_ids"]]}
    record(tmp_path / "bag", shifted, [(0.0, 0.0, 0.0), *bench.rig.moves[:7]])
    seen = look_with(bench.rig)
    outcome, notes = solve_recorded(tmp_path / "bag", tmp_path / "again", look=seen)
    assert outcome.hash == live.hash
    assert notes == ["the live run gave the same bits"]
    assert (outcome.camera_rms_px, outcome.views) == (live.camera_rms_px, live.views)
    assert (tmp_path / "again" / "observations.npz").is_file()


def test_a_recording_that_lacks_a_stack_is_refused(bench: Bench, tmp_path: Path) -> None:
    bench.calibrate()
    (run,) = bench.runs
    record(tmp_path / "bag", dict(run), bench.rig.moves[:4])
    seen = look_with(bench.rig)
    with pytest.raises(CalibrationError, match=r"lacks the stacks of scans \[5\]"):
        solve_recorded(tmp_path / "bag", tmp_path / "again", look=seen)


@pytest.mark.parametrize(
    ("name", "value"),
    [("plate", None), ("plate", {"origin_id": [0, 0], "colour": "white"}), ("plate", "a plate"),
     ("sequence", None), ("target", "stage")],
)  # fmt: skip
def test_a_recorded_run_that_makes_no_sense_is_refused(
    bench: Bench, tmp_path: Path, name: str, value: object
) -> None:
    bench.calibrate()
    made_from = {**bench.runs[0]["made_from"], name: value}
    if value is None:
        del made_from[name]
    record(tmp_path / "bag", {**bench.runs[0], "made_from": made_from}, bench.rig.moves[:1])
    with pytest.raises(CalibrationError, match="expected"):
        solve_recorded(tmp_path / "bag", tmp_path / "again", look=look_with(bench.rig))


def test_a_recording_that_tells_of_no_run_gives_all_its_stacks(
    bench: Bench, tmp_path: Path
) -> None:
    record(tmp_path / "bag", None, [(0.0, 0.0, height_m) for height_m in HEIGHTS_M])
    seen = look_with(bench.rig)
    outcome, notes = solve_recorded(tmp_path / "bag", tmp_path / "again", look=seen)
    assert outcome.views == len(HEIGHTS_M)
    assert "does not tell of a calibration" in notes[0]
    assert SEQUENCE.name == "precise-rows"
    assert PITCHES.camera_m == RIG.camera.pixel_pitch_m


def test_a_run_is_exported_for_opencv(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outcome = bench.calibrate()
    run, file = Path(outcome.calibration_file).parent, tmp_path / "rig.xml"
    assert main(["calibrate", "--from", str(run), "--opencv", str(file)]) == 0
    assert "OpenCV's lens is off the paper's by" in capsys.readouterr().out
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    rig = outcome.calibration.rig
    assert storage.getNode("cam_K").mat() == pytest.approx(rig.camera.camera_matrix)
    # A point in the camera's frame is where OpenCV's R and T say in the projector's.
    in_camera, in_projector = (
        d.rotation @ GRID[0] + d.translation_m for d in (rig.camera, rig.projector)
    )
    rotation, shift_mm = storage.getNode("R").mat(), storage.getNode("T").mat().ravel()
    assert rotation @ in_camera * 1e3 + shift_mm == pytest.approx(in_projector * 1e3)


def test_the_command_solves_a_run_again(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outcome = bench.calibrate(travel_m=0.5e-3)
    # Results go into the run's folder, whatever it is called.
    run = Path(outcome.calibration_file).parent.rename(tmp_path / "plate.2026")
    assert main(["calibrate", "--from", str(run)]) == 0
    assert (run / "again" / "calibration.yaml").is_file()
    out = capsys.readouterr().out
    assert outcome.hash in out
    assert "stage squareness  xy" in out
    assert main(["calibrate", "--opencv", str(tmp_path / "rig.xml")]) != 0
