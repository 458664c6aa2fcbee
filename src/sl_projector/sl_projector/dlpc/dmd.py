"""DMD projectors below ROS: the models, and what a driver must do.

A projector driver is any class with the methods of `ProjectorDriver`;
`sl_projector.dlpc.dlpc900_driver` is the one for TI's DLPC900. To support another projector write
such a class, nothing else changes.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import Protocol

from sl_common.errors import ConfigError
from sl_projector.sequence.pattern_sequence import PatternSequence

PLANES_PER_IMAGE = 24
MAX_EXPOSURE_US = (1 << 24) - 1  # the LUT entry's field has 24 bits


@dataclass(frozen=True)
class DmdModel:
    """What the driver must know of one DMD with its controller (TI DLPU018J, DLPS037H).

    Parameters
    ----------
    name : str
        TI's part number.
    hardware_code : int
        Byte 0 of the answer to command 0x0206.
    columns, rows : int
        Mirrors.
    max_patterns : int
        1-bit patterns that the controller's memory and pattern table hold.
    block_load_us : tuple of int
        Shortest 1-bit exposure with 1, 2, ... active blocks, microseconds; the last entry is for
        the whole DMD.
    min_exposure_us : tuple of int
        Shortest exposure of bit depth 1, 2, ... 8, microseconds, all blocks active.
    dual : bool
        Two controllers, each with one half of the columns (the left half is the primary's).
    controller : {"DLPC900", "DLPC350"}
        TI's controller, which decides on the driver.
    """

    name: str
    hardware_code: int
    columns: int
    rows: int
    max_patterns: int
    block_load_us: tuple[int, ...]
    min_exposure_us: tuple[int, ...]
    dual: bool = False
    controller: str = "DLPC900"

    @property
    def size(self) -> tuple[int, int]:
        """(columns, rows), as `PatternSequence.dmd_size`."""
        return self.columns, self.rows

    @property
    def min_dark_us(self) -> int:
        """Shortest dark time other than none: the time in which black is loaded."""
        return self.block_load_us[-1]


_DEPTHS_SINGLE = (304, 394, 823, 1215, 1487, 1998, 4046)
_DEPTHS_DUAL = (304, 380, 733, 1215, 1487, 1998, 4046)
_BLOCKS_6500 = (24, 45, 45, 45, 48, 54, 60, 66, 72, 78, 84, 90, 96, 101, 105)
_BLOCKS_9000 = (24, 42, 42, 42, 45, 51, 56, 61, 67, 72, 77, 83, 88, 93, 99, 105)
_DEPTHS_350 = (235, 700, 1570, 1700, 2000, 2500, 4500, 8333)
_BLOCKS_5500 = (25, 30, 35, 28, 33, 38, 43, 48, 53, 58, 63, 68, 73, 78, 83)

# Sizes of DLP670S and DLP500YX and their block tables are not confirmed by a second source; the
# driver always drives all blocks, so only the tables' last entries matter to it. For the DLP5500
# the datasheet says 1024 patterns, the programmer's guide 960 table entries: a controller that
# agrees with the guide answers error 15.
MODELS: dict[str, DmdModel] = {
    m.name: m
    for m in (
        DmdModel("DLP6500", 1, 1920, 1080, 400, _BLOCKS_6500, (105, *_DEPTHS_SINGLE)),
        DmdModel("DLP9000", 2, 2560, 1600, 480, _BLOCKS_9000, (105, *_DEPTHS_DUAL), dual=True),
        DmdModel("DLP670S", 3, 2716, 1600, 400, _BLOCKS_9000, (105, *_DEPTHS_DUAL), dual=True),
        DmdModel("DLP500YX", 4, 2048, 1200, 800, (62,), (62, *_DEPTHS_DUAL), dual=True),
        DmdModel("DLP5500", 5, 1024, 768, 1024, _BLOCKS_5500, (83, *_DEPTHS_SINGLE)),
        # LightCrafter 4500: it has no hardware code; its mirrors stand on their corners.
        DmdModel("DLP4500", -1, 912, 1140, 1824, (235,), _DEPTHS_350, controller="DLPC350"),
    )
}
DEFAULT_MODEL = "DLP5500"


def dmd_model(name: str = DEFAULT_MODEL) -> DmdModel:
    """Return a DMD of the family by TI's part number.

    Raises
    ------
    ConfigError
        When the name is unknown.

    Examples
    --------
    >>> dmd_model().size
    (1024, 768)
    """
    if name not in MODELS:
        raise ConfigError(f"DMD model {name!r} is unknown; expected one of {sorted(MODELS)}")
    return MODELS[name]


@dataclass(frozen=True)
class TriggerOut:
    """One trigger output: delays of its edges, -20e-6 to 20e-3 s, and its polarity."""

    rising_delay_s: float = 0.0
    falling_delay_s: float = 0.0
    inverted: bool = False

    def __post_init__(self) -> None:
        for delay_s in (self.rising_delay_s, self.falling_delay_s):
            if not -20e-6 <= delay_s <= 20e-3:
                raise ConfigError(
                    f"trigger output delay is {delay_s} s; expected -0.00002 to 0.02 s"
                )
        if self.inverted and self.rising_delay_s < self.falling_delay_s:
            raise ConfigError(
                f"inverted trigger output: rising_delay_s={self.rising_delay_s} is less than "
                f"falling_delay_s={self.falling_delay_s}; expected at least that"
            )


@dataclass(frozen=True)
class TriggerIn:
    """External trigger: every pattern waits for an edge on TRIG_IN_1, then for the delay.

    With ``first_only`` the first pattern of each run of the table does; the others follow by time.
    """

    delay_s: float = 105e-6
    falling_edge: bool = False
    first_only: bool = False

    def waits(self, index: int) -> bool:
        """Whether a pattern of the table waits."""
        return index == 0 or not self.first_only


@dataclass(frozen=True)
class Timing:
    """How long each pattern of a run is lit and dark, seconds; whole microseconds are used.

    With no dark time DLPC900's TRIG_OUT_1 stays high between patterns; TRIG_OUT_2 always marks
    the start of each pattern.
    """

    exposure_s: float = 10e-3
    dark_s: float = 0.0

    @property
    def exposure_us(self) -> int:
        """Exposure, whole microseconds."""
        return round(self.exposure_s * 1e6)

    @property
    def dark_us(self) -> int:
        """Dark time after the exposure, whole microseconds."""
        return round(self.dark_s * 1e6)

    @property
    def period_s(self) -> float:
        """From one exposure's start to the next, seconds, as the device keeps it."""
        return (self.exposure_us + self.dark_us) * 1e-6


@dataclass(frozen=True)
class LoadInfo:
    """What `ProjectorDriver.load` did."""

    digest: str
    uploaded: bool
    images: int = 0
    image_bytes: int = 0
    messages: int = 0
    reports: int = 0


@dataclass(frozen=True)
class Loaded:
    """What a device holds: where each pattern lies, and with which timing."""

    digest: str
    places: tuple[tuple[int, int], ...]
    timing: Timing
    repeats: int


def sequence_digest(sequence: PatternSequence) -> str:
    """Return a digest of what a sequence shows, whatever its name."""
    content = repr((sequence.dmd_size, sequence.patterns))
    return hashlib.sha256(content.encode()).hexdigest()


@dataclass(frozen=True)
class RunInfo:
    """What `ProjectorDriver.run` started.

    Parameters
    ----------
    start_ns : int
        Host clock (`time.time_ns`) at the middle of the start command's write.
    start_uncertainty_ns : int
        Half of that write's duration; the device's own latency comes on top.
    count : int
        Exposures to come; 0 means until `stop`.
    timing : Timing
        Exposure and dark time as the device has them. Exposure i of a run that is not triggered
        from outside starts at ``start_ns + i * timing.period_s``.
    """

    start_ns: int
    start_uncertainty_ns: int
    count: int
    timing: Timing

    @property
    def duration_s(self) -> float:
        """From the first exposure to the end of the last dark time; 0 when endless."""
        return self.count * self.timing.period_s


@dataclass(frozen=True)
class ProjectorStatus:
    """What the device says of itself; ``problems`` is empty when all is well."""

    model: str
    firmware: str
    power: str
    running: bool
    problems: tuple[str, ...] = ()
    registers: dict[str, int] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """True when the device reports no problem."""
        return not self.problems


class ProjectorDriver(Protocol):
    """What the projector node asks of a driver.

    The node calls `open` once at activation, `load` and `run`/`wait` for each scan, `status` once
    a second from another thread (so methods lock what they share), `stop` at any time, `close` at
    deactivation. After any `DeviceError` the node may call `open` again: it must then either work
    from a clean state or raise. Nothing is retried that could show a pattern twice.
    """

    @property
    def model(self) -> DmdModel:
        """The DMD: its size is what sequences must have."""
        ...

    def open(self) -> None:
        """Connect and make ready.

        Called at activation and after a failure, also when already open. Afterwards the device is
        awake, checked to be the configured model, and shows nothing; no sequence is loaded.

        Raises
        ------
        DeviceLost
            When the device is not there or another program has it.
        DeviceError
            When it is there but is of another model, faulty, or does not answer.
        """
        ...

    def status(self) -> ProjectorStatus:
        """Ask the device; changes nothing, also allowed in a run. Raises DeviceError."""
        ...

    def load(self, sequence: PatternSequence, timing: Timing | None = None) -> LoadInfo:
        """Make a sequence ready to run.

        Called before a run. Afterwards `run` with the same timing only has to start it. Loading
        what is loaded already sends nothing.

        Parameters
        ----------
        sequence : PatternSequence
            Made for the size of the DMD.
        timing : Timing, optional
            As loaded before, or the default.

        Raises
        ------
        SequenceError
            When the sequence does not fit the DMD or its memory; nothing has been sent.
        ConfigError
            When the timing is out of the device's range; nothing has been sent.
        DeviceError
            When the device refused or failed; no sequence is loaded then.
        """
        ...

    def run(self, timing: Timing | None = None, repeats: int = 1) -> RunInfo:
        """Start the loaded sequence and return at once.

        Called after `load`, with the camera armed. ``timing`` None keeps the one loaded;
        ``repeats`` 0 means until `stop`. Afterwards the first exposure has begun, or waits for
        the external trigger.

        Parameters
        ----------
        timing : Timing, optional
            As loaded if omitted.
        repeats : int
            0 runs until `stop`.

        Raises
        ------
        DeviceError
            When nothing is loaded, a sequence is running, or the device refused.
        """
        ...

    def wait(self, timeout_s: float | None = None) -> None:
        """Block until the run is over, then read the error and status registers.

        Called after `run` with ``repeats`` > 0. ``timeout_s`` is counted from the start; None
        means the run's duration and a few seconds.

        Raises
        ------
        DeviceTimeout
            When the run did not end in time; it has been stopped.
        DeviceError
            When the device aborted the sequence or it ended early (then the images are wrong).
        """
        ...

    def stop(self) -> None:
        """Stop showing patterns; the loaded sequence stays. Safe when nothing runs."""
        ...

    def idle(self) -> None:
        """Let the mirrors flip evenly, light off, to spare them; `run` ends it.

        Called when no scan is expected soon.
        """
        ...

    def close(self) -> None:
        """Stop, put the device on standby, release it.

        Called at deactivation, also when the device is gone or not open. Never raises a
        DeviceError: nobody could do anything about it.
        """
        ...
