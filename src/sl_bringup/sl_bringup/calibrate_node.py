"""Client of the action ``calibration/calibrate``: asks, shows progress, tells the verdict."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sl_interfaces.action import Calibrate
from sl_interfaces.srv import Verify

from sl_bringup.cli.calibrate import outcome_lines
from sl_bringup.client_node import GraphClient, run_client
from sl_bringup.graph.console import say
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

    def calibrate(self, goal: Calibrate.Goal, connect_s: float, patience_s: float) -> Any:
        """Calibrate, and return the action's result; cancelled as by `carry_out`.

        Raises
        ------
        DeviceLost
            When no node offers it within ``connect_s``, or it is refused.
        DeviceTimeout
            When the graph does not answer in time.
        """
        self.await_graph(self._action.server_is_ready, topics.CALIBRATE, connect_s)
        return self.carry_out(self._action, goal, self._feedback, patience_s)

    def verify(self, request: Verify.Request, connect_s: float, patience_s: float) -> Any:
        """Check the calibration in force, and return the service's answer; errors as above."""
        # A request to a service that is not found yet would be lost.
        self.await_graph(self._verify.service_is_ready, topics.VERIFY, connect_s)
        return self.answer(self._verify.call_async(request), patience_s)

    def _feedback(self, message: Any) -> None:
        told = message.feedback
        line = f"calibrate: view {told.view} of {told.views}, {told.stage}"
        self.show(line, f" {told.progress:4.0%}")


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
    result = client.calibrate(goal, args.connect_timeout, args.timeout)
    client.end_line()
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
    answer = client.verify(request, args.connect_timeout, args.timeout)
    say(answer.message)
    if answer.report:
        say(f"report            {answer.report}")
    return 0 if answer.success and not answer.recalibrate else 1


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate once; exit status 0 only when the calibration is in force."""
    args = _arguments(argv)

    def work() -> int:
        client = CalibrateClient(args.namespace)
        return (_verify if args.verify else _calibrate)(client, args)

    return run_client("slrig calibrate", work)


if __name__ == "__main__":
    raise SystemExit(main())
