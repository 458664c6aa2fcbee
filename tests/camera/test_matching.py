"""Matching of triggers, images and poses. Pixels tell which trigger an image was exposed for."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from sl_camera.sync.match_events import (
    FrameDecision,
    ImageEvent,
    MatcherSettings,
    Status,
    TriggerEvent,
)
from sl_camera.sync.matching import StackMatcher
from sl_common.errors import ConfigError
from sl_projector.sequence.pattern_sequence import Pattern, named
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


# -- good scans -------------------------------------------------------------------------------


def test_good_scan_makes_one_stack_with_everything_in_it() -> None:
    decisions = play(StackMatcher(), Script.good(7))
    assert [d.status for d in decisions] == [Status.MATCHED] * N + [Status.STACK_COMPLETE]
    assert [d.index for d in decisions[:-1]] == list(range(N))
    stack = stack_of(decisions[-1])
    assert_right(stack)
    assert stack.images.shape == (N, *SHAPE)
    assert stack.encoding == "mono16"
    assert stack.sequence == PAPER
    assert stack.stamps_ns == tuple(T0 + i * PERIOD for i in range(N))
    assert stack.pose is not None
    assert stack.exposure_s == 0.03


def test_stack_comes_within_the_settling_time_of_the_last_image() -> None:
    matcher = StackMatcher(MatcherSettings(settle_s=0.008))
    script = Script.good()
    last_ns = script.images[-1][0]
    for event in script.events():
        if event[0] <= last_ns:
            feed(matcher, event)
    assert not verdicts(matcher.tick(last_ns + 8 * MS - 1))
    assert verdicts(matcher.tick(last_ns + 8 * MS))[0].status is Status.STACK_COMPLETE


@pytest.mark.parametrize("offset_ms", [-8, -3, 0, 3, 8])
def test_constant_clock_offset_within_a_quarter_period_is_allowed(offset_ms: int) -> None:
    decisions = play(StackMatcher(), Script.good(offset_ns=offset_ms * MS))
    assert_right(stack_of(decisions[-1]))
    assert decisions[0].time_error_s == pytest.approx(offset_ms * 1e-3)


def test_known_clock_offset_of_many_periods_is_taken_off() -> None:
    settings = MatcherSettings(clock_offset_s=0.330 * 3)
    decisions = play(StackMatcher(settings), Script.good(offset_ns=990 * MS))
    assert_right(stack_of(decisions[-1]))


def test_images_that_come_before_their_triggers_wait_for_them() -> None:
    script = Script.good()
    script.triggers = [(at + 400 * MS, event) for at, event in script.triggers]
    assert_right(stack_of(verdicts(play(StackMatcher(), script))[0]))


def test_all_triggers_at_once_after_the_last_image() -> None:
    script = Script.good()
    script.triggers = [
        (T0 + N * PERIOD + 50 * MS + i, e) for i, (_, e) in enumerate(script.triggers)
    ]
    assert_right(stack_of(verdicts(play(StackMatcher(), script))[0]))


def test_one_pattern_and_eight_bit_images() -> None:
    white = trigger(3, 0, T0, sequence_name="one", count=1, pattern=Pattern("white"))
    script = Script.good()
    script.triggers = [(T0 + MS, white)]
    script.images = [(T0 + 40 * MS, ImageEvent(T0, 2, 3, "mono8", bytes(range(6))))]
    stack = stack_of(verdicts(play(StackMatcher(), script))[0])
    assert stack.encoding == "mono8"
    assert stack.images.tolist() == [[[0, 1, 2], [3, 4, 5]]]


def test_without_require_pose_no_pose_is_needed_and_moving_ones_still_refuse() -> None:
    settings = MatcherSettings(require_pose=False)
    script = Script.good()
    script.poses = []
    stack = stack_of(verdicts(play(StackMatcher(settings), script))[0])
    assert stack.pose is None
    assert_right(stack)
    moving = Script.good()
    moving.poses = [
        (at, replace(p, position_m=(1e-3 * k, 0, 0))) for k, (at, p) in enumerate(moving.poses)
    ]  # type: ignore[type-var]
    assert "moved" in refusal(moving, settings=settings).reason


def test_memory_of_a_recycled_stack_is_used_again() -> None:
    matcher = StackMatcher()
    first = stack_of(verdicts(play(matcher, Script.good(1)))[0])
    second = stack_of(verdicts(play(matcher, Script.good(2, T0 + 2000 * MS)))[0])
    assert not np.shares_memory(first.images, second.images)
    assert_right(first)
    matcher.recycle(first)
    third = stack_of(verdicts(play(matcher, Script.good(3, T0 + 4000 * MS)))[0])
    assert np.shares_memory(first.images, third.images)
    assert_right(third)


def test_the_projector_may_begin_to_count_anew() -> None:
    decisions = play(StackMatcher(), Script.good(1), Script.good(1, T0 + 2000 * MS))
    assert [v.status for v in verdicts(decisions)] == [Status.STACK_COMPLETE] * 2


# -- images -----------------------------------------------------------------------------------


@pytest.mark.parametrize("lost", [0, 1, 5, N - 1])
def test_dropped_image(lost: int) -> None:
    script = Script.good()
    del script.images[lost]
    verdict = refusal(script)
    assert f"image {lost + 1} of {N} did not come" in verdict.reason


def test_dropped_image_is_told_for_its_trigger() -> None:
    script = Script.good()
    del script.images[4]
    told = [d for d in play(StackMatcher(), script) if d.status is Status.TRIGGER_WITHOUT_IMAGE]
    assert [(d.index, d.trigger_stamp_ns) for d in told] == [(4, T0 + 4 * PERIOD)]
    assert math.isnan(told[0].time_error_s)


def test_all_images_dropped() -> None:
    script = Script.good()
    script.images = []
    assert "did not come" in refusal(script).reason


@pytest.mark.parametrize("twice", [0, 5, N - 1])
def test_duplicated_image(twice: int) -> None:
    script = Script.good()
    at, event = script.images[twice]
    script.images.insert(twice + 1, (at + 5 * MS, event))
    assert f"image {twice + 1} of {N} came twice" in refusal(script).reason


def test_duplicate_long_after_the_stack_is_told_but_harmless() -> None:
    script = Script.good()
    at, event = script.images[-1]
    script.images.append((at + 500 * MS, event))
    decisions = play(StackMatcher(), script)
    assert decisions[-1].status is Status.DUPLICATE
    assert_right(stack_of(verdicts(decisions)[0]))


@pytest.mark.parametrize("first", [0, 4, N - 2])
def test_swapped_images(first: int) -> None:
    script = Script.good()
    (a, early), (b, late) = script.images[first : first + 2]
    script.images[first : first + 2] = [(a, late), (b, early)]
    assert "before" in refusal(script).reason


def test_images_swapped_while_they_wait_for_their_triggers() -> None:
    script = Script.good()
    script.triggers = [(at + 400 * MS, event) for at, event in script.triggers]
    (a, early), (b, late) = script.images[3:5]
    script.images[3:5] = [(a, late), (b, early)]
    assert "out of order" in refusal(script).reason


def test_late_image_is_not_taken_by_the_next_scan() -> None:
    script = Script.good(1)
    at, event = script.images[6]
    script.images[6] = (at + 5000 * MS, event)
    following = Script.good(2, at + 5000 * MS - 5 * PERIOD)
    decisions = play(StackMatcher(), script, following)
    refused, complete = verdicts(decisions)
    assert (refused.scan_id, refused.status) == (1, Status.STACK_REFUSED)
    assert_right(stack_of(complete))
    late = [d for d in decisions if d.status is Status.LATE]
    assert [(d.scan_id, d.index) for d in late] == [(1, 6)]


def test_image_stamped_late() -> None:
    script = Script.good()
    at, event = script.images[6]
    script.images[6] = (at, replace(event, stamp_ns=event.stamp_ns + 15 * MS))
    assert "no trigger explains" in refusal(script).reason


def test_foreign_image_in_between() -> None:
    script = Script.good()
    script.images.insert(4, (script.images[4][0] - MS, image(FOREIGN, T0 + 3 * PERIOD + 16 * MS)))
    assert "no trigger explains" in refusal(script).reason


def test_foreign_image_with_a_stamp_of_another_day() -> None:
    script = Script.good()
    script.images.insert(4, (script.images[4][0] - MS, image(FOREIGN, T0 - 10**15)))
    assert "no trigger explains" in refusal(script).reason


def test_surplus_image_after_the_last_one() -> None:
    script = Script.good()
    at = script.images[-1][0]
    script.images.append((at + 5 * MS, image(FOREIGN, T0 + N * PERIOD)))
    assert "surplus" in refusal(script).reason


def test_images_of_a_free_running_camera_before_the_scan_do_no_harm() -> None:
    script = Script.good()
    script.images[:0] = [
        (T0 - k * PERIOD, image(FOREIGN, T0 - (k + 1) * PERIOD)) for k in (9, 7, 5, 3)
    ]
    decisions = play(StackMatcher(), script)
    assert_right(stack_of(verdicts(decisions)[0]))
    assert [d.status for d in decisions].count(Status.IMAGE_WITHOUT_TRIGGER) == 4


def test_everything_shifted_by_one_pattern_is_seen() -> None:
    """The first image is lost, a foreign one comes at the end: the count is right, the time not."""
    script = Script.good()
    arrivals = [at for at, _ in script.images]
    images = [e for _, e in script.images[1:]] + [image(FOREIGN, T0 + N * PERIOD)]
    script.images = list(zip(arrivals, images, strict=True))
    assert "image 1 of 11 did not come" in refusal(script).reason


def test_stamps_off_by_a_whole_period_are_not_taken_for_a_clock_offset() -> None:
    assert refusal(Script.good(offset_ns=PERIOD)).status is Status.STACK_REFUSED


def test_one_image_off_the_beat() -> None:
    script = Script.good()
    at, event = script.images[3]
    script.images[3] = (at, replace(event, stamp_ns=event.stamp_ns + 5 * MS))
    assert "off the beat" in refusal(script).reason


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"height": 5}, "bytes for"),
        ({"data": b""}, "0 bytes"),
        ({"data": bytes(10 * 96)}, "960 bytes"),
        ({"encoding": "rgb8"}, "rgb8"),
        ({"encoding": ""}, "encoding"),
        ({"height": 0, "width": 0, "data": b""}, "0 x 0"),
        ({"height": -6, "width": -8}, "-8 x -6"),
        ({"height": 3, "data": bytes(48)}, "began with"),
        ({"encoding": "mono8", "data": bytes(48)}, "began with"),
    ],
)
@pytest.mark.parametrize("which", [1, N - 1])
def test_bad_image(changes: dict[str, object], told: str, which: int) -> None:
    script = Script.good()
    at, event = script.images[which]
    script.images[which] = (at, replace(event, **changes))
    decisions = play(StackMatcher(), script)
    assert [d.index for d in decisions if d.status is Status.BAD_IMAGE] == [which]
    assert told in refusal(script).reason


def test_stack_too_large_for_memory() -> None:
    reason = refusal_of_first(Script.good(), MatcherSettings(max_stack_bytes=500))
    assert "expected at most 500" in reason


def refusal_of_first(script: Script, settings: MatcherSettings) -> str:
    (verdict,) = verdicts(play(StackMatcher(settings), script))
    assert verdict.status is Status.STACK_REFUSED
    return verdict.reason


# -- triggers ---------------------------------------------------------------------------------


@pytest.mark.parametrize("lost", [0, 4, N - 1])
def test_missing_trigger(lost: int) -> None:
    script = Script.good()
    del script.triggers[lost]
    assert "trigger" in refusal(script).reason


def test_only_the_first_trigger_comes() -> None:
    script = Script.good()
    del script.triggers[1:]
    assert "10 of 11 triggers did not come" in refusal(script).reason


def test_duplicated_trigger() -> None:
    script = Script.good()
    script.triggers.insert(4, (script.triggers[3][0] + 1, script.triggers[3][1]))
    assert "trigger 4 of 11 came twice" in refusal(script).reason


def test_swapped_triggers() -> None:
    script = Script.good()
    (a, early), (b, late) = script.triggers[3:5]
    script.triggers[3:5] = [(a, late), (b, early)]
    assert "trigger 4 of 11 is missing" in refusal(script).reason


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"count": 12}, "12"),
        ({"count": 0}, "count 0"),
        ({"count": 65_535}, "count 65535"),
        ({"index": 11}, "index 11"),
        ({"index": -1}, "index -1"),
        ({"sequence_name": "precise"}, "precise"),
        ({"sequence_name": "mine"}, "mine"),
        ({"dmd_size": (1920, 1080)}, "1920"),
        ({"dmd_size": (0, 0)}, "(0, 0)"),
        ({"exposure_s": math.nan}, "nan"),
        ({"exposure_s": -1.0}, "-1.0"),
        ({"exposure_s": 0.02}, "0.02"),
        ({"pattern": Pattern("white")}, "white"),
        ({"stamp_ns": 0}, "0 ns"),
        ({"stamp_ns": T0 - PERIOD}, "is stamped"),
    ],
)
def test_wrong_trigger_in_the_middle(changes: dict[str, object], told: str) -> None:
    script = Script.good()
    at, event = script.triggers[4]
    script.triggers[4] = (at, replace(event, **changes))
    assert told in refusal(script).reason


@pytest.mark.parametrize("count", [0, 12, 4000])
def test_wrong_count_from_the_first_trigger_on(count: int) -> None:
    script = Script.good()
    script.triggers = [(at, replace(e, count=count)) for at, e in script.triggers]  # type: ignore[type-var]
    assert str(count) in refusal(script).reason


def test_overlapping_scans_are_both_refused() -> None:
    assert "overlap" in refusal(Script.good(1), Script.good(2, T0 + 5 * PERIOD)).reason


def test_projector_that_begins_anew_in_the_middle() -> None:
    script = Script.good(1)
    del script.triggers[6:], script.images[6:]
    again = Script.good(1, T0 + 8 * PERIOD)
    first, second = verdicts(play(StackMatcher(), script, again))
    assert first.status is Status.STACK_REFUSED
    assert "anew" in first.reason
    assert_right(stack_of(second))


def test_memory_stays_bounded_whatever_comes() -> None:
    matcher = StackMatcher()
    decisions: list[FrameDecision] = []
    for scan in range(1, 201):
        start_ns = T0 + scan * 3 * PERIOD
        decisions += matcher.trigger(trigger(scan, 0, start_ns), scan)
        decisions += matcher.trigger(trigger(scan, 1, start_ns), scan)
        decisions += matcher.image(image(identity(scan, 0), start_ns), scan)
        decisions += matcher.image(image(FOREIGN, T0 - scan * 10**12), scan)
    assert len(matcher._open) <= 2
    assert len(matcher._waiting) <= 128
    assert len(matcher._closed) <= 32
    decisions += matcher.tick(10**12)
    assert sorted(v.scan_id for v in verdicts(decisions)) == list(range(1, 201))
    assert {v.status for v in verdicts(decisions)} == {Status.STACK_REFUSED}


# -- poses ------------------------------------------------------------------------------------


def test_no_pose_at_all() -> None:
    script = Script.good()
    script.poses = []
    matcher = StackMatcher()
    (verdict,) = verdicts(play(matcher, script))
    assert "pose before the first exposure is unknown" in verdict.reason


def test_no_pose_after_the_last_exposure() -> None:
    script = Script.good()
    script.poses = [(at, p) for at, p in script.poses if p.stamp_ns < T0 + 10 * PERIOD]
    assert "after the last exposure is unknown" in refusal(script).reason


def test_only_an_old_pose_before_the_first_exposure() -> None:
    script = Script.good()
    script.poses = [
        (at, p) for at, p in script.poses if p.stamp_ns > T0 + PERIOD or p.stamp_ns < T0 - 10**10
    ]
    assert "before the first exposure" in refusal(script).reason


@pytest.mark.parametrize("since", [2, 5, N + 1])
def test_stage_that_moves_before_between_or_at_the_end(since: int) -> None:
    script = Script.good()
    script.poses = [
        (at, replace(p, position_m=(3e-6 if k >= since else 0.0, 0.0, 0.0)))  # type: ignore[type-var]
        for k, (at, p) in enumerate(script.poses)
    ]
    assert "moved by 3.0 um" in refusal(script).reason


def test_stage_that_moves_there_and_back_between_two_exposures() -> None:
    script = Script.good()
    at, event = script.poses[6]
    script.poses[6] = (at, replace(event, position_m=(0.0, 1e-4, 0.0)))
    told = [d for d in play(StackMatcher(), script) if d.status is Status.STAGE_MOVED]
    assert len(told) == 1
    assert "moved by 100.0 um" in refusal(script).reason


def test_stage_that_moved_before_the_scan_or_trembles_within_tolerance_is_fine() -> None:
    script = Script.good()
    script.poses = [
        (at, replace(p, position_m=(1e-6 * (k % 2), 0.0, 0.0)))  # type: ignore[type-var]
        for k, (at, p) in enumerate(script.poses)
    ]
    script.poses.insert(0, (T0 - 900 * MS, pose(T0 - 900 * MS, 0.01)))
    assert_right(stack_of(verdicts(play(StackMatcher(), script))[0]))


def test_stage_that_turns() -> None:
    half = 0.5e-3 / 2  # half of 0.5 mrad, five times the tolerance
    script = Script.good()
    at, event = script.poses[6]
    turned = (0.0, 0.0, math.sin(half), math.cos(half))
    script.poses[6] = (at, replace(event, quaternion_xyzw=turned))
    assert "turned by 0.500 mrad" in refusal(script).reason


def test_negated_quaternion_is_the_same_orientation() -> None:
    script = Script.good()
    at, event = script.poses[6]
    script.poses[6] = (at, replace(event, quaternion_xyzw=(0.0, 0.0, 0.0, -1.0)))
    assert_right(stack_of(verdicts(play(StackMatcher(), script))[0]))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"position_m": (math.nan, 0.0, 0.0)}, "not a number"),
        ({"quaternion_xyzw": (0.0, 0.0, math.inf, 1.0)}, "not a number"),
        ({"quaternion_xyzw": (0.0, 0.0, 0.0, 0.0)}, "length 0"),
        ({"frame_id": "map"}, "frame"),
    ],
)
@pytest.mark.parametrize("which", [1, 6, N + 1])
def test_pose_that_is_none(changes: dict[str, object], told: str, which: int) -> None:
    script = Script.good()
    at, event = script.poses[which]
    script.poses[which] = (at, replace(event, **changes))
    assert told in refusal(script).reason


@pytest.mark.parametrize(
    "bad",
    [
        {"tolerance_fraction": 0.5}, {"tolerance_fraction": math.nan}, {"settle_s": 0.0},
        {"timeout_s": math.inf}, {"clock_offset_s": math.nan}, {"max_patterns": 0},
    ],
)  # fmt: skip
def test_settings_out_of_range(bad: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(bad))):
        MatcherSettings(**bad)  # type: ignore[arg-type]


# -- everything at once -----------------------------------------------------------------------

IMAGE_FAULTS = ("drop", "duplicate", "swap", "late", "stamp", "foreign", "size")
TRIGGER_FAULTS = ("drop", "duplicate", "swap")
POSE_FAULTS = ("nan", "moved")


def spoil(script: Script, rng: random.Random, rate: float) -> bool:
    """Spoil a scan at random; tell whether it is spoilt: two faults may undo each other."""
    before = as_it_comes(script)
    for index in range(N):
        if rng.random() < rate:
            spoil_image(script, rng, rng.choice(IMAGE_FAULTS), index)
    if rng.random() < rate:
        spoil_trigger(script, rng.choice(TRIGGER_FAULTS), rng.randrange(N - 1))
    if rng.random() < rate:
        spoil_poses(script, rng.choice(POSE_FAULTS), rng.randrange(2, N))
    return as_it_comes(script) != before


def as_it_comes(script: Script) -> list[list[int]]:
    """Which objects of each kind come in which order, but for what is later than the last of all.

    That is missed, or (the second one of a duplicate) harmless, for the stack is out by then.
    """
    last_ns = script.start_ns + N * PERIOD + 100 * MS
    kinds = (script.triggers, script.images, script.poses)
    ordered = [sorted(kind, key=lambda e: e[0]) for kind in kinds]
    return [[id(e) for at, e in kind if at < last_ns] for kind in ordered]


def spoil_image(script: Script, rng: random.Random, fault: str, index: int) -> None:
    images = script.images
    k = min(index, len(images) - 1)
    at, event = images[k]
    if fault == "drop" or len(images) < 3:
        del images[k]
    elif fault == "duplicate":
        images.insert(k + 1, (at + rng.randrange(6 * MS), event))
    elif fault == "swap":
        j = min(k, len(images) - 2)
        (a, x), (b, y) = images[j : j + 2]
        images[j : j + 2] = [(a, y), (b, x)]
    elif fault == "late":
        # Late by less than its time-out the last image is no fault; any other comes out of order.
        late_ms = 6000 if k == len(images) - 1 else rng.choice([60, 200, 900, 1500, 3000])
        images[k] = (at + late_ms * MS, event)
    elif fault == "stamp":
        images[k] = (at, replace(event, stamp_ns=event.stamp_ns + rng.choice([-1, 1]) * 14 * MS))
    elif fault == "foreign":
        # Off every beat by more than the tolerances, which are 8.25 and 3.3 ms here.
        stamp_ns = script.start_ns + index * PERIOD + rng.randrange(12, 21) * MS
        images.insert(k, (at - rng.randrange(3 * MS), image(FOREIGN, stamp_ns)))
    else:
        images[k] = (at, replace(event, height=SHAPE[0] - 1))


def spoil_trigger(script: Script, fault: str, index: int) -> None:
    if fault == "drop":
        del script.triggers[index]
    elif fault == "duplicate":
        at, event = script.triggers[index]
        script.triggers.insert(index + 1, (at + 1, event))
    else:
        (a, x), (b, y) = script.triggers[index : index + 2]
        script.triggers[index : index + 2] = [(a, y), (b, x)]


def spoil_poses(script: Script, fault: str, index: int) -> None:
    at, event = script.poses[index]
    bad = math.nan if fault == "nan" else 1e-3
    script.poses.append((at + 1, replace(event, position_m=(bad, 0.0, 0.0))))


def random_scan(scan: int, start_ns: int, rng: random.Random) -> Script:
    """Good scan with a clock offset, jitter and times of arrival as they may be."""
    script = Script.good(scan, start_ns, offset_ns=rng.randrange(-3 * MS, 4 * MS))
    lag_ns = rng.randrange(1, 60) * MS
    script.triggers = [(at + lag_ns, e) for at, e in script.triggers]
    script.images = [
        (at + rng.randrange(20 * MS), replace(e, stamp_ns=e.stamp_ns + rng.randrange(-MS, MS)))
        for at, e in script.images
    ]
    return script


def test_two_thousand_scans_with_faults_at_random() -> None:
    rng = random.Random(2005)
    matcher = StackMatcher()
    scripts, faulty = [], {}
    start_ns = T0
    for scan in range(1, 2001):
        script = random_scan(scan, start_ns, rng)
        faulty[scan] = spoil(script, rng, rng.choice([0.0, 0.01, 0.05, 0.3]))
        scripts.append(script)
        start_ns += N * PERIOD + rng.choice([150, 400, 2500]) * MS
    decisions = play(matcher, *scripts)
    told = {scan: [] for scan in faulty}  # type: dict[int, list[FrameDecision]]
    for verdict in verdicts(decisions):
        told[verdict.scan_id].append(verdict)
        if verdict.stack is not None:
            assert_right(verdict.stack)
            matcher.recycle(verdict.stack)
    for scan, found in told.items():
        expected = Status.STACK_REFUSED if faulty[scan] else Status.STACK_COMPLETE
        assert [v.status for v in found] == [expected], (scan, [v.reason for v in found])
        assert bool(found[0].reason) == faulty[scan]
    assert not matcher.busy
    # The draw has both kinds in numbers, or the test tests nothing.
    assert 500 < sum(faulty.values()) < 1500


def test_decisions_depend_on_arrivals_only_not_on_ticks() -> None:
    def run(ticks_ns: int) -> list[tuple[Status, int, int, str]]:
        rng = random.Random(38)
        scripts = []
        for scan in range(1, 61):
            script = random_scan(scan, T0 + scan * 1500 * MS, rng)
            spoil(script, rng, 0.1)
            scripts.append(script)
        found = play(StackMatcher(), *scripts, ticks_ns=ticks_ns)
        return [(d.status, d.scan_id, d.index, d.reason) for d in found]

    assert run(0) == run(3 * MS)
