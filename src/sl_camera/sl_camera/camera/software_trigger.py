"""Which pattern a software-triggered frame shows: the one that it was exposed in wholly, or none.

A camera without trigger line is told of each pattern by message. It is late by an unknown time, so
every frame is checked against the time for which its pattern was shown.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass, replace

from sl_camera.camera.camera import Frame
from sl_common.errors import DeviceError, DeviceRefused

#: Clocks of camera and projector may differ by so much.
SLACK_NS = 2_000_000


@dataclass(frozen=True, slots=True)
class Window:
    """While one pattern is shown, host clock, nanoseconds."""

    start_ns: int
    end_ns: int


class PatternWindows:
    """The patterns whose frames are still to come.

    Parameters
    ----------
    settle_s : float
        From a pattern's start to the camera's trigger, seconds.
    """

    def __init__(self, settle_s: float) -> None:
        self.settle_s = settle_s
        self._pending: deque[Window] = deque()
        self._lock = threading.Lock()

    def announce(
        self, stamp_ns: int, pattern_s: float, exposure_s: float, latency_s: float
    ) -> Window:
        """Take a pattern; the camera is to be triggered `settle_s` after its start.

        Parameters
        ----------
        stamp_ns : int
            Start of the pattern, host clock.
        pattern_s, exposure_s : float
            How long it is shown; how long the camera exposes.
        latency_s : float
            `CameraDriver.latency_s`.

        Raises
        ------
        DeviceRefused
            When the camera cannot be done before the pattern ends.
        """
        needed_s = self.settle_s + latency_s + exposure_s
        if needed_s > pattern_s:
            raise DeviceRefused(
                f"a pattern is shown for {pattern_s:g} s; this software-triggered camera needs "
                f"{needed_s:g} s (settle {self.settle_s:g}, latency {latency_s:g}, exposure "
                f"{exposure_s:g}): lengthen the projector's exposure_s"
            )
        window = Window(stamp_ns, stamp_ns + round(pattern_s * 1e9))
        late_s = time.time_ns() * 1e-9 - stamp_ns * 1e-9 - self.settle_s
        if late_s + needed_s > pattern_s:
            raise DeviceRefused(
                f"the trigger came {late_s:g} s late; a pattern of {pattern_s:g} s is over before "
                f"the camera is done, which needs {needed_s:g} s"
            )
        with self._lock:
            self._pending.append(window)
        return window

    def withdraw(self, window: Window) -> None:
        """Expect no frame for it any more."""
        with self._lock:
            if window in self._pending:
                self._pending.remove(window)

    def take(self, frame: Frame) -> Frame:
        """Give a frame the stamp of the pattern that it shows.

        A frame that nothing announced is returned as it is.

        Raises
        ------
        DeviceError
            When it was still being exposed when its pattern ended: it shows two.
        """
        with self._lock:
            while self._pending and frame.stamp_ns >= self._pending[0].end_ns:
                self._pending.popleft()
            if not self._pending or frame.stamp_ns < self._pending[0].start_ns - SLACK_NS:
                return frame
            window = self._pending.popleft()
        over_ns = frame.stamp_ns + round(frame.exposure_s * 1e9) - window.end_ns
        if over_ns > SLACK_NS:
            raise DeviceError(
                f"frame {frame.frame_id} was exposed until {over_ns * 1e-6:.1f} ms after its "
                "pattern had ended, thrown away"
            )
        return replace(frame, stamp_ns=window.start_ns)
