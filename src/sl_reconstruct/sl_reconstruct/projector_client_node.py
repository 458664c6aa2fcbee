"""The projector as a scan asks for it, for every node that conducts scans."""

from __future__ import annotations

from typing import Any

from sl_interfaces.srv import Project
from std_srvs.srv import Trigger

from sl_common import topics
from sl_common.base_node import RigNode
from sl_reconstruct.scan.scan_flow import ScanFailed, ScanRequest, ScanWatch


class ProjectorClient:
    """Asks the projector node to project and to stop.

    Parameters
    ----------
    node : RigNode
        Whose clients these are.
    """

    def __init__(self, node: RigNode) -> None:
        self._project = node.client(topics.PROJECT)
        self._stop = node.client(topics.STOP_PROJECTOR)

    def gap(self) -> str:
        """Name what is missing before anything can be projected; empty when nothing is."""
        if not self._project.service_is_ready():
            return f"nobody offers {topics.PROJECT.name}: is the projector node running?"
        return ""

    def project(self, watch: ScanWatch, order: ScanRequest) -> None:
        """Ask the projector; the watch is told when it has answered.

        Raises
        ------
        ScanFailed
            When the node is being shut down.
        """
        request = Project.Request(
            sequence=order.sequence, scan_id=watch.scan_id, exposure_s=order.exposure_s
        )

        def answered(future: Any) -> None:
            reply = future.result()
            watch.answered(reply.success, reply.count, reply.message)

        try:
            self._project.call_async(request).add_done_callback(answered)
        except RuntimeError as error:  # rclpy: the context is gone
            raise ScanFailed(f"the projector cannot be asked: {error}") from error

    def stop(self) -> None:
        """Ask the projector to stop; its answer is of no interest."""
        if self._stop.service_is_ready():
            self._stop.call_async(Trigger.Request())
