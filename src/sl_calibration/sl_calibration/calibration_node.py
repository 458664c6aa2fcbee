"""The calibration's node: calibrates the rig on request, checks it, and says what is in force.

One run at a time, in a worker's thread; the executor's thread only hands over. A calibration that
is not accepted, a run that fails or is cancelled, leave the one in force as it is.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from std_msgs.msg import String

from sl_calibration.acquisition_node import AcquisitionSettings, GraphDevices
from sl_calibration.data.run_store import Store, default_directory
from sl_calibration.data.session import CalibrationProgress, CalibrationRequest
from sl_calibration.solve.acceptance import Limits
from sl_calibration.target.plate import DEFAULT_PLATE, Plate
from sl_calibration.verify.rig_check import VerifyLimits
from sl_calibration.workflow.calibrator import Calibrator, InForce, VerifyOutcome, VerifyRequest
from sl_calibration.workflow.conclusion import Outcome
from sl_calibration.workflow.run_record import Pitches
from sl_calibration.workflow.warm_up import warm_up_apart
from sl_common import topics
from sl_common.base_node import Health, RigNode, Task, run
from sl_common.errors import CalibrationError, SlError
from sl_reconstruct.messages import rig_to_msg
from sl_reconstruct.model.calibration_file import Calibration, load_calibration
from sl_reconstruct.scan.scan_flow import ScanTimeouts

_LimitsT = TypeVar("_LimitsT", Limits, VerifyLimits)

NOT_CALIBRATED = "not calibrated"
#: A calibration file that is not there yet, or is not whole, is looked for again after this.
RETRY_S = 1.0
_ACQUISITION = {
    "max_repeats": ("how often a spoilt stack is repeated", 0, 9),
    "move_timeout_s": ("wait for the stage, s", 1.0, 3600.0),
    "settle_s": ("rest after a move before anything is exposed, s", 0.0, 60.0),
}
_TIMEOUTS = {
    "project_timeout_s": ("wait for the projector, s", 1.0, 3600.0),
    "silence_timeout_s": ("wait for the next frame, s", 0.1, 600.0),
}
_MARK = "diameter of the one hole that marks the origin, m; 0: no mark"
_TRAVEL = "x and y travel of two views that tell squareness; 0: none, m"
_FILE = "in force at the start; empty: the last accepted in store_dir"
_HEIGHTS_M = [-1e-3, -0.5e-3, 0.0, 0.5e-3, 1e-3]


class CalibrationNode(RigNode):
    """Offers ``calibration/calibrate`` (service and action) and ``calibration/verify``."""

    def __init__(self, **options: Any) -> None:
        super().__init__("calibration", **options)
        self._declare_parameters()
        self._calibrator = self._make_calibrator()
        self._running = threading.Lock()
        self._in_force: Calibration | None = None
        self._source = ""
        self._fault = ""
        self._last = "no run yet"
        self._rigs = self.advertise(topics.CALIBRATION)
        self._load()
        if self._file:
            self._retry = self.create_timer(RETRY_S, self._load, clock=self.steady)
        self.add_on_set_parameters_callback(self._on_parameters)
        task = Task(self._calibrate, fill, _feedback)
        self._action = self.serve_task(topics.CALIBRATE, topics.CALIBRATE_ACTION, task)
        self.serve(topics.VERIFY, self._serve_verify)
        self._compiler = warm_up_apart()

    # -- parameters -----------------------------------------------------------------------------

    def _declare_parameters(self) -> None:
        folder = self.declare("store_dir", "", "folder of calibrations; empty: the user's")
        self._store = Store(Path(folder or default_directory()).expanduser())
        self._file = self.declare("calibration_file", "", _FILE, live=True)
        self.declare("heights_m", _HEIGHTS_M, "stage heights of the views, m", live=True)
        self.declare("sequence", "precise-rows", "patterns, both axes", live=True)
        self._declare_plate()
        self._pitches = Pitches(
            self.declare("camera_pitch_m", 11.4e-6, "pixel pitch, for reports, m", 3e-7, 2e-4),
            self.declare("projector_pitch_m", 13.68e-6, "mirror pitch, for reports, m", 3e-7, 2e-4),
        )
        self._stage_tolerance_m = self.declare(
            "stage_tolerance_m", 5e-6, "the stage stands where it was sent within, m", 1e-7, 1e-3
        )
        self._travel_m = self.declare("travel_m", 0.5e-3, _TRAVEL, 0.0, 0.1)
        self._limits = self._declare_limits(Limits(), "limit", "acceptance")
        self._verify_limits = self._declare_limits(VerifyLimits(), "verify_limit", "verify")
        settings = self.declare_fields(AcquisitionSettings(), _ACQUISITION)
        timeouts = self.declare_fields(ScanTimeouts(), _TIMEOUTS)
        self._devices = GraphDevices(self, settings, timeouts)

    def _declare_plate(self) -> None:
        plate = DEFAULT_PLATE
        for name, value, text, *span in (
            ("columns", plate.columns, "holes along x", 3, 200),
            ("rows", plate.rows, "holes along y", 3, 200),
            ("pitch_m", plate.pitch_m, "pitch of the holes, m", 0.0, 1.0),
            ("diameter_m", plate.diameter_m, "diameter of the holes, m", 0.0, 1.0),
            ("origin_diameter_m", plate.origin_diameter_m or 0.0, _MARK, 0.0, 1.0),
            ("origin_column", plate.origin_id[0], "column of the mark", 0, 199),
            ("origin_row", plate.origin_id[1], "row of the mark", 0, 199),
            ("chamfer_m", 0.0, "width of the holes' chamfers, m", 0.0, 1.0),
            ("dark_holes", True, "dark holes in a bright plate; false: bright dots"),
        ):
            low, high = span or (None, None)
            self.declare(f"plate_{name}", value, text, low, high, live=True)

    def _declare_limits(self, default: _LimitsT, prefix: str, what: str) -> _LimitsT:
        """Limits of acceptance or of a check, each a parameter of its own."""
        about = {item.name: (f"{what}: largest {item.name}",) for item in fields(default)}
        return self.declare_fields(default, about, f"{prefix}_")

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _make_calibrator(self) -> Calibrator:
        self._runs = self.advertise(topics.CALIBRATION_RUN)
        return Calibrator(
            self._store, self._limits, self._pitches, self._stage_tolerance_m, self._verify_limits,
            record=self._publish_run,
        )  # fmt: skip

    def _publish_run(self, run: Mapping[str, Any]) -> None:
        """Say as JSON what a run was: a recording then holds what it takes to solve it again."""
        self._runs.publish(String(data=json.dumps(run)))

    # -- the calibration in force -----------------------------------------------------------------

    def _load(self) -> None:
        """Put the named file, else the last accepted run, in force as soon as it is there."""
        if self._in_force is not None:
            self._retry.cancel()
            return
        try:
            path = Path(self._file) if self._file else self._store.current()
            if path is None:
                return
            calibration = load_calibration(path)
            since_ns = path.stat().st_mtime_ns if self._file else self._store.in_force_since_ns()
            self._put_in_force(calibration, str(path), since_ns)
        except (SlError, OSError) as error:
            if str(error) != self._fault:
                self._fault = str(error)
                self.complain("stored calibration", error)

    def _put_in_force(self, calibration: Calibration, source: str, since_ns: int) -> None:
        self._in_force, self._source, self._fault = calibration, source, ""
        self._rigs.publish(rig_to_msg(calibration, source, since_ns))
        self.get_logger().info(f"calibration {calibration.hash[:12]} of {source} is in force")

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Put a newly named file in force at once; a bad one is refused, the old one stays."""
        for parameter in parameters:
            if parameter.name == "calibration_file":
                try:
                    calibration = load_calibration(parameter.value)
                except SlError as error:
                    return SetParametersResult(successful=False, reason=str(error))
                self._file = parameter.value
                self._put_in_force(calibration, self._file, time.time_ns())
        return SetParametersResult(successful=True)

    def health(self) -> Health:
        """What is in force, and what is being done."""
        calibration = self._in_force
        # Without a calibration, or with a spoilt store, the node is ready to calibrate.
        level = "error" if self._file and not calibration else "ok"
        message = "ready" if calibration else f"ready; {self._fault or NOT_CALIBRATED}"
        if self._running.locked():
            message = "a run is going on"
        values: dict[str, object] = {
            "calibration": calibration.hash if calibration else "",
            "source": self._source,
            "last run": self._last,
            "store": str(self._store.directory),
        }
        return Health(level, message, "calibration", str(self._store.directory), values)

    def close(self) -> None:
        """End; a run that is going on is cancelled, since the context is gone."""
        self._action.destroy()
        self._compiler.terminate()
        self._compiler.wait()
        super().close()

    # -- calibrate --------------------------------------------------------------------------------

    def _calibrate(
        self,
        request: Any,
        tell: Callable[[CalibrationProgress], None],
        cancelled: Callable[[], bool],
    ) -> Outcome:
        def work() -> Outcome:
            order = self._order(request)
            self._await_compiler(cancelled)
            with self._devices.in_use(cancelled) as devices:
                return self._calibrator.calibrate(
                    devices, order, self._stands(), tell, str(request.keep)
                )

        outcome: Outcome = self._alone(work, Outcome)
        if outcome.success and outcome.calibration is not None:
            self._put_in_force(outcome.calibration, outcome.calibration_file, time.time_ns())
        return outcome

    def _stands(self) -> InForce | None:
        return InForce(self._in_force, self._source) if self._in_force else None

    def _await_compiler(self, cancelled: Callable[[], bool]) -> None:
        """Let the first start on a machine compile once, not twice at the same time."""
        while self._compiler.poll() is None and not cancelled():
            time.sleep(0.05)

    def _alone(self, work: Callable[[], Any], failed: Callable[..., Any]) -> Any:
        """Do one run at a time; what goes wrong is its answer."""
        if not self._running.acquire(blocking=False):
            return failed(message="a run is going on already; wait for it or cancel it")
        try:
            outcome = work()
        except SlError as error:
            outcome = failed(message=str(error))
        except Exception as error:  # the caller gets an answer whatever happens
            self.get_logger().error(f"calibration failed: {error!r}")
            outcome = failed(message=f"internal fault: {error!r}")
        finally:
            self._running.release()
        self._last = outcome.message
        self.say(outcome.message)
        return outcome

    def _order(self, request: Any) -> CalibrationRequest:
        heights = [float(h) for h in request.heights_m] or list(self._value("heights_m"))
        plate = self._plate(request)
        sequence = request.sequence or str(self._value("sequence"))
        return CalibrationRequest(
            request.target or "both", tuple(heights), plate, sequence, self._travel_m
        )

    def _plate(self, request: Any = None) -> Plate:
        """Plate of the parameters; what a request names is the request's."""

        def number(name: str) -> Any:
            asked = getattr(request, name, 0)
            if not (math.isfinite(asked) and asked >= 0):
                raise CalibrationError(f"{name}={asked}; expected a positive number or 0")
            return asked or self._value(name)

        return Plate(
            columns=number("plate_columns"),
            rows=number("plate_rows"),
            pitch_m=number("plate_pitch_m"),
            diameter_m=number("plate_diameter_m"),
            dark_holes=bool(self._value("plate_dark_holes")),
            origin_diameter_m=self._value("plate_origin_diameter_m") or None,
            origin_id=(self._value("plate_origin_column"), self._value("plate_origin_row")),
            chamfer_m=self._value("plate_chamfer_m"),
        )

    # -- verify -----------------------------------------------------------------------------------

    async def _serve_verify(self, request: Any, response: Any) -> Any:
        def work() -> VerifyOutcome:
            heights_m, sequence = tuple(map(float, request.heights_m)), str(self._value("sequence"))
            asked = VerifyRequest(request.target or "plate", heights_m, self._plate(), sequence)
            in_force = self._stands()
            if in_force is None:
                raise CalibrationError(f"nothing to verify: {self._fault or NOT_CALIBRATED}")
            self._await_compiler(self.shutting_down)
            with self._devices.in_use(self.shutting_down) as devices:
                return self._calibrator.verify(devices, asked, in_force)

        outcome = await self.in_worker(lambda: self._alone(work, VerifyOutcome))
        for item in fields(VerifyOutcome):
            setattr(response, item.name, getattr(outcome, item.name))
        return response


#: Figures of an outcome that service and action answer with under the same names.
_ANSWERS = (
    "success", "accepted", "message", "camera_rms_px", "projector_rms_px", "camera_rms_m",
    "projector_rms_m", "predicted_sigma_m", "left_out_rms_m", "views", "holes",
    "calibration_file", "report", "hash", "stage_z_scale", "stage_z_lean_rad",
    "stage_squareness_rad",
)  # fmt: skip


def fill(response: Any, outcome: Outcome) -> Any:
    """Put an outcome into a service's response or an action's result.

    Parameters
    ----------
    response : object
        The message that is filled.
    outcome : Outcome
        How the run ended.
    """
    for name in _ANSWERS:
        setattr(response, name, getattr(outcome, name))
    return response


def _feedback(progress: CalibrationProgress) -> dict[str, Any]:
    found = asdict(progress)
    return found | {"progress": float(found.pop("fraction"))}


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run(CalibrationNode, args)


if __name__ == "__main__":
    main()
