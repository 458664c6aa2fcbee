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
from dataclasses import asdict, fields, replace
from typing import Any

from sl_interfaces.msg import PatternStack

from sl_common import topics
from sl_common.base_node import Health, RigNode, Task, run
from sl_common.errors import CalibrationError, ConfigError, SlError, StackError
from sl_projector.sequence.messages import image_to_msg, stack_from_msg
from sl_projector.sequence.stack import Stack
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.measure_service_node import MeasureService
from sl_reconstruct.messages import cloud_to_msg, frames_of, report_to_msg
from sl_reconstruct.model.calibration_file import parse_calibration
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
    ScanTimeouts,
)
from sl_reconstruct.scan.scan_summary import ScanSummary
from sl_reconstruct.scan.stack_client import StackClient

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # tf2 is not among the wheels; the poses are on calibration/rig as well
    TFMessage = None

#: Stacks that may wait while one is being worked on; more would fill the memory.
MAX_WAITING = 2
NO_CALIBRATION = "no calibration is in force: run 'slrig calibrate' or name a file (--calibration)"
#: What most rigs do not need at once is compiled when the node has run so long: not in the first
#: minutes, in which everybody waits for something else.
REST_AFTER_S = 180.0

_TIMEOUTS = {
    "project_timeout_s": ("wait for the projector, s", 1.0, 3600.0),
    "silence_timeout_s": ("wait for the next frame, the verdict, the stack, s", 0.1, 600.0),
    "reconstruct_timeout_s": ("wait for the cloud, s", 1.0, 3600.0),
}
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
        self._ready = False
        self._calibration_fault = ""
        self._last = "no stack yet"
        self._clouds = self.advertise(topics.POINTS)
        self._refusals = self.advertise(topics.REFUSALS)
        self._reports = self.advertise(topics.REPORT)
        self.latch_settings(topics.SETTINGS)(self._workshop.settings.to_dict())
        self._frames = self.advertise(topics.TF_STATIC) if TFMessage else None
        self.listen(topics.CALIBRATION, self._on_calibration)
        self._client = StackClient(self, self._gap)
        self.listen(topics.FRAME, self._client.on_frame)
        self.listen(topics.STACK, self._on_stack)
        task = Task(self._scan, self._fill, _feedback)
        self._action = self.serve_task(topics.SCAN, topics.SCAN_ACTION, task)
        self._measuring = MeasureService(self)
        self._compiler = None if compiled() else compile_apart()
        self._worker.submit(self._warm_up)
        self._rest = self.create_timer(REST_AFTER_S, self._compile_rest, clock=self.steady)

    def _declare_parameters(self) -> None:
        self.declare("max_repeats", 2, "how often a spoilt scan is repeated", 0, 254, live=True)
        self._timeouts = self.declare_fields(ScanTimeouts(), _TIMEOUTS)

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
            level = "error" if self._calibration_fault else "warn"
            message = self._calibration_fault or NO_CALIBRATION
        elif not self._ready:
            level, message = "warn", "compiling; scans wait"
        values: dict[str, object] = {
            "calibration": self._workshop.calibration_hash,
            "settings": self._workshop.settings_hash,
            "compiled": self._ready,
            "last stack": self._last,
            "scanning": self._scanning.locked(),
        }
        return Health(level, message, "reconstruction", values=values)

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
        """Compile before the first stack comes."""
        try:
            if self._compiler is not None:
                self._compiler.wait()
            if self.context.ok():
                warm_up()
        except Exception as error:  # the first real stack will say it again
            self.get_logger().error(f"warm-up failed: {error!r}")
        self._ready = True
        self.get_logger().info("ready" if self._workshop.calibration_hash else NO_CALIBRATION)

    def _compile_rest(self) -> None:
        """Compile row patterns and 16-bit images apart, once and while nobody scans."""
        if self._ready and not self._scanning.locked():
            self._rest.cancel()
            if not compiled(rest=True):
                self._compiler = compile_apart(rest=True)

    # -- calibration --------------------------------------------------------------------------

    def _on_calibration(self, message: Any) -> None:
        """Take what the calibration node (or the player of a recording) says is in force."""
        if message.hash == self._workshop.calibration_hash:
            return
        source = f"{topics.CALIBRATION.name} ({message.source})"
        try:
            calibration = parse_calibration(message.yaml, source)
            if calibration.hash != message.hash:
                raise CalibrationError(
                    f"{source} says hash {message.hash[:12]}, its document has "
                    f"{calibration.hash[:12]}; expected the same"
                )
        except SlError as error:
            self._calibration_fault = str(error)
            raise
        self._workshop.calibrate(calibration)
        self._calibration_fault = ""
        if self._frames is not None:
            self._frames.publish(TFMessage(transforms=frames_of(calibration.rig)))
        self.get_logger().info(f"calibration {message.hash[:12]} of {message.source} is in force")

    # -- stacks -------------------------------------------------------------------------------

    def _on_stack(self, message: PatternStack) -> None:
        watch = self._client.watch_of(message.scan_id)
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

    def _finish(self, scan_id: int, result: Any) -> None:
        if watch := self._client.watch_of(scan_id):
            watch.finished(result)

    def _process(self) -> None:
        """Reconstruct, publish, report; runs in the worker's thread."""
        stack, came_ns = self._stacks.popleft()
        try:
            summary = self._reconstruct(stack, came_ns)
        except SlError as error:
            self.complain(topics.STACK.name, error)
            self._last = f"scan {stack.scan_id}: {error}"
            self._finish(stack.scan_id, error)
        except Exception as error:  # a fault of ours is the scan's answer, not the node's end
            self.complain(topics.STACK.name, error)
            self._finish(stack.scan_id, StackError(f"internal fault: {error!r}"))
        else:
            self._last = f"scan {stack.scan_id}: {summary.points} points"
            self._finish(stack.scan_id, summary)
        finally:
            self._waiting.release()

    def _reconstruct(self, stack: Stack, came_ns: int) -> ScanSummary:
        if not self._workshop.calibration_hash:
            raise CalibrationError(self._calibration_fault or NO_CALIBRATION)
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
        summary = ScanSummary.of(
            product,
            stack,
            attempts=1,
            acquisition_s=max(0.0, (came_ns - stamp_ns) * 1e-9),
            processing_s=(done_ns - came_ns) * 1e-9,
        )
        self._reports.publish(report_to_msg(summary))
        self.get_logger().info(
            f"scan {stack.scan_id}: {summary.points} points {summary.processing_s:.3f} s after the "
            f"last image, {computed_s:.3f} s of it reconstruction"
        )
        return summary

    # -- scans --------------------------------------------------------------------------------

    def _scan(
        self, request: Any, tell: Callable[[ScanProgress], None], cancelled: Callable[[], bool]
    ) -> ScanResult:
        if not self._scanning.acquire(blocking=False):
            return ScanResult(False, "a scan is running already; wait for it or cancel it")
        try:
            return self._client.take(self._order(request), tell, cancelled, self._timeouts)
        except ConfigError as error:
            return ScanResult(False, str(error))
        except Exception as error:  # the caller gets an answer whatever happens
            self.get_logger().error(f"scan failed: {error!r}")
            return ScanResult(False, f"internal fault: {error!r}")
        finally:
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
        summary = replace(
            result.report or ScanSummary(result.scan_id),
            attempts=len(result.attempt_messages) + (1 if result.scan_id else 0),
            attempt_messages=tuple(result.attempt_messages),
        )
        response.success, response.message = result.success, result.message
        response.report = report_to_msg(summary)
        if result.success:
            response.message = (
                f"{summary.points} points of {summary.lit_positions} lit positions, "
                f"median sigma {summary.median_sigma_m * 1e6:.2f} um"
            )
        else:
            self.get_logger().error(f"scan failed: {result.message}")
        return response

    def _gap(self) -> str:
        """Say what a scan lacks here; see `StackClient`."""
        return NO_CALIBRATION if self._ready and not self._workshop.calibration_hash else ""


def _feedback(progress: ScanProgress) -> dict[str, Any]:
    return asdict(progress) | {"progress": float(progress.fraction)}


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run(ReconstructNode, args)


if __name__ == "__main__":
    main()
