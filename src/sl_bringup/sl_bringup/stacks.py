"""A recording through the matching of the live graph: the same stacks, without DDS.

The matcher is fed in the order and with the times at which the recorder received the messages,
so it decides as the synchroniser did.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_bringup.bags import IMAGE, POSE, TRIGGER, Bag, Recorded
from sl_camera.match_events import PIXEL_TYPES, ImageEvent, PoseEvent, TriggerEvent
from sl_camera.matching import FrameDecision, StackMatcher
from sl_projector.errors import SequenceError
from sl_projector.sequence import Pattern

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


def _feed(bag: Bag, matcher: StackMatcher, recorded: Recorded, now_ns: int) -> list[FrameDecision]:
    if recorded.topic == IMAGE:
        return matcher.image(image_event(recorded.message), now_ns)
    if recorded.topic == POSE:
        return matcher.pose(pose_event(recorded.message), now_ns)
    try:
        event = trigger_event(recorded.message)
    except SequenceError as exc:
        bag.lost.append(f"a trigger of scan {recorded.message.scan_id} cannot be used: {exc}")
        return []
    return matcher.trigger(event, now_ns)


def trigger_event(message: Any) -> TriggerEvent:
    """One trigger for the matcher.

    Raises
    ------
    SequenceError
        When its pattern is none.
    """
    p = message.pattern
    return TriggerEvent(
        scan_id=message.scan_id,
        sequence_name=message.sequence,
        dmd_size=(message.dmd_columns, message.dmd_rows),
        index=message.index,
        count=message.count,
        pattern=Pattern(p.kind, p.axis, p.bit, p.bits, p.division_px, p.shift_px, bool(p.inverted)),
        stamp_ns=stamp_ns(message),
        exposure_s=message.exposure_s,
    )


def image_event(message: Any) -> ImageEvent:
    """One image for the matcher, which judges it; padding is cut off, big-endian turned round."""
    data: NDArray[Any] = np.frombuffer(message.data, np.uint8)
    size = PIXEL_TYPES[message.encoding].itemsize if message.encoding in PIXEL_TYPES else 1
    row_bytes = message.width * size
    if message.step > row_bytes and data.size == message.step * message.height:
        data = np.ascontiguousarray(data.reshape(message.height, message.step)[:, :row_bytes])
    if size == 2 and message.is_bigendian and data.size % 2 == 0:
        data = data.reshape(-1).view(">u2").astype("<u2")
    flat = data.reshape(-1).view(np.uint8)
    return ImageEvent(stamp_ns(message), message.height, message.width, message.encoding, flat)


def pose_event(message: Any) -> PoseEvent:
    """One pose for the matcher, which judges it."""
    p, q = message.pose.position, message.pose.orientation
    return PoseEvent(
        stamp_ns(message), (p.x, p.y, p.z), (q.x, q.y, q.z, q.w), message.header.frame_id
    )


def stamp_ns(message: Any) -> int:
    """Header stamp, nanoseconds since the epoch."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
