"""The stage's recent past: did the part stand still while it was exposed?"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence

from sl_camera.sync.match_events import MatcherSettings
from sl_projector.sequence.stack import StagePose

#: Poses kept; at 100 Hz more than a minute.
HISTORY = 8192


class PoseTrack:
    """Poses in order of their stamps, the oldest forgotten."""

    def __init__(self, settings: MatcherSettings) -> None:
        self._settings = settings
        self._poses: list[StagePose] = []
        self._stamps: list[int] = []

    def add(self, pose: StagePose) -> None:
        """Take a pose; a late one is put in its place."""
        at = bisect_right(self._stamps, pose.stamp_ns)
        self._stamps.insert(at, pose.stamp_ns)
        self._poses.insert(at, pose)
        if len(self._poses) > HISTORY:
            # Half at once, so that a long run does not move the list with every pose.
            del self._poses[: HISTORY // 2], self._stamps[: HISTORY // 2]

    def at(self, stamp_ns: int) -> StagePose | None:
        """Newest pose not later than a time, None when there is none."""
        before = bisect_right(self._stamps, stamp_ns)
        return self._poses[before - 1] if before else None

    def known_after(self, end_ns: int) -> bool:
        """Tell whether a pose at or after a time has come."""
        return bool(self._stamps) and self._stamps[-1] >= end_ns

    def during(self, start_ns: int, end_ns: int) -> list[StagePose]:
        """Poses from the last at or before the start to the first at or after the end.

        Parameters
        ----------
        start_ns, end_ns : int
            Stamps, nanoseconds.
        """
        first = max(bisect_right(self._stamps, start_ns) - 1, 0)
        last = bisect_left(self._stamps, end_ns)
        return self._poses[first : last + 1]

    def stood(self, start_ns: int, end_ns: int) -> tuple[StagePose | None, str]:
        """Where the part stood from start to end, and why that cannot be said (or "").

        Without `require_pose` the poses may be missing; those that are there must agree.

        Parameters
        ----------
        start_ns, end_ns : int
            First exposure's start and last one's end, nanoseconds.
        """
        poses = self.during(start_ns, end_ns)
        fault = next((f for f in (p.fault() for p in poses) if f), "")
        fault = fault or self._disagreement(poses) or self._gap(poses, start_ns, end_ns)
        if fault or not poses:
            return None, fault
        middle = (start_ns + end_ns) // 2
        return min(poses, key=lambda p: abs(p.stamp_ns - middle)), ""

    def _gap(self, poses: Sequence[StagePose], start_ns: int, end_ns: int) -> str:
        if not self._settings.require_pose:
            return ""
        max_age_s = self._settings.pose_max_age_s
        oldest = start_ns - max_age_s * 1e9
        if not poses or not oldest <= poses[0].stamp_ns <= start_ns:
            return (
                f"the stage's pose before the first exposure is unknown "
                f"(expected one at most {max_age_s:g} s old)"
            )
        if poses[-1].stamp_ns < end_ns:
            return "the stage's pose after the last exposure is unknown"
        return ""

    def _disagreement(self, poses: Sequence[StagePose]) -> str:
        settings = self._settings
        for pose in poses[1:]:
            if pose.frame_id != poses[0].frame_id:
                return f"the stage's pose changed from frame {poses[0].frame_id} to {pose.frame_id}"
            moved_m = math.dist(pose.position_m, poses[0].position_m)
            turned_rad = _angle(pose, poses[0])
            if moved_m > settings.position_tolerance_m:
                return (
                    f"the stage moved by {moved_m * 1e6:.1f} um during the exposures, "
                    f"expected at most {settings.position_tolerance_m * 1e6:g} um"
                )
            if turned_rad > settings.rotation_tolerance_rad:
                return (
                    f"the stage turned by {turned_rad * 1e3:.3f} mrad during the exposures, "
                    f"expected at most {settings.rotation_tolerance_rad * 1e3:g} mrad"
                )
        return ""


def _angle(a: StagePose, b: StagePose) -> float:
    """Angle between two orientations, rad; q and -q are the same one."""
    p, q = a.quaternion_xyzw, b.quaternion_xyzw
    apart = math.dist(p, q)
    together = math.dist(p, [-x for x in q])
    # The chord, not the dot product: the dot loses angles below 1e-8.
    return 4.0 * math.asin(min(apart, together) / 2.0)
