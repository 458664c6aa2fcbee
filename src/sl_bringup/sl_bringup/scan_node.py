"""Client of the graph's action ``scan``: asks, shows progress, receives the cloud, writes files."""

from __future__ import annotations

import argparse
import importlib
import sys
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image, PointCloud2
from sl_interfaces.action import Scan

from sl_bringup.cli.main import parse
from sl_bringup.client_node import CONNECT_S, GraphClient, run_client
from sl_bringup.graph.console import complain, say
from sl_bringup.graph.graph_arguments import graph_options
from sl_bringup.results.live_scan import check_cloud, live_report, summary, write_result
from sl_common import topics
from sl_reconstruct.messages import cloud_from_msg, refusals_from_msg, report_from_msg

#: The cloud is sent before the action's result; it may still be later by so long.
CLOUD_WAIT_S = 10.0
DEFAULT_REPEATS = 255


class ScanClient(GraphClient):
    """Asks for one scan.

    Parameters
    ----------
    namespace : str
        Of the rig.
    """

    def __init__(self, namespace: str) -> None:
        super().__init__("scan_client", namespace)
        self._cloud: PointCloud2 | None = None
        self._refusals: Image | None = None
        self._action = self.action_client(topics.SCAN_ACTION)
        self.listen(topics.POINTS, self._take)
        self.listen(topics.REFUSALS, self._take_refusals)

    def connect(self, patience_s: float) -> None:
        """Wait for the graph.

        Raises
        ------
        DeviceLost
            When no node offers the action.
        """
        self.await_graph(
            lambda: self._action.server_is_ready() and self.count_publishers(topics.POINTS.name),
            topics.SCAN,
            patience_s,
        )

    def scan(self, goal: Scan.Goal, patience_s: float) -> tuple[Any, PointCloud2 | None]:
        """Scan, and return the action's result and the cloud; else as `carry_out`.

        Parameters
        ----------
        goal : Scan.Goal
            The request.
        patience_s : float
            Longest wait for the result, seconds.

        Raises
        ------
        DeviceTimeout
            When the graph does not answer in time.
        """
        result = self.carry_out(self._action, goal, self._feedback, patience_s)
        if result.success:
            self.until(lambda: self._cloud is not None, CLOUD_WAIT_S)
        return result, self._cloud

    def _take(self, message: PointCloud2) -> None:
        self._cloud = message

    def _take_refusals(self, message: Image) -> None:
        self._refusals = message

    def refusals(self) -> NDArray[np.uint8] | None:
        """Why positions of the cloud hold no point; None where that did not arrive."""
        cloud, message = self._cloud, self._refusals
        if cloud is None or message is None or message.header.stamp != cloud.header.stamp:
            return None
        return refusals_from_msg(message)

    def _feedback(self, message: Any) -> None:
        told = message.feedback
        line = f"scan: {told.stage}, attempt {told.attempt}"
        self.show(line, f", {told.frames}/{told.count} frames {told.progress:4.0%}")


def _deliver(
    args: argparse.Namespace,
    result: Any,
    cloud: PointCloud2 | None,
    refusals: NDArray[np.uint8] | None,
) -> int:
    """Write and tell what came; the exit status."""
    report = live_report(report_from_msg(result.report), result.success, result.message)
    points = None if cloud is None or not result.success else cloud_from_msg(cloud)
    fault = check_cloud(points, report) if points is not None else ""
    if result.success and points is None:
        fault = "the scan succeeded, but its cloud did not arrive"
    write_result(args.output, report, points, args.measure, not args.no_pictures, refusals)
    for line in summary(report):
        say(line)
    if fault:
        complain(f"slrig scan: {fault}")
    say(f"results           {args.output}")
    return 0 if result.success and not fault else 1


def _import_meanwhile(module: str) -> None:
    """Import what takes a second and is needed only when the cloud is there."""
    threading.Thread(target=importlib.import_module, args=(module,), name=module).start()


def main(argv: Sequence[str] | None = None) -> int:
    """Scan once; exit status 0 only when the cloud is there."""
    args = parse(["scan", *(sys.argv[1:] if argv is None else argv)])

    def work() -> int:
        client = ScanClient(graph_options(args).changes.namespace)
        client.connect(CONNECT_S)
        if not args.no_pictures:
            _import_meanwhile("sl_bringup.results.scan_pictures")
        repeats = DEFAULT_REPEATS if args.repeats is None else args.repeats
        goal = Scan.Goal(sequence=args.sequence, exposure_s=args.exposure, max_repeats=repeats)
        result, cloud = client.scan(goal, args.timeout)
        client.end_line()
        return _deliver(args, result, cloud, client.refusals())

    return run_client("slrig scan", work)


if __name__ == "__main__":
    raise SystemExit(main())
