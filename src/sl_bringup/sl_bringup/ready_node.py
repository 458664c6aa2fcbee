"""Asks the graph whether it is ready: nodes there, content with themselves, services offered."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

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
#: A node that said it was compiling is taken at its word for this long; it says so once a second.
COMPILING_S = 30.0
_WORDS = {DiagnosticStatus.OK: "ok", DiagnosticStatus.WARN: "warning"}


class _Said(NamedTuple):
    """A node's last word."""

    level: bytes
    text: str
    compiling_s: float


class Fault(NamedTuple):
    """What is not ready, in words; ``compiling`` when it ends with the compiler's work."""

    text: str
    compiling: bool = False


class ReadyNode(GraphNode):
    """Watches `/diagnostics` and the graph.

    Parameters
    ----------
    namespace : str
        Of the rig.
    nodes : sequence of str
        Nodes that must be there.
    """

    def __init__(self, namespace: str, nodes: Sequence[str], **options: Any) -> None:
        super().__init__("ready", namespace=namespace, **options)
        self._nodes = nodes
        self._said: dict[str, _Said] = {}
        self._calibrations: dict[str, str] = {}
        self.listen(topics.DIAGNOSTICS, self._on_diagnostics)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name, level = status.name.partition(":")[0], status.level
            values = {item.key: item.value for item in status.values}
            if "calibration" in values:
                self._calibrations[name] = values["calibration"]
            # A rig that has yet to be calibrated is ready for just that; a refusal passes.
            ready = values.get("passing") or values.get("compiled") == "True"
            if ready and level == DiagnosticStatus.WARN:
                level = DiagnosticStatus.OK
            compiling = values.get("compiled") == "False" and level == DiagnosticStatus.WARN
            until_s = time.monotonic() + COMPILING_S if compiling else 0.0
            self._said[name] = _Said(level, status.message, until_s)

    @property
    def uncalibrated(self) -> bool:
        """Whether no node knows a calibration."""
        return not any(self._calibrations.values())

    def missing(self) -> list[Fault]:
        """Say what is not ready; warnings are not errors but worth a wait."""
        found = [fault for name in self._nodes if (fault := self._fault(name))]
        if len(set(self._calibrations.values())) > 1:
            found.append(Fault("the calibration in force has not reached every node yet"))
        offered = {name for name, _ in self.get_service_names_and_types()}
        prefix = self.get_namespace().rstrip("/")
        wanted = [s for s in SERVICES if "stage" in self._nodes or not s.startswith("stage/")]
        return found + [Fault(f"no service {s}") for s in wanted if f"{prefix}/{s}" not in offered]

    def states(self) -> list[str]:
        """Each node's name, level and last word, "NAME | ok | ready"."""
        return [f"{n} | {_WORDS.get(s.level, 'error')} | {s.text}" for n, s in self._said.items()]

    def _fault(self, name: str) -> Fault | None:
        if name not in self._said:
            return Fault(f"{name} is silent")
        said = self._said[name]
        if said.level == DiagnosticStatus.OK:
            return None
        return Fault(f"{name}: {said.text}", time.monotonic() < said.compiling_s)


def wait(node: ReadyNode, timeout_s: float, for_compiler: bool = False) -> bool:
    """Spin until nothing is missing; what is, is said again and again.

    Parameters
    ----------
    node : ReadyNode
        Not spun by anybody else.
    timeout_s : float
        Give up when something has been missing for this long; 0: never.
    for_compiler : bool
        Do not count the time in which only the compiler is waited for: how long it takes depends
        on the machine and its load, and its end can be relied on.

    Returns
    -------
    bool
        Whether everything is there.
    """
    blocked_s = time.monotonic()
    next_s = blocked_s + PATIENCE_S
    with SingleThreadedExecutor(context=node.context) as executor:
        executor.add_node(node)
        while missing := node.missing():
            executor.spin_once(timeout_sec=0.1)
            now_s = time.monotonic()
            if for_compiler and all(fault.compiling for fault in missing):
                blocked_s = now_s
            words = "; ".join(fault.text for fault in missing)
            if timeout_s and now_s - blocked_s > timeout_s:
                complain(f"graph not ready: {words}")
                return False
            if now_s > next_s:
                next_s = now_s + REPEAT_S
                say(f"waiting: {words}")
    return True


def main(args: Sequence[str] | None = None) -> int:
    """Exit status 0 when the graph is ready in time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--namespace", default="/sl")
    parser.add_argument("--nodes", nargs="+", required=True)
    parser.add_argument("--states", action="store_true", help="print each node's last word")
    parser.add_argument("--timeout", type=float, default=0.0, help="seconds; 0: none")
    parser.add_argument(
        "--wait-for-compiler", action="store_true", help="no time-out while a node is compiling"
    )
    options = parser.parse_args(args)
    try:
        rclpy.init(args=[])
        node = ReadyNode(options.namespace, options.nodes)
        ready = wait(node, options.timeout, options.wait_for_compiler)
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
