"""One scan from request to cloud: project, follow, repeat, refuse. No ROS here.

A scan runs in its own thread. What arrives meanwhile (verdicts, answers, results) is told to its
`ScanWatch` from other threads; every wait has a time-out that names what is missing.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

from sl_common.errors import SlError, StackError

POLL_S = 0.05


class ScanFailed(SlError):
    """The scan cannot be made; repeating it would not help."""


class ScanSpoilt(SlError):
    """An attempt is worthless, the next one may be good."""


class ScanCancelled(SlError):
    """Whoever asked for the scan does not want it any more."""


@dataclass(frozen=True)
class ScanRequest:
    """What is asked for.

    Parameters
    ----------
    sequence : str
        Name of the sequence; empty: the projector's default.
    exposure_s : float
        Exposure of each pattern, seconds; 0: the projector's default.
    max_repeats : int
        How often a spoilt attempt is repeated.
    rest_s : float
        Pause before a repeat, longer each time, so that late images of the attempt before pass.
    """

    sequence: str = ""
    exposure_s: float = 0.0
    max_repeats: int = 2
    rest_s: float = 0.0


@dataclass(frozen=True)
class ScanProgress:
    """How far a scan is; ``stage`` is "project", "match", "reconstruct" or "publish"."""

    stage: str
    attempt: int
    frames: int
    count: int

    @property
    def fraction(self) -> float:
        """0 .. 1; most of the time goes by while frames come in."""
        if self.stage == "publish":
            return 1.0
        if self.stage == "reconstruct":
            return 0.9
        return 0.9 * self.frames / self.count if self.count else 0.0


@dataclass
class ScanResult:
    """What became of a scan; ``report`` is the node's, None where there is no cloud."""

    success: bool
    message: str
    cancelled: bool = False
    scan_id: int = 0
    attempt_messages: list[str] = field(default_factory=list)
    report: Any = None


