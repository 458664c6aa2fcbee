"""GRBL 1.1's G-code parser for a stage: words, modal groups, error codes. No arcs, no probing.

Source: gnea/grbl 1.1h, ``doc/markdown/interface.md`` (error codes) and ``commands.md`` (modes).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace

AXIS_WORDS = "XYZ"
_GROUPS = {
    "motion": "G0 G1 G80",
    "plane": "G17 G18 G19",
    "distance": "G90 G91",
    "feed mode": "G94",
    "units": "G20 G21",
    "coordinates": "G54 G55 G56 G57 G58 G59",
    "non-modal": "G4 G10 G53 G92 G92.1",
    "spindle": "M5",
    "coolant": "M9",
}
_GROUP_OF = {code: name for name, codes in _GROUPS.items() for code in codes.split()}
JOG_CODES = frozenset({"G20", "G21", "G53", "G90", "G91"})
_WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))")


class GrblError(Exception):
    """A line is refused with ``error:code``."""

    def __init__(self, code: int) -> None:
        super().__init__(f"error:{code}")
        self.code = code


@dataclass
class Modes:
    """What the parser remembers from line to line."""

    motion: str = "G0"
    distance: str = "G90"
    units: str = "G21"
    coordinates: str = "G54"
    feed: float = 0.0
    offsets: dict[str, list[float]] = field(
        default_factory=lambda: {g: [0.0] * 3 for g in [*_GROUPS["coordinates"].split(), "G92"]}
    )

    def reset(self) -> None:
        """Modes after a reset; G92 is lost, the stored coordinate systems stay."""
        self.offsets["G92"] = [0.0] * 3
        self.__dict__.update(vars(Modes(offsets=self.offsets)))

    def work_offset(self) -> list[float]:
        """WCO = MPos - WPos, mm."""
        stored = self.offsets[self.coordinates]
        return [a + b for a, b in zip(stored, self.offsets["G92"], strict=True)]


@dataclass(frozen=True)
class GcodeCommand:
    """What a line asks for, after the modes have been updated."""

    #: Machine position to go to, mm.
    target: list[float] | None = None
    #: mm/min; 0 for a rapid move.
    feed: float = 0.0
    #: ``G4``.
    dwell_s: float | None = None


def clean(line: str) -> str:
    """Drop blanks and comments and make it upper case, as GRBL's line reader does."""
    return re.sub(r"\([^)]*\)?|;.*|[ \t]", "", line).upper()


def parse(line: str, modes: Modes, position: list[float], *, jog: bool = False) -> GcodeCommand:
    """Read a cleaned line, update the modes (not for a jog) and return what to do.

    Parameters
    ----------
    line : str
        After `clean`; without ``$J=``.
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
        if not JOG_CODES.issuperset(codes.values()) or set(words) - set("XYZFN"):
            raise GrblError(16)
        modes = replace(modes, motion="G1", feed=0.0)
    _check(set(codes.values()), words)
    modal = {name: code for name, code in codes.items() if name in vars(modes)}
    wanted = replace(modes, **modal)  # type: ignore[arg-type]
    scale = 25.4 if wanted.units == "G20" else 1.0
    if "F" in words:
        wanted.feed = words["F"] * scale
    axes = {AXIS_WORDS.index(a): words[a] * scale for a in AXIS_WORDS if a in words}
    command = _command(codes.get("non-modal"), words, axes, wanted, position)
    if jog and command.target is None:
        raise GrblError(26)
    modes.__dict__.update(vars(wanted))
    return command


def _command(
    non_modal: str | None,
    words: dict[str, float],
    axes: dict[int, float],
    modes: Modes,
    position: list[float],
) -> GcodeCommand:
    if non_modal == "G4":
        return GcodeCommand(dwell_s=words["P"])
    if non_modal in ("G10", "G92", "G92.1"):
        _set_offset(non_modal, words, axes, modes, position)
        return GcodeCommand()
    if not axes:
        return GcodeCommand()
    if modes.motion == "G80":
        raise GrblError(31)
    if modes.motion == "G1" and modes.feed <= 0.0:
        raise GrblError(22)
    target = _target(axes, modes, position, non_modal == "G53")
    return GcodeCommand(target=target, feed=modes.feed if modes.motion == "G1" else 0.0)


def _split(line: str) -> tuple[dict[str, str], dict[str, float]]:
    """G and M codes by their modal group, one of each, and the values of the other words."""
    codes: dict[str, str] = {}
    words: dict[str, float] = {}
    at = 0
    while at < len(line):
        match = _WORD.match(line, at)
        if match is None:
            raise GrblError(2 if line[at].isalpha() else 1)
        letter, value = match[1], float(match[2])
        at = match.end()
        if letter in "GM":
            code = f"{letter}{value:g}"
            if code not in _GROUP_OF:
                raise GrblError(20)
            if _GROUP_OF[code] in codes:
                raise GrblError(21)
            codes[_GROUP_OF[code]] = code
        elif letter in words:
            raise GrblError(25)
        else:
            words[letter] = value
    return codes, words


def _check(codes: set[str], words: dict[str, float]) -> None:
    """Rules that need no modes: unknown and missing words, negative values."""
    if set(words) - set("XYZFSTNPLIJK"):
        raise GrblError(20)
    if any(words.get(letter, 0.0) < 0.0 for letter in "FSTNP"):
        raise GrblError(4)
    needed = set("LP") if "G10" in codes else set("P") if "G4" in codes else set()
    if needed - set(words):
        raise GrblError(28)
    if codes & {"G10", "G92"}:
        if not set(AXIS_WORDS) & set(words):
            raise GrblError(26)
        if codes & {"G0", "G1"}:
            raise GrblError(24)
    if set(words) - set("XYZFSTN") - needed:
        raise GrblError(36)


def _target(
    axes: dict[int, float], modes: Modes, position: list[float], machine: bool
) -> list[float]:
    offset = [0.0, 0.0, 0.0] if machine else modes.work_offset()
    # G53 is absolute whatever the distance mode.
    relative = modes.distance == "G91" and not machine
    target = list(position)
    for axis, value in axes.items():
        target[axis] = position[axis] + value if relative else value + offset[axis]
    return target


def _set_offset(
    code: str, words: dict[str, float], axes: dict[int, float], modes: Modes, here: list[float]
) -> None:
    """G10 L2/L20 and G92: change a coordinate system so that the given values hold."""
    if code == "G92.1":
        modes.offsets["G92"] = [0.0] * 3
        return
    if code == "G10" and words["L"] not in (2, 20):
        raise GrblError(20)
    system = modes.coordinates if code == "G92" or not words["P"] else f"G{53 + words['P']:g}"
    if system not in modes.offsets:
        raise GrblError(29)
    changed, other = ("G92", system) if code == "G92" else (system, "G92")
    for axis, value in axes.items():
        stored = code == "G10" and words["L"] == 2
        offset = value if stored else here[axis] - modes.offsets[other][axis] - value
        modes.offsets[changed][axis] = offset
