"""One suite for every stage driver: what ``StageDriver`` promises.

On a real stage as well: ``pytest tests/test_stage_contract.py --hardware grbl=/dev/ttyUSB0``
(or ``zaber=...``). It homes and moves +-2 mm about the middle; what needs a fault is skipped.
"""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Iterator

import pytest

from sl_camera.stage.stage import Position
from sl_common.errors import DeviceLost, DeviceRefused, DeviceTimeout
from support.devices.stage_bench import Mover, StageBench, stage_bench


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    kinds = ["grbl", "zaber", "manual", *metafunc.config.getoption("--hardware")]
    metafunc.parametrize(
        "kind", [k for k in kinds if k.split("=")[0] in ("grbl", "zaber", "manual")]
    )


@pytest.fixture
def bench(kind: str) -> Iterator[StageBench]:
    before = set(threading.enumerate())
    with stage_bench(kind) as made:
        yield made
    assert set(threading.enumerate()) <= before, "a thread is left over"


def place(bench: StageBench) -> Position:
    return bench.truth() if bench.truth else bench.stage.position_m()


def assert_stands(bench: StageBench) -> None:
    before = place(bench)
    time.sleep(0.05)
    assert place(bench) == before


def test_is_locked_until_homed(bench: StageBench, kind: str) -> None:
    bench.stage.open()
    if "=" in kind and bench.stage.state().kind == "idle":
        pytest.skip("the real stage is homed already")
    before = place(bench)
    assert bench.stage.state().kind == "not_homed"
    with pytest.raises(DeviceRefused, match="not_homed"):
        bench.stage.move_to(0.0, 0.0, 0.001)
    assert place(bench) == before
    bench.stage.home()
    assert bench.stage.state().kind == "idle"
    assert bench.stage.state().referenced


def test_limits_enclose_the_zero(bench: StageBench) -> None:
    limits = bench.ready().limits_m()
    assert all(low < 0.0 < high for low, high in zip(limits.low_m, limits.high_m, strict=True))


TARGETS = [(0.0, 0.0, 0.0), (0.002, -0.001, 0.0015), (-0.0012344, 0.0017, -0.002)]


def test_stands_where_it_was_sent(bench: StageBench) -> None:
    stage = bench.ready()
    tolerance = bench.position_error_m + 1e-12
    for target in TARGETS:
        stage.move_to(*target)
        assert stage.position_m() == pytest.approx(target, rel=0, abs=tolerance)
        assert place(bench) == pytest.approx(target, rel=0, abs=tolerance)
        assert stage.state().kind == "idle"


def test_refuses_what_is_out_of_reach(bench: StageBench) -> None:
    stage = bench.ready()
    before = place(bench)
    for axis, value in itertools.product(range(3), (1.0, -1.0, math.nan, math.inf)):
        target = [0.0, 0.0, 0.0]
        target[axis] = value
        with pytest.raises(DeviceRefused, match="xyz"[axis]):
            stage.move_to(*target)
    assert place(bench) == before
    assert stage.state().kind == "idle"


def test_one_mover_at_a_time(bench: StageBench) -> None:
    stage = bench.ready()
    stage.move_to(0.0, 0.0, 0.0)
    bench.slow()
    mover = Mover(stage, 0.002, 0.0, 0.0) if bench.truth is None else Mover(stage, 0.02, 0.0, 0.0)
    with pytest.raises(DeviceRefused):
        stage.move_to(0.0, 0.0, 0.0)
    assert mover.ended() is None
    assert place(bench)[1:] == pytest.approx((0.0, 0.0), abs=2e-6)


def test_hold_keeps_the_move(bench: StageBench) -> None:
    stage = bench.ready()
    stage.move_to(0.0, 0.0, 0.0)
    bench.slow()
    mover = Mover(stage, 0.02, 0.0, 0.0)
    stage.hold()
    assert stage.state().kind == "hold"
    assert_stands(bench)
    assert place(bench)[0] < 0.02
    with pytest.raises(DeviceRefused):
        stage.home()
    stage.resume()
    assert stage.state().kind == "moving"
    assert mover.ended() is None
    assert place(bench)[0] == pytest.approx(0.02, abs=2e-6)


