"""GRBL 1.1's G-code parser for a stage: words, modal groups, error codes. No arcs, no probing.

Source: gnea/grbl 1.1h, ``doc/markdown/interface.md`` (error codes) and ``commands.md`` (modes).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

AXIS_WORDS = "XYZ"
MODAL_GROUPS: dict[str, frozenset[float]] = {
    "motion": frozenset({0, 1, 80}),
    "plane": frozenset({17, 18, 19}),
    "distance": frozenset({90, 91}),
    "arc distance": frozenset({91.1}),
    "feed mode": frozenset({93, 94}),
    "units": frozenset({20, 21}),
    "cutter": frozenset({40}),
    "tool length": frozenset({49}),
    "coordinates": frozenset({54, 55, 56, 57, 58, 59}),
    "non-modal": frozenset({4, 10, 28, 30, 53, 92, 92.1}),
}
M_GROUPS: dict[str, frozenset[float]] = {
    "program": frozenset({0, 1, 2, 30}),
    "spindle": frozenset({3, 4, 5}),
    "coolant": frozenset({7, 8, 9}),
}
JOG_CODES = frozenset({20, 21, 53, 90, 91})
_WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))")


class GrblError(Exception):
    """A line is refused with ``error:code``."""

    def __init__(self, code: int) -> None:
        super().__init__(f"error:{code}")
        self.code = code


@dataclass
class Modes:
    """What the parser remembers from line to line."""

    motion: float = 0
    distance: float = 90
    units: float = 21
    coordinates: float = 54
    feed: float = 0.0
    offsets: dict[float, list[float]] = field(
        default_factory=lambda: {g: [0.0, 0.0, 0.0] for g in (54, 55, 56, 57, 58, 59, 92)}
    )

    def reset(self) -> None:
        """Modes after a reset; G92 goes, the stored coordinate systems stay."""
        self.motion, self.distance, self.units, self.coordinates, self.feed = 0, 90, 21, 54, 0.0
        self.offsets[92] = [0.0, 0.0, 0.0]

    def work_offset(self) -> list[float]:
        """WCO = MPos - WPos, mm."""
        stored = self.offsets[self.coordinates]
        return [a + b for a, b in zip(stored, self.offsets[92], strict=True)]


@dataclass(frozen=True)
class GcodeCommand:
    """What a line asks for, after the modes have been updated.

    Parameters
    ----------
    target : list of float or None
        Machine position to go to, mm.
    feed : float
        mm/min; 0 for a rapid move.
    dwell_s : float or None
        ``G4``.
    """

    target: list[float] | None = None
    feed: float = 0.0
    dwell_s: float | None = None


def clean(line: str) -> str:
    """Drop blanks and comments, and upper the case, as GRBL's line reader does."""
    return re.sub(r"\([^)]*\)?|;.*", "", line).replace(" ", "").replace("\t", "").upper()


def parse(line: str, modes: Modes, position: list[float], *, jog: bool = False) -> GcodeCommand:
    """Read a cleaned line, update the modes (not for a jog) and say what to do.

    Parameters
    ----------
    line : str
        After ``clean``; without ``$J=``.
    modes : Modes
        Changed in place, unless the line is refused.
    position : list of float
        Planned machine position, mm.
    jog : bool
        The jog's rules: few words, its own F, nothing remembered.

    Raises
    ------
    GrblError
        With the documented code.
    """
    codes, words = _split(line)
    if jog:
        if not {("G", c) for c in JOG_CODES} >= codes or set(words) - set("XYZFN"):
            raise GrblError(16)
        modes = Modes(1, modes.distance, modes.units, modes.coordinates, 0.0, modes.offsets)
    _check(codes, words)
    groups = {_group(letter, code): code for letter, code in codes}
    units = groups.get("units", modes.units)
    scale = 25.4 if units == 20 else 1.0
    wanted = Modes(
        motion=groups.get("motion", modes.motion),
        distance=groups.get("distance", modes.distance),
        units=units,
        coordinates=groups.get("coordinates", modes.coordinates),
        feed=words["F"] * scale if "F" in words else modes.feed,
        offsets=modes.offsets,
    )
    axes = {AXIS_WORDS.index(a): words[a] * scale for a in AXIS_WORDS if a in words}
    order = _order(groups.get("non-modal"), words, axes, wanted, position)
    if jog and order.target is None:
        raise GrblError(26)
    modes.__dict__.update(wanted.__dict__)
    return order


