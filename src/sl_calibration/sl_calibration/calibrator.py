"""A calibration from its order to its verdict and its folder. No ROS here."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from sl_calibration.bundle import FlatPrior, Freedom
from sl_calibration.linear import Sensor
from sl_calibration.observe import observe
from sl_calibration.plate import Plate
from sl_calibration.report import write_report, write_verify_report
from sl_calibration.samples import HoleView, TargetView
from sl_calibration.session import (
    Gear,
    Order,
    Progress,
    RunCancelled,
    Session,
    Taken,
    Tell,
)
from sl_calibration.solution import RigSolution, metres_per_pixel, solve_rig
from sl_calibration.store import CALIBRATION, OBSERVATIONS, PAGE, Store
from sl_calibration.uncertainty import EdgeNoise, Limits, Verdict, Volume, judge, sigma_map
from sl_calibration.verify import Check, check_rig_on, triangulate
from sl_calibration.views import Observations, View, load_observations, save_observations
from sl_projector.errors import CalibrationError, SlError
from sl_reconstruct.calibration_file import Calibration, save_calibration


@dataclass(frozen=True)
class Pitches:
    """Pixel pitches of the chips, metres; they only turn pixels into millimetres in reports."""

    camera_m: float
    projector_m: float


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
    calibration: Calibration | None = field(default=None, repr=False)


@dataclass(frozen=True)
class VerifyOutcome:
    """What became of a check; fields as the service's."""

    message: str
    success: bool = False
    recalibrate: bool = False
    rms_m: float = 0.0
    limit_m: float = 0.0
    report: str = ""


