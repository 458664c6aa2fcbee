"""What a command tells its user while it works: lines, and progress that overwrites itself."""

from __future__ import annotations

import sys
import time

_BAR = 24
#: Time between redraws on a terminal, and between lines elsewhere (logs).
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


class StatusLine:
    """How work stands: a line that overwrites itself on a terminal, lines in a log now and then.

    Parameters
    ----------
    what : str
        The work.
    """

    def __init__(self, what: str) -> None:
        self._what, self._told = what, ""
        self._terminal = sys.stderr.isatty()
        self._next_s = time.monotonic() + (0.0 if self._terminal else _LOG_S)

    def show(self, text: str) -> None:
        """Tell how it stands, not too often; a log hears of it when it has changed."""
        if time.monotonic() < self._next_s or (text == self._told and not self._terminal):
            return
        self._next_s = time.monotonic() + (_REDRAW_S if self._terminal else _LOG_S)
        self._told = text
        if self._terminal:
            sys.stderr.write(f"\r{self._what}: {text} ")
            sys.stderr.flush()
        else:
            complain(f"{self._what}: {text}")


class ProgressLine(StatusLine):
    """Counted work, with a bar on a terminal; a context manager.

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
        super().__init__(what)
        self._total, self._unit, self._done = max(total, 1), unit, 0

    def __enter__(self) -> ProgressLine:
        return self

    def __exit__(self, *_: object) -> None:
        if self._terminal and self._done:
            self._next_s = 0.0  # the last step in any case
            self._show()
            sys.stderr.write("\n")

    def step(self) -> None:
        """One more is done."""
        self._done += 1
        self._show()

    def _show(self) -> None:
        done = min(self._done, self._total)
        bar = f"[{'#' * (_BAR * done // self._total):<{_BAR}}] " if self._terminal else ""
        self.show(f"{bar}{done}/{self._total} {self._unit}")
