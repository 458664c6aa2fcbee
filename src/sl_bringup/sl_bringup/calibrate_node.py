"""Client of the action ``calibration/calibrate``: asks, shows progress, tells the verdict."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import rclpy
from rclpy.action import ActionClient
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sl_interfaces.action import Calibrate
from sl_interfaces.srv import Verify

from sl_bringup.calibrate import outcome_lines
from sl_bringup.paper_tables import table_1_lines
from sl_bringup.progress import complain, say
from sl_projector.errors import DeviceLost, DeviceTimeout, SlError

#: A cancelled run answers when stage and projector have stopped.
_CANCEL_S = 20.0


class CalibrateClient(Node):  # type: ignore[misc]  # rclpy carries no types
    """Asks for one calibration, or for a check of the one in force.

    Parameters
    ----------
    namespace : str
        Of the rig.
    """

    def __init__(self, namespace: str) -> None:
        super().__init__("calibrate_client", namespace=namespace)
        self._shown = ""
        self._action = ActionClient(self, Calibrate, "calibration/calibrate")
        self._verify = self.create_client(Verify, "calibration/verify")

    def connect(self, patience_s: float) -> None:
        """Wait for the graph.

        Raises
        ------
        DeviceLost
            When no node offers the action.
        """
        if not self._until(self._action.server_is_ready, patience_s):
            raise DeviceLost(
                f"no node offers the action {self.get_namespace()}/calibration/calibrate in domain "
                f"{self.context.get_domain_id()}; start the graph with 'slrig up', or use --up"
            )

    def calibrate(self, goal: Calibrate.Goal, patience_s: float) -> Any:
        """Calibrate, and return the action's result; an interrupt cancels the run.

        Raises
        ------
        DeviceTimeout
            When the graph does not answer in time.
        """
        handle = self._answer(
            self._action.send_goal_async(goal, feedback_callback=self._show), patience_s
        )
        if not handle.accepted:
            raise DeviceLost("the graph refused the calibration")
        result = handle.get_result_async()
        try:
            return self._answer(result, patience_s).result
        except KeyboardInterrupt:
            handle.cancel_goal_async()
            self._until(result.done, _CANCEL_S)
            raise

    def verify(self, request: Verify.Request, patience_s: float) -> Any:
        """Check the calibration in force, and return the service's answer."""
        return self._answer(self._verify.call_async(request), patience_s)

    def _answer(self, future: Any, patience_s: float) -> Any:
        if not self._until(future.done, patience_s):
            raise DeviceTimeout(f"the graph did not answer within {patience_s:g} s")
        return future.result()

    def _until(self, condition: Callable[[], bool], patience_s: float) -> bool:
        end_s = time.monotonic() + patience_s
        while not condition():
            if time.monotonic() > end_s:
                return False
            rclpy.spin_once(self, timeout_sec=0.05)
        return True

    def _show(self, message: Any) -> None:
        told = message.feedback
        line = f"calibrate: view {told.view} of {told.views}, {told.stage}"
        if sys.stderr.isatty():
            sys.stderr.write(f"\r{line} {told.progress:4.0%}      ")
        elif line != self._shown:
            complain(line)
        self._shown = line


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--namespace", default="/sl")
    parser.add_argument("--target", default="both")
    parser.add_argument("--heights-m", type=float, nargs="+", default=[])
    parser.add_argument("--sequence", default="")
    parser.add_argument("--keep", default="")
    parser.add_argument("--verify", default="")
    parser.add_argument("--timeout", type=float, default=600.0)
    parser.add_argument("--connect-timeout", type=float, default=10.0)
    return parser.parse_args(argv)


def _calibrate(client: CalibrateClient, args: argparse.Namespace) -> int:
    goal = Calibrate.Goal(
        target=args.target, heights_m=args.heights_m, sequence=args.sequence, keep=args.keep
    )
    result = client.calibrate(goal, args.timeout)
    if sys.stderr.isatty():
        sys.stderr.write("\n")
    for line in outcome_lines(result):
        say(line)
    for line in _table_1(result.report):
        say(line)
    return 0 if result.success else 1


def _table_1(report: str) -> list[str]:
    """Table 1 of a run, from beside its page; nothing where there is none on this machine."""
    file = Path(report).with_suffix(".json") if report else None
    if file is None or not file.is_file():
        return []
    return ["", *table_1_lines(json.loads(file.read_text()))]


def _verify(client: CalibrateClient, args: argparse.Namespace) -> int:
    request = Verify.Request(target=args.verify, heights_m=args.heights_m)
    answer = client.verify(request, args.timeout)
    say(answer.message)
    if answer.report:
        say(f"report            {answer.report}")
    return 0 if answer.success and not answer.recalibrate else 1


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate once; exit status 0 only when the calibration is in force."""
    args = _arguments(argv)
    rclpy.init(args=[])
    try:
        client = CalibrateClient(args.namespace)
        client.connect(args.connect_timeout)
        return (_verify if args.verify else _calibrate)(client, args)
    except SlError as error:
        complain(f"slrig calibrate: error: {error}")
        return 1
    except (KeyboardInterrupt, ExternalShutdownException):
        complain("slrig calibrate: interrupted")
        return 130
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    raise SystemExit(main())
