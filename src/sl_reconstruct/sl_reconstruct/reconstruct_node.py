"""The reconstruction's node: stacks become clouds, and scans are conducted on request.

A stack that nobody asked for here (someone called `projector/project`, a bag is played) is
reconstructed and published too. One worker thread reconstructs, one conducts the scan; the
executor's thread only hands over.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from sl_interfaces.action import Scan
from sl_interfaces.msg import MatchedFrame, PatternStack, RigCalibration, ScanReport

from sl_common import topics
from sl_common.base_node import Health, RigNode, next_scan_id, run
from sl_common.errors import CalibrationError, ConfigError, SlError, StackError
from sl_common.messages import stamp_from_msg
from sl_projector.sequence.messages import image_to_msg, stack_from_msg
from sl_projector.sequence.stack import Stack
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.measure_service_node import MeasureService
from sl_reconstruct.messages import cloud_to_msg, frames_of, report_to_msg, rig_to_msg
from sl_reconstruct.model.calibration_file import Calibration, load_calibration, parse_calibration
from sl_reconstruct.projector_client_node import ProjectorClient
from sl_reconstruct.reconstruction.reconstructor_cache import (
    Workshop,
    compile_apart,
    compiled,
    warm_up,
)
from sl_reconstruct.reconstruction.scan_quality import verdict
from sl_reconstruct.scan.scan_flow import (
    ScanFailed,
    ScanProgress,
    ScanRequest,
    ScanResult,
    ScanRun,
    ScanTimeouts,
    ScanWatch,
)

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # tf2 is not among the wheels; the poses are on calibration/rig as well
    TFMessage = None

#: Stacks that may wait while one is being worked on; more would fill the memory.
MAX_WAITING = 2
#: What most rigs do not need at once is compiled when the node has run so long: not in the first
#: minutes, in which everybody waits for something else.
REST_AFTER_S = 180.0

_SETTINGS = {
    "estimator": "matched, or cubic: the paper's third-order fit with secant and centres by BR8",
    "edge_blur_px": "standard deviation of an edge's blur, camera px; 0: measured in each stack",
    "min_contrast_dn": "least difference of lit and unlit at an edge; 0: 3 % of the full scale",
    "saturation_dn": "values from here on are saturated; 0: the full scale that the values show",
    "max_jump_px": "an edge lies at most so far from where its neighbours lead, camera px",
    "min_slope": "least slope of an edge over the one that the blur makes expect",
    "max_slope": "greatest slope of an edge over the one that the blur makes expect",
    "min_light": "least light under an edge as a part of its brighter side's",
    "max_gap_px": "greatest distance of the two rays of a point with rows, px; 0: any",
    "max_light_change": "an image is at most so much brighter or darker than its like, a part",
}


class ReconstructNode(RigNode):
    """Turns stacks into clouds and conducts scans."""

    def __init__(self, **options: Any) -> None:
        super().__init__("reconstruct", **options)
        self._declare_parameters()
        self._workshop = Workshop(self._declare_settings())
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="reconstruct")
        self._waiting = threading.Semaphore(MAX_WAITING + 1)
        self._stacks: deque[tuple[Stack, int]] = deque()
        self._scanning = threading.Lock()
        self._watch: ScanWatch | None = None
        self._last_id = 0
        self._ready = False
        self._in_force_since_ns = 0
        self._calibration_fault = "no calibration yet"
        self._last = "no stack yet"
        self._clouds = self.advertise(topics.POINTS)
        self._refusals = self.advertise(topics.REFUSALS)
        self._reports = self.advertise(topics.REPORT)
        self._rigs = self.advertise(topics.CALIBRATION)
        self.latch_settings(topics.SETTINGS)(self._workshop.settings.to_dict())
        self._frames = self.advertise(topics.TF_STATIC) if TFMessage else None
        self.listen(topics.CALIBRATION, self._on_rig)
        self.listen(topics.FRAME, self._on_frame)
        self.listen(topics.STACK, self._on_stack)
        self._offer_scan()
        self._measuring = MeasureService(self)
        self.add_on_set_parameters_callback(self._on_parameters)
        self._compiler = None if compiled() else compile_apart()
        self._worker.submit(self._warm_up)
        self._rest = self.create_timer(REST_AFTER_S, self._compile_rest, clock=self.steady)

    def _offer_scan(self) -> None:
        self._projector = ProjectorClient(self)
        self.serve(topics.SCAN, self._serve_scan)
        self._action = self.serve_action(topics.SCAN_ACTION, self._execute_scan)

    def _declare_parameters(self) -> None:
        self._file = self.declare("calibration_file", "", "calibration of the rig", live=True)
        self.declare("max_repeats", 2, "how often a spoilt scan is repeated", 0, 254, live=True)
        default = ScanTimeouts()
        self._timeouts = ScanTimeouts(
            project_s=self.declare(
                "project_timeout_s", default.project_s, "wait for the projector, s", 1.0, 3600.0
            ),
            silence_s=self.declare(
                "silence_timeout_s", default.silence_s,
                "wait for the next frame, the verdict, the stack, s", 0.1, 600.0,
            ),
            reconstruct_s=self.declare(
                "reconstruct_timeout_s", default.reconstruct_s, "wait for the cloud, s", 1.0, 3600.0
            ),
        )  # fmt: skip

    def _declare_settings(self) -> Settings:
        """Settings from parameters; 0 stands for those that are measured or derived."""
        values: dict[str, Any] = {}
        for item in fields(Settings):
            text = _SETTINGS.get(item.name, "see the settings' documentation")
            zero = 0 if "int" in str(item.type) else 0.0
            given = self.declare(item.name, zero if item.default is None else item.default, text)
            values[item.name] = None if item.default is None and not given else given
        return Settings(**values)

    def health(self) -> Health:
        """Whether a scan could be made."""
        level, message = "ok", "ready"
        if not self._workshop.calibration_hash:
            level, message = ("error" if self._file else "warn"), self._calibration_fault
        elif not self._ready:
            level, message = "warn", "compiling; scans wait"
        values: dict[str, object] = {
            "calibration": self._workshop.calibration_hash,
            "settings": self._workshop.settings_hash,
            "compiled": self._ready,
            "last stack": self._last,
            "scanning": self._scanning.locked(),
        }
        return Health(level, message, "reconstruction", self._file, values)

    def close(self) -> None:
        """Let the stack that is being worked on end, forget the others."""
        self._stop_compiler()
        self._worker.shutdown(wait=True, cancel_futures=True)
        self._stop_compiler()
        self._action.destroy()
        super().close()

    def _stop_compiler(self) -> None:
        if self._compiler is not None:
            self._compiler.terminate()
            self._compiler.wait()

    def _warm_up(self) -> None:
        """Compile before the first stack comes; then the calibration, so that ready means ready."""
        if self._file:
            self._read_calibration()
        try:
            if self._compiler is not None:
                self._compiler.wait()
            if self.context.ok():
                warm_up()
        except Exception as error:  # the first real stack will say it again
            self.get_logger().error(f"warm-up failed: {error!r}")
        self._ready = True
        self.get_logger().info(
            "ready" if self._workshop.calibration_hash else self._calibration_fault
        )

    def _compile_rest(self) -> None:
        """Compile row patterns and 16-bit images apart, once and while nobody scans."""
        if self._ready and not self._scanning.locked():
            self._rest.cancel()
            if not compiled(rest=True):
                self._compiler = compile_apart(rest=True)

    # -- calibration --------------------------------------------------------------------------

    def _read_calibration(self) -> None:
        """Put the file's calibration in force; a bad one is told and changes nothing."""
        try:
            path = Path(self._file)
            calibration = load_calibration(path)
            self._put_in_force(calibration, str(path), path.stat().st_mtime_ns)
        except (SlError, OSError) as error:
            self._calibration_fault = str(error)
            self.complain("calibration_file", error)

    def _put_in_force(self, calibration: Calibration, source: str, stamp_ns: int) -> None:
        self._workshop.calibrate(calibration)
        self._in_force_since_ns = stamp_ns
        self._calibration_fault = ""
        self._rigs.publish(rig_to_msg(calibration, source, stamp_ns))
        if self._frames is not None:
            self._frames.publish(TFMessage(transforms=frames_of(calibration.rig)))
        self.get_logger().info(f"calibration {calibration.hash[:12]} of {source} is in force")

    def _on_rig(self, message: RigCalibration) -> None:
        """Take the calibration that came in force last, whoever published it."""
        stamp_ns = stamp_from_msg(message.header.stamp)
        if message.hash == self._workshop.calibration_hash or stamp_ns <= self._in_force_since_ns:
            return
        calibration = parse_calibration(
            message.yaml, f"{topics.CALIBRATION.name} ({message.source})"
        )
        if calibration.hash != message.hash:
            raise CalibrationError(
                f"{topics.CALIBRATION.name} says hash {message.hash[:12]}, its document has "
                f"{calibration.hash[:12]}; expected the same"
            )
        self._put_in_force(calibration, message.source, stamp_ns)

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Read a new calibration file at once; a bad one is refused, the old one stays."""
        for parameter in parameters:
            if parameter.name == "calibration_file":
                try:
                    calibration = load_calibration(parameter.value)
                except SlError as error:
                    return SetParametersResult(successful=False, reason=str(error))
                self._file = parameter.value
                self._put_in_force(calibration, self._file, time.time_ns())
        return SetParametersResult(successful=True)

    # -- stacks -------------------------------------------------------------------------------

    def _on_frame(self, message: MatchedFrame) -> None:
        watch = self._watch
        if watch is None or message.scan_id != watch.scan_id:
            return
        if message.status == MatchedFrame.MATCHED:
            watch.matched(message.index, message.count)
        elif message.status in (MatchedFrame.STACK_COMPLETE, MatchedFrame.STACK_REFUSED):
            watch.decided(message.status == MatchedFrame.STACK_COMPLETE, message.reason)
        else:
            watch.sign()

    def _on_stack(self, message: PatternStack) -> None:
        watch = self._watch_of(message.scan_id)
        if watch is None and not self._clouds.get_subscription_count():
            self._last = f"scan {message.scan_id}: not asked for here, and nobody listens"
            return
        came_ns = watch.last_image_ns if watch and watch.last_image_ns else time.time_ns()
        if watch:
            watch.arrived()
        if not self._waiting.acquire(blocking=False):
            raise StackError(
                f"stack of scan {message.scan_id} thrown away: {MAX_WAITING} more are waiting "
                "to be reconstructed already"
            )
        try:
            stack = stack_from_msg(message)
        except SlError as error:
            self._waiting.release()
            self._finish(message.scan_id, error)
            raise
        self._stacks.append((stack, came_ns))
        self._worker.submit(self._process)

    def _watch_of(self, scan_id: int) -> ScanWatch | None:
        watch = self._watch
        return watch if watch is not None and watch.scan_id == scan_id else None

    def _finish(self, scan_id: int, result: Any) -> None:
        if watch := self._watch_of(scan_id):
            watch.finished(result)

    def _process(self) -> None:
        """Reconstruct, publish, report; runs in the worker's thread."""
        stack, came_ns = self._stacks.popleft()
        try:
            report = self._reconstruct(stack, came_ns)
        except SlError as error:
            self.complain(topics.STACK.name, error)
            self._last = f"scan {stack.scan_id}: {error}"
            self._finish(stack.scan_id, error)
        except Exception as error:  # a fault of ours is the scan's answer, not the node's end
            self.complain(topics.STACK.name, error)
            self._finish(stack.scan_id, StackError(f"internal fault: {error!r}"))
        else:
            self._last = f"scan {stack.scan_id}: {report.points} points"
            self._finish(stack.scan_id, report)
        finally:
            self._waiting.release()

    def _reconstruct(self, stack: Stack, came_ns: int) -> ScanReport:
        if not self._workshop.calibration_hash and self._file:
            self._read_calibration()
        if not self._workshop.calibration_hash:
            raise CalibrationError(f"no calibration is in force: {self._calibration_fault}")
        began_s = time.perf_counter()
        # The images are let go before the cloud is published, which needs as much memory again.
        product = self._workshop(stack.release_images(), stack.sequence)
        computed_s = time.perf_counter() - began_s
        good, reasons = verdict(product.cloud)
        if not good:
            raise ScanFailed(f"no cloud is published: {'; '.join(reasons)}")
        stamp_ns = stack.stamps_ns[0]
        self._refusals.publish(image_to_msg(product.cloud.reason, stamp_ns))
        self._clouds.publish(cloud_to_msg(product.cloud.points, stamp_ns))
        self._measuring.remember(product.cloud.points, stamp_ns)
        done_ns = time.time_ns()
        report = report_to_msg(product, stack)
        report.processing_s = (done_ns - came_ns) * 1e-9
        report.acquisition_s = max(0.0, (came_ns - stamp_ns) * 1e-9)
        self._reports.publish(report)
        self.get_logger().info(
            f"scan {stack.scan_id}: {report.points} points {report.processing_s:.3f} s after the "
            f"last image, {computed_s:.3f} s of it reconstruction"
        )
        return report

    # -- scans --------------------------------------------------------------------------------

    async def _serve_scan(self, request: Any, response: Any) -> Any:
        result = await self.in_worker(
            lambda: self._scan(request, lambda _: None, self._shutting_down)
        )
        return self._fill(response, result)

    async def _execute_scan(self, goal: Any) -> Any:
        def tell(progress: ScanProgress) -> None:
            goal.publish_feedback(_feedback(progress))

        def cancelled() -> bool:
            return bool(goal.is_cancel_requested) or self._shutting_down()

        result = await self.in_worker(lambda: self._scan(goal.request, tell, cancelled))
        if result.success:
            goal.succeed()
        elif result.cancelled and goal.is_cancel_requested:
            goal.canceled()
        else:
            goal.abort()
        return self._fill(Scan.Result(), result)

    def _shutting_down(self) -> bool:
        return not self.context.ok()

    def _scan(
        self, request: Any, tell: Callable[[ScanProgress], None], cancelled: Callable[[], bool]
    ) -> ScanResult:
        if not self._scanning.acquire(blocking=False):
            return ScanResult(False, "a scan is running already; wait for it or cancel it")
        try:
            run_ = ScanRun(self, self._order(request), tell, cancelled, self._timeouts)
            return run_.run()
        except ConfigError as error:
            return ScanResult(False, str(error))
        except Exception as error:  # the caller gets an answer whatever happens
            self.get_logger().error(f"scan failed: {error!r}")
            return ScanResult(False, f"internal fault: {error!r}")
        finally:
            self._watch = None
            self._scanning.release()

    def _order(self, request: Any) -> ScanRequest:
        if not 0.0 <= request.exposure_s <= 16.0:
            raise ConfigError(f"exposure_s={request.exposure_s}; expected 0 (default) to 16 s")
        repeats = request.max_repeats
        if repeats == 255:
            repeats = int(self.get_parameter("max_repeats").value)
        return ScanRequest(request.sequence, request.exposure_s, repeats)

    def _fill(self, response: Any, result: ScanResult) -> Any:
        """Put a result into a service's response or an action's result."""
        report = result.report or ScanReport(scan_id=result.scan_id)
        report.attempt_messages = result.attempt_messages
        report.attempts = len(result.attempt_messages) + (1 if result.scan_id else 0)
        response.success, response.message, response.report = result.success, result.message, report
        if result.success:
            response.message = (
                f"{report.points} points of {report.lit_positions} lit positions, "
                f"median sigma {report.median_sigma_m * 1e6:.2f} um"
            )
        else:
            self.get_logger().error(f"scan failed: {result.message}")
        return response

    # -- what a scan needs of the graph (`scan_flow.ScanDevices`) -----------------------

    def begin(self) -> ScanWatch:
        """Take a number that no scan had."""
        self._last_id = next_scan_id(self._last_id)
        self._watch = ScanWatch(self._last_id)
        return self._watch

    def missing(self, patience_s: float) -> str:
        """Name what a scan cannot do without and nobody offers, even after a while."""
        deadline_s = time.monotonic() + patience_s
        while (gap := self._gap()) and time.monotonic() < deadline_s and self.context.ok():
            time.sleep(0.05)
        return gap

    def _gap(self) -> str:
        if gap := self._projector.gap():
            return gap
        for topic in (topics.IMAGE, topics.STACK):
            if not self.count_publishers(topic.name):
                return f"nobody publishes {topic.name}: is the {topic.node} node running?"
        if self._ready and not self._workshop.calibration_hash and not self._file:
            return (
                "no calibration is in force: run 'slrig calibrate' or name a file (--calibration)"
            )
        return ""

    def project(self, watch: ScanWatch, order: ScanRequest) -> None:
        """Ask the projector; the watch is told when it has answered."""
        self._projector.project(watch, order)

    def stop_projecting(self) -> None:
        """Ask the projector to stop; its answer is of no interest."""
        self._projector.stop()


def _feedback(progress: ScanProgress) -> Any:
    return Scan.Feedback(
        stage=progress.stage,
        attempt=progress.attempt,
        frames=progress.frames,
        count=progress.count,
        progress=float(progress.fraction),
    )


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run(ReconstructNode, args)


if __name__ == "__main__":
    main()
