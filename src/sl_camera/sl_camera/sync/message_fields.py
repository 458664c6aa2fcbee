"""Events for the matcher from the fields of messages, whoever's classes these are.

The live graph reads messages with rclpy, an evaluation with rosbags; their fields are the same.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_camera.sync.match_events import PIXEL_TYPES, ImageEvent, PoseEvent, TriggerEvent
from sl_common.errors import SequenceError
from sl_projector.sequence.pattern_sequence import Pattern


def stamp_ns(message: Any) -> int:
    """Header stamp, nanoseconds since the epoch."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def trigger_event(message: Any) -> TriggerEvent:
    """One trigger for the matcher.

    Raises
    ------
    SequenceError
        When its pattern is none.
    """
    p = message.pattern
    try:
        pattern = Pattern(
            p.kind, p.axis, p.bit, p.bits, p.division_px, p.shift_px, bool(p.inverted)
        )
    except ValueError as error:
        raise SequenceError(f"pattern message cannot be used: {error}") from error
    return TriggerEvent(
        scan_id=message.scan_id,
        sequence_name=message.sequence,
        dmd_size=(message.dmd_columns, message.dmd_rows),
        index=message.index,
        count=message.count,
        pattern=pattern,
        stamp_ns=stamp_ns(message),
        exposure_s=message.exposure_s,
    )


def image_event(message: Any) -> ImageEvent:
    """One image for the matcher, which also judges it; its rows have no padding any more.

    Big-endian pixels are turned round. A message whose numbers do not fit each other is passed on
    as it is: the matcher says what is wrong with it.
    """
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
    """One pose for the matcher, which also judges it."""
    p, q = message.pose.position, message.pose.orientation
    return PoseEvent(
        stamp_ns(message), (p.x, p.y, p.z), (q.x, q.y, q.z, q.w), message.header.frame_id
    )
