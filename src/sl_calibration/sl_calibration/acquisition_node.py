"""What a calibration asks of the graph: move the stage, project, bring the images.

Not a node of its own; it works for the calibration's node, in a thread beside the executor's.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import Point

from sl_calibration.data.session import Place, RunCancelled, in_words
from sl_common import topics
from sl_common.base_node import RigNode
from sl_common.errors import CalibrationError, DeviceError, DeviceTimeout, SlError
from sl_common.messages import stamp_from_msg
from sl_projector.sequence.messages import stack_from_msg
from sl_projector.sequence.stack import Stack
from sl_reconstruct.scan.scan_flow import ScanRequest, ScanTimeouts
from sl_reconstruct.scan.stack_client import StackClient

#: A stage that is there answers a question about its travel within this.
_ANSWER_S = 5.0
_POLL_S = 0.02
#: Pause before a spoilt stack is repeated, longer each time: what spoilt it is to be over.
REST_S = 2.0
#: Publishers and services of a graph that has just started are found within this.
_DISCOVERY_S = 10.0


@dataclass(frozen=True)
class AcquisitionSettings:
    """How views are taken.

    Parameters
    ----------
    max_repeats : int
        How often a spoilt stack is repeated.
    move_timeout_s : float
        Longest move of the stage.
    settle_s : float
        Rest after a move before anything is exposed.
    """

    max_repeats: int = 4
    move_timeout_s: float = 120.0
    settle_s: float = 0.2


class GraphDevices:
    """Drives stage and projector by their services and listens to the synchroniser.

    It is `session.CalibrationDevices`.

    Parameters
    ----------
    node : RigNode
        Whose clients and subscriptions these are.
    settings : AcquisitionSettings
        Patience with the stage, and with spoilt stacks.
    timeouts : ScanTimeouts
        Patience with each stack.
    """

    def __init__(
        self, node: RigNode, settings: AcquisitionSettings, timeouts: ScanTimeouts
    ) -> None:
        self._node, self._settings, self._timeouts = node, settings, timeouts
        self._move = node.client(topics.MOVE_STAGE)
        self._stop_stage = node.client(topics.STOP_STAGE)
        self._stacks = StackClient(node)
        self._cancelled: Callable[[], bool] = lambda: False
        self._pose_ns = 0

    @contextmanager
    def in_use(self, cancelled: Callable[[], bool]) -> Iterator[GraphDevices]:
        """Listen to the synchroniser for one run; its stacks are too large to listen always."""
        self._cancelled = cancelled
        subscriptions = [
            self._node.listen(topics.FRAME, self._stacks.on_frame),
            self._node.listen(topics.STACK, self._on_stack),
            self._node.listen(topics.POSE, self._on_pose),
        ]
        try:
            self._await_publishers(subscriptions)
            yield self
        finally:
            self._forget(subscriptions)

    def _await_publishers(self, subscriptions: list[Any]) -> None:
        end_s = time.monotonic() + _DISCOVERY_S
        while not all(s.get_publisher_count() for s in subscriptions):
            if time.monotonic() > end_s:
                missing = [s.topic_name for s in subscriptions if not s.get_publisher_count()]
                raise CalibrationError(
                    f"nobody publishes {' and '.join(missing)}: are synchronizer and stage running?"
                )
            self._pause()

    def _forget(self, subscriptions: list[Any]) -> None:
        """End the subscriptions in the executor's thread, where nobody uses them meanwhile."""
        executor = self._node.executor
        if executor is None or not self._node.context.ok():
            return
        done = threading.Event()

        def destroy() -> None:
            for subscription in subscriptions:
                self._node.destroy_subscription(subscription)
            done.set()

        executor.create_task(destroy)
        done.wait(_ANSWER_S)

    def _pause(self) -> None:
        if self._cancelled():
            raise RunCancelled("calibration cancelled")
        time.sleep(_POLL_S)

    # -- stage ----------------------------------------------------------------------------------

    def where(self) -> Place:
        """Where the stage stands now, metres."""
        return _position(self._ask((0.0, 0.0, 0.0), relative=True, check_only=True).pose)

    def check(self, place: Place) -> None:
        """Refuse a place outside the travel."""
        try:
            self._ask(place, check_only=True)
        except DeviceError as error:
            raise CalibrationError(
                f"the stage does not reach {in_words(place)}: {error}"
            ) from error

    def move(self, place: Place) -> Place:
        """Move, and wait until the stage has told anew that it stands.

        Exposures are matched with the poses told before and after them; one from before the
        move would make the synchroniser believe that the stage moved meanwhile.
        """
        reply = self._ask(place)
        settled_ns = stamp_from_msg(reply.pose.header.stamp) + round(self._settings.settle_s * 1e9)
        end_s = time.monotonic() + self._settings.settle_s + _ANSWER_S
        while self._pose_ns < settled_ns:
            if time.monotonic() > end_s:
                raise DeviceTimeout(f"{topics.POSE.name} is silent: is the stage node running?")
            self._pause()
        return _position(reply.pose)

    def _on_pose(self, message: Any) -> None:
        self._pose_ns = stamp_from_msg(message.header.stamp)

    def _ask(self, place: Place, relative: bool = False, check_only: bool = False) -> Any:
        """Ask the stage node; what it refuses is raised with its reason."""
        if not self._move.wait_for_service(timeout_sec=_DISCOVERY_S):
            raise DeviceError(f"nobody offers {topics.MOVE_STAGE.name}: is the stage node running?")
        x, y, z = place
        request = self._move.srv_type.Request(
            target=Point(x=x, y=y, z=z), relative=relative, check_only=check_only
        )
        patience_s = _ANSWER_S if check_only else self._settings.move_timeout_s
        reply = self._answer(self._move.call_async(request), patience_s, topics.MOVE_STAGE.name)
        if not reply.success:
            raise DeviceError(reply.message)
        return reply

    def _answer(self, future: Any, patience_s: float, service: str) -> Any:
        end_s = time.monotonic() + patience_s
        while not future.done():
            if time.monotonic() > end_s:
                raise DeviceTimeout(f"{service} did not answer within {patience_s:g} s")
            self._pause()
        return future.result()

    def halt(self) -> None:
        """Stop stage and projector; their answers are of no interest."""
        if not self._node.context.ok():
            return
        if self._stop_stage.service_is_ready():
            self._stop_stage.call_async(self._stop_stage.srv_type.Request())
        self._stacks.stop_projecting()

    # -- images ---------------------------------------------------------------------------------

    def take(self, sequence: str) -> Stack:
        """Project a sequence; spoilt attempts are repeated."""
        request = ScanRequest(sequence, 0.0, self._settings.max_repeats, REST_S)
        result = self._stacks.take(request, lambda _: None, self._cancelled, self._timeouts)
        if result.cancelled:
            raise RunCancelled("calibration cancelled")
        if not result.success:
            raise CalibrationError(f"no images: {result.message}")
        stack: Stack = result.report
        return stack

    def _on_stack(self, message: Any) -> None:
        if watch := self._stacks.watch_of(message.scan_id):
            watch.arrived()
            try:
                watch.finished(stack_from_msg(message))
            except SlError as error:
                watch.finished(error)


def _position(stamped: Any) -> Place:
    position = stamped.pose.position
    return float(position.x), float(position.y), float(position.z)
