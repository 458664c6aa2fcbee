"""Drivers without devices: a projector that lights a tiny plane, a camera wired to it, a stage."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable

import numpy as np

from sl_camera.camera.camera import CameraSettings, CameraStatistics, Frame, FrameStatus
from sl_camera.stage.stage import Position, StageLimits, StageState
from sl_common.errors import DeviceError, DeviceLost, DeviceRefused
from sl_projector.dlpc.dmd import DmdModel, LoadInfo, ProjectorStatus, RunInfo, Timing
from sl_projector.sequence.pattern_sequence import PatternSequence

#: A DLP5500 of 128 x 96 mirrors, the size of `tiny_scans`.
TINY_DMD = DmdModel("tiny", 5, 128, 96, 400, (83,), (83,))


class FakeProjector:
    """Shows what it is told; tells ``on_run`` when each pattern begins."""

    def __init__(self, on_run: Callable[[PatternSequence, RunInfo], None] | None = None) -> None:
        self.model = TINY_DMD
        self.on_run = on_run
        self.fault: DeviceError | None = None
        self.gone = False
        self.opened = 0
        self.stopped = False
        self._sequence: PatternSequence | None = None
        self._info: RunInfo | None = None

    def open(self) -> None:
        if self.gone:
            raise DeviceLost("no USB device 0451:c900 found")
        self.opened += 1

    def close(self) -> None:
        pass

    def status(self) -> ProjectorStatus:
        if self.gone:
            raise DeviceLost("the device is gone")
        return ProjectorStatus("tiny", "1.0", "normal", False)

    def load(self, sequence: PatternSequence, timing: Timing | None = None) -> LoadInfo:
        if self.gone:
            raise DeviceLost("the device is gone")
        self._sequence = sequence
        return LoadInfo("", False)

    def run(self, timing: Timing | None = None, repeats: int = 1) -> RunInfo:
        assert self._sequence is not None
        self.stopped = False
        self._info = RunInfo(time.time_ns(), 0, len(self._sequence), timing or Timing())
        if self.on_run is not None:
            self.on_run(self._sequence, self._info)
        return self._info

    def wait(self, timeout_s: float | None = None) -> None:
        assert self._info is not None
        end_ns = self._info.start_ns + round(self._info.duration_s * 1e9)
        while time.time_ns() < end_ns and not self.stopped:
            time.sleep(0.001)
        if self.fault is not None:
            raise self.fault

    def stop(self) -> None:
        self.stopped = True

    def idle(self) -> None:
        pass


class FakeCamera:
    """Delivers the frames that are put into it."""

    def __init__(self) -> None:
        self.frames: queue.SimpleQueue[Frame | Exception] = queue.SimpleQueue()
        self.settings: CameraSettings | None = None
        self.gone = False
        self.armed = 0
        self.opened = 0
        self.triggered = 0
        self.counts = CameraStatistics()
        self.image_size = (320, 120)
        self.latency_s = 0.0

    def open(self) -> None:
        if self.gone:
            raise DeviceLost("no camera at this address")
        self.opened += 1

    def configure(self, settings: CameraSettings) -> None:
        if settings.exposure_s > 1.0:
            raise DeviceRefused(f"exposure_s={settings.exposure_s}; this camera can 1 s at most")
        self.settings = settings

    def arm(self) -> None:
        self.armed += 1

    def disarm(self) -> None:
        pass

    def read(self, timeout_s: float) -> Frame | None:
        if self.gone:
            raise DeviceLost("the camera is gone")
        try:
            item = self.frames.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if isinstance(item, Exception):
            raise item
        return item

    def software_trigger(self) -> None:
        self.triggered += 1

    def statistics(self) -> CameraStatistics:
        return self.counts

    def close(self) -> None:
        pass


class WiredPair:
    """A projector and a camera on its trigger line, looking at a scene.

    ``drop`` says for each run (from 0) which frames get lost, ``swap`` which neighbours come with
    each other's content, as after a mix-up of buffers that no number betrays, ``white`` which frame
    is saturated all over, ``twice`` which frames a doubled trigger gives twice.
    """

    def __init__(self, render: Callable[[PatternSequence], np.ndarray]) -> None:
        self.projector = FakeProjector(self._on_run)
        self.camera = FakeCamera()
        self.drop: dict[int, set[int]] = {}
        self.swap: dict[int, int] = {}
        self.white: dict[int, int] = {}
        self.twice: dict[int, set[int]] = {}
        self.runs = 0
        self._render = render

    def _on_run(self, sequence: PatternSequence, info: RunInfo) -> None:
        run, self.runs = self.runs, self.runs + 1
        images = self._render(sequence).copy()
        if run in self.swap:
            i = self.swap[run]
            images[[i, i + 1]] = images[[i + 1, i]]
        if run in self.white:
            images[self.white[run]] = 255
        for index, image in enumerate(images):
            if index in self.drop.get(run, set()):
                continue
            stamp_ns = info.start_ns + round(index * info.timing.period_s * 1e9)
            for _ in range(1 + (index in self.twice.get(run, set()))):
                self.camera.frames.put(Frame(image, index + 1, stamp_ns, 0.001, FrameStatus.OK))


class FakeStage:
    """Goes where it is told, at once."""

    def __init__(self) -> None:
        self.position: Position = (0.0, 0.0, 0.0)
        self.kind = "idle"
        self.gone = False
        self.homed = 0

    def open(self) -> None:
        if self.gone:
            raise DeviceLost("no such port")

    def close(self) -> None:
        pass

    def home(self, *, timeout_s: float = 120.0) -> None:
        self.homed += 1
        self.position = (0.0, 0.0, 0.0)

    def move_to(
        self, x_m: float, y_m: float, z_m: float, *, timeout_s: float | None = None
    ) -> None:
        self.position = (x_m, y_m, z_m)

    def position_m(self) -> Position:
        return self.position

    def state(self) -> StageState:
        if self.gone:
            return StageState("lost", "the port is gone")
        return StageState(self.kind, "", True)  # type: ignore[arg-type]

    def hold(self) -> None:
        pass

    def resume(self) -> None:
        pass

    def stop(self) -> None:
        self.kind = "idle"

    def clear(self) -> None:
        self.kind = "idle"

    def limits_m(self) -> StageLimits:
        return StageLimits((-0.01, -0.01, -0.01), (0.01, 0.01, 0.01))
