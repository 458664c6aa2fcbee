"""The emulated camera: exposes the bench's world at each edge of its trigger line.

Edge, shutter, rendering and delivery are a chain of queues: rendering that takes longer than an
exposure delays frames but never changes what is on them, their stamps or their order.
"""

from __future__ import annotations

import heapq
import itertools
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_bench.camera.camera_faults import CameraFaults
from sl_bench.camera.camera_server import CameraServer
from sl_bench.camera.endpoint import Endpoint, Execute
from sl_camera.camera.camera import CameraSettings, PixelFormat
from sl_camera.drivers import socket_protocol as wire
from sl_common.errors import DeviceRefused

Mirrors = NDArray[np.bool_]
Position = tuple[float, float, float]

#: A frame to be swapped with the next one is delivered after this time when there is none.
SWAP_WAIT_S = 0.3
#: An edge may come early by this fraction of the frame time: clocks are not exact.
READY_SLACK = 0.005
#: Frames of an earlier sequence that are later than this are not rendered: nobody waits for them
#: any more, and a slow machine would be late again with the next sequence.
GIVEN_UP_S = 5.0
#: Exposures of the DMD that are remembered, to integrate over.
HISTORY = 256
_POLL_S = 0.05


@dataclass(frozen=True)
class Exposure:
    """One exposure of the sensor.

    Parameters
    ----------
    number : int
        Counts all frames since the camera was switched on; its noise depends on it.
    shown : sequence of (mirrors, seconds)
        What the DMD showed meanwhile; the rest of the exposure it was dark.
    exposure_s : float
        Length, seconds.
    stage_m : tuple of float
        Where the stage stood in the middle of it, metres.
    """

    number: int
    shown: Sequence[tuple[Mirrors, float]]
    exposure_s: float
    stage_m: Position


Render = Callable[[Exposure], NDArray[Any]]


@dataclass
class _Job:
    frame_id: int
    start_ns: int
    settings: CameraSettings
    generation: int
    faults: frozenset[str]
    stage_m: Position

    @property
    def end_ns(self) -> int:
        return self.start_ns + round(self.settings.exposure_s * 1e9)


@dataclass
class _Delivery:
    due_ns: int
    order: int
    header: wire.Header
    pixels: NDArray[Any]

    def __lt__(self, other: _Delivery) -> bool:
        return (self.due_ns, self.order) < (other.due_ns, other.order)


