"""How long from the call of ``scan`` to the first exposure when the sequence is already loaded.

On two quiet cores the medians were 4 ms for ``scan`` and 2 ms for ``projector/project``; with load
24 from other work 20 ms (least 4) and 18 ms (least 2): wake-ups of three processes; nothing in
the way waits for time.

Takes the graph that runs in the domain, or starts one on the bench. The exposure's start is the
stamp of the first ``projector/trigger``; both are on this machine's clock. The way through the
projector's own service and through the action is timed beside it.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import statistics
import threading
import time
from typing import Any

from sl_bringup.graph.graph import Graph, GraphOptions, is_running


class Caller:
    """Calls and hears triggers."""

    def __init__(self, sequence: str) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        from sl_common import topics
        from sl_common.base_node import GraphNode

        rclpy.init()
        self._sequence = sequence
        self._node = GraphNode("first_exposure", namespace=topics.NAMESPACE)
        self._scan = self._node.client(topics.SCAN)
        self._project = self._node.client(topics.PROJECT)
        self._first_ns: list[int] = []
        self._node.listen(topics.TRIGGER, self._hear)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()
        assert self._scan.wait_for_service(30) and self._project.wait_for_service(30)

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._thread.join(10.0)
        self._node.destroy_node()

    def _hear(self, message: Any) -> None:
        if message.index == 0:
            stamp = message.header.stamp
            self._first_ns.append(stamp.sec * 10**9 + stamp.nanosec)

    def latency_ms(self, client: Any, **fields: Any) -> float:
        """Call once; from the call to the first exposure, milliseconds."""
        self._first_ns.clear()
        done = threading.Event()
        request = client.srv_type.Request(sequence=self._sequence, **fields)
        called_ns = time.time_ns()
        future = client.call_async(request)
        future.add_done_callback(lambda _: done.set())
        assert done.wait(120), "no answer"
        assert self._first_ns, future.result().message
        time.sleep(0.3)
        return (self._first_ns[0] - called_ns) * 1e-6

    def measure(self, repeats: int) -> None:
        """Print medians."""
        ways = {
            "scan": lambda: self.latency_ms(self._scan, max_repeats=0),
            "projector/project": lambda: self.latency_ms(self._project),
        }
        for way in ways.values():
            way()  # loads the sequence
        for name, way in ways.items():
            times = sorted(way() for _ in range(repeats))
            print(
                f"{name}: median {statistics.median(times):.1f} ms, "
                f"least {times[0]:.1f} ms, most {times[-1]:.1f} ms of {repeats} calls"
            )


def measure(arguments: argparse.Namespace) -> None:
    caller = Caller(arguments.sequence)
    try:
        caller.measure(arguments.repeats)
    finally:
        caller.close()


async def measure_own_graph(options: GraphOptions, arguments: argparse.Namespace) -> None:
    async with Graph(options, lambda _line: None) as graph:
        assert await graph.ready(300.0)
        await asyncio.to_thread(measure, arguments)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--sequence", default="precise")
    parser.add_argument("--repeats", type=int, default=30)
    arguments = parser.parse_args()
    options = GraphOptions(bench=True, domain=arguments.domain)
    os.environ.update(options.transport.environment())
    if is_running(options.directory):
        measure(arguments)
    else:
        asyncio.run(measure_own_graph(options, arguments))


if __name__ == "__main__":
    main()
