"""Faults of images, triggers and poses, one at a time: refused with a reason, then a good scan."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from sl_camera.sync.match_events import FrameDecision, MatcherSettings, Status
from sl_camera.sync.matching import StackMatcher
from sl_projector.sequence.pattern_sequence import Pattern
from support.match_scripts import (
    FOREIGN,
    MS,
    PERIOD,
    T0,
    N,
    Script,
    assert_right,
    identity,
    image,
    play,
    pose,
    refusal,
    stack_of,
    trigger,
    verdicts,
)

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
