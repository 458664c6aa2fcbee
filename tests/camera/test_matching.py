"""Matching of triggers, images and poses: what makes a complete stack."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sl_camera.sync.match_events import ImageEvent, MatcherSettings, Status
from sl_camera.sync.matching import StackMatcher
from sl_common.errors import ConfigError
from sl_projector.sequence.pattern_sequence import Pattern
from support.match_scripts import (
    MS,
    PAPER,
    PERIOD,
    SHAPE,
    T0,
    N,
    Script,
    assert_right,
    feed,
    play,
    refusal,
    stack_of,
    trigger,
    verdicts,
)


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
