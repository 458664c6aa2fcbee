"""The course of a scan, without ROS: who is waited for, what is repeated, what ends it."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from sl_common.errors import CalibrationError, StackError
from sl_reconstruct.scan.scan_flow import (
    ScanFailed,
    ScanProgress,
    ScanRequest,
    ScanResult,
    ScanRun,
    ScanTimeouts,
    ScanWatch,
)

SHORT = ScanTimeouts(0.2, 0.2, 0.2)
Script = Callable[[ScanWatch], None]


class FakeGear:
    """A node that plays one script per attempt."""

    def __init__(self, *scripts: Script, missing: str = "") -> None:
        self.scripts = list(scripts)
        self.lack = missing
        self.begun = 0
        self.stopped = False

    def begin(self) -> ScanWatch:
        self.begun += 1
        return ScanWatch(100 + self.begun)

    def project(self, watch: ScanWatch, request: ScanRequest) -> None:
        self.scripts.pop(0)(watch)

    def stop_projecting(self) -> None:
        self.stopped = True

    def missing(self, patience_s: float) -> str:
        return self.lack


def good(watch: ScanWatch) -> None:
    for index in range(3):
        watch.matched(index, 3)
    watch.answered(True, 3, "3 patterns shown")
    watch.arrived()
    watch.decided(True, "")
    watch.finished("the report")


def refused(watch: ScanWatch) -> None:
    watch.matched(0, 3)
    watch.answered(True, 3, "3 patterns shown")
    watch.decided(False, "image 2 of 3 is missing")


def faltered(watch: ScanWatch) -> None:
    watch.answered(False, 3, "the run ended early")


def swapped(watch: ScanWatch) -> None:
    watch.answered(True, 3, "")
    watch.decided(True, "")
    watch.arrived()
    watch.finished(StackError("images 1 and 2 were exchanged"))


def silent(watch: ScanWatch) -> None:
    pass


def run(
    gear: FakeGear, repeats: int = 2, cancelled: Callable[[], bool] = lambda: False
) -> tuple[ScanResult, list[ScanProgress]]:
    told: list[ScanProgress] = []
    order = ScanRequest("precise", 0.0, repeats)
    return ScanRun(gear, order, told.append, cancelled, SHORT).run(), told


def test_a_good_scan_gives_the_report_and_tells_every_stage() -> None:
    result, told = run(FakeGear(good))
    assert (result.success, result.report, result.attempt_messages) == (True, "the report", [])
    assert [p.stage for p in told] == ["project", "project", "match", "reconstruct", "publish"]
    fractions = [p.fraction for p in told]
    assert fractions == sorted(fractions)
    assert fractions[0] == 0.0
    assert fractions[-1] == 1.0


@pytest.mark.parametrize("spoilt", [refused, faltered, swapped])
def test_a_spoilt_attempt_is_repeated_and_its_reason_kept(spoilt: Script) -> None:
    gear = FakeGear(spoilt, good)
    result, told = run(gear)
    assert result.success
    assert gear.begun == 2
    assert len(result.attempt_messages) == 1
    assert "101" in result.attempt_messages[0]
    assert told[-1].attempt == 2


def test_the_limit_of_repeats_ends_a_scan_with_the_last_reason() -> None:
    gear = FakeGear(refused, refused, refused, good)
    result, _ = run(gear, repeats=2)
    assert not result.success
    assert gear.begun == 3
    assert "3 times" in result.message
    assert "image 2 of 3 is missing" in result.message
    assert len(result.attempt_messages) == 2


def test_what_cannot_get_better_is_not_repeated() -> None:
    def unknown(watch: ScanWatch) -> None:
        watch.answered(False, 0, "no sequence is called 'nix'")

    def uncalibrated(watch: ScanWatch) -> None:
        swapped(watch)
        watch.finished(CalibrationError("no calibration is in force"))

    for script, word in ((unknown, "nix"), (uncalibrated, "no calibration")):
        gear = FakeGear(script, good)
        result, _ = run(gear)
        assert (result.success, gear.begun) == (False, 1)
        assert word in result.message


def test_every_wait_names_what_is_missing() -> None:
    def only_projected(watch: ScanWatch) -> None:
        watch.answered(True, 3, "")

    def no_stack(watch: ScanWatch) -> None:
        watch.answered(True, 3, "")
        watch.decided(True, "")

    def no_cloud(watch: ScanWatch) -> None:
        no_stack(watch)
        watch.arrived()

    scripts = {
        "projector node running": silent,
        "synchronizer node running": only_projected,
        "the stack did not arrive": no_stack,
        "reconstruction did not end": no_cloud,
    }
    for words, script in scripts.items():
        result, _ = run(FakeGear(script))
        assert not result.success
        assert words in result.message


def test_a_refusal_without_any_image_asks_for_the_camera() -> None:
    def dark(watch: ScanWatch) -> None:
        watch.answered(True, 3, "")
        watch.decided(False, "3 of 3 images did not come")

    result, _ = run(FakeGear(dark), repeats=0)
    assert "is the camera running" in result.message


def test_a_graph_with_a_gap_is_told_before_anything_is_projected() -> None:
    gear = FakeGear(good, missing="nobody publishes camera/image_raw: is the camera node running?")
    result, _ = run(gear)
    assert not result.success
    assert gear.begun == 0
    assert "camera/image_raw" in result.message


def test_cancel_ends_every_wait_and_stops_the_projector() -> None:
    gear = FakeGear(silent)
    result, _ = run(gear, cancelled=lambda: True)
    assert (result.success, result.cancelled, gear.stopped) == (False, True, True)


def test_nobody_to_ask_is_an_answer() -> None:
    class Deaf(FakeGear):
        def project(self, watch: ScanWatch, request: ScanRequest) -> None:
            raise ScanFailed("the projector cannot be asked")

    result, _ = run(Deaf())
    assert result.message == "the projector cannot be asked"
