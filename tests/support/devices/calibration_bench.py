"""A calibrator on a rig without devices: stage, projector and camera that are computed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sl_calibration.data.observations import View
from sl_calibration.data.run_store import Store
from sl_calibration.data.session import CalibrationProgress, CalibrationRequest, Place, RunCancelled
from sl_calibration.solve.acceptance import Limits
from sl_calibration.target.plate import Plate
from sl_calibration.workflow.calibrator import Calibrator, InForce
from sl_calibration.workflow.conclusion import Outcome
from sl_calibration.workflow.run_record import Pitches
from sl_common.errors import CalibrationError
from sl_projector.sequence.pattern_sequence import named
from sl_projector.sequence.stack import Stack, StagePose
from support.scenes.calibration_scenes import CAMERA, RIG, Scene

HEIGHTS_M = (-1e-3, -0.5e-3, 0.0, 0.5e-3, 1e-3)
PITCHES = Pitches(RIG.camera.pixel_pitch_m, RIG.projector.pixel_pitch_m)
SEQUENCE = named("precise-rows")
START = (0.0, 0.0, 0.2e-3)
PLACES = [(0.0, 0.0, height_m) for height_m in HEIGHTS_M]


class FakeRig:
    """Stage, projector and camera that do as they are told, or not."""

    def __init__(self) -> None:
        self.place: Place = START
        self.plate_m: float | None = None  # where the plate is, if not where the stage says
        self.travel_m = (-0.01, 0.01)
        self.moves: list[Place] = []
        self.halted = False
        self.stuck = False
        self.only_z = False
        self.taken = 0
        self.cancel_after: int | None = None

    def where(self) -> Place:
        return self.place

    def check(self, place: Place) -> None:
        low, high = self.travel_m
        if not low <= place[2] <= high or (self.only_z and any(place[:2])):
            raise CalibrationError(f"the stage does not reach {place[2] * 1e3:.4f} mm")

    def move(self, place: Place) -> Place:
        if self.cancel_after == len(self.moves):
            raise RunCancelled("calibration cancelled")
        self.moves.append(place)
        if not self.stuck:
            self.place = place
        return self.place

    def take(self, sequence: str) -> Stack:
        assert sequence == "precise-rows"
        width, height = CAMERA.image_size
        images = np.broadcast_to(np.uint8(0), (len(SEQUENCE), height, width))
        self.taken += 1
        return Stack(images, SEQUENCE, self.taken, pose=StagePose(0, self.place))

    def halt(self) -> None:
        self.halted = True


def look_with(
    rig: FakeRig, noise_px: float = 0.01, scene: Scene | None = None, seed: int = 7
) -> Callable[[Stack, CalibrationRequest], View]:
    """What is seen of the plate: computed, not rendered."""
    scene = replace(scene or Scene(), hole_noise_px=noise_px)
    rng = np.random.default_rng(seed)

    def look(stack: Stack, request: CalibrationRequest) -> View:
        height_m = stack.place[2] if rig.plate_m is None else rig.plate_m
        stage_m = np.array([*stack.place[:2], height_m])
        view = scene.view(stage_m, scene.holes(rng, stage_m), scene.thrown(rng, stage_m))
        few = slice(None) if request.patterns else slice(0)
        parts = {n: getattr(view, n)[few] for n in ("camera_px", "dmd_px", "dmd_sigma_px")}
        return replace(view, height_m=stack.place[2], **parts)

    return look


class Bench:
    """A calibrator on a fake rig."""

    def __init__(self, directory: Path) -> None:
        self.rig = FakeRig()
        self.store = Store(directory)
        self.told: list[CalibrationProgress] = []
        self.runs: list[Mapping[str, Any]] = []
        self.in_force: InForce | None = None
        self.scene, self.seed = Scene(), 7

    def calibrate(
        self, heights_m: tuple[float, ...] = HEIGHTS_M, limits: Limits | None = None,
        noise_px: float = 0.01, target: str = "both", travel_m: float = 0.0, keep: str = "",
    ) -> Outcome:  # fmt: skip
        look = look_with(self.rig, noise_px, self.scene, self.seed)
        calibrator = Calibrator(
            self.store, limits or Limits(), PITCHES, look=look, record=self.runs.append
        )
        request = CalibrationRequest(target, heights_m, Plate(), "precise-rows", travel_m)
        outcome = calibrator.calibrate(self.rig, request, self.in_force, self.told.append, keep)
        if outcome.accepted and outcome.calibration:
            self.in_force = InForce(outcome.calibration, outcome.calibration_file)
        return outcome
