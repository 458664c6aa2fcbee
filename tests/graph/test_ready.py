"""Waiting for a graph: the compiler takes as long as it takes, all else has a time-out."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from support import ros_graph

ros_graph.require_ros()

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue  # noqa: E402

from sl_bringup import ready_node  # noqa: E402
from sl_bringup.ready_node import ReadyNode  # noqa: E402
from sl_common import topics  # noqa: E402
from support.patience import patience  # noqa: E402
from support.ros_graph import Graph  # noqa: E402

TIMEOUT_S = 0.7


@pytest.fixture
def graph() -> Iterator[Graph]:
    with ros_graph.graph() as made:
        yield made


@pytest.fixture
def waiting(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> Iterator[ReadyNode]:
    """A node that waits for the reconstruction alone, and for no service."""
    monkeypatch.setattr(ready_node, "SERVICES", ())
    node = ReadyNode(topics.NAMESPACE, ["reconstruct"], context=graph.context)
    yield node
    node.destroy_node()


@contextmanager
def compiling(graph: Graph, seconds: float, silent_after_s: float = float("inf")) -> Iterator[None]:
    """Diagnostics as of a node that compiles for a while and may fall silent."""
    publisher = graph.publisher(topics.DIAGNOSTICS)
    ended, began_s = threading.Event(), time.monotonic()

    def say() -> None:
        while not ended.wait(0.05) and time.monotonic() - began_s < silent_after_s:
            compiled = time.monotonic() - began_s > seconds
            status = DiagnosticStatus(
                level=DiagnosticStatus.OK if compiled else DiagnosticStatus.WARN,
                name="reconstruct: reconstruction",
                message="ready" if compiled else "compiling; scans wait",
                values=[KeyValue(key="compiled", value=str(compiled))],
            )
            publisher.publish(DiagnosticArray(status=[status]))

    thread = threading.Thread(target=say)
    thread.start()
    yield
    ended.set()
    thread.join()


def test_compiling_outlasts_the_timeout(graph: Graph, waiting: ReadyNode) -> None:
    timeout_s, began_s = patience(TIMEOUT_S), time.monotonic()
    with compiling(graph, 3 * timeout_s):
        assert ready_node.wait(waiting, timeout_s, for_compiler=True)
    assert time.monotonic() - began_s > 3 * timeout_s


def test_who_does_not_wait_for_the_compiler_hears_of_it(
    graph: Graph, waiting: ReadyNode, capsys: pytest.CaptureFixture[str]
) -> None:
    """As `slrig doctor` asks: it tells the state, and does not wait for a better one."""
    with compiling(graph, 1e6):
        assert not ready_node.wait(waiting, TIMEOUT_S)
    assert "graph not ready: reconstruct: compiling; scans wait" in capsys.readouterr().err


def test_what_else_is_missing_keeps_its_timeout(
    graph: Graph, waiting: ReadyNode, capsys: pytest.CaptureFixture[str]
) -> None:
    waiting._nodes = ["reconstruct", "camera"]
    with compiling(graph, 1e6):
        assert not ready_node.wait(waiting, TIMEOUT_S, for_compiler=True)
    assert "camera is silent" in capsys.readouterr().err


def test_a_node_that_died_compiling_is_not_waited_for(
    graph: Graph, waiting: ReadyNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ready_node, "COMPILING_S", 0.5)
    with compiling(graph, 1e6, silent_after_s=1.0):
        assert not ready_node.wait(waiting, TIMEOUT_S, for_compiler=True)
