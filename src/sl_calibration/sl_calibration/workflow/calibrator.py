"""A calibration, or a check of the one in force, from its request to its folder. No ROS here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sl_calibration.bundle.parameters import FixedLens
from sl_calibration.data.observations import View, save_observations
from sl_calibration.data.run_store import OBSERVATIONS, PAGE, Store
from sl_calibration.data.session import (
    CalibrationDevices,
    CalibrationProgress,
    CalibrationRequest,
    RunCancelled,
    Session,
    Tell,
    check_motion,
)
from sl_calibration.data.view_extraction import observe
from sl_calibration.report.camera_file import load_fixed_lens
from sl_calibration.report.verification_report import write_verify_report
from sl_calibration.solve.acceptance import Limits, judge
from sl_calibration.solve.fixed_intrinsics import fixed_lens_of
from sl_calibration.target.plate import Plate
from sl_calibration.verify.rig_check import (
    Check,
    Findings,
    VerifyLimits,
    check_rig_on,
    check_target,
    default_heights,
    stage_z_axis,
)
from sl_calibration.workflow.conclusion import Outcome, conclude
from sl_calibration.workflow.run_record import Pitches, RunRecord, made_from_request
from sl_common.errors import CalibrationError, SlError
from sl_projector.sequence.stack import Stack
from sl_reconstruct.model.calibration_file import Calibration

NAN = float("nan")


@dataclass(frozen=True)
class VerifyOutcome:
    """What became of a check; fields as the service's."""

    message: str
    success: bool = False
    recalibrate: bool = False
    rms_m: float = 0.0
    limit_m: float = 0.0
    report: str = ""
    views: int = 0
    flatness_m: float = NAN
    ray_gap_m: float = NAN
    lattice_m: float = NAN
    pitch_error: float = NAN
    step_m: float = NAN
    z_scale_error: float = NAN


class VerifyRequest(NamedTuple):
    """A check that is asked for.

    ``target``, "plate" or "flat", lies on the stage; ``heights_m`` of the stage, empty for three
    among those of the calibration; ``plate``, where it is one; ``sequence`` of both axes.
    """

    target: str
    heights_m: tuple[float, ...]
    plate: Plate
    sequence: str


@dataclass(frozen=True)
class InForce:
    """The calibration in force and where it comes from."""

    calibration: Calibration
    source: str


