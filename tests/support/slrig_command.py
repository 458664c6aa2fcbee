"""A ``slrig`` that runs in a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

from sl_bringup.graph.transport import process_environment
from support.patience import Deadline, patience

SLRIG = (sys.executable, "-m", "sl_bringup.cli.main")
#: The first start on a machine compiles for a minute or two.
READY_PATIENCE_S = 280.0


class Command:
    """A running ``slrig`` whose output is collected."""

    def __init__(self, *arguments: str) -> None:
        self._process = subprocess.Popen(
            (*SLRIG, *arguments),
            env=process_environment({"PYTHONPATH": os.pathsep.join(sys.path)}),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout
        self.lines.extend(line.rstrip() for line in iter(self._process.stdout.readline, ""))

    @property
    def text(self) -> str:
        return "\n".join(self.lines)

    def wait_for(self, text: str, patience_s: float, times: int = 1) -> None:
        deadline = Deadline(patience_s)
        while self.text.count(text) < times:
            assert self._process.poll() is None, f"ended before it said {text!r}:\n{self.text}"
            assert not deadline.is_over, f"did not say {text!r}:\n{self.text}"
            time.sleep(0.05)

    def end(self, number: signal.Signals | None = None, patience_s: float = 60.0) -> int:
        if number:
            self._process.send_signal(number)
        try:
            return self._process.wait(patience(patience_s))
        finally:
            self._process.kill()
            self._process.wait()
            self._reader.join()
            self._process.stdout.close()  # type: ignore[union-attr]

    def pid_of(self, name: str) -> int:
        started = [line for line in self.lines if line.startswith(f"[{name}-") and "pid [" in line]
        return int(started[-1].rpartition("[")[2].rstrip("]"))
