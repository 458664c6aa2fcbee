"""Two thousand scans with random faults, and decisions that do not depend on ticks."""

from __future__ import annotations

import math
import random
from dataclasses import replace

from sl_camera.sync.match_events import Status
from sl_camera.sync.matching import StackMatcher
from support.match_scripts import (
    FOREIGN,
    MS,
    PERIOD,
    SHAPE,
    T0,
    N,
    Script,
    assert_right,
    image,
    play,
    verdicts,
)

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
