"""A run's observations solved, judged and written to its folder: live, stored or recorded."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sl_calibration.data.observations import Observations, load_observations
from sl_calibration.data.run_store import CALIBRATION, CAMERA, CAMERA_PAGE, OBSERVATIONS, PAGE
from sl_calibration.data.session import CalibrationProgress, Tell
from sl_calibration.report.calibration_report import write_report
from sl_calibration.report.camera_file import save_camera
from sl_calibration.solve.acceptance import Limits
from sl_calibration.solve.solution import JudgedSolution, metres_per_pixel
from sl_calibration.solve.solution_pipeline import solve, solve_camera_alone
from sl_common.errors import CalibrationError
from sl_reconstruct.model.calibration_file import Calibration, save_calibration

_NAN3 = (float("nan"),) * 3


@dataclass(frozen=True)
class Outcome:
    """What became of a run; the fields that the service answers with carry its names."""

    message: str
    success: bool = False
    accepted: bool = False
    cancelled: bool = False
    camera_rms_px: float = 0.0
    projector_rms_px: float = 0.0
    camera_rms_m: float = 0.0
    projector_rms_m: float = 0.0
    predicted_sigma_m: float = 0.0
    left_out_rms_m: float = 0.0
    views: int = 0
    holes: int = 0
    calibration_file: str = ""
    report: str = ""
    hash: str = ""
    stage_z_scale: float = float("nan")
    stage_z_lean_rad: tuple[float, ...] = _NAN3[:2]
    stage_squareness_rad: tuple[float, ...] = _NAN3
    calibration: Calibration | None = field(default=None, repr=False)
    #: A camera without a projector was accepted: nothing to put in force.
    camera_alone: bool = False


def conclude(
    observations: Observations, limits: Limits, folder: Path, tell: Tell = lambda _: None
) -> Outcome:
    """Solve, judge, and write calibration and report into a folder.

    Parameters
    ----------
    observations : Observations
        ``made_from["target"]`` says what is calibrated, ``made_from["kept"]`` whose lens stays.
    limits : Limits
        Acceptance gate.
    folder : Path
        For the results.
    tell : callable
        Called with each change of progress.

    Raises
    ------
    CalibrationError
        When the observations do not determine what is asked for.
    """
    try:
        if not observations.has_targets:
            return _conclude_camera(observations, limits, folder)
        outcome = _conclude_rig(observations, limits, folder, tell)
        if outcome.accepted or observations.made_from.get("target") != "camera":
            return outcome
        return _camera_beside(outcome, _conclude_camera(observations, limits, folder))
    except CalibrationError as error:
        raise CalibrationError(f"{error} (observations kept in {folder})") from error


def _conclude_rig(observations: Observations, limits: Limits, folder: Path, tell: Tell) -> Outcome:
    solved = solve(observations, limits)
    count = len(observations.views)
    tell(CalibrationProgress("check", count, count, 0.92))
    calibration = solved.solution.calibration(observations.made_from)
    save_calibration(folder / CALIBRATION, calibration)
    tell(CalibrationProgress("store", count, count, 0.95))
    write_report(folder, solved, calibration)
    accepted, projector_px = solved.verdict.passed, solved.bundle.rms_px(1)
    return Outcome(
        message=_message(solved),
        success=accepted,
        accepted=accepted,
        projector_rms_px=projector_px,
        projector_rms_m=projector_px * metres_per_pixel(calibration.rig.projector),
        predicted_sigma_m=solved.predicted_sigma_m,
        left_out_rms_m=solved.left_out_rms_m,
        calibration_file=str(folder / CALIBRATION),
        report=str(folder / PAGE),
        hash=calibration.hash,
        calibration=calibration,
        **_camera_figures(solved),
    )


def _camera_figures(solved: JudgedSolution) -> dict[str, Any]:
    """Figures of an outcome that holes and stage have."""
    bundle = solved.bundle
    camera_px, stage = bundle.rms_px(0), bundle.stage
    return {
        "camera_rms_px": camera_px,
        "camera_rms_m": camera_px * metres_per_pixel(bundle.state.devices[0]),
        "views": len(solved.observations.views),
        "holes": int(bundle.used[bundle.problem.groups[0]].sum()),
        "stage_z_scale": float(stage.scale[2]),
        "stage_z_lean_rad": tuple(map(float, stage.z_lean_rad)),
        "stage_squareness_rad": tuple(map(float, stage.squareness_rad)),
    }


def _message(solved: JudgedSolution) -> str:
    if not solved.verdict.passed:
        return "not accepted, the calibration in force stays: " + "; ".join(solved.verdict.reasons)
    figures = solved.verdict.figures
    text = (
        f"accepted: z known to {figures['point_sigma_m'] * 1e6:.3f} um in the volume (edge noise "
        f"apart), heights left out are met within {figures['left_out_z_m'] * 1e6:.3f} um"
    )
    if kept := solved.observations.made_from.get("kept"):
        text += (
            f"; the {kept['name']} keeps its lens of {kept['source']}, "
            f"{figures['kept_lens_sigmas']:.1f} sigma from what this run finds; its "
            "position was measured again"
        )
    return text


def _conclude_camera(observations: Observations, limits: Limits, folder: Path) -> Outcome:
    """Solve the camera alone; its file and page stand beside those of a rig, if there are any."""
    solved = solve_camera_alone(observations, limits)
    save_camera(folder / CAMERA, solved.bundle, observations.made_from)
    write_report(folder, solved, None)
    accepted = solved.verdict.passed
    message = (
        "accepted: the camera is calibrated and stored; it is not in force, for there is no "
        "calibrated projector: calibrate the 'projector' next"
        if accepted
        else "not accepted: " + "; ".join(solved.verdict.reasons)
    )
    return Outcome(
        message=message,
        success=accepted,
        accepted=accepted,
        camera_alone=accepted,
        calibration_file=str(folder / CAMERA),
        report=str(folder / CAMERA_PAGE),
        **_camera_figures(solved),
    )


def _camera_beside(rig: Outcome, camera: Outcome) -> Outcome:
    """What is said when the camera is good but the projector that was kept does not fit it."""
    if not camera.accepted:
        return rig
    message = (
        f"{rig.message}. The camera alone is good and stored in {camera.calibration_file}: "
        "calibrate the 'projector' next, or 'both'"
    )
    return replace(rig, message=message, camera_alone=True)


def solve_stored(source: Path, output: Path, limits: Limits | None = None) -> Outcome:
    """Solve a stored run's observations again and write the results elsewhere.

    Parameters
    ----------
    source : Path
        Folder of a run, or its ``observations.npz``.
    output : Path
        For calibration and report.
    limits : Limits, optional
        Acceptance gate.

    Raises
    ------
    CalibrationError
        When there are no observations, or they do not determine a rig.
    """
    file = source / OBSERVATIONS if source.is_dir() else source
    output.mkdir(parents=True, exist_ok=True)
    return conclude(load_observations(file), limits or Limits(), output)