class CameraEmulator:
    """A camera on a local socket (`sl_camera.drivers.socket_protocol`), driven by `SocketCamera`.

    Parameters
    ----------
    endpoint : path or callable
        Its socket (`CameraServer`); or ``endpoint(execute)`` makes another `Endpoint`.
    render : callable
        ``render(exposure) -> image`` of the whole sensor, called from one thread.
    image_size : tuple of int
        (width, height) of the sensor, pixels.
    stage_m : callable
        ``stage_m(time_ns) -> position``: where the stage stood at a time of the host's clock,
        metres: on a busy machine the shutter may look late.
    mirrors_now : callable
        What the DMD shows now, for frames that are not triggered by it.
    max_rate_hz : float
        Frames per second; an edge that comes too early is lost, as a camera loses it.
    readout_s : float
        From the end of the exposure to the delivery.
    pixel_format : {"mono8", "mono16"}
        What the sensor delivers.
    """

    def __init__(
        self,
        endpoint: str | Path | Callable[[Execute], Endpoint],
        render: Render,
        image_size: tuple[int, int],
        stage_m: Callable[[int], Position] = lambda _: (0.0, 0.0, 0.0),
        mirrors_now: Callable[[], Mirrors | None] = lambda: None,
        max_rate_hz: float = 30.0,
        readout_s: float = 0.004,
        pixel_format: PixelFormat = "mono8",
    ) -> None:
        self.faults = CameraFaults()
        self.edges_lost = 0
        self.frames_given_up = 0
        self._render = render
        self._image_size = image_size
        self._stage_m = stage_m
        self._mirrors_now = mirrors_now
        self._frame_time_s = 1.0 / max_rate_hz
        self._readout_ns = round(readout_s * 1e9)
        self._pixel_format = pixel_format
        self._settings = CameraSettings(pixel_format=pixel_format)
        self._armed = False
        self._generation = 0
        self._last_start_ns = 0
        self._sequence_ns = 0
        self._frame_ids = itertools.count(1)
        self._frames_taken = 0
        self._lock = threading.RLock()
        self._shown: deque[tuple[int, float, Mirrors]] = deque(maxlen=HISTORY)
        self._exposing: queue.SimpleQueue[_Job] = queue.SimpleQueue()
        self._rendering: queue.SimpleQueue[_Job] = queue.SimpleQueue()
        self._outbox = _Outbox()
        self._stop = threading.Event()
        self._server: Endpoint = (
            endpoint(self._execute) if callable(endpoint) else CameraServer(endpoint, self._execute)
        )
        self._threads = [
            threading.Thread(target=target, name=f"camera {name}", daemon=True)
            for name, target in (
                ("shutter", self._shutter_loop),
                ("renderer", self._render_loop),
                ("delivery", self._delivery_loop),
            )
        ]

    def start(self) -> None:
        """Switch on."""
        self._server.start()
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Switch off; its endpoint is gone afterwards."""
        self._stop.set()
        self._server.close()
        for thread in self._threads:
            if thread.is_alive():
                thread.join()

    def disconnect(self, seconds: float) -> None:
        """Be unplugged for some seconds; afterwards it is idle and must be configured again."""
        self._idle()
        self._server.disconnect(seconds)

    def state(self) -> dict[str, object]:
        """Return what the control socket reports about the camera."""
        return {
            "armed": self._armed,
            "trigger": self._settings.trigger,
            "frames_taken": self._frames_taken,
            "edges_lost": self.edges_lost,
            "frames_given_up": self.frames_given_up,
        }

    # -- commands ---------------------------------------------------------------------------

    def _execute(self, command: dict[str, Any]) -> dict[str, Any] | None:
        op = command.pop("op")
        if op == "trigger":
            if self._settings.trigger == "software":
                self._expose(time.time_ns())
            return None
        if op == "configure":
            self._configure(command)
        elif op in ("arm", "disarm"):
            self._idle()
            self._armed = op == "arm"
        else:
            raise DeviceRefused(f"no command is called {op!r}")
        return {"ok": True, "image_size": list(self._region()[2:])}

    def _configure(self, fields: dict[str, Any]) -> None:
        region = fields.pop("region", None)
        settings = CameraSettings(**fields, region=tuple(region) if region else None)
        if settings.pixel_format != self._pixel_format:
            raise DeviceRefused(
                f"pixel_format={settings.pixel_format!r}; this sensor delivers "
                f"{self._pixel_format} only"
            )
        width, height = self._image_size
        x, y, w, h = settings.region or (0, 0, 0, 0)
        if x + w > width or y + h > height:
            raise DeviceRefused(
                f"region {settings.region} is not on the sensor of {width} x {height}"
            )
        self._idle()
        self._settings = settings

    def _region(self) -> tuple[int, int, int, int]:
        return self._settings.region or (0, 0, *self._image_size)

    def _idle(self) -> None:
        """Forget all frames on their way."""
        with self._lock:
            self._armed = False
            self._generation += 1
            self._last_start_ns = 0
            self._outbox.clear()

    # -- edges ------------------------------------------------------------------------------

    def on_exposure(self, mirrors: Mirrors, index: int, start_ns: int, exposure_s: float) -> None:
        """Take the DMD's trigger edge; quick, called from the DMD's thread at the edge.

        Parameters
        ----------
        mirrors : ndarray, (rows, columns) bool
            What the DMD shows.
        index : int
            Number of the exposure in the DMD's run.
        start_ns : int
            Time of the edge, host clock.
        exposure_s : float
            For how long the DMD shows it.
        """
        if not self._shown or self._shown[-1][0] != start_ns:  # a doubled edge is no more light
            self._shown.append((start_ns, exposure_s, mirrors))
        if index == 0:
            self._sequence_ns = start_ns
        if self._settings.trigger == "hardware":
            self._expose(start_ns)

    def _expose(self, start_ns: int) -> None:
        """Begin an exposure, unless idle or still busy with the one before."""
        with self._lock:
            if not self._armed:
                return
            busy_s = self._busy_s() * (1 - READY_SLACK)
            too_early = 0 <= start_ns - self._last_start_ns < busy_s * 1e9
            faults = frozenset() if too_early else self.faults.next_frame()
            if too_early or "lost_trigger" in faults:
                self.edges_lost += 1
                return
            self._last_start_ns = start_ns
            frame_id = next(self._frame_ids) & 0xFFFFFFFF
            settings, generation = self._settings, self._generation
            self._exposing.put(
                _Job(frame_id, start_ns, settings, generation, faults, self._stage_m(start_ns))
            )

    def _busy_s(self) -> float:
        """Shortest time between frames."""
        return max(self._frame_time_s, self._settings.exposure_s)

    @property
    def _free_running(self) -> bool:
        return self._armed and self._settings.trigger == "free"

    def _shutter_loop(self) -> None:
        """Wait for the end of each exposure, and see where the stage is then."""
        while not self._stop.is_set():
            try:
                job = self._exposing.get(timeout=self._idle_wait_s())
            except queue.Empty:
                if self._free_running:
                    self._expose(time.time_ns())
                continue
            self._stop.wait(max(0.0, (job.end_ns - time.time_ns()) * 1e-9))
            end_m = self._stage_m(job.end_ns)
            x, y, z = ((a + b) / 2 for a, b in zip(job.stage_m, end_m, strict=True))
            job.stage_m = (x, y, z)
            self._rendering.put(job)

    def _idle_wait_s(self) -> float:
        if not self._free_running:
            return _POLL_S
        since_s = (time.time_ns() - self._last_start_ns) * 1e-9
        return max(0.001, self._busy_s() - since_s)

    # -- frames -----------------------------------------------------------------------------

    def _render_loop(self) -> None:
        while not self._stop.is_set():
            try:
                job = self._rendering.get(timeout=_POLL_S)
            except queue.Empty:
                continue
            if job.generation == self._generation and not self._given_up(job):
                self._post(job, self._image(job))

    def _given_up(self, job: _Job) -> bool:
        late_s = (time.time_ns() - job.end_ns) * 1e-9
        given_up = job.start_ns < self._sequence_ns and late_s > GIVEN_UP_S
        self.frames_given_up += given_up
        return given_up

    def _image(self, job: _Job) -> NDArray[Any]:
        exposure = Exposure(
            job.frame_id, self._integrate(job), job.settings.exposure_s, job.stage_m
        )
        image = self._render(exposure)
        if job.settings.gain != 1.0:
            top = np.iinfo(image.dtype).max
            image = np.clip(image * job.settings.gain, 0, top).astype(image.dtype)
        if job.settings.region is not None:
            x, y, w, h = job.settings.region
            image = image[y : y + h, x : x + w]
        self._frames_taken += 1
        return _spoil(image, job.faults)

    def _integrate(self, job: _Job) -> list[tuple[Mirrors, float]]:
        """Return what the DMD showed during an exposure, and for how long."""
        shown = []
        for start_ns, exposure_s, mirrors in list(self._shown):
            until_ns = min(start_ns + round(exposure_s * 1e9), job.end_ns)
            seconds = (until_ns - max(start_ns, job.start_ns)) * 1e-9
            if seconds > 0:
                shown.append((mirrors, seconds))
        if not shown and job.settings.trigger != "hardware":
            still = self._mirrors_now()
            return [] if still is None else [(still, job.settings.exposure_s)]
        return shown

    def _post(self, job: _Job, image: NDArray[Any]) -> None:
        height, width = image.shape
        header = wire.Header(
            wire.FRAME,
            image.nbytes // 2 if "incomplete" in job.faults else image.nbytes,
            image.itemsize,
            width,
            height,
            job.frame_id,
            job.start_ns + ("stamp" in job.faults) * round(self.faults.stamp_s * 1e9),
            job.settings.exposure_s,
        )
        due_ns = max(job.end_ns + self._readout_ns, time.time_ns())
        due_ns += ("delay" in job.faults) * round(self.faults.delay_s * 1e9)
        with self._lock:
            if job.generation == self._generation:
                self._outbox.post(header, image, due_ns, job.faults)

    def _delivery_loop(self) -> None:
        while not self._stop.is_set():
            delivery = self._outbox.next_due(_POLL_S)
            if delivery is not None:
                self._server.send(delivery.header, delivery.pixels)


def _spoil(image: NDArray[Any], faults: frozenset[str]) -> NDArray[Any]:
    if "saturate" in faults:
        image = np.full_like(image, np.iinfo(image.dtype).max)
    if "wrong_size" in faults:
        height, width = image.shape
        image = image[: max(height // 2, 1), : max(width // 2, 1)]
    return np.ascontiguousarray(image)


class _Outbox:
    """Frames waiting for their time of delivery."""

    def __init__(self) -> None:
        self._heap: list[_Delivery] = []
        self._held: _Delivery | None = None
        self._order = itertools.count()
        self._changed = threading.Condition()

    def clear(self) -> None:
        with self._changed:
            self._heap.clear()
            self._held = None

    def post(
        self, header: wire.Header, pixels: NDArray[Any], due_ns: int, faults: frozenset[str]
    ) -> None:
        """Queue a frame, as often and as late as its faults say."""
        copies = 0 if "drop" in faults else 2 if "duplicate" in faults else 1
        with self._changed:
            held, self._held = self._held, None
            for _ in range(copies):
                delivery = _Delivery(due_ns, next(self._order), header, pixels)
                if "swap" in faults:
                    delivery.due_ns += round(SWAP_WAIT_S * 1e9)
                    self._held = delivery
                self._heap.append(delivery)
            if held is not None and any(held is waiting for waiting in self._heap):
                held.due_ns, held.order = due_ns, next(self._order)
            heapq.heapify(self._heap)
            self._changed.notify()

    def next_due(self, timeout_s: float) -> _Delivery | None:
        """Wait for a frame that is due; None when there was none in time."""
        with self._changed:
            wait_s = timeout_s
            if self._heap:
                wait_s = min(timeout_s, (self._heap[0].due_ns - time.time_ns()) * 1e-9)
            if wait_s > 0:
                self._changed.wait(wait_s)
            if self._heap and self._heap[0].due_ns <= time.time_ns():
                return heapq.heappop(self._heap)
            return None
