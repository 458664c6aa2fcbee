"""Events for the matcher from messages, its decisions as messages, and the camera's info.

Functions that read take messages of rclpy (live) and of rosbags (an evaluation) alike.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_camera.sync.match_events import FrameDecision, ImageEvent, TriggerEvent
from sl_common.messages import header, ros_message, stamp_from_msg, stamp_to_msg
from sl_common.topics import CAMERA_FRAME, CAMERA_INFO, FRAME
from sl_projector.sequence.messages import pattern_from_msg, pose_to_msg
from sl_projector.sequence.stack import PIXEL_TYPES


def trigger_event(message: Any) -> TriggerEvent:
    """One trigger for the matcher.

    Raises
    ------
    SequenceError
        When its pattern is none.
    """
    return TriggerEvent(
        scan_id=message.scan_id,
        sequence_name=message.sequence,
        dmd_size=(message.dmd_columns, message.dmd_rows),
        index=message.index,
        count=message.count,
        pattern=pattern_from_msg(message.pattern),
        stamp_ns=stamp_from_msg(message.header.stamp),
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
    stamp_ns, flat = stamp_from_msg(message.header.stamp), data.reshape(-1).view(np.uint8)
    return ImageEvent(stamp_ns, message.height, message.width, message.encoding, flat)


def camera_info_for(template: Any, image: Any) -> Any:
    """Return the camera info that goes with an image: same stamp, frame and size.

    Parameters
    ----------
    template : sensor_msgs/CameraInfo or None
        Of the calibration. Without one, or with one for another image size, K is zero, which
        means "uncalibrated".
    image : sensor_msgs/Image
        The image.
    """
    info = template
    if info is None or (info.height, info.width) != (image.height, image.width):
        info = ros_message(CAMERA_INFO.msgtype, height=image.height, width=image.width)
    info.header = image.header
    return info


def decision_to_msg(decision: FrameDecision) -> Any:
    """One decision of the matcher as a ``sl_interfaces/MatchedFrame``."""
    return ros_message(
        FRAME.msgtype,
        header=header(decision.stamp_ns, CAMERA_FRAME),
        scan_id=decision.scan_id,
        index=decision.index,
        count=decision.count,
        status=int(decision.status),
        reason=decision.reason,
        trigger_stamp=stamp_to_msg(decision.trigger_stamp_ns),
        image_stamp=stamp_to_msg(decision.image_stamp_ns),
        time_error_s=decision.time_error_s,
        stage_pose=pose_to_msg(decision.pose),
    )
