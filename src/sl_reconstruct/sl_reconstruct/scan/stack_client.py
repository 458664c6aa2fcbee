"""Takes stacks of the graph: asks the projector, follows the synchroniser, repeats and refuses.

It has two users: scans, whose stacks become clouds, and calibrations, which look for holes in
them. The course of each attempt is `scan_flow`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from sl_common import topics
from sl_common.clock import next_scan_id
from sl_reconstruct.scan.scan_flow import (
    ScanFailed,
    ScanProgress,
    ScanRequest,
    ScanResult,
    ScanRun,
    ScanTimeouts,
    ScanWatch,
)

if TYPE_CHECKING:
    from sl_common.base_node import RigNode

_POLL_S = 0.05


class StackClient:
    """One attempt after the other, for a node; it is `scan_flow.ScanDevices`.

    Its user listens to `topics.FRAME` with `on_frame`, and tells the watch of a stack
    (`watch_of`) that it arrived and what came of it.

    Parameters
    ----------
    node : RigNode
        Whose clients these are.
    gap : callable
        Says what else is missing before anything is projected; empty when nothing is.
    """

    def __init__(self, node: RigNode, gap: Callable[[], str] = lambda: "") -> None:
        self._node, self._own_gap = node, gap
        self._projector = node.client(topics.PROJECT)
        self._stop = node.client(topics.STOP_PROJECTOR)
        self._watch: ScanWatch | None = None
        self._cancelled: Callable[[], bool] = lambda: False
        self._last_id = 0

    def take(
        self,
        request: ScanRequest,
        tell: Callable[[ScanProgress], None],
        cancelled: Callable[[], bool],
        timeouts: ScanTimeouts,
    ) -> ScanResult:
        """Take one stack; see `ScanRun` for the arguments. It blocks, and raises no `SlError`.

        Parameters
        ----------
        request : ScanRequest
            What to take.
        tell : callable
            Takes each `ScanProgress`.
        cancelled : callable
            Tells whether nobody wants it any more.
        timeouts : ScanTimeouts
            Longest waits.
        """
        self._cancelled = cancelled
        try:
            return ScanRun(self, request, tell, cancelled, timeouts).run()
        finally:
            self._watch = None

    # -- what the graph says ------------------------------------------------------------------

    def watch_of(self, scan_id: int) -> ScanWatch | None:
        """Return the watch of a scan that is being taken; None for any other."""
        watch = self._watch
        return watch if watch is not None and watch.scan_id == scan_id else None

    def on_frame(self, message: Any) -> None:
        """Take a decision of the synchroniser."""
        if (watch := self.watch_of(message.scan_id)) is None:
            return
        if message.status == message.MATCHED:
            watch.matched(message.index, message.count)
        elif message.status in (message.STACK_COMPLETE, message.STACK_REFUSED):
            watch.decided(message.status == message.STACK_COMPLETE, message.reason)
        else:
            watch.sign()

    # -- what an attempt needs (`scan_flow.ScanDevices`) --------------------------------------

    def begin(self) -> ScanWatch:
        """See `ScanDevices`."""
        self._last_id = next_scan_id(self._last_id)
        self._watch = ScanWatch(self._last_id)
        return self._watch

    def missing(self, patience_s: float) -> str:
        """See `ScanDevices`."""
        end_s = time.monotonic() + patience_s
        while (gap := self._gap()) and time.monotonic() < end_s and not self._cancelled():
            time.sleep(_POLL_S)
        return gap

    def _gap(self) -> str:
        if not self._projector.service_is_ready():
            return f"nobody offers {topics.PROJECT.name}: is the projector node running?"
        for topic in (topics.IMAGE, topics.STACK):
            if not self._node.count_publishers(topic.name):
                return f"nobody publishes {topic.name}: is the {topic.node} node running?"
        return self._own_gap()

    def project(self, watch: ScanWatch, request: ScanRequest) -> None:
        """See `ScanDevices`."""
        message = self._projector.srv_type.Request(
            sequence=request.sequence, scan_id=watch.scan_id, exposure_s=request.exposure_s
        )

        def answered(future: Any) -> None:
            reply = future.result()
            watch.answered(reply.success, reply.count, reply.message)

        try:
            self._projector.call_async(message).add_done_callback(answered)
        except RuntimeError as error:  # rclpy: the context is gone
            raise ScanFailed(f"the projector cannot be asked: {error}") from error

    def stop_projecting(self) -> None:
        """Ask the projector to stop; its answer is of no interest."""
        if self._stop.service_is_ready():
            self._stop.call_async(self._stop.srv_type.Request())
