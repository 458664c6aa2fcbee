"""One scan from request to cloud: project, follow, repeat, refuse. No ROS here.

A scan runs in its own thread. What arrives meanwhile (verdicts, answers, results) is told to its
`ScanWatch` from other threads; every wait has a time-out that names what is missing.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

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
        """One frame found its place.

        Parameters
        ----------
        index, count : int
            Position in the sequence, and its length.
        """
        self._tell(frames=max(self.frames, index + 1), count=count, last_image_ns=time.time_ns())

    def decided(self, complete: bool, reason: str) -> None:
        """The synchroniser gave its verdict.

        Parameters
        ----------
        complete : bool
            Whether there is a stack.
        reason : str
            Why there is none.
        """
        self._tell(verdict="complete" if complete else "refused", reason=reason)

    def answered(self, success: bool, shown: int, message: str) -> None:
        """The projector is done.

        Parameters
        ----------
        success : bool
            Whether it showed all patterns.
        shown : int
            How many it showed.
        message : str
            What it says.
        """
        self._tell(projected=(success, shown, message))

    def arrived(self) -> None:
        """The stack is here and will be worked on."""
        self._tell(stack_came=True)

    def finished(self, result: Any) -> None:
        """The stack became a report, or an error."""
        self._tell(result=result)

    def sign(self) -> None:
        """Anything else that shows that work goes on."""
        self._tell()

    def silent_s(self) -> float:
        """Seconds since anything was told."""
        return time.monotonic() - self._sign_s

    def wait(self, done: Callable[[], bool]) -> None:
        """Wait until done, a little while at most."""
        with self._condition:
            self._condition.wait_for(done, POLL_S)

    def _tell(self, **values: Any) -> None:
        """Set attributes, and wake who waits for them."""
        with self._condition:
            vars(self).update(values)
            self._sign_s = time.monotonic()
            self._condition.notify_all()


class ScanDevices(Protocol):
    """What a scan needs of the graph."""

    def begin(self) -> ScanWatch:
        """Take a new scan number; from now on its watch is told what arrives."""
        ...

    def project(self, watch: ScanWatch, request: ScanRequest) -> None:
        """Ask the projector and return; the watch is told its answer.

        Parameters
        ----------
        watch : ScanWatch
            Of this attempt.
        request : ScanRequest
            Sequence and exposure.

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
    """How long to wait for something that should come, seconds.

    Parameters
    ----------
    project_timeout_s : float
        For the projector's answer, the upload of patterns included.
    silence_timeout_s : float
        For the next frame, the verdict, the stack.
    reconstruct_timeout_s : float
        For the cloud once the stack is there; the first one may wait for the compiler.
    """

    project_timeout_s: float = 120.0
    silence_timeout_s: float = 5.0
    reconstruct_timeout_s: float = 300.0


class _Step(NamedTuple):
    """Something that is waited for: its stage in the progress, and what to say if it fails."""

    stage: str
    is_done: Callable[[ScanWatch], bool]
    timeout: str
    lack: str


_PROJECTION = _Step(
    "project",
    lambda watch: watch.projected is not None,
    "project_timeout_s",
    "the projector did not answer: is the projector node running?",
)
_VERDICT = _Step(
    "match",
    lambda watch: watch.verdict is not None,
    "silence_timeout_s",
    "no verdict came from the synchronizer: is the synchronizer node running?",
)
_STACK = _Step(
    "match",
    lambda watch: watch.stack_came,
    "silence_timeout_s",
    "the stack did not arrive though the synchronizer sent it: is the shared-memory profile in "
    "force?",
)
_RESULT = _Step(
    "reconstruct",
    lambda watch: watch.result is not None,
    "reconstruct_timeout_s",
    "the reconstruction did not end in time",
)


class ScanRun:
    """One scan, with its repeats.

    Parameters
    ----------
    devices : ScanDevices
        The graph.
    request : ScanRequest
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
        devices: ScanDevices,
        request: ScanRequest,
        tell: Callable[[ScanProgress], None],
        cancelled: Callable[[], bool],
        timeouts: ScanTimeouts,
    ) -> None:
        self._devices, self._request, self._tell = devices, request, tell
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
            self._devices.stop_projecting()
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
                if self._attempt > self._request.max_repeats:
                    made = "once" if self._attempt == 1 else f"{self._attempt} times"
                    raise ScanFailed(f"the scan was tried {made}, at last: {error}") from error
                self._result.attempt_messages.append(str(error))
                self._rest(self._attempt * self._request.rest_s)

    def _rest(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            if self._cancelled():
                raise ScanCancelled("scan cancelled")
            time.sleep(POLL_S)

    def _once(self) -> Any:
        """One attempt: the node's report, or the reason why there is none."""
        if gap := self._devices.missing(self._timeouts.silence_timeout_s):
            raise ScanFailed(gap)
        watch = self._devices.begin()
        self._result.scan_id = watch.scan_id
        self._report("project", watch)
        self._devices.project(watch, self._request)
        self._await_projection(watch)
        self._await_verdict(watch)
        return self._await_cloud(watch)

    def _await_projection(self, watch: ScanWatch) -> None:
        self._await(watch, _PROJECTION)
        success, shown, message = watch.projected or (False, 0, "")
        if not success and shown:
            raise ScanSpoilt(f"the projector failed during scan {watch.scan_id}: {message}")
        if not success:
            raise ScanFailed(f"the projector did not show the sequence: {message}")

    def _await_verdict(self, watch: ScanWatch) -> None:
        self._await(watch, _VERDICT)
        if watch.verdict == "refused":
            hint = "" if watch.frames else "; no image came: is the camera running and triggered?"
            raise ScanSpoilt(f"scan {watch.scan_id} refused: {watch.reason}{hint}")

    def _await_cloud(self, watch: ScanWatch) -> Any:
        self._await(watch, _STACK)
        self._await(watch, _RESULT)
        if isinstance(watch.result, Exception):
            kind = ScanSpoilt if isinstance(watch.result, StackError) else ScanFailed
            raise kind(f"scan {watch.scan_id}: {watch.result}") from watch.result
        self._report("publish", watch)
        return watch.result

    def _await(self, watch: ScanWatch, step: _Step) -> None:
        """Wait for a step; what else happens is told, and silence ends the scan."""
        timeout_s: float = getattr(self._timeouts, step.timeout)
        watch.sign()
        while not step.is_done(watch):
            if self._cancelled():
                raise ScanCancelled(f"scan {watch.scan_id} cancelled")
            if watch.silent_s() > timeout_s:
                lack = self._devices.missing(0.0) or step.lack
                raise ScanFailed(f"{lack} (waited {timeout_s:g} s)")
            self._report(step.stage, watch)
            watch.wait(lambda: step.is_done(watch))
        self._report(step.stage, watch)

    def _report(self, stage: str, watch: ScanWatch) -> None:
        progress = ScanProgress(stage, self._attempt, watch.frames, watch.count)
        if progress != self._told:
            self._told = progress
            self._tell(progress)
