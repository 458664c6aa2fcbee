"""Start every executable of a workspace as `ros2 run` does, which is not among the wheels.

What `ros2 run PACKAGE NAME` starts is lib/PACKAGE/NAME below the prefix that the ament index has
for the package. A command answers --help and ends with 0; a node tells how it is on /diagnostics,
and ends with 0 on Ctrl-C.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import rclpy
from ament_index_python.packages import get_packages_with_prefixes
from diagnostic_msgs.msg import DiagnosticArray

UP_S, DOWN_S = 180.0, 30.0


def executables(workspace: Path) -> list[Path]:
    """Return what `ros2 run` finds in the workspace; fails for a package from elsewhere."""
    found = []
    for name, prefix in sorted(get_packages_with_prefixes().items()):
        if Path(prefix).is_relative_to(workspace):
            spec = importlib.util.find_spec(name)
            assert spec, f"{name} cannot be imported"
            assert spec.origin and Path(spec.origin).is_relative_to(prefix), (
                f"{name}: {spec.origin}"
            )
            found += sorted(f for f in Path(prefix, "lib", name).glob("*") if os.access(f, os.X_OK))
    return [f for f in found if f.is_file()]


class Started:
    """An executable that runs with --help, which nodes do not look at."""

    def __init__(self, file: Path, logs: Path) -> None:
        self.node = file.name.removesuffix("_node")
        self.log = logs / f"{file.parent.name}-{file.name}.log"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [file, "--help"], stdout=log, stderr=log, stdin=subprocess.DEVNULL,
                start_new_session=True,
            )  # fmt: skip

    def wait(self, told: set[str]) -> str:
        """Return what became of it: "command", "node", or "" as long as it is open."""
        if self.process.poll() is not None:
            assert self.process.returncode == 0, self.failed(
                f"ended with {self.process.returncode}"
            )
            return "command"
        return "node" if self.node in told else ""

    def end(self) -> None:
        """Press Ctrl-C, and hold the exit status to 0."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGINT)
        try:
            status = self.process.wait(DOWN_S)
        except subprocess.TimeoutExpired:
            raise AssertionError(self.failed("does not end on Ctrl-C")) from None
        assert status == 0, self.failed(f"ended with {status} on Ctrl-C")

    def failed(self, how: str) -> str:
        """Return what to say of a failure: how, and the end of the output."""
        return f"{self.log.stem} {how}:\n{self.log.read_text()[-3000:]}"

    def kill(self) -> None:
        """End it and its children, whatever state they are in."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)


def come_up(started: list[Started]) -> list[Started]:
    """Wait until each command has ended and each node has told how it is; return the nodes."""
    told: set[str] = set()
    context = rclpy.Context()
    context.init()
    watcher = rclpy.create_node("start_nodes", context=context)
    executor = rclpy.executors.SingleThreadedExecutor(context=context)
    executor.add_node(watcher)

    def hear(message: DiagnosticArray) -> None:
        # A status is called "node: part".
        told.update(status.name.partition(":")[0] for status in message.status)

    watcher.create_subscription(DiagnosticArray, "/diagnostics", hear, 50)
    deadline = time.monotonic() + UP_S
    try:
        while silent := [s for s in started if not s.wait(told)]:
            assert time.monotonic() < deadline, "\n".join(
                s.failed(f"tells nothing in {UP_S:.0f} s; heard of {sorted(told)}") for s in silent
            )
            executor.spin_once(timeout_sec=0.2)
    finally:
        context.try_shutdown()
    return [s for s in started if s.wait(told) == "node"]


def main() -> None:
    """Start all executables of the workspace in the first argument at once."""
    workspace = Path(sys.argv[1]).resolve()
    logs = workspace.parent / "log"
    files = executables(workspace)
    assert files, f"no executables below {workspace}"
    started = [Started(file, logs) for file in files]
    try:
        nodes = come_up(started)
        assert nodes, "no executable is a node"
        for node in nodes:
            node.end()
    finally:
        for process in started:
            process.kill()
    names = ", ".join(n.node for n in nodes)
    sys.stdout.write(f"{len(started) - len(nodes)} commands and {len(nodes)} nodes ran: {names}\n")


if __name__ == "__main__":
    main()
