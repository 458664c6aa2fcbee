"""A check of the calibration in force: what it sees of which error, at one height and at three."""

from __future__ import annotations

import html
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sl_calibration.workflow.calibrator
from sl_calibration.data.run_store import Store
from sl_calibration.data.session import CalibrationRequest
from sl_calibration.solve.acceptance import Limits
from sl_calibration.target.plate import Plate
from sl_calibration.verify.rig_check import Check, VerifyLimits, check_on, default_heights
from sl_calibration.workflow.calibrator import Calibrator, InForce, VerifyOutcome, VerifyRequest
from sl_common.errors import CalibrationError
from sl_projector.sequence.stack import Stack
from sl_reconstruct.model.calibration_file import Calibration
from sl_reconstruct.model.rig import Rig
from support.devices.calibration_bench import PITCHES, START, FakeRig, look_with
from support.scenes.calibration_scenes import RIG, Scene
from support.scenes.rigs import rotation, turned

HEIGHTS_M = (-0.8e-3, 0.0, 0.8e-3)


class Checked:
    """A calibrator that checks a rig on computed views."""

    def __init__(self, directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.rig = FakeRig()
        self.calibrator = Calibrator(Store(directory), Limits(), PITCHES)
        self.directory = directory
        self.rig_in_force = RIG
        self.made_from: dict[str, object] = {"heights_m": [-1e-3, 0.0, 1e-3]}
        self.stretch = 1.0  # how far the plate really moves, over what the stage says
        monkeypatch.setattr(sl_calibration.workflow.calibrator, "check_rig_on", self.check)

    def check(self, stack: Stack, target: str, plate: Plate, rig: Rig) -> Check:
        self.rig.plate_m = stack.place[2] * self.stretch
        view = look_with(self.rig, 0.01, Scene(), seed=round(stack.place[2] * 1e6) + 5000)(
            stack, CalibrationRequest("both", (0.0,), plate, "precise-rows", least=1)
        )
        holes = (view.centres_px, view.plate_xy_m) if target == "plate" else None
        return check_on(rig, stack.place[2], (view.camera_px, view.dmd_px), holes)

    def verify(
        self, heights_m: tuple[float, ...] = HEIGHTS_M, target: str = "plate"
    ) -> VerifyOutcome:
        calibration = Calibration(self.rig_in_force, made_from=self.made_from)
        request = VerifyRequest(target, heights_m, Plate(), "precise-rows")
        return self.calibrator.verify(self.rig, request, InForce(calibration, "a file"))


@pytest.fixture
def checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Checked:
    return Checked(tmp_path / "store", monkeypatch)


def test_the_true_rig_is_good_at_every_height(checked: Checked) -> None:
    found = checked.verify()
    assert (found.success, found.recalibrate, found.views) == (True, False, 3)
    # 0.01 DMD px of noise is 0.12 um across the rays of 137 mm over 6 993 px (12 um a pixel with
    # the camera's tilt at most 3 times that in z); 0.01 camera px is 0.08 um on the plate.
    assert found.flatness_m < 0.5e-6
    assert found.ray_gap_m < 0.5e-6
    # Both coordinates of 100 holes: 0.08 um * sqrt(2), stretched by up to 1 / cos 28 degrees.
    assert found.lattice_m == pytest.approx(0.08e-6 * np.sqrt(2), rel=0.25)
    assert abs(found.pitch_error) < 1e-5
    # Each plane is the mean of 108 points.
    assert found.step_m < 0.1e-6
    assert abs(found.z_scale_error) < 1e-4
    assert "the calibration in force is good" in found.message
    assert checked.rig.place == START


def test_an_error_of_the_z_scale_is_seen_from_three_heights_only(checked: Checked) -> None:
    checked.stretch = 1.002
    found = checked.verify()
    assert found.recalibrate
    # The highest plane stands 1.6 mm over the lowest.
    assert found.step_m == pytest.approx(0.002 * 1.6e-3, rel=0.05)
    assert found.z_scale_error == pytest.approx(0.002, rel=0.05)
    assert "step_m is 3.2" in found.message
    one = checked.verify((0.8e-3,))
    assert not one.recalibrate
    assert np.isnan([one.step_m, one.z_scale_error]).all()
    assert "an error of the z scale would not be seen" in one.message


def moved(scale: float) -> Rig:
    """The reference rig, its world so many times larger."""
    return Rig(
        *(replace(d, translation_m=d.translation_m * scale) for d in (RIG.camera, RIG.projector))
    )


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        # A world 0.1 % too large: the plate's pitch says so.
        (lambda: moved(1.001), "pitch_error is 0.001"),
        # The camera turned by 0.1 mrad about its x axis: rays miss by 14 um at 137 mm.
        (lambda: Rig(turned(RIG.camera, rotation(1e-4, 0.0, 0.0)), RIG.projector), "ray_gap_m is"),
        # The camera's lens without its distortion: 1.2e-8 * 800^2 is 0.8 % at the border.
        (lambda: Rig(replace(RIG.camera, lens=type(RIG.camera.lens)(0.0)), RIG.projector),
         "lattice_m is"),
    ],
)  # fmt: skip
def test_each_kind_of_error_is_named(
    checked: Checked, wrong: Callable[[], Rig], reason: str
) -> None:
    checked.rig_in_force = wrong()
    found = checked.verify()
    assert found.recalibrate
    assert reason in found.message
    assert "recalibrate (" in found.message


def test_a_flat_has_no_pitch_and_no_lattice(checked: Checked) -> None:
    found = checked.verify(target="flat")
    assert not found.recalibrate
    assert np.isnan([found.pitch_error, found.lattice_m]).all()
    assert found.rms_m == pytest.approx(np.hypot(found.flatness_m, found.ray_gap_m))


def test_the_report_names_every_figure_and_its_limit(checked: Checked) -> None:
    checked.stretch = 1.002
    found = checked.verify()
    page = Path(found.report).read_text()
    assert "Planes off the stage's steps" in html.unescape(page)
    assert page.count("data:image/png;base64,") == 1
    content = json.loads(Path(found.report).with_suffix(".json").read_text())
    assert content["recalibrate"] is True
    assert content["limits"]["step_m"] == VerifyLimits().step_m
    assert [h["height_m"] for h in content["heights"]] == list(HEIGHTS_M)
    assert not (checked.directory / "current").exists()


def test_heights_are_three_within_those_of_the_calibration(checked: Checked) -> None:
    assert default_heights({"heights_m": [-1e-3, 0.0, 1e-3]}, 0.5) == pytest.approx(HEIGHTS_M)
    assert default_heights({}, 0.5) == (0.5,)
    assert checked.verify(heights_m=()).views == 3
    checked.made_from = {}
    assert checked.verify(heights_m=()).views == 1


def test_a_height_out_of_reach_or_an_unknown_target_moves_nothing(checked: Checked) -> None:
    with pytest.raises(CalibrationError, match="does not reach"):
        checked.verify((0.0, 0.5))
    with pytest.raises(CalibrationError, match="target='lens'"):
        checked.verify(target="lens")
    assert checked.rig.moves == []
