"""Processes kept alive: started, their lines prefixed, restarted with back-off, stopped cleanly.

The semantics are those of ``launch``: SIGINT, five seconds, SIGTERM, five seconds, SIGKILL. Each
process leads a session of its own, so that Ctrl-C reaches it once, from here.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import signal
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass, field

#: Lines longer than this are cut: a process that writes no line ends must not fill the memory.
MAX_LINE_BYTES = 1 << 16
_PR_SET_PDEATHSIG = 1
_libc = ctypes.CDLL(None)


@dataclass(frozen=True)
class Process:
    """One process.

    Parameters
    ----------
    name : str
        For prefixes and messages.
    command : sequence of str
        Program and arguments.
    environment : mapping
        All variables of its environment.
    on_line : callable, optional
        Gets every line that it writes.
    """

    name: str
    command: Sequence[str]
    environment: Mapping[str, str] = field(default_factory=lambda: dict(os.environ))
    on_line: Callable[[str], None] | None = None


@dataclass(frozen=True)
class Timing:
    """Waits of the supervisor, seconds.

    Parameters
    ----------
    backoff_s, backoff_limit_s : float
        Wait before the first restart; it doubles with every further one up to the limit.
    steady_s : float
        A process that lived this long starts with the shortest wait again.
    interrupt_s, terminate_s : float
        Patience after SIGINT and after SIGTERM.
    """

    backoff_s: float = 0.5
    backoff_limit_s: float = 30.0
    steady_s: float = 30.0
    interrupt_s: float = 5.0
    terminate_s: float = 5.0


class Supervisor:
    """Keeps processes alive; an asynchronous context manager.

    Parameters
    ----------
    tell : callable
        Gets every line, prefixed.
    timing : Timing
        Waits.
    """

    def __init__(self, tell: Callable[[str], object], timing: Timing | None = None) -> None:
        self._tell = tell
        self._timing = timing or Timing()
        self._stopping = asyncio.Event()
        self._children: dict[str, asyncio.subprocess.Process] = {}
        self._keepers: list[asyncio.Task[None]] = []
        #: Starts of each process; more than one means that it died.
        self.starts: dict[str, int] = {}
        #: What did not end cleanly when it was asked to.
        self.unclean: list[str] = []

    async def __aenter__(self) -> Supervisor:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop()

    def start(self, process: Process) -> None:
        """Start a process and keep it alive until `stop`."""
        label = f"{process.name}-{len(self._keepers) + 1}"
        self._keepers.append(asyncio.create_task(self._keep(process, label), name=label))

    @property
    def running(self) -> dict[str, int]:
        """Process ids by name."""
        return {name: child.pid for name, child in self._children.items()}

    async def stop(self) -> None:
        """Stop all processes and wait for their ends; `unclean` then says which did not obey."""
        self._stopping.set()
        waiting = set(self._keepers)
        while waiting:  # a process may be just being started
            await asyncio.gather(*(self._end(n, c) for n, c in list(self._children.items())))
            _, waiting = await asyncio.wait(waiting, timeout=0.05)

    async def _keep(self, process: Process, label: str) -> None:
        pause_s = self._timing.backoff_s
        while not self._stopping.is_set():
            began_s = time.monotonic()
            reason = await self._run(process, label)
            if self._stopping.is_set():
                return
            if time.monotonic() - began_s >= self._timing.steady_s:
                pause_s = self._timing.backoff_s
            self._tell(f"[{label}] {reason}; restart in {pause_s:g} s")
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._stopping.wait(), pause_s)
            pause_s = min(2 * pause_s, self._timing.backoff_limit_s)

    async def _run(self, process: Process, label: str) -> str:
        """Run it once, to its end; say how it ended."""
        self.starts[process.name] = self.starts.get(process.name, 0) + 1
        try:
            child = await _spawn(process)
        except OSError as error:
            return f"process cannot be started: {error}"
        self._children[process.name] = child
        self._tell(f"[{label}] process started with pid [{child.pid}]")
        await self._forward(child, process, label)
        code = await child.wait()
        del self._children[process.name]
        if self._stopping.is_set():
            self._note_end(process.name, label, code)
        return f"process has died [pid {child.pid}, exit code {code}, cmd {process.command[0]} ...]"

    def _note_end(self, name: str, label: str, code: int) -> None:
        if code == 0:
            self._tell(f"[{label}] process has finished cleanly")
        else:
            self._tell(f"[{label}] process ended with exit code {code}")
            self.unclean.append(f"{name}: exit code {code}")

    async def _forward(
        self, child: asyncio.subprocess.Process, process: Process, label: str
    ) -> None:
        async for line in _lines(child):
            self._tell(f"[{label}] {line}")
            if process.on_line:
                process.on_line(line)

    async def _end(self, name: str, child: asyncio.subprocess.Process) -> None:
        timing = self._timing
        steps = {
            signal.SIGINT: timing.interrupt_s,
            signal.SIGTERM: timing.terminate_s,
            signal.SIGKILL: 5.0,
        }
        for number, patience_s in steps.items():
            if child.returncode is not None:
                return
            if number != signal.SIGINT:
                self._tell(f"{name} does not end; sending {number.name}")
            _signal_group(child.pid, number)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(child.wait(), patience_s)


def _die_with_parent() -> None:
    """Ask Linux for a SIGINT when the supervisor is killed: no process outlives it unseen."""
    _libc.prctl(_PR_SET_PDEATHSIG, int(signal.SIGINT), 0, 0, 0)


async def _spawn(process: Process) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        *process.command,
        env=dict(process.environment),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        start_new_session=True,
        preexec_fn=_die_with_parent,
    )


async def _lines(child: asyncio.subprocess.Process) -> AsyncIterator[str]:
    """Lines of a process until it closes its output."""
    assert child.stdout is not None
    rest = b""
    while data := await child.stdout.read(MAX_LINE_BYTES):
        *whole, rest = (rest + data).split(b"\n")
        if len(rest) >= MAX_LINE_BYTES:
            whole, rest = [*whole, rest], b""
        for line in whole:
            yield line.decode(errors="replace").rstrip("\r")
    if rest:
        yield rest.decode(errors="replace")


def _signal_group(pid: int, number: signal.Signals) -> None:
    """Signal a process and what it started; it leads its group."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(pid, number)