def test_stop_drops_the_move(bench: StageBench) -> None:
    stage = bench.ready()
    stage.move_to(0.0, 0.0, 0.0)
    bench.slow()
    mover = Mover(stage, 0.02, 0.0, 0.0)
    stage.stop()
    error = mover.ended()
    assert error is not None
    assert "stopped" in str(error)
    assert stage.state().kind == "idle"
    assert stage.state().referenced
    assert_stands(bench)
    assert place(bench)[0] < 0.02
    # the position after a stop is not on a step's middle: a report's rounding more
    assert stage.position_m() == pytest.approx(place(bench), abs=2e-6)
    stage.move_to(0.0, 0.0, 0.0)


def test_stop_while_held(bench: StageBench) -> None:
    stage = bench.ready()
    bench.slow()
    mover = Mover(stage, 0.0, 0.0, 0.0)
    stage.hold()
    stage.stop()
    assert mover.ended() is not None
    assert stage.state().kind == "idle"
    assert_stands(bench)


def test_nothing_moves_after_an_alarm_until_it_is_cleared(bench: StageBench) -> None:
    if bench.alarm is None:
        pytest.skip("no fault can be made on this device")
    stage = bench.ready()
    stage.move_to(0.0, 0.0, 0.0)
    bench.slow()
    mover = Mover(stage, 0.02, 0.0, 0.0)
    bench.alarm()
    assert mover.ended() is not None
    assert_stands(bench)
    state = stage.state()
    assert state.kind == "alarm"
    assert state.text
    for attempt in (stage.home, lambda: stage.move_to(0.0, 0.0, 0.0)):
        with pytest.raises(DeviceRefused, match="alarm"):
            attempt()
    assert_stands(bench)
    bench.fast()
    stage.clear()
    stage.home()
    stage.move_to(0.001, 0.0, 0.0)
    assert stage.state().kind == "idle"


def test_a_move_that_takes_too_long_is_stopped(bench: StageBench, kind: str) -> None:
    if bench.truth is None:
        pytest.skip("no slow motion on this device")
    stage = bench.ready()
    bench.never()
    # the time-out strikes in slow motion; the braking after it must not take for ever
    hurry = threading.Timer(0.3, bench.fast if kind != "manual" else lambda: None)
    hurry.start()
    with pytest.raises(DeviceTimeout, match=r"0\.1 s"):
        stage.move_to(0.0, 0.0, 0.0, timeout_s=0.1)
    hurry.join()
    assert stage.state().kind == "idle"
    assert_stands(bench)


def test_closed_is_lost_and_opens_again(bench: StageBench) -> None:
    stage = bench.ready()
    stage.close()
    stage.close()
    assert stage.state().kind == "lost"
    with pytest.raises(DeviceLost):
        stage.move_to(0.0, 0.0, 0.0)
    with pytest.raises(DeviceLost):
        stage.position_m()
    stage.open()
    assert stage.state().kind in ("idle", "not_homed")


def test_many_may_ask_while_one_moves(bench: StageBench) -> None:
    stage = bench.ready()
    stage.move_to(0.0, 0.0, 0.0)
    bench.slow()
    mover = Mover(stage, 0.01, 0.0, 0.0)
    seen: list[float] = []

    def watch() -> None:
        for _ in range(10):
            seen.append(stage.position_m()[0])
            stage.state()

    watchers = [threading.Thread(target=watch) for _ in range(3)]
    for watcher in watchers:
        watcher.start()
    for watcher in watchers:
        watcher.join()
    assert mover.ended() is None
    assert len(seen) == 30
    assert all(-2e-6 <= x <= 0.01 + 2e-6 for x in seen)
