"""A private ROS graph for tests: own domain, loopback discovery, one executor in a thread.

Import nothing of ROS before `require_ros` has set the environment.
"""

from __future__ import annotations

import os
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from sl_common import topics
from sl_common.topics import NAMESPACE, Service, Topic
from support.domains import ReservedDomain
from support.patience import PATIENCE_S, patience, wait


def require_ros() -> None:
    """Skip the module where ROS or the project's messages are not installed."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    with warnings.catch_warnings():
        # ROS' own generator imports a deprecated module of the standard library.
        warnings.simplefilter("ignore", DeprecationWarning)
        pytest.importorskip("rclpy", reason="ROS (rclpy) is not installed")
        pytest.importorskip("rosidl_generator_py", reason="ROS is not complete")
    pytest.importorskip("sl_interfaces.msg", reason="sl_interfaces is not installed")


class Graph:
    """Nodes in one executor, and a node of the test's own."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        from sl_common.base_node import GraphNode

        self.context = rclpy.Context()
        self._reserved = ReservedDomain()
        self.domain = self._reserved.number
        rclpy.init(context=self.context, domain_id=self.domain)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.tester = GraphNode("tester", namespace=NAMESPACE, context=self.context)
        self.executor.add_node(self.tester)
        self._nodes: list[Any] = []
        self._clients: list[Any] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def _spin(self) -> None:
        # Not `spin` and a shutdown from another thread: rclpy then waits on what is gone.
        while not self._ended.is_set():
            self.executor.spin_once()

    def add(self, make: Callable[..., Any], *args: Any, **parameters: Any) -> Any:
        """Make a node with these parameters."""
        from rclpy.parameter import Parameter

        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        node = make(*args, context=self.context, parameter_overrides=overrides)
        self._nodes.append(node)
        self.executor.add_node(node)
        return node

    def remove(self, node: Any) -> None:
        """End a node as `base_node.run` does."""
        self._nodes.remove(node)
        self.executor.remove_node(node)
        node.close()
        node.destroy_node()

    def publisher(self, topic: Topic) -> Any:
        """Make a publisher that has found its subscriber."""
        publisher = self.tester.advertise(topic)
        wait(publisher.get_subscription_count, f"a subscriber of {topic.name}")
        return publisher

    def collect(self, topic: Topic) -> list[Any]:
        """Messages of a topic as they come; its publisher has been found."""
        found: list[Any] = []
        subscription = self.tester.listen(topic, found.append)
        wait(lambda: self.tester.count_publishers(topic.name), f"a publisher of {topic.name}")
        wait(lambda: subscription.get_publisher_count(), f"a publisher of {topic.name}")
        return found

    def call(self, service: Service, request: Any, timeout_s: float = PATIENCE_S) -> Any:
        """Call a service and wait for its answer."""
        future = self.call_async(service, request)
        wait(future.done, f"an answer of {service.name}", timeout_s)
        return future.result()

    def call_async(self, service: Service, request: Any) -> Any:
        """Call a service."""
        client = self.tester.client(service)
        assert client.wait_for_service(patience(PATIENCE_S)), f"nobody offers {service.name}"
        return client.call_async(request)

    def await_well(self, nodes: Iterable[str], seconds: float = 280.0) -> None:
        """Wait until every node has said of itself that it is well."""
        levels: dict[str, bytes] = {}

        def hear(message: Any) -> None:
            levels.update({s.name.partition(":")[0]: s.level for s in message.status})

        self.tester.listen(topics.DIAGNOSTICS, hear)
        wait(lambda: all(levels.get(n) == b"\0" for n in nodes), f"all well: {levels}", seconds)

    def action_client(self, action: Service) -> Any:
        """Make a client of an action that is there; destroyed when nothing spins any more."""
        client = self.tester.action_client(action)
        self._clients.append(client)
        assert client.wait_for_server(patience(PATIENCE_S)), f"nobody offers {action.name}"
        return client

    def close(self) -> None:
        """End everything, in the order of a clean shutdown: no callback runs any more."""
        self._ended.set()
        self.executor.create_task(lambda: None)  # wakes it
        self._thread.join(timeout=patience(PATIENCE_S))
        self.executor.shutdown()
        for client in self._clients:
            client.destroy()
        for node in self._nodes:
            node.close()
            node.destroy_node()
        self._nodes.clear()
        self.tester.destroy_node()
        self.context.try_shutdown()
        self._reserved.release()


@contextmanager
def graph() -> Iterator[Graph]:
    """A graph that is closed whatever happens."""
    made = Graph()
    try:
        yield made
    finally:
        made.close()
