"""Matching of triggers, images and poses by count and time: the synchroniser without ROS.

Used identically by `synchronizer_node` and by `slrig evaluate`. A stack is made only when image i
of a scan came i-th and was exposed within a tolerance of trigger i, nothing else came in between,
and the part stood still. Everything else ends in one refusal per scan, with the reason.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sl_camera.sync.match_events import (
    FrameDecision,
    ImageEvent,
    MatcherSettings,
    Status,
    TriggerEvent,
)
from sl_camera.sync.pose_track import PoseTrack
from sl_camera.sync.scan_assembly import ScanRecord
from sl_projector.sequence.stack import Pixels, Stack, StagePose

#: Scans whose triggers and images may still be coming.
MAX_OPEN = 2
#: Scans remembered after their verdict, to tell a late image from a foreign one.
MAX_CLOSED = 32
#: Images kept while their trigger is not known.
MAX_WAITING = 128
#: Stack buffers kept for reuse.
MAX_SPARE = 2


@dataclass(frozen=True, slots=True)
class _Waiting:
    event: ImageEvent
    arrival: int
    now_ns: int


class StackMatcher:
    """Feed it what arrives, in the order of arrival; it answers with decisions.

    Every scan of which at least one trigger came gets exactly one verdict, STACK_COMPLETE (with
    the stack) or STACK_REFUSED. The decisions depend on the events and their times of arrival only,
    not on when or how often `tick` is called.

    `now_ns` is the time of arrival on any clock that does not step (live: `time.monotonic_ns`,
    offline: the time of reception that the bag holds); stamps are on the host's clock.

    Parameters
    ----------
    settings : MatcherSettings
        How strictly is matched.
    """

    def __init__(self, settings: MatcherSettings | None = None) -> None:
        self.settings = settings or MatcherSettings()
        self._poses = PoseTrack(self.settings)
        self._open: list[ScanRecord] = []
        self._closed: deque[ScanRecord] = deque(maxlen=MAX_CLOSED)
        self._waiting: deque[_Waiting] = deque()
        self._spare: list[Pixels] = []
        self._arrivals = 0

    # -- what comes in ----------------------------------------------------------------------

    def trigger(self, event: TriggerEvent, now_ns: int) -> list[FrameDecision]:
        """Take a trigger; it may explain images that came before it.

        Parameters
        ----------
        event : TriggerEvent
            What was announced.
        now_ns : int
            Monotonic clock, nanoseconds.
        """
        return [
            *self._advance(now_ns),
            *self._take_trigger(event, now_ns),
            *self._place_waiting(now_ns),
            *self._advance(now_ns),
        ]

    def image(self, event: ImageEvent, now_ns: int) -> list[FrameDecision]:
        """Take an image; its pixels are copied once, here or when its trigger comes.

        Parameters
        ----------
        event : ImageEvent
            What arrived.
        now_ns : int
            Monotonic clock, nanoseconds.
        """
        decisions = list(self._advance(now_ns))
        self._arrivals += 1
        waiting = _Waiting(event, self._arrivals, now_ns)
        decision = self._place(waiting, now_ns)
        if decision is None:
            self._waiting.append(waiting)
        else:
            decisions.append(decision)
        if len(self._waiting) > MAX_WAITING:
            decisions.append(self._foreign(self._waiting.popleft()))
        return [*decisions, *self._advance(now_ns)]

    def pose(self, event: StagePose, now_ns: int) -> list[FrameDecision]:
        """Take a pose; the first one after a scan's last exposure may complete it.

        Parameters
        ----------
        event : StagePose
            What the stage said.
        now_ns : int
            Monotonic clock, nanoseconds.
        """
        decisions = list(self._advance(now_ns))
        self._poses.add(event)
        return [*decisions, *self._advance(now_ns)]

    def tick(self, now_ns: int) -> list[FrameDecision]:
        """Let time pass; call it every few milliseconds, and late once at the end of a bag."""
        return list(self._advance(now_ns))

    def recycle(self, stack: Stack) -> None:
        """Take the memory of a stack back that nobody uses any more."""
        self._keep(stack.images)

    @property
    def busy(self) -> bool:
        """Tell whether `tick` is needed: a scan waits for its verdict, an image for its trigger."""
        return bool(self._open or self._waiting)

    # -- triggers ---------------------------------------------------------------------------

    def _take_trigger(self, event: TriggerEvent, now_ns: int) -> Iterator[FrameDecision]:
        scan = self._find(self._open, event)
        if scan is None:
            closed = self._find(self._closed, event)
            if closed is not None:
                yield self._of_closed(closed, event)
                return
            scan = yield from self._begin(event)
        decision = scan.add_trigger(event, now_ns)
        if decision is not None:
            yield decision
        if scan.hopeless:
            yield from self._close(scan)

    def _find(
        self, scans: list[ScanRecord] | deque[ScanRecord], event: TriggerEvent
    ) -> ScanRecord | None:
        """Scan that a trigger belongs to: its id, unless the projector began to count anew."""
        for scan in reversed(scans):
            if scan.first.scan_id == event.scan_id:
                began_anew = event.index == 0 and event.stamp_ns > scan.newest_ns
                return None if began_anew else scan
        return None

    def _of_closed(self, scan: ScanRecord, event: TriggerEvent) -> FrameDecision:
        known = event.index in scan.triggers
        return scan.decide(
            Status.DUPLICATE if known else Status.LATE,
            min(max(event.index, 0), 0xFFFF),
            f"a trigger of scan {event.scan_id} came after the scan had its verdict",
            trigger_ns=event.stamp_ns,
        )

    def _begin(self, event: TriggerEvent) -> Generator[FrameDecision, None, ScanRecord]:
        """Open a scan; generator that returns it."""
        scan = ScanRecord(event, self.settings, self._allocate)
        for other in list(self._open):
            self._check_apart(other, scan)
            if event.scan_id == other.first.scan_id:
                yield from self._close(other)
        while len(self._open) >= MAX_OPEN:
            oldest = self._open[0]
            oldest.blame(f"{MAX_OPEN} more scans began before it was complete")
            yield from self._close(oldest)
        self._open.append(scan)
        return scan

    def _check_apart(self, old: ScanRecord, new: ScanRecord) -> None:
        if new.first.scan_id == old.first.scan_id:
            old.blame("the projector began to count its scans anew")
        elif new.first.stamp_ns <= old.newest_ns + old.gate_ns():
            problem = f"the exposures of scans {old.first.scan_id} and {new.first.scan_id} overlap"
            old.blame(problem)
            new.blame(problem)

    # -- images -----------------------------------------------------------------------------

    def _place_waiting(self, now_ns: int) -> Iterator[FrameDecision]:
        """Give waiting images to the scans that explain them, in the order of arrival."""
        for _ in range(len(self._waiting)):
            waiting = self._waiting.popleft()
            decision = self._place(waiting, now_ns)
            if decision is None:
                self._waiting.append(waiting)
            else:
                yield decision

    def _place(self, waiting: _Waiting, now_ns: int) -> FrameDecision | None:
        """Decide on one image; None while a trigger may still come that explains it."""
        stamp_ns = waiting.event.stamp_ns
        for scan in self._open:
            index = scan.index_of(stamp_ns)
            if index is not None:
                return self._add_image(scan, waiting, index, now_ns)
        for scan in reversed(self._closed):
            index = scan.index_of(stamp_ns)
            if index is not None:
                return self._late(scan, waiting, index)
        if any(scan.period_ns() and scan.covers(stamp_ns) for scan in self._open):
            return self._foreign(waiting)
        if any(scan.covers(stamp_ns) for scan in self._closed):
            reason = "an image came late that was exposed during a scan that had its verdict"
            return FrameDecision(Status.LATE, reason=reason, image_stamp_ns=stamp_ns)
        return None

    def _add_image(
        self, scan: ScanRecord, waiting: _Waiting, index: int, now_ns: int
    ) -> FrameDecision:
        status, fault = scan.add_image(waiting.event, index, waiting.arrival, now_ns)
        reason = "" if status is Status.MATCHED else fault
        pose = self._poses.at(waiting.event.stamp_ns)
        return scan.decide(status, index, reason, image_ns=waiting.event.stamp_ns, pose=pose)

    def _late(self, scan: ScanRecord, waiting: _Waiting, index: int) -> FrameDecision:
        again = index in scan.image_stamps
        return scan.decide(
            Status.DUPLICATE if again else Status.LATE,
            index,
            f"image {scan.of(index)} of scan {scan.first.scan_id} came "
            + ("once more, " if again else "")
            + "after the scan had its verdict",
            image_ns=waiting.event.stamp_ns,
        )

    def _foreign(self, waiting: _Waiting) -> FrameDecision:
        """Decide that no trigger explains an image; it spoils every scan in which it came."""
        reason, stamp_ns = "no trigger explains this image", waiting.event.stamp_ns
        decision = FrameDecision(
            Status.IMAGE_WITHOUT_TRIGGER, reason=reason, image_stamp_ns=stamp_ns
        )
        for scan in self._open:
            if scan.covers(stamp_ns) or 0 <= scan.first_arrival < waiting.arrival:
                scan.blame("an image came in between that no trigger explains")
                decision = scan.decide(decision.status, 0, reason, 0, stamp_ns)
        return decision

    def _spoil(self, scan: ScanRecord) -> Iterator[FrameDecision]:
        """Blame a scan for unexplained images that came among its own, or right behind them."""
        for waiting in list(self._waiting):
            among = scan.first_arrival < waiting.arrival < scan.last_arrival
            if among or scan.follows(waiting.event.stamp_ns):
                self._waiting.remove(waiting)
                scan.blame(
                    "an image came in between that no trigger explains"
                    if among
                    else "a surplus image came after the last one"
                )
                yield scan.decide(
                    Status.IMAGE_WITHOUT_TRIGGER, 0, scan.problems[-1], 0, waiting.event.stamp_ns
                )

    # -- verdicts ---------------------------------------------------------------------------

    def _advance(self, now_ns: int) -> Iterator[FrameDecision]:
        """Give every verdict that is due, then give up images that nothing explained."""
        for scan in list(self._open):
            if now_ns >= self._verdict_at_ns(scan):
                yield from self._close(scan)
        horizon_ns = now_ns - int(self.settings.early_image_s * 1e9)
        while self._waiting and self._waiting[0].now_ns < horizon_ns:
            yield self._foreign(self._waiting.popleft())

    def _verdict_at_ns(self, scan: ScanRecord) -> int:
        timeout_ns = scan.timeout_at_ns()
        if not scan.received:
            return timeout_ns
        pose_missing = self.settings.require_pose and not self._poses.known_after(scan.end_ns)
        if pose_missing and not scan.problems:
            return timeout_ns
        return min(timeout_ns, scan.last_image_ns + int(self.settings.settle_s * 1e9))

    def _close(self, scan: ScanRecord) -> Iterator[FrameDecision]:
        """Give the verdict on a scan, and forget all but what tells late images."""
        self._open.remove(scan)
        yield from scan.missing()
        if scan.triggers:
            yield from self._spoil(scan)
        scan.check_complete()
        pose = None
        if not scan.problems:
            pose, fault = self._poses.stood(scan.start_ns, scan.end_ns)
            if fault:
                scan.blame(fault)
                yield scan.decide(Status.STAGE_MOVED, 0, fault, pose=self._poses.at(scan.end_ns))
        yield self._verdict(scan, pose)
        self._closed.append(scan)

    def _verdict(self, scan: ScanRecord, pose: StagePose | None) -> FrameDecision:
        if scan.problems:
            self._keep(scan.data)
            verdict = scan.decide(Status.STACK_REFUSED, 0, scan.reason())
        else:
            complete = scan.decide(Status.STACK_COMPLETE, 0, image_ns=scan.image_stamps[0])
            verdict = replace(complete, pose=pose, stack=scan.stack(pose))
        scan.data = None
        return verdict

    # -- memory -----------------------------------------------------------------------------

    def _allocate(self, shape: tuple[int, int, int], dtype: np.dtype[Any]) -> Pixels:
        for i, spare in enumerate(self._spare):
            if (spare.shape, spare.dtype) == (shape, dtype):
                return self._spare.pop(i)
        return np.empty(shape, dtype)

    def _keep(self, data: Pixels | None) -> None:
        if data is not None:
            self._spare = [*self._spare, data][-MAX_SPARE:]
