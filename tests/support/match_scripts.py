"""Scans as scripts of triggers, images and poses with their arrival, and what a matcher says.

Pixels tell which trigger an image was exposed for.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from sl_camera.sync.match_events import (
    FrameDecision,
    ImageEvent,
    MatcherSettings,
    Status,
    TriggerEvent,
)
from sl_camera.sync.matching import StackMatcher
from sl_projector.sequence.pattern_sequence import named
from sl_projector.sequence.stack import Stack, StagePose

PAPER = named("paper")
N = len(PAPER)
MS = 1_000_000
PERIOD = 33 * MS
T0 = 1_700_000_000_000_000_000
SHAPE = (6, 8)
FOREIGN = 65_535


def trigger(scan: int, index: int, start_ns: int, **changes: object) -> TriggerEvent:
    stamp_ns = start_ns + index * PERIOD
    event = TriggerEvent(
        scan, "paper", PAPER.dmd_size, index, N, PAPER.patterns[index % N], stamp_ns, 0.03
    )
    return replace(event, **changes)  # type: ignore[arg-type]


def image(value: int, stamp_ns: int, **changes: object) -> ImageEvent:
    pixels = np.full(SHAPE, value, "<u2")
    event = ImageEvent(stamp_ns, *SHAPE, "mono16", pixels.reshape(-1).view(np.uint8))
    return replace(event, **changes)  # type: ignore[arg-type]


def identity(scan: int, index: int) -> int:
    return (scan % 600) * 100 + index


def pose(stamp_ns: int, x_m: float = 0.0, **changes: object) -> StagePose:
    return replace(StagePose(stamp_ns, (x_m, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), **changes)  # type: ignore[arg-type]


Event = tuple[int, TriggerEvent | ImageEvent | StagePose]


@dataclass
class Script:
    """Events of one scan with their arrival, in a form that tests spoil."""

    scan: int = 1
    start_ns: int = T0
    triggers: list[Event] = field(default_factory=list)
    images: list[Event] = field(default_factory=list)
    poses: list[Event] = field(default_factory=list)

    @classmethod
    def good(cls, scan: int = 1, start_ns: int = T0, offset_ns: int = 0) -> Script:
        script = cls(scan, start_ns)
        for i in range(N):
            at = start_ns + i * PERIOD
            script.triggers.append((at + 2 * MS, trigger(scan, i, start_ns)))
            script.images.append((at + 45 * MS, image(identity(scan, i), at + offset_ns)))
        # Number 1 is the last before the first exposure, N + 1 the first after the last one.
        for k in range(-2, N + 2):
            at = start_ns + k * PERIOD + 31 * MS
            script.poses.append((at + MS, pose(at)))
        return script

    def events(self) -> list[Event]:
        # A stable sort: what a test put in one list in some order stays so at equal arrival.
        return sorted([*self.poses, *self.triggers, *self.images], key=lambda e: e[0])


def feed(matcher: StackMatcher, event: Event) -> list[FrameDecision]:
    now_ns, content = event
    if isinstance(content, TriggerEvent):
        return matcher.trigger(content, now_ns)
    if isinstance(content, ImageEvent):
        return matcher.image(content, now_ns)
    return matcher.pose(content, now_ns)


def play(matcher: StackMatcher, *scripts: Script, ticks_ns: int = 0) -> list[FrameDecision]:
    events = sorted((e for s in scripts for e in s.events()), key=lambda e: e[0])
    decisions: list[FrameDecision] = []
    last_ns = events[0][0]
    for event in events:
        if ticks_ns:
            for now_ns in range(last_ns, event[0], ticks_ns):
                decisions += matcher.tick(now_ns)
        decisions += feed(matcher, event)
        last_ns = event[0]
    return decisions + matcher.tick(last_ns + 100 * 1000 * MS)


def verdicts(decisions: list[FrameDecision]) -> list[FrameDecision]:
    return [d for d in decisions if d.status in (Status.STACK_COMPLETE, Status.STACK_REFUSED)]


def stack_of(decision: FrameDecision) -> Stack:
    assert decision.stack is not None, decision.reason
    return decision.stack


def assert_right(stack: Stack) -> None:
    expected = [identity(stack.scan_id, i) for i in range(len(stack.images))]
    assert (stack.images == np.array(expected)[:, None, None]).all()


def refusal(*scripts: Script, settings: MatcherSettings | None = None) -> FrameDecision:
    """Verdict on a spoilt scan; a good one right after it must be taken."""
    matcher = StackMatcher(settings)
    after_ns = max(e[0] for s in scripts for e in s.events()) + 6000 * MS
    decisions = play(matcher, *scripts, Script.good(99, after_ns))
    *bad, good = verdicts(decisions)
    assert_right(stack_of(good))
    assert good.scan_id == 99
    assert [v.status for v in bad] == [Status.STACK_REFUSED] * len(scripts)
    assert bad[0].reason
    assert not matcher.busy
    return bad[0]
