"""Stages under test: a driver, what it drives, and what a test may do to it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress

from sl_bench.stage.grbl_emulator import GrblEmulator
from sl_bench.stage.zaber_emulator import ZaberEmulator
from sl_camera.stage.grbl.grbl_stage import GrblStage
from sl_camera.stage.manual_stage import ManualStage
from sl_camera.stage.stage import Position, StageDriver
from sl_camera.stage.zaber.zaber_stage import ZaberStage
from sl_common.errors import DeviceError
from support.patience import patience, wait

FAST = 25.0


class Clock:
    """Time that runs faster; the rate may change at any moment."""

    def __init__(self, rate: float = FAST) -> None:
        self._base, self._start, self._rate = 0.0, time.monotonic(), rate

    def __call__(self) -> float:
        return self._base + (time.monotonic() - self._start) * self._rate

    def run_at(self, rate: float) -> None:
        self._base, self._start, self._rate = self(), time.monotonic(), rate


class Operator:
    """Somebody who does what a manual stage asks for, after a while."""

    def __init__(self, stage: ManualStage) -> None:
        self.stage, self.delay_s, self.present = stage, 0.02, True
        self._running = True
        self._thread = threading.Thread(target=self._work)
        self._thread.start()

    def _work(self) -> None:
        while self._running:
            if self.present and self.stage.state().kind in ("moving", "homing"):
                time.sleep(self.delay_s)
                with suppress(DeviceError):  # withdrawn or held meanwhile
                    self.stage.confirm()
            time.sleep(0.005)

    def close(self) -> None:
        self._running = False
        self._thread.join()


class StageBench:
    """What a contract test needs besides the driver.

    ``truth`` is where the stage really stands, or None on hardware; ``fast`` is the
    usual pace; ``slow`` makes a move of 20 mm take about a second; ``never`` makes moves take
    practically for ever.
    """

    def __init__(
        self,
        stage: StageDriver,
        truth: Callable[[], Position] | None,
        alarm: Callable[[], None] | None,
        fast: Callable[[], None],
        slow: Callable[[], None],
        never: Callable[[], None],
        position_error_m: float,
    ) -> None:
        self.stage, self.truth, self.alarm = stage, truth, alarm
        self.fast, self.slow, self.never = fast, slow, never
        self.position_error_m = position_error_m

    def ready(self) -> StageDriver:
        self.stage.open()
        self.stage.home()
        return self.stage


class Mover(threading.Thread):
    """A move in the background, and how it ended."""

    def __init__(self, stage: StageDriver, *target: float) -> None:
        super().__init__()
        self._stage, self._target = stage, target
        self.error: DeviceError | None = None
        self.start()
        wait(lambda: stage.state().kind == "moving", "the motion")

    def run(self) -> None:
        try:
            self._stage.move_to(*self._target)
        except DeviceError as error:
            self.error = error

    def ended(self) -> DeviceError | None:
        self.join(patience(10.0))
        assert not self.is_alive()
        return self.error


@contextmanager
def stage_bench(kind: str) -> Iterator[StageBench]:
    """Make a bench: ``grbl``, ``zaber``, ``manual``, or ``grbl=PORT`` for hardware."""
    with ExitStack() as stack:
        name, _, port = kind.partition("=")
        make = {"grbl": _grbl, "zaber": _zaber, "manual": _manual}
        bench = _real(name, port) if port else make[name](stack)
        stack.callback(bench.stage.close)
        yield bench


def _grbl(stack: ExitStack) -> StageBench:
    clock = Clock()
    emulator = stack.enter_context(GrblEmulator(clock=clock))
    # a step is 1 um, and a report rounds to 1 um: half of each
    return StageBench(
        GrblStage(emulator.port),
        emulator.position_m,
        lambda: emulator.close_switch(0),
        lambda: clock.run_at(FAST),
        lambda: clock.run_at(1.5),
        lambda: clock.run_at(0.001),
        1.0e-6,
    )


def _zaber(stack: ExitStack) -> StageBench:
    clock = Clock()
    emulator = stack.enter_context(ZaberEmulator(clock=clock))
    return StageBench(
        ZaberStage(emulator.port),
        emulator.position_m,
        lambda: emulator.fault(0),
        lambda: clock.run_at(FAST),
        lambda: clock.run_at(1.5),
        lambda: clock.run_at(0.001),
        0.5 * 0.047625e-6,  # half a microstep
    )


def _manual(stack: ExitStack) -> StageBench:
    stage = ManualStage()
    operator = Operator(stage)
    stack.callback(operator.close)

    def be(delay_s: float, present: bool) -> None:
        operator.delay_s, operator.present = delay_s, present

    return StageBench(
        stage,
        stage.position_m,
        lambda: stage.give_up("the operator has stopped"),
        lambda: be(0.02, True),
        lambda: be(0.5, True),
        lambda: be(0.0, False),
        0.0,
    )


def _real(name: str, port: str) -> StageBench:
    def nothing() -> None:
        pass

    stage: StageDriver = GrblStage(port) if name == "grbl" else ZaberStage(port)
    return StageBench(stage, None, None, nothing, nothing, nothing, 1.0e-6)