class ScanWatch:
    """What is known of one attempt; written by other threads, awaited by the scan's."""

    def __init__(self, scan_id: int) -> None:
        self.scan_id = scan_id
        self.frames = 0
        self.count = 0
        self.verdict: str | None = None
        self.reason = ""
        self.last_image_ns = 0
        self.projected: tuple[bool, int, str] | None = None
        self.stack_came = False
        self.result: Any = None
        self._sign_s = time.monotonic()
        self._condition = threading.Condition()

    def matched(self, index: int, count: int) -> None:
        """One frame found its place."""
        with self._told():
            self.frames, self.count = max(self.frames, index + 1), count
            self.last_image_ns = time.time_ns()

    def decided(self, complete: bool, reason: str) -> None:
        """The synchroniser gave its verdict."""
        with self._told():
            self.verdict, self.reason = ("complete" if complete else "refused"), reason

    def answered(self, success: bool, shown: int, message: str) -> None:
        """The projector is done with so many patterns, or cannot."""
        with self._told():
            self.projected = (success, shown, message)

    def arrived(self) -> None:
        """The stack is here and will be worked on."""
        with self._told():
            self.stack_came = True

    def finished(self, result: Any) -> None:
        """The stack became a report, or an error."""
        with self._told():
            self.result = result

    def sign(self) -> None:
        """Anything else that shows that work goes on."""
        with self._told():
            pass

    def silent_s(self) -> float:
        """Seconds since anything was told."""
        return time.monotonic() - self._sign_s

    def wait(self, done: Callable[[], bool]) -> None:
        """Wait until done, a little while at most."""
        with self._condition:
            self._condition.wait_for(done, POLL_S)

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Hold the lock while the watch is written, then wake who waits."""
        with self._condition:
            yield
            self._sign_s = time.monotonic()
            self._condition.notify_all()


class ScanDevices(Protocol):
    """What a scan needs of the node."""

    def begin(self) -> ScanWatch:
        """Take a new scan number; from now on its watch is told what arrives."""
        ...

    def project(self, watch: ScanWatch, order: ScanRequest) -> None:
        """Ask the projector and return; the watch is told its answer.

        Raises
        ------
        ScanFailed
            When there is nobody to ask.
        """
        ...

    def stop_projecting(self) -> None:
        """End a projection that nobody needs any more."""
        ...

    def missing(self, patience_s: float) -> str:
        """Say which part of the graph is still not there after a while; empty when all are."""
        ...


@dataclass(frozen=True)
class ScanTimeouts:
    """How long is waited for something that should come, seconds.

    Parameters
    ----------
    project_s : float
        For the projector's answer, the upload of patterns included.
    silence_s : float
        For the next frame, the verdict, the stack.
    reconstruct_s : float
        For the cloud once the stack is there; the first one may wait for the compiler.
    """

    project_s: float = 120.0
    silence_s: float = 5.0
    reconstruct_s: float = 300.0


class ScanRun:
    """One scan, with its repeats.

    Parameters
    ----------
    gear : ScanDevices
        The node.
    order : ScanRequest
        What is asked for.
    tell : callable
        Called with each change of progress.
    cancelled : callable
        Asked often; True ends the scan.
    timeouts : ScanTimeouts
        Patience.
    """

    def __init__(
        self,
        gear: ScanDevices,
        order: ScanRequest,
        tell: Callable[[ScanProgress], None],
        cancelled: Callable[[], bool],
        timeouts: ScanTimeouts,
    ) -> None:
        self._gear, self._order, self._tell = gear, order, tell
        self._cancelled, self._timeouts = cancelled, timeouts
        self._told: ScanProgress | None = None
        self._attempt = 0
        self._result = ScanResult(False, "")

    def run(self) -> ScanResult:
        """Scan; never raises an `SlError`: what went wrong is in the result."""
        result = self._result
        try:
            result.report = self._repeat()
            result.success, result.message = True, "cloud published"
        except ScanCancelled as error:
            self._gear.stop_projecting()
            result.cancelled, result.message = True, str(error)
        except SlError as error:
            result.message = str(error)
        return result

    def _repeat(self) -> Any:
        while True:
            self._attempt += 1
            try:
                return self._once()
            except ScanSpoilt as error:
                if self._attempt > self._order.max_repeats:
                    made = "once" if self._attempt == 1 else f"{self._attempt} times"
                    raise ScanFailed(f"the scan was tried {made}, at last: {error}") from error
                self._result.attempt_messages.append(str(error))
                self._rest(self._attempt * self._order.rest_s)

    def _rest(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            if self._cancelled():
                raise ScanCancelled("scan cancelled")
            time.sleep(POLL_S)

    def _once(self) -> Any:
        """One attempt: the node's report, or the reason why there is none."""
        if gap := self._gear.missing(self._timeouts.silence_s):
            raise ScanFailed(gap)
        watch = self._gear.begin()
        self._result.scan_id = watch.scan_id
        self._report("project", watch)
        self._gear.project(watch, self._order)
        self._await_projection(watch)
        self._await_verdict(watch)
        return self._await_cloud(watch)

    def _await_projection(self, watch: ScanWatch) -> None:
        self._wait(
            watch, "project", lambda: watch.projected is not None, self._timeouts.project_s,
            "the projector did not answer: is the projector node running?",
        )  # fmt: skip
        success, shown, message = watch.projected or (False, 0, "")
        if not success and shown:
            raise ScanSpoilt(f"the projector faltered in scan {watch.scan_id}: {message}")
        if not success:
            raise ScanFailed(f"the projector did not show the sequence: {message}")

    def _await_verdict(self, watch: ScanWatch) -> None:
        self._wait(
            watch, "match", lambda: watch.verdict is not None, self._timeouts.silence_s,
            "no verdict came from the synchronizer: is the synchronizer node running?",
        )  # fmt: skip
        if watch.verdict == "refused":
            hint = "" if watch.frames else "; no image came: is the camera running and triggered?"
            raise ScanSpoilt(f"scan {watch.scan_id} refused: {watch.reason}{hint}")

    def _await_cloud(self, watch: ScanWatch) -> Any:
        self._wait(
            watch, "match", lambda: watch.stack_came, self._timeouts.silence_s,
            "the stack did not arrive though the synchronizer sent it: is the shared-memory "
            "profile in force?",
        )  # fmt: skip
        self._wait(
            watch, "reconstruct", lambda: watch.result is not None, self._timeouts.reconstruct_s,
            "the reconstruction did not end in time",
        )  # fmt: skip
        if isinstance(watch.result, StackError):
            raise ScanSpoilt(f"scan {watch.scan_id}: {watch.result}") from watch.result
        if isinstance(watch.result, Exception):
            raise ScanFailed(f"scan {watch.scan_id}: {watch.result}") from watch.result
        self._report("publish", watch)
        return watch.result

    def _wait(
        self, watch: ScanWatch, stage: str, done: Callable[[], bool], timeout_s: float, lack: str
    ) -> None:
        """Wait until done; what else happens is told, and silence ends the scan."""
        watch.sign()
        while not done():
            if self._cancelled():
                raise ScanCancelled(f"scan {watch.scan_id} cancelled")
            if watch.silent_s() > timeout_s:
                raise ScanFailed(f"{self._gear.missing(0.0) or lack} (waited {timeout_s:g} s)")
            self._report(stage, watch)
            watch.wait(done)
        self._report(stage, watch)

    def _report(self, stage: str, watch: ScanWatch) -> None:
        progress = ScanProgress(stage, self._attempt, watch.frames, watch.count)
        if progress != self._told:
            self._told = progress
            self._tell(progress)
