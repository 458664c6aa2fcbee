"""Asks the graph whether it is ready: nodes there, content with themselves, services offered."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import ExternalShutdownException

from sl_bringup.graph.console import complain, say
from sl_common import topics
from sl_common.base_node import GraphNode

SERVICES = (
    *(s.name for s in (topics.PROJECT, topics.MOVE_STAGE, topics.HOME_STAGE, topics.SCAN)),
    *(s.name for s in (topics.MEASURE, topics.CALIBRATE)),
    *(f"{a.name}/_action/send_goal" for a in (topics.SCAN_ACTION, topics.CALIBRATE_ACTION)),
)
#: What is missing is said when it has been so for the first wait, and again after the second.
PATIENCE_S, REPEAT_S = 5.0, 20.0


class ReadyNode(GraphNode):
    """Watches `/diagnostics` and the graph.

    Parameters
    ----------
    namespace : str
        Of the rig.
    nodes : sequence of str
        Nodes that must be there.
    """

    def __init__(self, namespace: str, nodes: Sequence[str]) -> None:
        super().__init__("ready", namespace=namespace)
        self._nodes = nodes
        self._said: dict[str, tuple[bytes, str]] = {}
        self._calibrations: dict[str, str] = {}
        self.listen(topics.DIAGNOSTICS, self._on_diagnostics)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name, level = status.name.partition(":")[0], status.level
            values = {item.key: item.value for item in status.values}
            if "calibration" in values:
                self._calibrations[name] = values["calibration"]
            # A rig that has yet to be calibrated is ready for just that; a refusal passes.
            if values.get("passing") and level == DiagnosticStatus.WARN:
                level = DiagnosticStatus.OK
            if values.get("compiled") == "True" and level == DiagnosticStatus.WARN:
                level = DiagnosticStatus.OK
            self._said[name] = (level, status.message)

    @property
    def uncalibrated(self) -> bool:
        """Whether no node knows a calibration."""
        return not any(self._calibrations.values())

    def missing(self) -> list[str]:
        """Say what is not ready, in words; warnings are not errors but worth a wait."""
        found = [fault for name in self._nodes if (fault := self._fault(name))]
        if len(set(self._calibrations.values())) > 1:
            found.append("the calibration in force has not reached every node yet")
        offered = {name for name, _ in self.get_service_names_and_types()}
        prefix = self.get_namespace().rstrip("/")
        wanted = [s for s in SERVICES if "stage" in self._nodes or not s.startswith("stage/")]
        return found + [f"no service {s}" for s in wanted if f"{prefix}/{s}" not in offered]

    def states(self) -> list[str]:
        """Each node's name, level and last word, "NAME | ok | ready"."""
        words = {DiagnosticStatus.OK: "ok", DiagnosticStatus.WARN: "warning"}
        return [f"{n} | {words.get(v, 'error')} | {text}" for n, (v, text) in self._said.items()]

    def _fault(self, name: str) -> str:
        if name not in self._said:
            return f"{name} is silent"
        level, message = self._said[name]
        return "" if level == DiagnosticStatus.OK else f"{name}: {message}"


def wait(node: ReadyNode, timeout_s: float) -> bool:
    """Spin until nothing is missing; what is, is said again and again."""
    began_s = time.monotonic()
    next_s = began_s + PATIENCE_S
    while missing := node.missing():
        rclpy.spin_once(node, timeout_sec=0.1)
        now_s = time.monotonic()
        if timeout_s and now_s - began_s > timeout_s:
            complain(f"graph not ready: {'; '.join(missing)}")
            return False
        if now_s > next_s:
            next_s = now_s + REPEAT_S
            say(f"waiting: {'; '.join(missing)}")
    return True


def main(args: Sequence[str] | None = None) -> int:
    """Exit status 0 when the graph is ready in time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--namespace", default="/sl")
    parser.add_argument("--nodes", nargs="+", required=True)
    parser.add_argument("--states", action="store_true", help="tell what each node said at last")
    parser.add_argument("--timeout", type=float, default=0.0, help="seconds; 0: wait for ever")
    options = parser.parse_args(args)
    try:
        rclpy.init(args=[])
        node = ReadyNode(options.namespace, options.nodes)
        ready = wait(node, options.timeout)
        for line in node.states() if options.states else []:
            say(line)
        if ready and node.uncalibrated:
            say("the rig is not calibrated: put the hole plate on and run 'slrig calibrate'")
        return 0 if ready else 1
    except (KeyboardInterrupt, ExternalShutdownException):
        return 130
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    raise SystemExit(main())
