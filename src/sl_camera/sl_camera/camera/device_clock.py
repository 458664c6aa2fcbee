"""A camera's own clock, told in the host's time."""

from __future__ import annotations

from collections import deque

#: Samples that decide; older ones are forgotten, so that drift is followed.
WINDOW = 32
#: Clocks drift apart by so much at most; what was read becomes uncertain at this rate.
DRIFT = 100e-6


class DeviceClock:
    """Host time of a device's time stamps.

    Two kinds of evidence, the better one wins: a latched device time between two readings of the
    host's clock (right to half their distance), or frames' arrivals, of which the least delayed
    tells the offset (right to that frame's delay, so stamps come out late by it).
    """

    def __init__(self) -> None:
        self._latched_ns: int | None = None
        self._latched_at_ns = 0
        self._uncertainty_ns = 0
        self._delays_ns: deque[int] = deque(maxlen=WINDOW)

    @property
    def latched(self) -> bool:
        """Whether the device's clock itself was read."""
        return self._latched_ns is not None

    def latch(self, samples: list[tuple[int, int, int]]) -> None:
        """Take readings of the device's clock, unless an older one is still more certain.

        Parameters
        ----------
        samples : list of (before_ns, device_ns, after_ns)
            Host clock before the reading, device clock, host clock after; the tightest counts.
        """
        before_ns, device_ns, after_ns = min(samples, key=lambda s: s[2] - s[0])
        uncertainty_ns = (after_ns - before_ns) // 2
        aged_ns = self._uncertainty_ns + round(DRIFT * (before_ns - self._latched_at_ns))
        if self._latched_ns is None or uncertainty_ns <= aged_ns:
            self._latched_ns = (before_ns + after_ns) // 2 - device_ns
            self._latched_at_ns, self._uncertainty_ns = after_ns, uncertainty_ns

    def arrival(self, device_ns: int, host_ns: int, exposure_s: float) -> None:
        """Take a frame: it arrived at `host_ns`, at least its exposure after its stamp.

        Parameters
        ----------
        device_ns, host_ns : int
            Start of the exposure by the camera's clock; arrival by the host's, nanoseconds.
        exposure_s : float
            Exposure time, seconds.
        """
        self._delays_ns.append(host_ns - device_ns - round(exposure_s * 1e9))

    def host_ns(self, device_ns: int) -> int:
        """Host time of a device time; needs a reading or a frame before."""
        offset_ns = self._latched_ns if self._latched_ns is not None else min(self._delays_ns)
        return device_ns + offset_ns