@dataclass(frozen=True)
class Solved:
    """A solution, its verdict and how long it took."""

    observations: Observations
    solution: RigSolution
    verdict: Verdict
    limits: Limits
    seconds: float

    @property
    def edge_noise(self) -> EdgeNoise:
        """Noise of a point's edge, as it was found on the plate."""
        edges = [v.edge_sigma_px for v in self.observations.views if np.isfinite(v.edge_sigma_px)]
        return EdgeNoise(float(np.median(edges))) if edges else EdgeNoise()

    @property
    def volume(self) -> Volume:
        """Box of everything that the projector lit and the camera saw."""
        return lit_volume(self.solution)

    @property
    def predicted_sigma_m(self) -> float:
        """Predicted 1-sigma of a point's z, edge noise included, worst in the volume."""
        sigma = sigma_map(self.solution.joint, self.volume, self.edge_noise)[1]
        return float(np.nanmax(sigma[..., 2]))

    @property
    def left_out_rms_m(self) -> float:
        """Error of z at heights left out, rms of all; NaN where there were too few."""
        errors = [left.z_rms_m for left in self.solution.left_out]
        return float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan")


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
    verify_limit_m : float
        Error beyond which a check asks for a new calibration.
    look : callable
        Makes a view of a stack.
    """

    def __init__(
        self,
        store: Store,
        limits: Limits,
        pitches: Pitches,
        stage_tolerance_m: float = 5e-6,
        verify_limit_m: float = 3e-6,
        look: Callable[[Taken, Order], View] = observe,
    ) -> None:
        self._store, self._limits, self._pitches = store, limits, pitches
        self._stage_tolerance_m, self._verify_limit_m = stage_tolerance_m, verify_limit_m
        self._observe = look

    def calibrate(
        self, gear: Gear, order: Order, in_force: Calibration | None, tell: Tell
    ) -> Outcome:
        """Take views, solve, judge, store; in force only when accepted.

        Never raises an `SlError`: what went wrong is the outcome's message.
        """
        try:
            if order.target != "both":
                raise CalibrationError(
                    f"target={order.target!r}: one device cannot be calibrated without the other "
                    "on this rig, since both share the plate's world; expected 'both'"
                )
            return self._run(gear, order, tell)
        except RunCancelled as error:
            kept = "the calibration in force stays" if in_force else "nothing is in force"
            return Outcome(f"{error}; stage and projector were stopped, {kept}", cancelled=True)
        except SlError as error:
            return Outcome(str(error))

    def _run(self, gear: Gear, order: Order, tell: Tell) -> Outcome:
        sizes: list[tuple[tuple[int, int], tuple[int, int]]] = []

        def look(taken: Taken, asked: Order) -> View:
            height, width = taken.images.shape[1:]
            sizes.append(((width, height), taken.sequence.dmd_size))
            return self._observe(taken, asked)

        taken = Session(gear, order, look, tell, self._stage_tolerance_m).views()
        camera_size, dmd_size = sizes[0]
        observations = Observations(
            taken, camera_size, dmd_size, self._pitches.camera_m, self._pitches.projector_m,
            _made_from(order),
        )  # fmt: skip
        folder = self._store.new_run()
        save_observations(folder / OBSERVATIONS, observations)
        count = len(taken)
        tell(Progress("solve", count, count, 0.85))
        outcome = conclude(observations, self._limits, folder, tell)
        if outcome.accepted:
            self._store.put_in_force(folder)
        tell(Progress("store", count, count, 1.0))
        return outcome

    def verify(
        self, gear: Gear, target: str, plate: Plate, sequence: str, in_force: Calibration
    ) -> VerifyOutcome:
        """Check the calibration in force on plate or flat, where the stage stands.

        Raises
        ------
        SlError
            When the check cannot be made.
        """
        check = check_rig_on(gear.take(sequence), target, plate, in_force.rig)
        folder = self._store.new_run("verify")
        bad = not check.rms_m <= self._verify_limit_m
        message = _verify_message(check, self._verify_limit_m, bad)
        write_verify_report(folder, check, self._verify_limit_m, message, in_force.hash)
        return VerifyOutcome(
            message, True, bad, check.rms_m, self._verify_limit_m, str(folder / PAGE)
        )


def _verify_message(check: Check, limit_m: float, bad: bool) -> str:
    advice = "recalibrate" if bad else "the calibration in force is good"
    return (
        f"{check.rms_m * 1e6:.3f} um rms on the {check.target} (limit {limit_m * 1e6:g} um): "
        f"{advice}; {check.words}"
    )


def _made_from(order: Order) -> dict[str, Any]:
    """Everything that a calibration was made from, plain values."""
    return {
        "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "heights_m": order.distinct,
        "plate": asdict(order.plate),
        "sequence": order.sequence,
        "software": versions(),
    }


def versions() -> dict[str, str]:
    """Versions of what computes a calibration."""
    found = {}
    for name in ("slrig", "numpy", "scipy", "opencv-python-headless", "numba"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "unknown"
    return found


def solve(observations: Observations, limits: Limits) -> Solved:
    """Solve and judge.

    Raises
    ------
    CalibrationError
        When the observations do not determine a rig.
    """
    began_s = time.perf_counter()
    holes = [
        HoleView(_stage(v), v.plate_xy_m, v.centres_px, v.centres_sigma_px)
        for v in observations.views
    ]
    targets = [TargetView(_stage(v), v.camera_px, v.dmd_px, v.dmd_sigma_px)
               for v in observations.views]  # fmt: skip
    camera = Sensor(observations.camera_size, observations.camera_pitch_m)
    projector = Sensor(observations.dmd_size, observations.dmd_pitch_m)
    solution = solve_rig(holes, targets, camera, projector, _freedom(observations.made_from))
    verdict = judge(solution.figures(lit_volume(solution)), limits)
    return Solved(observations, solution, verdict, limits, time.perf_counter() - began_s)


def lit_volume(solution: RigSolution) -> Volume:
    """Box of the triangulated targets, without the outermost that may be wrong."""
    joint = solution.joint
    used = joint.used[joint.problem.groups[1]]
    data = joint.problem.targets
    points, _ = triangulate(solution.rig, data.camera_px[used], data.pixels[used])
    low, high = np.quantile(points, (0.002, 0.998), axis=0)
    return Volume(
        (float(low[0]), float(low[1]), float(low[2])),
        (float(high[0]), float(high[1]), float(high[2])),
    )


def _stage(view: View) -> Any:
    return np.array([0.0, 0.0, view.height_m])


def _freedom(made_from: Mapping[str, Any]) -> Freedom:
    """What is estimated: with chamfered holes also how far their edges lie below the face."""
    chamfer_m = float(made_from.get("plate", {}).get("chamfer_m", 0.0))
    return Freedom(flat=FlatPrior(2 * chamfer_m, 1e-3)) if chamfer_m else Freedom()


def conclude(
    observations: Observations, limits: Limits, folder: Path, tell: Tell = lambda _: None
) -> Outcome:
    """Solve, judge, and write calibration and report into a folder.

    Raises
    ------
    CalibrationError
        When the observations do not determine a rig.
    """
    try:
        solved = solve(observations, limits)
    except CalibrationError as error:
        raise CalibrationError(f"{error} (observations kept in {folder})") from error
    count = len(observations.views)
    tell(Progress("check", count, count, 0.92))
    calibration = solved.solution.calibration(observations.made_from)
    save_calibration(folder / CALIBRATION, calibration)
    tell(Progress("store", count, count, 0.95))
    write_report(folder, solved, calibration)
    return _outcome(solved, calibration, folder)


def _outcome(solved: Solved, calibration: Calibration, folder: Path) -> Outcome:
    joint, rig = solved.solution.joint, solved.solution.rig
    camera_px, projector_px = joint.rms_px(0), joint.rms_px(1)
    accepted = solved.verdict.passed
    return Outcome(
        message=_message(solved),
        success=accepted,
        accepted=accepted,
        camera_rms_px=camera_px,
        projector_rms_px=projector_px,
        camera_rms_m=camera_px * metres_per_pixel(rig.camera),
        projector_rms_m=projector_px * metres_per_pixel(rig.projector),
        predicted_sigma_m=solved.predicted_sigma_m,
        left_out_rms_m=solved.left_out_rms_m,
        views=len(solved.observations.views),
        holes=int(joint.used[joint.problem.groups[0]].sum()),
        calibration_file=str(folder / CALIBRATION),
        report=str(folder / PAGE),
        hash=calibration.hash,
        calibration=calibration,
    )


def _message(solved: Solved) -> str:
    if not solved.verdict.passed:
        return "not accepted, the calibration in force stays: " + "; ".join(solved.verdict.reasons)
    figures = solved.verdict.figures
    return (
        f"accepted: z known to {figures['point_sigma_m'] * 1e6:.3f} um in the volume (edge noise "
        f"apart), heights left out are met within {figures['left_out_z_m'] * 1e6:.3f} um"
    )


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
