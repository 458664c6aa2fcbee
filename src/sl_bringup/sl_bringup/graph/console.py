"""What a command tells its user while it works: lines, and progress that overwrites itself."""

from __future__ import annotations

import sys
import time
from types import TracebackType

_BAR = 24
#: Redraws a second on a terminal; elsewhere (logs) a line every so many seconds.
_REDRAW_S, _LOG_S = 0.1, 5.0

#: Exit status of a command that was interrupted.
INTERRUPTED = 130


def say(line: str) -> None:
    """Write a line to standard output at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def complain(line: str) -> None:
    """Write a line to standard error at once."""
    sys.stderr.write(line + "\n")
    sys.stderr.flush()


class ProgressLine:
    """ProgressLine of counted work on standard error; a bar on a terminal, lines in a log.

    Parameters
    ----------
    what : str
        The work.
    total : int
        Steps in all.
    unit : str
        What a step is.
    """

    def __init__(self, what: str, total: int, unit: str) -> None:
        self._what, self._total, self._unit = what, max(total, 1), unit
        self._done = 0
        self._terminal = sys.stderr.isatty()
        self._shown_s = time.monotonic()

    def __enter__(self) -> ProgressLine:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._terminal and self._done:
            self._show()
            sys.stderr.write("\n")

    def step(self) -> None:
        """One more is done."""
        self._done += 1
        now_s = time.monotonic()
        if now_s - self._shown_s >= (_REDRAW_S if self._terminal else _LOG_S):
            self._shown_s = now_s
            self._show()

    def _show(self) -> None:
        done = min(self._done, self._total)
        counted = f"{done}/{self._total} {self._unit}"
        if self._terminal:
            bar = "#" * (_BAR * done // self._total)
            sys.stderr.write(f"\r{self._what} [{bar:<{_BAR}}] {counted}")
        else:
            sys.stderr.write(f"{self._what}: {counted}\n")
        sys.stderr.flush()


class StatusLine:
    """How work stands that has no known end: a line that overwrites itself, in a log now and then.

    Parameters
    ----------
    what : str
        The work.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._terminal = sys.stderr.isatty()
        self._next_s = time.monotonic() + _LOG_S
        self._told = ""

    def show(self, text: str) -> None:
        """Tell how it stands; a log hears of it when it has changed."""
        if self._terminal:
            sys.stderr.write(f"\r{self._what}: {text} ")
            sys.stderr.flush()
        elif time.monotonic() >= self._next_s and text != self._told:
            self._next_s = time.monotonic() + _LOG_S
            self._told = text
            complain(f"{self._what}: {text}")
