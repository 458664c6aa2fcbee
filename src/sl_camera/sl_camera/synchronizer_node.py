"""The synchroniser's node: which trigger, image and pose belong together, or why they do not."""

from __future__ import annotations

import time
from typing import Any

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image
from sl_interfaces.msg import PatternTrigger

from sl_camera.messages import decision_to_msg, image_event, trigger_event
from sl_camera.sync.match_events import FrameDecision, MatcherSettings, Status
from sl_camera.sync.matching import StackMatcher
from sl_common import topics
from sl_common.base_node import Health, RigNode, run
from sl_projector.sequence.messages import pose_from_msg, stack_to_msg
from sl_projector.sequence.stack import Stack

#: While a scan is open, time-outs and the settling time are looked at so often.
TICK_S = 0.004

_PARAMETERS = {
    "tolerance_fraction": ("image and trigger stamps may differ by this part of a period",),
    "jitter_fraction": ("scatter of these differences in a scan, part of a period",),
    "clock_offset_s": ("known constant camera stamp minus projector stamp, s",),
    "settle_s": ("wait so long after the last image for a surplus one, s",),
    "timeout_s": ("give a scan up when so long nothing came that was due, s",),
    "early_image_s": ("keep an image so long whose trigger did not come yet, s",),
    "require_pose": ("refuse scans without stage poses before and after them",),
    "pose_max_age_s": ("the pose before the first exposure may be so old, s",),
    "position_tolerance_m": ("the part stood still when its poses agree so well, m",),
    "rotation_tolerance_rad": ("the part stood still when its poses agree so well, rad",),
    "max_patterns": ("longer sequences are refused",),
    "max_stack_bytes": ("larger stacks are refused",),
}


class SynchronizerNode(RigNode):
    """Feeds `StackMatcher` with what arrives, publishes what it decides."""

    def __init__(self, **options: Any) -> None:
        super().__init__("synchronizer", **options)
        self._matcher = StackMatcher(self.declare_fields(MatcherSettings(), _PARAMETERS))
        self.latch_settings(topics.MATCHING)(self._matcher.settings.to_dict())
        self._last_verdict = "none yet"
        self._frames = self.advertise(topics.FRAME)
        self._stacks = self.advertise(topics.STACK)
        self.listen(topics.TRIGGER, self._on_trigger)
        self.listen(topics.IMAGE, self._on_image)
        self.listen(topics.POSE, self._on_pose)
        self._ticks = self.create_timer(TICK_S, self._on_tick, clock=self.steady)
        self._ticks.cancel()

    def health(self) -> Health:
        """Counts of every verdict so far."""
        return Health("ok", "running", "matching", values={"last verdict": self._last_verdict})

    def _on_trigger(self, message: PatternTrigger) -> None:
        event = trigger_event(message)
        self._publish(self._matcher.trigger(event, time.monotonic_ns()))

    def _on_image(self, message: Image) -> None:
        event = image_event(message)
        self._publish(self._matcher.image(event, time.monotonic_ns()))

    def _on_pose(self, message: PoseStamped) -> None:
        event = pose_from_msg(message)
        if fault := event.fault():
            self.complain(topics.POSE.name, ValueError(fault))
        self._publish(self._matcher.pose(event, time.monotonic_ns()))

    def _on_tick(self) -> None:
        self._publish(self._matcher.tick(time.monotonic_ns()))

    def _publish(self, decisions: list[FrameDecision]) -> None:
        for decision in decisions:
            self.counts[decision.status.name.lower()] += 1
            if decision.stack is not None:
                self._publish_stack(decision.stack)
            self._frames.publish(decision_to_msg(decision))
            if decision.status not in (Status.MATCHED, Status.STACK_COMPLETE):
                self.get_logger().warning(f"scan {decision.scan_id}: {decision.reason}")
            if decision.status in (Status.STACK_COMPLETE, Status.STACK_REFUSED):
                self._last_verdict = f"scan {decision.scan_id}: {decision.reason or 'complete'}"
            if decision.status is Status.STACK_REFUSED:
                self.note(self._last_verdict)
        if self._matcher.busy == self._ticks.is_canceled():
            self._ticks.reset() if self._matcher.busy else self._ticks.cancel()

    def _publish_stack(self, stack: Stack) -> None:
        """Publish before the verdict, so that whoever hears the verdict can expect the stack."""
        self._stacks.publish(stack_to_msg(stack))
        self._matcher.recycle(stack)


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run(SynchronizerNode, args)


if __name__ == "__main__":
    main()
