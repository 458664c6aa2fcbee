"""Patterns, triggers, images, poses and stacks as messages and back; what comes in is checked.

Functions that write take the classes from ``make`` (`sl_common.messages`), functions that read take
messages of rclpy and of rosbags alike. Pixels are not copied: a stack is a view into its message,
and a message shares the memory of its pixels until it is published.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np

from sl_common.errors import SequenceError, StackError
from sl_common.messages import MakeMessage, header, ros_message, stamp_from_msg, stamp_to_msg
from sl_common.topics import CAMERA_FRAME, IMAGE, POSE, PROJECTOR_FRAME, STACK, TRIGGER
from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence
from sl_projector.sequence.stack import PIXEL_TYPES, Pixels, Stack, StagePose, encoding_of

_NOWHERE = StagePose(0, (math.nan,) * 3, frame_id="")


def pattern_to_msg(pattern: Pattern, make: MakeMessage = ros_message) -> Any:
    """Make a ``sl_interfaces/Pattern``.

    Parameters
    ----------
    pattern : Pattern
        What is projected.
    make : MakeMessage
        Where messages come from.
    """
    return make(
        "sl_interfaces/msg/Pattern",
        kind=pattern.kind,
        axis=pattern.axis,
        bit=pattern.bit,
        bits=pattern.bits,
        division_px=pattern.division_px,
        shift_px=pattern.shift_px,
        inverted=pattern.inverted,
    )


def pattern_from_msg(message: Any) -> Pattern:
    """One pattern of a message.

    Raises
    ------
    SequenceError
        When the numbers describe no pattern.
    """
    m = message
    try:
        return Pattern(m.kind, m.axis, m.bit, m.bits, m.division_px, m.shift_px, bool(m.inverted))
    except ValueError as error:
        raise SequenceError(f"pattern message cannot be used: {error}") from error


def trigger_to_msg(
    sequence: PatternSequence,
    index: int,
    scan_id: int,
    stamp_ns: int,
    exposure_s: float,
    make: MakeMessage = ros_message,
) -> Any:
    """Announce that a pattern began to show: a ``sl_interfaces/PatternTrigger``.

    Parameters
    ----------
    sequence : PatternSequence
        What is projected.
    index : int
        Which of its patterns, 0 .. N - 1.
    scan_id : int
        The scan.
    stamp_ns : int
        Start of the exposure, host clock.
    exposure_s : float
        How long the pattern shows, seconds.
    make : MakeMessage
        Where messages come from.
    """
    return make(
        TRIGGER.msgtype,
        header=header(stamp_ns, PROJECTOR_FRAME, make),
        scan_id=scan_id,
        sequence=sequence.name,
        dmd_columns=sequence.dmd_size[0],
        dmd_rows=sequence.dmd_size[1],
        index=index,
        count=len(sequence),
        pattern=pattern_to_msg(sequence.patterns[index], make),
        exposure_s=exposure_s,
    )


def image_to_msg(pixels: Pixels, stamp_ns: int, make: MakeMessage = ros_message) -> Any:
    """Make a ``sensor_msgs/Image`` in the camera's frame.

    Parameters
    ----------
    pixels : ndarray, (H, W), uint8 or uint16
        The image; copied only where it is not in C order.
    stamp_ns : int
        Start of the exposure.
    make : MakeMessage
        Where messages come from.
    """
    height, width = pixels.shape
    return make(
        IMAGE.msgtype,
        header=header(stamp_ns, CAMERA_FRAME, make),
        height=height,
        width=width,
        encoding=encoding_of(pixels),
        is_bigendian=0,
        step=width * pixels.itemsize,
        data=flat_bytes(pixels),
    )


def flat_bytes(array: np.ndarray[Any, Any]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """View of an array as bytes, (n,); copies only what is not in C order."""
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8)


def pose_to_msg(pose: StagePose | None, make: MakeMessage = ros_message) -> Any:
    """Make a ``geometry_msgs/PoseStamped``.

    Parameters
    ----------
    pose : StagePose or None
        Where the part stands; an unknown pose gets NaN for its position, and no frame.
    make : MakeMessage
        Where messages come from.
    """
    pose = pose or _NOWHERE
    return make(
        POSE.msgtype,
        header=header(pose.stamp_ns, pose.frame_id, make),
        pose=rigid_to_msg(pose.position_m, pose.quaternion_xyzw, make),
    )


def rigid_to_msg(position_m: Any, quaternion_xyzw: Any, make: MakeMessage = ros_message) -> Any:
    """Make a ``geometry_msgs/Pose``.

    Parameters
    ----------
    position_m : sequence of float, (3,)
        Metres.
    quaternion_xyzw : sequence of float, (4,)
        Unit quaternion.
    make : MakeMessage
        Where messages come from.
    """
    x, y, z = (float(v) for v in position_m)
    qx, qy, qz, qw = (float(v) for v in quaternion_xyzw)
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )


def pose_from_msg(message: Any) -> StagePose:
    """One pose as it is; `StagePose.fault` says whether it can be used."""
    p, q = message.pose.position, message.pose.orientation
    stamp_ns = stamp_from_msg(message.header.stamp)
    return StagePose(stamp_ns, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w), message.header.frame_id)


def stack_to_msg(stack: Stack, make: MakeMessage = ros_message) -> Any:
    """Make a ``sl_interfaces/PatternStack``.

    Parameters
    ----------
    stack : Stack
        Complete, with the stamp of each exposure.
    make : MakeMessage
        Where messages come from.
    """
    width, height = stack.image_size
    return make(
        STACK.msgtype,
        header=header(stack.stamps_ns[0], CAMERA_FRAME, make),
        scan_id=stack.scan_id,
        sequence=stack.sequence.name,
        dmd_columns=stack.sequence.dmd_size[0],
        dmd_rows=stack.sequence.dmd_size[1],
        patterns=[pattern_to_msg(p, make) for p in stack.sequence.patterns],
        stamps=[stamp_to_msg(stamp_ns, make) for stamp_ns in stack.stamps_ns],
        exposure_s=stack.exposure_s,
        height=height,
        width=width,
        encoding=stack.encoding,
        data=flat_bytes(stack.images),
        stage_pose=pose_to_msg(stack.pose, make),
    )


def stack_from_msg(message: Any) -> Stack:
    """Check a stack message and return what is in it, without a copy of its pixels.

    Raises
    ------
    StackError
        When encoding, size, number of images, stamps or patterns do not fit each other.
    """
    name, size = f"stack of scan {message.scan_id}", (message.dmd_columns, message.dmd_rows)
    try:
        patterns = tuple(pattern_from_msg(p) for p in message.patterns)
        sequence = PatternSequence(message.sequence, size, patterns)
    except SequenceError as error:
        raise StackError(f"{name}: {error}") from error
    stamps_ns = tuple(stamp_from_msg(stamp) for stamp in message.stamps)
    if len(stamps_ns) != len(sequence):
        raise StackError(
            f"{name} has {len(stamps_ns)} stamps for {len(sequence)} patterns; expected one each"
        )
    if any(b <= a for a, b in pairwise(stamps_ns)):
        raise StackError(f"{name}: its stamps do not increase")
    pose = pose_from_msg(message.stage_pose) if message.stage_pose.header.frame_id else None
    images = _images(message, len(sequence), name)
    return Stack(images, sequence, int(message.scan_id), stamps_ns, message.exposure_s, pose)


def _images(message: Any, count: int, name: str) -> Pixels:
    if message.encoding not in PIXEL_TYPES:
        raise StackError(
            f"{name} has the encoding {message.encoding!r}; expected one of {sorted(PIXEL_TYPES)}"
        )
    dtype = PIXEL_TYPES[message.encoding]
    expected = count * message.height * message.width * dtype.itemsize
    if expected == 0 or len(message.data) != expected:
        raise StackError(
            f"{name} has {len(message.data)} bytes; expected {count} images of {message.width} x "
            f"{message.height} {message.encoding} = {expected} (not 0)"
        )
    flat: Pixels = np.frombuffer(message.data, dtype)
    return flat.reshape(count, message.height, message.width)
