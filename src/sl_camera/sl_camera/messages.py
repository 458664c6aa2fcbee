"""Images, poses, verdicts and stacks as ROS messages; `message_fields` has the way back.

Pixels are not copied where that can be avoided: rclpy's setter of ``uint8[]`` fields copies into
an ``array.array`` (0.15 s for an image given as ndarray), but its serialisation takes anything
with a buffer, so the field's storage is set directly.
"""

from __future__ import annotations

import math

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image
from sl_interfaces.msg import MatchedFrame, PatternStack

from sl_camera.stage.stage import Position
from sl_camera.sync.match_events import PIXEL_TYPES, FrameDecision, MatchedStack, PoseEvent
from sl_projector.sequence.messages import pattern_to_msg, stamp_to_msg

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

_ENCODINGS = {dtype.itemsize: name for name, dtype in PIXEL_TYPES.items()}


def image_to_msg(pixels: Pixels, stamp_ns: int, frame_id: str) -> Image:
    """One image as a message that shares the pixels' memory until it is published.

    Parameters
    ----------
    pixels : ndarray, (H, W), uint8 or uint16
        The image, C order.
    stamp_ns : int
        Start of the exposure.
    frame_id : str
        Frame of the camera.
    """
    height, width = pixels.shape
    message = Image(
        height=height,
        width=width,
        encoding=_ENCODINGS[pixels.itemsize],
        step=width * pixels.itemsize,
    )
    message.header.stamp = stamp_to_msg(stamp_ns)
    message.header.frame_id = frame_id
    message._data = _bytes_of(pixels)
    return message


def _bytes_of(pixels: Pixels) -> NDArray[np.uint8]:
    """Flat byte view; copies only what is not in C order."""
    return np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)


def camera_info_for(template: CameraInfo | None, image: Image) -> CameraInfo:
    """Return the camera info that goes with an image: same stamp, frame and size.

    Without a calibration, or with one for another image size, K is zero: "uncalibrated".
    """
    info = CameraInfo(height=image.height, width=image.width)
    if template is not None and (template.height, template.width) == (image.height, image.width):
        info = template
    info.header = image.header
    return info


def pose_to_msg(pose: PoseEvent | None) -> PoseStamped:
    """One pose as a message; an unknown one has NaN for its position."""
    message = PoseStamped()
    if pose is None:
        message.pose.position.x = message.pose.position.y = message.pose.position.z = math.nan
        return message
    message.header.stamp = stamp_to_msg(pose.stamp_ns)
    message.header.frame_id = pose.frame_id
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = pose.position_m
    q.x, q.y, q.z, q.w = pose.quaternion_xyzw
    return message


def stage_pose(position_m: Position, stamp_ns: int, frame_id: str) -> PoseStamped:
    """Where a stage without rotary axes stands."""
    return pose_to_msg(PoseEvent(stamp_ns, position_m, (0.0, 0.0, 0.0, 1.0), frame_id))


def decision_to_msg(decision: FrameDecision, frame_id: str) -> MatchedFrame:
    """One verdict of the matcher as a message."""
    message = MatchedFrame(
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
    message.header.stamp = stamp_to_msg(decision.stamp_ns)
    message.header.frame_id = frame_id
    return message


def stack_to_msg(stack: MatchedStack, frame_id: str) -> PatternStack:
    """One complete stack as a message that shares the images' memory until it is published."""
    _, height, width = stack.data.shape
    message = PatternStack(
        scan_id=stack.scan_id,
        sequence=stack.sequence.name,
        dmd_columns=stack.sequence.dmd_size[0],
        dmd_rows=stack.sequence.dmd_size[1],
        patterns=[pattern_to_msg(p) for p in stack.sequence.patterns],
        stamps=[stamp_to_msg(stamp_ns) for stamp_ns in stack.image_stamps_ns],
        exposure_s=stack.exposure_s,
        height=height,
        width=width,
        encoding=stack.encoding,
        stage_pose=pose_to_msg(stack.pose),
    )
    message.header.stamp = message.stamps[0]
    message.header.frame_id = frame_id
    message._data = _bytes_of(stack.data)
    return message