class Calibrator:
    """Runs calibrations and checks, and stores them.

    Parameters
    ----------
    store : Store
        Folder of all runs.
    limits : Limits
        Acceptance gate.
    pitches : Pitches
        Of camera and DMD.
    stage_tolerance_m : float
        The stage stands where it was sent within this.
    verify_limits : VerifyLimits
        Figures beyond which a check asks for a new calibration.
    look : callable
        Makes a view of a stack.
    record : callable
        Called with what is needed to make a run again from a recording, plain values.
    """

    def __init__(
        self,
        store: Store,
        limits: Limits,
        pitches: Pitches,
        stage_tolerance_m: float = 5e-6,
        verify_limits: VerifyLimits | None = None,
        look: Callable[[Stack, CalibrationRequest], View] = observe,
        record: Callable[[Mapping[str, Any]], None] = lambda _: None,
    ) -> None:
        self._store, self._limits, self._pitches = store, limits, pitches
        self._stage_tolerance_m = stage_tolerance_m
        self._verify_limits = verify_limits or VerifyLimits()
        self._observe, self._record = look, record

    # -- calibrate --------------------------------------------------------------------------------

    def calibrate(
        self,
        devices: CalibrationDevices,
        request: CalibrationRequest,
        in_force: InForce | None,
        tell: Tell,
        keep: str = "",
    ) -> Outcome:
        """Take views, solve, judge, store; in force only when accepted.

        Parameters
        ----------
        devices : CalibrationDevices
            Stage, projector and camera.
        request : CalibrationRequest
            What is asked for.
        in_force : InForce or None
            Calibration in force: the device that is not asked for keeps its lens of it.
        tell : callable
            Called with each change of progress.
        keep : str
            Calibration file whose device is kept instead.

        Returns
        -------
        Outcome
            Never an `SlError`: what went wrong is its message.
        """
        try:
            fixed = self._fixed_lens(request.target, in_force, keep)
            # Without a projector to be kept, a camera needs no patterns.
            request = replace(request, patterns=request.target != "camera" or fixed is not None)
            return self._run(devices, request, fixed, tell)
        except RunCancelled as error:
            stays = "the calibration in force stays" if in_force else "nothing is in force"
            return Outcome(f"{error}; stage and projector were stopped, {stays}", cancelled=True)
        except SlError as error:
            return Outcome(str(error))

    def _fixed_lens(self, target: str, in_force: InForce | None, keep: str) -> FixedLens | None:
        """Lens of the device that is not asked for; None where both are, or there is none yet."""
        if target == "both":
            return None
        name = "projector" if target == "camera" else "camera"
        waiting = self._store.camera() if name == "camera" else None
        if keep or waiting:
            return load_fixed_lens(Path(keep) if keep else Path(waiting or ""), name)
        if in_force:
            return fixed_lens_of(in_force.calibration, name, in_force.source)
        if target == "projector":
            raise CalibrationError(
                "target='projector', but no calibrated camera is in force or named; expected one: "
                "calibrate the 'camera' first, or 'both'"
            )
        return None

    def _run(
        self,
        devices: CalibrationDevices,
        request: CalibrationRequest,
        fixed: FixedLens | None,
        tell: Tell,
    ) -> Outcome:
        stacks: list[Stack] = []

        def look(stack: Stack, asked: CalibrationRequest) -> View:
            view = self._observe(stack, asked)
            # Sizes and number are needed later; the images would fill the memory.
            stack.release_images()
            stacks.append(stack)
            return view

        request, refused = _within_travel(devices, request)
        made_from = {**made_from_request(request, fixed), **refused}
        run = RunRecord((), made_from, self._pitches, self._limits)
        try:
            session = Session(devices, request, look, tell, self._stage_tolerance_m, check_motion)
            views = session.views()
            outcome = self._solved(views, stacks[0], run, tell)
        except SlError as error:
            self._publish(run, stacks, Outcome(str(error)))
            raise
        self._publish(run, stacks, outcome)
        return outcome

    def _solved(self, views: tuple[View, ...], stack: Stack, run: RunRecord, tell: Tell) -> Outcome:
        observations = run.observations(views, stack.image_size, stack.sequence.dmd_size)
        folder = self._store.new_run()
        save_observations(folder / OBSERVATIONS, observations)
        tell(CalibrationProgress("solve", len(views), len(views), 0.85))
        outcome = conclude(observations, self._limits, folder, tell)
        if outcome.camera_alone:
            self._store.put_camera(folder)
        elif outcome.accepted:
            self._store.put_in_force(folder)
        tell(CalibrationProgress("store", len(views), len(views), 1.0))
        return outcome

    def _publish(self, run: RunRecord, stacks: list[Stack], outcome: Outcome) -> None:
        """Say what it takes to make the run again from a recording of it."""
        if stacks:
            scan_ids = tuple(stack.scan_id for stack in stacks)
            ended = {name: getattr(outcome, name) for name in ("accepted", "hash", "message")}
            self._record(replace(run, scan_ids=scan_ids, **ended).plain)

    # -- verify -----------------------------------------------------------------------------------

    def verify(
        self, devices: CalibrationDevices, request: VerifyRequest, in_force: InForce
    ) -> VerifyOutcome:
        """Check the calibration in force on plate or flat; the stage goes back where it stood.

        Parameters
        ----------
        devices : CalibrationDevices
            Stage, projector and camera.
        request : VerifyRequest
            What is asked for.
        in_force : InForce
            What is checked; it is not changed.

        Raises
        ------
        SlError
            When the check cannot be made.
        """
        target, heights_m, plate, sequence = request
        check_target(target)
        calibration = in_force.calibration
        heights_m = heights_m or default_heights(calibration.made_from, devices.where()[2])
        views = CalibrationRequest("both", heights_m, plate, sequence, least=1)

        def look(stack: Stack, _: CalibrationRequest) -> Check:
            return check_rig_on(stack, target, plate, calibration.rig)

        checks = Session(devices, views, look, lambda _: None, self._stage_tolerance_m).views()
        return self._judged(Findings(checks, stage_z_axis(calibration)), calibration.hash)

    def _judged(self, findings: Findings, calibration_hash: str) -> VerifyOutcome:
        limits = self._verify_limits
        known = {name: value for name, value in findings.figures.items() if np.isfinite(value)}
        verdict = judge(known, limits)
        reasons = f" ({'; '.join(verdict.reasons)})" if verdict.reasons else ""
        advice = "the calibration in force is good" if verdict.passed else f"recalibrate{reasons}"
        target, count = findings.checks[0].target, len(findings.checks)
        message = (
            f"{known['rms_m'] * 1e6:.3f} um rms on the {target} at {count} "
            f"height{'s' * (count > 1)} (limit {limits.rms_m * 1e6:g} um): {advice}; "
            f"{findings.words}"
        )
        folder = self._store.new_run("verify")
        write_verify_report(folder, findings, limits, message, not verdict.passed, calibration_hash)
        return VerifyOutcome(
            message,
            success=True,
            recalibrate=not verdict.passed,
            limit_m=limits.rms_m,
            report=str(folder / PAGE),
            views=count,
            z_scale_error=findings.z_scale_error,
            **findings.figures,
        )


def _within_travel(
    devices: CalibrationDevices, request: CalibrationRequest
) -> tuple[CalibrationRequest, dict[str, str]]:
    """The request without the views aside where the stage cannot move so, and why it cannot."""
    if not request.travel_m:
        return request, {}
    x, y, _ = devices.where()
    try:
        for dx, dy, z in request.places:
            if dx or dy:
                devices.check((x + dx, y + dy, z))
    except SlError as error:
        return replace(request, travel_m=0.0), {"not_square": f"squareness not measured: {error}"}
    return request, {}
