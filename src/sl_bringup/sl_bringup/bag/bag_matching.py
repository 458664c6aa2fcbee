"""A recording through the matching of the live graph: the same stacks, without DDS.

The matcher is fed in the order and with the times at which the recorder received the messages,
so it decides as the synchroniser did.
"""

from __future__ import annotations

from collections.abc import Iterator

from sl_bringup.bag.bags import Bag, Recorded
from sl_camera.messages import image_event, trigger_event
from sl_camera.sync.match_events import FrameDecision, MatcherSettings
from sl_camera.sync.matching import StackMatcher
from sl_common.errors import SequenceError
from sl_common.topics import IMAGE, POSE, TRIGGER
from sl_projector.sequence.messages import pose_from_msg
from sl_projector.sequence.stack import Stack

#: At the end of a bag time passes until every scan has its verdict.
END_NS = 3_600_000_000_000


def decisions(bag: Bag, matcher: StackMatcher) -> Iterator[FrameDecision]:
    """Yield everything that the matcher decides about a bag, in order.

    Parameters
    ----------
    bag : Bag
        The recording; what it holds that cannot be used is noted in ``bag.lost``.
    matcher : StackMatcher
        As in the graph; give stacks back to it with ``recycle``.
    """
    now_ns = 0
    for recorded in bag.messages(TRIGGER, IMAGE, POSE):
        # The recorder's clock may step back by a hair between topics; the matcher's may not.
        now_ns = max(now_ns, recorded.received_ns)
        yield from _feed(bag, matcher, recorded, now_ns)
    yield from matcher.tick(now_ns + END_NS)


def stacks(bag: Bag, settings: MatcherSettings | None = None) -> Iterator[Stack]:
    """Yield the complete stacks of a bag; what is incomplete or spoilt is left out.

    Parameters
    ----------
    bag : Bag
        The recording.
    settings : MatcherSettings, optional
        How strictly triggers, images and poses are matched.
    """
    for decision in decisions(bag, StackMatcher(settings or MatcherSettings())):
        if decision.stack is not None:
            yield decision.stack


def _feed(bag: Bag, matcher: StackMatcher, recorded: Recorded, now_ns: int) -> list[FrameDecision]:
    if recorded.topic == IMAGE:
        return matcher.image(image_event(recorded.message), now_ns)
    if recorded.topic == POSE:
        return matcher.pose(pose_from_msg(recorded.message), now_ns)
    try:
        event = trigger_event(recorded.message)
    except SequenceError as exc:
        bag.lost.append(f"a trigger of scan {recorded.message.scan_id} cannot be used: {exc}")
        return []
    return matcher.trigger(event, now_ns)
