"""Client of the action ``calibration/calibrate``: asks, shows progress, tells the verdict."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sl_interfaces.action import Calibrate
from sl_interfaces.srv import Verify

from sl_bringup.cli.main import parse
from sl_bringup.client_node import CONNECT_S, GraphClient, run_client
from sl_bringup.graph.console import say
from sl_bringup.graph.graph_arguments import graph_options
from sl_bringup.results.calibration_lines import outcome_lines
from sl_bringup.results.paper_tables import table_1_lines
from sl_common import topics


class CalibrateClient(GraphClient):
    """Asks for one calibration, or for a check of the one in force.

    Parameters
    ----------
    namespace : str
        Of the rig.
    """

    def __init__(self, namespace: str) -> None:
        super().__init__("calibrate_client", namespace)
        self._action = self.action_client(topics.CALIBRATE_ACTION)
        self._verify = self.client(topics.VERIFY)

    def calibrate(self, goal: Calibrate.Goal, patience_s: float) -> Any:
        """Calibrate, and return the action's result; cancelled as by `carry_out`.

        Parameters
        ----------
        goal : Calibrate.Goal
            The request.
        patience_s : float
            Longest wait for the result, seconds.

        Raises
        ------
        DeviceLost
            When no node offers it in time, or it is refused.
        DeviceTimeout
            When the graph does not answer in time.
        """
        self.await_graph(self._action.server_is_ready, topics.CALIBRATE, CONNECT_S)
        return self.carry_out(self._action, goal, self._feedback, patience_s)

    def verify(self, request: Verify.Request, patience_s: float) -> Any:
        """Check the calibration in force, and return the service's answer; errors as above.

        Parameters
        ----------
        request : Verify.Request
            The request.
        patience_s : float
            Longest wait for the answer, seconds.
        """
        # A request to a service that is not found yet would be lost.
        self.await_graph(self._verify.service_is_ready, topics.VERIFY, CONNECT_S)
        return self.answer(self._verify.call_async(request), patience_s)

    def _feedback(self, message: Any) -> None:
        told = message.feedback
        line = f"calibrate: view {told.view} of {told.views}, {told.stage}"
        self.show(line, f" {told.progress:4.0%}")


def _calibrate(client: CalibrateClient, args: argparse.Namespace) -> int:
    goal = Calibrate.Goal(
        target=args.target,
        heights_m=_heights_m(args),
        sequence=args.sequence,
        keep=str(args.keep.resolve()) if args.keep else "",
    )
    result = client.calibrate(goal, args.timeout)
    client.end_line()
    for line in outcome_lines(result):
        say(line)
    for line in _table_1(result.report):
        say(line)
    return 0 if result.success else 1


def _heights_m(args: argparse.Namespace) -> list[float]:
    return [height_mm * 1e-3 for height_mm in args.heights_mm]


def _table_1(report: str) -> list[str]:
    """Table 1 of a run, from beside its page; nothing where there is none on this machine."""
    file = Path(report).with_suffix(".json") if report else None
    if file is None or not file.is_file():
        return []
    return ["", *table_1_lines(json.loads(file.read_text()))]


def _verify(client: CalibrateClient, args: argparse.Namespace) -> int:
    request = Verify.Request(target=args.verify, heights_m=_heights_m(args))
    answer = client.verify(request, args.timeout)
    say(answer.message)
    if answer.report:
        say(f"report            {answer.report}")
    return 0 if answer.success and not answer.recalibrate else 1


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate once; exit status 0 only when the calibration is in force."""
    args = parse(["calibrate", *(sys.argv[1:] if argv is None else argv)])

    def work() -> int:
        client = CalibrateClient(graph_options(args).changes.namespace)
        return (_verify if args.verify else _calibrate)(client, args)

    return run_client("slrig calibrate", work)


if __name__ == "__main__":
    raise SystemExit(main())
