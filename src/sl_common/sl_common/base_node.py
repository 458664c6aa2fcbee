"""What every node of the graph shares: topics, parameters, diagnostics, workers and `main`.

A node never dies of a message: what is wrong with one becomes a count, a log line and a reply.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.action import ActionClient, ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_msgs.msg import String

from sl_common import topics
from sl_common.errors import SlError
from sl_common.messages import interface_class
from sl_common.topics import Service, Topic

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_ResultT = TypeVar("_ResultT")
_SettingsT = TypeVar("_SettingsT", bound="DataclassInstance")

#: A refusal is a warning on `/diagnostics` for so long: at least two messages.
NOTED_S = 2.5
DIAGNOSTICS_S = 1.0


@dataclass(frozen=True)
class Health:
    """What a node says about itself once a second.

    Parameters
    ----------
    level : {"ok", "warn", "error"}
        How bad it is.
    message : str
        One line.
    component : str
        What the status is about.
    hardware_id : str
        Serial number or address of the device.
    values : dict
        Numbers and words beside it.
    """

    level: str
    message: str
    component: str = "node"
    hardware_id: str = ""
    values: dict[str, object] = field(default_factory=dict)


_LEVELS = {
    "ok": DiagnosticStatus.OK,
    "warn": DiagnosticStatus.WARN,
    "error": DiagnosticStatus.ERROR,
}


def device_health(connected: bool, reason: str) -> tuple[str, str]:
    """Level and message of a node that drives one device.

    Parameters
    ----------
    connected : bool
        Whether the device is open.
    reason : str
        Why it is not.
    """
    return ("ok", "ready") if connected else ("error", reason)


def qos_profile(topic: Topic) -> QoSProfile:
    """QoS that publishers and subscribers of a topic have in common."""
    durable, volatile = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE
    return QoSProfile(
        depth=topic.depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durable if topic.latched else volatile,
    )


class GraphNode(Node):  # type: ignore[misc]  # rclpy carries no types
    """A node that takes topics, services and actions from `sl_common.topics`."""

    def advertise(self, topic: Topic) -> Any:
        """Return a publisher."""
        return self.create_publisher(interface_class(topic.msgtype), topic.name, qos_profile(topic))

    def listen(self, topic: Topic, handle: Callable[[Any], None]) -> Any:
        """Subscribe.

        Parameters
        ----------
        topic : Topic
            What.
        handle : callable
            Called with each message.
        """
        kind = interface_class(topic.msgtype)
        return self.create_subscription(kind, topic.name, handle, qos_profile(topic))

    def client(self, service: Service) -> Any:
        """Return a client of a service."""
        return self.create_client(interface_class(service.kind), service.name)

    def action_client(self, action: Service) -> ActionClient:
        """Return a client of an action."""
        return ActionClient(self, interface_class(action.kind), action.name)


class Task(NamedTuple):
    """Long work that a node does on request.

    Parameters
    ----------
    carry_out : callable
        ``carry_out(request, tell, cancelled)`` works in a worker's thread, calls ``tell`` with its
        progress, gives up when ``cancelled()``, and returns an outcome with the flags ``success``
        and ``cancelled``.
    fill : callable
        Puts an outcome into a response or a result, and returns that.
    feedback : callable
        Fields of the action's feedback for a progress.
    """

    carry_out: Callable[[Any, Callable[[Any], None], Callable[[], bool]], Any]
    fill: Callable[[Any, Any], Any]
    feedback: Callable[[Any], dict[str, Any]]


class RigNode(GraphNode):
    """A node of the rig: relative names in namespace ``/sl``, `/diagnostics` at 1 Hz.

    Parameters
    ----------
    name : str
        Node name.
    options
        Passed to `rclpy.node.Node` (tests give a context and parameters).
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, namespace=topics.NAMESPACE, **options)
        self.counts: Counter[str] = Counter()
        self.last_error = ""
        self._noted_s = -math.inf
        self.workers = ThreadPoolExecutor(4, thread_name_prefix=name)
        self.long_work = ReentrantCallbackGroup()
        self._diagnostics = self.advertise(topics.DIAGNOSTICS)
        #: Timers run on it, so that a bag's clock that stands still does not stop them.
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(DIAGNOSTICS_S, self._publish_diagnostics, clock=self.steady)

    def health(self) -> Health:
        """Say how the node is; called once a second in the executor's thread."""
        return Health("ok", "running")

    def close(self) -> None:
        """Give back what the node holds; called once, after the executor has stopped."""
        self.workers.shutdown(wait=True, cancel_futures=True)

    def latch_settings(self, topic: Topic) -> Callable[[Mapping[str, object]], None]:
        """Return what publishes settings on a latched topic, as JSON: recordings then hold them."""
        publisher = self.advertise(topic)

        def tell(values: Mapping[str, object]) -> None:
            publisher.publish(String(data=json.dumps(values, sort_keys=True)))

        return tell

    def declare(
        self,
        name: str,
        default: Any,
        description: str,
        low: float | None = None,
        high: float | None = None,
        live: bool = False,
    ) -> Any:
        """Declare a parameter, and return its value.

        Parameters
        ----------
        name, description : str
            What it is called, and what it means (with its unit).
        default : object
            Its value where none is given; tells its type.
        low, high : float, optional
            Its range.
        live : bool
            Whether it may be set while the node runs, not only when it starts.
        """
        descriptor = ParameterDescriptor(description=description, read_only=not live)
        if low is not None and high is not None:
            if isinstance(default, float):
                limits = FloatingPointRange(from_value=float(low), to_value=float(high))
                descriptor.floating_point_range = [limits]
            else:
                span = IntegerRange(from_value=int(low), to_value=int(high), step=1)
                descriptor.integer_range = [span]
        return self.declare_parameter(name, default, descriptor).value

    def declare_fields(
        self, default: _SettingsT, about: Mapping[str, Sequence[Any]], prefix: str = ""
    ) -> _SettingsT:
        """Declare parameters for fields of a dataclass, and return it with their values.

        Parameters
        ----------
        default : dataclass
            With the defaults.
        about : mapping
            By field: its description, or description and range, as `declare` takes them.
        prefix : str
            Of the parameters' names.
        """
        values = {
            name: self.declare(prefix + name, getattr(default, name), *texts)
            for name, texts in about.items()
        }
        return replace(default, **values)

    def listen(self, topic: Topic, handle: Callable[[Any], None]) -> Any:
        """Subscribe so that no message can end the node, and lost ones are counted.

        Parameters
        ----------
        topic : Topic
            What.
        handle : callable
            Called with each message; what it raises is counted and logged.
        """

        def guarded(message: Any) -> None:
            try:
                handle(message)
            except SlError as error:
                self.complain(topic.name, error)
            except Exception as error:  # a fault of ours must not stop a production line
                self.complain(topic.name, error)
                self.get_logger().error(f"internal fault on {topic.name}: {error!r}")

        events = SubscriptionEventCallbacks(
            message_lost=lambda event: self._count_lost(topic.name, event.total_count_change),
            incompatible_qos=lambda _: self.get_logger().warning(
                f"a publisher of {topic.name} has an incompatible QoS; its messages do not arrive"
            ),
        )
        kind, qos = interface_class(topic.msgtype), qos_profile(topic)
        return self.create_subscription(kind, topic.name, guarded, qos, event_callbacks=events)

    def client(self, service: Service) -> Any:
        """Return a client whose answers arrive while other callbacks wait."""
        kind = interface_class(service.kind)
        return self.create_client(kind, service.name, callback_group=self.long_work)

    def serve(self, service: Service, handle: Callable[[Any, Any], Any]) -> Any:
        """Offer a service.

        Parameters
        ----------
        service : Service
            What.
        handle : callable
            Gets request and response, returns the response; may be a coroutine.
        """
        kind = interface_class(service.kind)
        return self.create_service(kind, service.name, handle, callback_group=self.long_work)

    def serve_work(
        self,
        service: Service,
        work: Callable[[Any, Any], None],
        failed: Callable[[SlError], None] = lambda _: None,
    ) -> None:
        """Offer a service whose work blocks; what goes wrong becomes its answer.

        Parameters
        ----------
        service : Service
            What; its response has the fields ``success`` and ``message``.
        work : callable
            Gets request and response in a worker's thread and fills the response, or raises.
        failed : callable
            Called with what was raised, there too.
        """

        def answer(request: Any, response: Any) -> Any:
            try:
                work(request, response)
            except Exception as error:  # the caller gets an answer whatever happens
                known = isinstance(error, SlError)
                response.success = False
                response.message = str(error) if known else f"internal fault: {error!r}"
                self.get_logger().error(f"{service.name} failed: {response.message}")
                if isinstance(error, SlError):
                    failed(error)
            return response

        async def handle(request: Any, response: Any) -> Any:
            return await self.in_worker(partial(answer, request, response))

        self.serve(service, handle)

    def serve_task(self, service: Service, action: Service, task: Task) -> ActionServer:
        """Offer long work as a service and as an action of the same meaning.

        Parameters
        ----------
        service, action : Service
            Under which it is asked for.
        task : Task
            What is done.

        Returns
        -------
        ActionServer
            To be destroyed when the node closes.
        """
        kind = interface_class(action.kind)

        async def serve(request: Any, response: Any) -> Any:
            work = partial(task.carry_out, request, lambda _: None, self.shutting_down)
            return task.fill(response, await self.in_worker(work))

        async def execute(goal: Any) -> Any:
            def tell(progress: Any) -> None:
                goal.publish_feedback(kind.Feedback(**task.feedback(progress)))

            def cancelled() -> bool:
                return bool(goal.is_cancel_requested) or self.shutting_down()

            outcome = await self.in_worker(partial(task.carry_out, goal.request, tell, cancelled))
            if outcome.success:
                goal.succeed()
            elif outcome.cancelled and goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.abort()
            return task.fill(kind.Result(), outcome)

        self.serve(service, serve)
        how = {"callback_group": self.long_work, "cancel_callback": lambda _: CancelResponse.ACCEPT}
        return ActionServer(self, kind, action.name, execute, **how)

    def shutting_down(self) -> bool:
        """Whether the node is about to end: long work is given up then."""
        return not self.context.ok()

    def say(self, text: str) -> None:
        """Log a line, also from a thread that outlives the context by a moment."""
        if self.context.ok():
            self.get_logger().info(text)

    def note(self, text: str) -> None:
        """Remember what was refused or failed; for a moment it makes a healthy node warn."""
        self.last_error, self._noted_s = text, time.monotonic()

    def complain(self, topic: str, error: Exception) -> None:
        """Count and log something that was refused.

        Parameters
        ----------
        topic : str
            On which it came.
        error : Exception
            Why it was refused.
        """
        self.counts[f"{topic} refused"] += 1
        self.note(f"{topic}: {error}")
        self.get_logger().warning(self.last_error, throttle_duration_sec=0.2)

    def _count_lost(self, topic: str, lost: int) -> None:
        self.counts[f"{topic} lost in transport"] += lost
        self.get_logger().warning(f"{lost} messages of {topic} were lost in transport")

    async def in_worker(self, work: Callable[[], _ResultT]) -> _ResultT:
        """Await work that runs in a worker thread, while the executor goes on.

        The callback that awaits must be in `long_work`, else it would block all others.
        """
        executor = self.executor
        future = Future(executor=executor)
        future.add_done_callback(lambda _: executor.wake())

        def run() -> None:
            try:
                future.set_result(work())
            except BaseException as error:
                future.set_exception(error)

        self.workers.submit(run)
        return await future  # type: ignore[no-any-return]

    def _publish_diagnostics(self) -> None:
        health = self.health()
        values = {**health.values, **self.counts}
        level, message = health.level, health.message
        if self.last_error:
            values["last refusal"] = self.last_error
        if level == "ok" and time.monotonic() - self._noted_s < NOTED_S:
            # The node itself is well: whoever waits for it need not wait for this to pass.
            level, message, values["passing"] = "warn", self.last_error, True
        status = DiagnosticStatus(
            level=_LEVELS[level],
            name=f"{self.get_name()}: {health.component}",
            message=message,
            hardware_id=health.hardware_id,
            values=[KeyValue(key=str(k), value=str(v)) for k, v in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)


def run(make: Callable[[], RigNode], args: list[str] | None = None) -> None:
    """Make a node and spin it until SIGINT or SIGTERM; the exit status is then 0.

    A configuration that cannot work is one line and exit status 1.

    Parameters
    ----------
    make : callable
        Makes the node when ROS is up.
    args : list of str, optional
        Of ROS; by default those of the process.
    """
    node: RigNode | None = None
    try:
        rclpy.init(args=args)
        node = make()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except SlError as error:
        sys.stderr.write(f"{type(error).__name__}: {error}\n")
        raise SystemExit(1) from None
    finally:
        _end(node)


def _end(node: RigNode | None) -> None:
    if node is not None:
        node.close()
        node.destroy_node()
    rclpy.try_shutdown()