def _order(
    non_modal: float | None,
    words: dict[str, float],
    axes: dict[int, float],
    modes: Modes,
    position: list[float],
) -> GcodeCommand:
    if non_modal == 4:
        return GcodeCommand(dwell_s=words["P"])
    if non_modal in (10, 92, 92.1):
        _set_offset(non_modal, words, axes, modes, position)
        return GcodeCommand()
    if not axes:
        return GcodeCommand()
    if modes.motion == 80:
        raise GrblError(31)
    if modes.motion == 1 and modes.feed <= 0.0:
        raise GrblError(22)
    target = _target(axes, modes, position, non_modal == 53)
    return GcodeCommand(target=target, feed=modes.feed if modes.motion == 1 else 0.0)


def _split(line: str) -> tuple[set[tuple[str, float]], dict[str, float]]:
    """Words of a line; G and M apart, because they may come more than once."""
    codes: set[tuple[str, float]] = set()
    words: dict[str, float] = {}
    at = 0
    while at < len(line):
        match = _WORD.match(line, at)
        if match is None:
            raise GrblError(2 if line[at].isalpha() else 1)
        letter, value = match[1], float(match[2])
        at = match.end()
        if letter in "GM":
            _add_code(codes, letter, value)
        elif letter in words:
            raise GrblError(25)
        else:
            words[letter] = value
    return codes, words


def _add_code(codes: set[tuple[str, float]], letter: str, value: float) -> None:
    group = _group(letter, value)
    if group in {_group(*code) for code in codes}:
        raise GrblError(21)
    codes.add((letter, value))


def _group(letter: str, value: float) -> str:
    for name, members in (MODAL_GROUPS if letter == "G" else M_GROUPS).items():
        if value in members:
            return name
    raise GrblError(20 if value == int(value) or letter == "G" else 23)


def _check(codes: set[tuple[str, float]], words: dict[str, float]) -> None:
    """Rules that need no modes: unknown and missing words, negative values."""
    if set(words) - set("XYZFSTNPLIJK"):
        raise GrblError(20)
    if any(words.get(letter, 0.0) < 0.0 for letter in "FSTNP"):
        raise GrblError(4)
    if ("G", 4) in codes and "P" not in words:
        raise GrblError(28)
    has_axes = any(axis in words for axis in AXIS_WORDS)
    if ("G", 10) in codes and not {"L", "P"} <= set(words):
        raise GrblError(28)
    setters = {("G", 10), ("G", 92)} & codes
    if setters and not has_axes:
        raise GrblError(26)
    if setters and {("G", 0), ("G", 1)} & codes:
        raise GrblError(24)
    used = set("XYZFSTN") | ({"P"} if {("G", 4), ("G", 10)} & codes else set())
    if set(words) - used - ({"L"} if ("G", 10) in codes else set()):
        raise GrblError(36)


def _target(
    axes: dict[int, float], modes: Modes, position: list[float], machine: bool
) -> list[float]:
    offset = [0.0, 0.0, 0.0] if machine else modes.work_offset()
    target = list(position)
    for axis, value in axes.items():
        # G53 is absolute whatever the distance mode
        relative = modes.distance == 91 and not machine
        target[axis] = position[axis] + value if relative else value + offset[axis]
    return target


def _set_offset(
    code: float, words: dict[str, float], axes: dict[int, float], modes: Modes, here: list[float]
) -> None:
    """G10 L2/L20 and G92: change a coordinate system so that the given values hold."""
    if code == 92.1:
        modes.offsets[92] = [0.0, 0.0, 0.0]
        return
    if code == 10 and words["L"] not in (2, 20):
        raise GrblError(20)
    system = modes.coordinates if code == 92 or not words["P"] else 53 + words["P"]
    if system not in modes.offsets:
        raise GrblError(29)
    for axis, value in axes.items():
        if code == 92:
            modes.offsets[92][axis] = here[axis] - modes.offsets[system][axis] - value
        elif words["L"] == 2:
            modes.offsets[system][axis] = value
        else:
            modes.offsets[system][axis] = here[axis] - modes.offsets[92][axis] - value
