"""What goes into the matching of triggers, images and poses, and what comes out of it.

Plain data, no ROS: `synchronizer_node` makes it from messages, `slrig evaluate` from a bag.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import ConfigError
from sl_projector.sequence.pattern_sequence import Pattern
from sl_projector.sequence.stack import PIXEL_TYPES, Pixels, Stack, StagePose


class Status(IntEnum):
    """Verdicts; the numbers are those of `sl_interfaces/MatchedFrame`."""

    MATCHED = 0
    TRIGGER_WITHOUT_IMAGE = 1
    IMAGE_WITHOUT_TRIGGER = 2
    DUPLICATE = 3
    LATE = 4
    REORDERED = 5
    BAD_IMAGE = 6
    STAGE_MOVED = 7
    STACK_COMPLETE = 8
    STACK_REFUSED = 9


@dataclass(frozen=True, slots=True)
class TriggerEvent:
    """One exposed pattern.

    Parameters
    ----------
    scan_id : int
        All triggers of one scan share it.
    sequence_name : str
        The sequence that is projected.
    dmd_size : tuple of int
        (columns, rows), DMD pixels.
    index, count : int
        Position in the sequence, 0 .. count - 1, and its length.
    pattern : Pattern
        What the mirrors show.
    stamp_ns : int
        Start of the exposure, host clock.
    exposure_s : float
        How long the pattern is shown, seconds.
    """

    scan_id: int
    sequence_name: str
    dmd_size: tuple[int, int]
    index: int
    count: int
    pattern: Pattern
    stamp_ns: int
    exposure_s: float


@dataclass(frozen=True, slots=True)
class ImageEvent:
    """One image as it came; it is checked by the matcher, not by whoever makes it.

    Parameters
    ----------
    stamp_ns : int
        Start of the exposure, host clock.
    height, width : int
        Pixels.
    encoding : str
        "mono8" or "mono16" (little endian).
    data : buffer
        height x width pixels, rows one after the other without padding. A view is enough; it must
        stay as it is until the matcher has copied it, at the latest when the scan has its verdict.
    """

    stamp_ns: int
    height: int
    width: int
    encoding: str
    data: NDArray[np.uint8] | memoryview | bytes | bytearray

    def fault(self) -> str:
        """Say what is wrong with size, encoding or length; empty when all is well."""
        if self.encoding not in PIXEL_TYPES:
            return f"its encoding is {self.encoding!r}, expected one of {sorted(PIXEL_TYPES)}"
        found = len(self.data) if isinstance(self.data, bytes | bytearray) else self.data.nbytes
        expected = self.height * self.width * PIXEL_TYPES[self.encoding].itemsize
        if self.height < 1 or self.width < 1 or found != expected:
            return (
                f"it has {found} bytes for {self.width} x {self.height} pixels {self.encoding}, "
                f"expected {max(expected, 1)}"
            )
        return ""

    def pixels(self) -> Pixels:
        """View as (height, width); only for an image without `fault`."""
        flat: NDArray[Any] = np.frombuffer(self.data, dtype=PIXEL_TYPES[self.encoding])
        return flat.reshape(self.height, self.width)


@dataclass(frozen=True, slots=True)
class FrameDecision:
    """What was decided about one trigger or image, or (STACK_*) about a whole scan.

    Parameters
    ----------
    status : Status
        The decision.
    scan_id, index, count : int
        Scan (0: none known), position in the sequence (0 for a whole scan), length (0: unknown).
    reason : str
        In words; empty when MATCHED.
    trigger_stamp_ns, image_stamp_ns : int
        0 where there is none.
    pose : StagePose or None
        The newest pose not later than the exposure, or the stack's.
    stack : Stack or None
        With STACK_COMPLETE only.
    """

    status: Status
    scan_id: int = 0
    index: int = 0
    count: int = 0
    reason: str = ""
    trigger_stamp_ns: int = 0
    image_stamp_ns: int = 0
    pose: StagePose | None = None
    stack: Stack | None = None

    @property
    def stamp_ns(self) -> int:
        """Start of the exposure: the trigger's, the image's where there is no trigger."""
        return self.trigger_stamp_ns or self.image_stamp_ns

    @property
    def time_error_s(self) -> float:
        """Image minus trigger stamp, seconds; NaN where one is missing."""
        if not (self.trigger_stamp_ns and self.image_stamp_ns):
            return math.nan
        return (self.image_stamp_ns - self.trigger_stamp_ns) * 1e-9


@dataclass(frozen=True)
class MatcherSettings:
    """How strictly is matched.

    Parameters
    ----------
    tolerance_fraction : float
        An image belongs to a trigger when their stamps, less `clock_offset_s`, differ by at most
        this fraction of the pattern period; below 0.5, so that it cannot belong to two.
    jitter_fraction : float
        Within a scan the differences may scatter about their median by this fraction of the period.
        The median itself is the clock offset of the scan.
    clock_offset_s : float
        Known constant difference, camera stamp minus projector stamp.
    settle_s : float
        A stack is complete when so long after its last image no surplus image came.
    timeout_s : float
        A scan is given up when so long after an event was due nothing happened.
    early_image_s : float
        So long an image is kept that comes before its trigger.
    require_pose : bool
        Refuse a scan without stage poses before and after its exposures.
    pose_max_age_s : float
        The pose before the first exposure may be so old.
    position_tolerance_m, rotation_tolerance_rad : float
        The part stood still when all poses agree within these.
    max_patterns : int
        Longer sequences are refused.
    max_stack_bytes : int
        Larger stacks are refused.

    Raises
    ------
    ConfigError
        When a value is out of range.
    """

    tolerance_fraction: float = 0.25
    jitter_fraction: float = 0.1
    clock_offset_s: float = 0.0
    settle_s: float = 0.008
    timeout_s: float = 3.0
    early_image_s: float = 1.0
    require_pose: bool = True
    pose_max_age_s: float = 2.0
    position_tolerance_m: float = 2e-6
    rotation_tolerance_rad: float = 1e-4
    max_patterns: int = 128
    max_stack_bytes: int = 1 << 30

    def __post_init__(self) -> None:
        if not 0.0 < self.tolerance_fraction < 0.5:
            raise ConfigError(
                f"tolerance_fraction={self.tolerance_fraction}; expected between 0 and 0.5"
            )
        for name in (
            "jitter_fraction", "settle_s", "timeout_s", "early_image_s", "pose_max_age_s",
            "position_tolerance_m", "rotation_tolerance_rad", "max_patterns", "max_stack_bytes",
        ):  # fmt: skip
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"{name}={value}; expected a positive number")
        if not math.isfinite(self.clock_offset_s):
            raise ConfigError(f"clock_offset_s={self.clock_offset_s}; expected a number")

    def to_dict(self) -> dict[str, Any]:
        """Plain values by name, for files."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> MatcherSettings:
        """Return the settings of ``to_dict``; missing ones keep their defaults.

        Raises
        ------
        ConfigError
            When a name is unknown or a value cannot be used.
        """
        known = [f.name for f in fields(cls)]
        if unknown := sorted(set(values) - set(known)):
            raise ConfigError(f"unknown settings {unknown}; expected some of {known}")
        try:
            return cls(**values)
        except TypeError as error:
            raise ConfigError(f"a setting has the wrong type: {error}") from error
