"""Lost frames, told from the numbers that a camera gives its frames."""

from __future__ import annotations

#: GigE Vision's 16-bit block ids run 1 ... 65535 and never are 0; 65535 is followed by 1.
GVSP_PERIOD = 65535


class FrameIds:
    """Counts frames that never came.

    Parameters
    ----------
    period : int
        Numbers repeat after so many frames.
    """

    def __init__(self, period: int) -> None:
        self.lost = 0
        self._period = period
        self._last: int | None = None

    def start(self) -> None:
        """Begin anew: whatever number comes next is the first."""
        self._last = None

    def take(self, frame_id: int) -> None:
        """Count the numbers between this frame and the newest before it.

        A frame that comes late was counted as lost and is not any more; a repeated one is neither.
        """
        if self._last is None:
            self._last = frame_id
            return
        ahead = (frame_id - self._last) % self._period
        if 0 < ahead < self._period // 2:
            self.lost += ahead - 1
            self._last = frame_id
        elif ahead:
            self.lost = max(0, self.lost - 1)
