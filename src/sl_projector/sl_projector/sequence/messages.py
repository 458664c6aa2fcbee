"""Patterns, sequences, triggers and times as ROS messages and back; what comes in is checked."""

from __future__ import annotations

from collections.abc import Sequence

from builtin_interfaces.msg import Time
from sl_interfaces.msg import Pattern as PatternMsg
from sl_interfaces.msg import PatternTrigger

from sl_common.errors import SequenceError
from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence

NS_PER_S = 1_000_000_000


def stamp_to_msg(stamp_ns: int) -> Time:
    """Nanoseconds since the epoch as a message; times before the epoch become zero."""
    sec, nanosec = divmod(max(0, stamp_ns), NS_PER_S)
    return Time(sec=sec, nanosec=nanosec)


def stamp_from_msg(message: Time) -> int:
    """Nanoseconds since the epoch."""
    return int(message.sec) * NS_PER_S + int(message.nanosec)


def pattern_to_msg(pattern: Pattern) -> PatternMsg:
    """One pattern as a message."""
    return PatternMsg(
        kind=pattern.kind,
        axis=pattern.axis,
        bit=pattern.bit,
        bits=pattern.bits,
        division_px=pattern.division_px,
        shift_px=pattern.shift_px,
        inverted=pattern.inverted,
    )


def pattern_from_msg(message: PatternMsg) -> Pattern:
    """One pattern of a message.

    Raises
    ------
    SequenceError
        When the numbers describe no pattern.
    """
    try:
        return Pattern(
            message.kind, message.axis, message.bit, message.bits,
            message.division_px, message.shift_px, message.inverted,
        )  # fmt: skip
    except ValueError as error:
        raise SequenceError(f"pattern message cannot be used: {error}") from error


def sequence_from_msgs(
    name: str, dmd_size: tuple[int, int], messages: Sequence[PatternMsg]
) -> PatternSequence:
    """Build the sequence that a stack message names.

    Raises
    ------
    SequenceError
        When a pattern or the DMD's size is impossible, or there is no pattern.
    """
    return PatternSequence(name, dmd_size, tuple(pattern_from_msg(m) for m in messages))


def trigger_to_msg(
    sequence: PatternSequence,
    index: int,
    scan_id: int,
    stamp_ns: int,
    exposure_s: float,
    frame_id: str,
) -> PatternTrigger:
    """Announce that pattern ``index`` of a sequence began to show at ``stamp_ns``."""
    message = PatternTrigger(
        scan_id=scan_id,
        sequence=sequence.name,
        dmd_columns=sequence.dmd_size[0],
        dmd_rows=sequence.dmd_size[1],
        index=index,
        count=len(sequence),
        pattern=pattern_to_msg(sequence.patterns[index]),
        exposure_s=exposure_s,
    )
    message.header.stamp = stamp_to_msg(stamp_ns)
    message.header.frame_id = frame_id
    return message
