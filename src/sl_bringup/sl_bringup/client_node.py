"""What all clients of the graph's actions share: waiting for it, its answers, how far it is."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.signals import SignalHandlerOptions

from sl_bringup.graph.console import INTERRUPTED, complain
from sl_common.base_node import GraphNode
from sl_common.errors import DeviceLost, DeviceTimeout, SlError
from sl_common.topics import Service

#: A graph that runs is found within this.
CONNECT_S = 10.0
#: A cancelled goal ends when stage and projector have stopped.
CANCEL_S = 20.0


class GraphClient(GraphNode):
    """A node that asks for something, shows progress in one line, and ends.

    Parameters
    ----------
    name : str
        Of the node.
    namespace : str
        Of the rig.
    """

    def __init__(self, name: str, namespace: str) -> None:
        super().__init__(name, namespace=namespace)
        self._shown = ""

    def await_graph(self, is_there: Callable[[], bool], wanted: Service, patience_s: float) -> None:
        """Wait until what is wanted of the graph is offered.

        Parameters
        ----------
        is_there : callable
            Whether it is.
        wanted : Service
            What it is.
        patience_s : float
            Longest wait, seconds.

        Raises
        ------
        DeviceLost
            When nobody offers it.
        """
        if not self.until(is_there, patience_s):
            raise DeviceLost(
                f"no node offers {self.get_namespace()}/{wanted.name} in domain "
                f"{self.context.get_domain_id()}; start the graph with 'slrig up', or use --up"
            )

    def answer(self, future: Any, patience_s: float) -> Any:
        """Return what a future holds.

        Parameters
        ----------
        future : Future
            Of a call or a goal.
        patience_s : float
            Longest wait, seconds.

        Raises
        ------
        DeviceTimeout
            When the graph does not answer in time.
        """
        if not self.until(future.done, patience_s):
            raise DeviceTimeout(f"the graph did not answer within {patience_s:g} s")
        return future.result()

    def carry_out(
        self, action: Any, goal: Any, feedback: Callable[[Any], None], patience_s: float
    ) -> Any:
        """Ask an action for a goal, and return its result.

        When it takes too long, and at an interrupt, it is cancelled and its end waited for:
        nothing goes on in the graph for which nobody waits.

        Parameters
        ----------
        action : ActionClient
            The action.
        goal : object
            Its goal.
        feedback : callable
            Takes each feedback message.
        patience_s : float
            Longest wait for the result, seconds.

        Raises
        ------
        DeviceLost
            When the graph refuses the goal.
        DeviceTimeout
            When it does not end in time.
        """
        asked = action.send_goal_async(goal, feedback_callback=feedback)
        try:
            handle = self.answer(asked, patience_s)
            if not handle.accepted:
                raise DeviceLost(f"{self.get_namespace()}: the graph refused the goal")
            return self.answer(handle.get_result_async(), patience_s).result
        except (KeyboardInterrupt, DeviceTimeout):
            self._cancel(asked)
            raise

    def _cancel(self, asked: Any) -> None:
        """Cancel a goal that may still be on its way, and wait for its end."""
        if self.until(asked.done, CANCEL_S) and asked.result().accepted:
            ended = asked.result().get_result_async()
            asked.result().cancel_goal_async()
            self.until(ended.done, CANCEL_S)

    def until(self, condition: Callable[[], bool], patience_s: float) -> bool:
        """Serve the node until a condition holds; whether it does in time.

        Parameters
        ----------
        condition : callable
            Tells whether the wait is over.
        patience_s : float
            Longest wait, seconds.
        """
        end_s = time.monotonic() + patience_s
        while not condition():
            if time.monotonic() > end_s:
                return False
            rclpy.spin_once(self, timeout_sec=0.05)
        return True

    def show(self, line: str, detail: str) -> None:
        """Tell progress: on a terminal over the line before, in a log only what is new.

        Parameters
        ----------
        line, detail : str
            What is being done; how far it is, for a terminal.
        """
        if sys.stderr.isatty():
            sys.stderr.write(f"\r{line}{detail}      ")
        elif line != self._shown:
            complain(line)
        self._shown = line

    def end_line(self) -> None:
        """Leave the line of the progress."""
        if self._shown and sys.stderr.isatty():
            sys.stderr.write("\n")
        self._shown = ""


def run_client(command: str, work: Callable[[], int]) -> int:
    """Do a client's work with ROS up, and tell what goes wrong.

    Parameters
    ----------
    command : str
        Under which the user knows it.
    work : callable
        Returns the exit status.

    Returns
    -------
    int
        Its exit status; 1 after an error, 130 after Ctrl-C.
    """
    # ROS would end itself at a signal, and nothing could be cancelled any more.
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    try:
        return work()
    except SlError as error:
        complain(f"{command}: error: {error}")
        return 1
    except KeyboardInterrupt:
        complain(f"{command}: interrupted")
        return INTERRUPTED
    finally:
        rclpy.try_shutdown()
