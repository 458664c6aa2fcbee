"""GRBL 1.1's side of the conversation as data: status reports, codes in words, coordinates.

Sources: gnea/grbl 1.1h, ``doc/markdown/interface.md`` and ``commands.md``; grblHAL's additions
where they are marked so. Pure functions, no port.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from sl_camera.stage.stage import AXES, Position, StageLimits

HOLD = b"!"
RESUME = b"~"
STATUS = b"?"
RESET = b"\x18"
JOG_CANCEL = b"\x85"
#: What a controller that echoes puts in front of its own lines: commands that end no line.
ECHO = "?!~\x18"
#: Oldest version whose status reports and real-time commands are these.
OLDEST_VERSION = (1, 1)

ERRORS = {
    1: "a word has no letter",
    2: "a number is missing or malformed",
    3: "the $ command is not known",
    4: "a value is negative",
    5: "homing is not enabled ($22)",
    6: "the step pulse is shorter than 3 us",
    7: "the EEPROM could not be read; defaults restored",
    8: "the $ command needs the idle state",
    9: "G-code is locked out in alarm or jog",
    10: "soft limits need homing enabled",
    11: "the line is too long",
    12: "the step rate is above what the controller can do",
    13: "the safety door is open",
    14: "the start-up line is too long",
    15: "the jog target is beyond the travel; ignored",
    16: "the jog command has no '=' or a word that is not allowed",
    17: "laser mode needs PWM",
    18: "a reset is asserted (grblHAL)",
    20: "a G-code is not supported",
    21: "two G-codes of one modal group",
    22: "no feed rate is set",
    23: "a whole number is needed",
    24: "two commands use the axis words",
    25: "a word is repeated",
    26: "no axis words",
    27: "the line number is out of range",
    28: "a P or L word is missing",
    29: "G59.1 to G59.3 are not supported",
    30: "G53 needs G0 or G1",
    31: "axis words are unused",
    32: "an arc has no axis words",
    33: "the motion target is invalid",
    34: "the arc radius is invalid",
    35: "an arc has no offset words",
    36: "words are left over",
    37: "the tool length offset is on another axis",
    38: "the tool number is too high",
    45: "only homing is allowed while a limit switch is closed (grblHAL)",
    46: "home the machine first (grblHAL)",
    50: "the emergency stop is active (grblHAL)",
    79: "not allowed while a critical event is active (grblHAL)",
}

ALARMS = {
    1: "a limit switch closed; the position is lost",
    2: "the target is beyond the soft limits; the position is kept",
    3: "reset while moving; the position is lost",
    4: "the probe is not in its initial state",
    5: "the probe made no contact",
    6: "homing was interrupted by a reset",
    7: "homing was interrupted by the safety door",
    8: "homing could not clear the limit switch",
    9: "homing found no limit switch",
    10: "the emergency stop is pressed (grblHAL)",
    11: "homing is required (grblHAL)",
    12: "a limit switch is closed (grblHAL)",
    17: "motor fault (grblHAL)",
}

UNTOLD_ALARM = "the controller is in alarm and did not say why"
ALARMS_KEEPING_POSITION = frozenset({2, 4, 5})


def error_text(reply: str) -> str:
    """Put ``error:N`` into words; an unknown code stays a number."""
    return f"{reply} ({ERRORS.get(_code(reply), 'meaning not known')})"


def alarm_text(code: int) -> str:
    """Put an alarm code into words; an unknown code stays a number."""
    return f"ALARM:{code}: {ALARMS.get(code, 'meaning not known')}"


def alarm_code(line: str) -> int:
    """Code of an ``ALARM:N`` line; 0 where it carries none."""
    return _code(line)


def _code(line: str) -> int:
    digits = line.partition(":")[2].strip()
    return int(digits) if digits.isdigit() else 0


@dataclass(frozen=True)
class Report:
    """One status report.

    Parameters
    ----------
    state : str
        ``Idle``, ``Run``, ``Hold``, ``Jog``, ``Alarm``, ``Door``, ``Check``, ``Home``, ``Sleep``
        (grblHAL: ``Tool``).
    substate : int
        ``Hold:0`` stopped, ``Hold:1`` decelerating; ``Door:0`` to 3; 0 where there is none.
    position : tuple of float
        First three axes as reported, in the report's unit.
    is_machine : bool
        The position is MPos; otherwise WPos, and MPos = WPos + WCO.
    offset : tuple of float or None
        WCO, where this report carries it.
    """

    state: str
    substate: int
    position: tuple[float, float, float]
    is_machine: bool
    offset: tuple[float, float, float] | None

    @property
    def is_halted(self) -> bool:
        """A hold or an open door whose motion is over (not ``Hold:1``, ``Door:2``, ``Door:3``)."""
        return (self.state == "Hold" and self.substate == 0) or (
            self.state == "Door" and self.substate < 2
        )

    @property
    def is_braking(self) -> bool:
        """On its way to being halted."""
        return self.state in ("Hold", "Door") and not self.is_halted


def parse_report(line: str) -> Report:
    """Read a ``<...>`` status report.

    Raises
    ------
    ValueError
        It is not one: brackets, position or numbers are missing.
    """
    if not (line.startswith("<") and line.endswith(">")):
        raise ValueError(f"no status report: {line!r}")
    head, *fields = line[1:-1].split("|")
    state, _, sub = head.partition(":")
    values = dict(field.split(":", 1) for field in fields if ":" in field)
    is_machine = "MPos" in values
    if not state.isalpha() or not (is_machine or "WPos" in values):
        raise ValueError(f"status report without state or position: {line!r}")
    return Report(
        state=state,
        substate=int(sub) if sub.isdigit() else 0,
        position=_triple(values["MPos" if is_machine else "WPos"]),
        is_machine=is_machine,
        offset=_triple(values["WCO"]) if "WCO" in values else None,
    )


def _triple(text: str) -> tuple[float, float, float]:
    x, y, z, *_ = (float(word) for word in text.split(","))
    return x, y, z


def parse_setting(line: str) -> tuple[int, float] | None:
    """Read ``$n=value (comment)``; None for another line, or no number (grblHAL has texts)."""
    name, equals, value = line.partition("=")
    if not (equals and name.startswith("$") and name[1:].isdigit()):
        return None
    try:
        return int(name[1:]), float(value.partition("(")[0])
    except ValueError:
        return None


def is_supported(banner: str) -> bool:
    """Whether a banner is GRBL's or a descendant's, of version 1.1 or later."""
    found = re.match(r"grbl\w*\s+v?(\d+)\.(\d+)", banner.lower())
    return found is not None and (int(found[1]), int(found[2])) >= OLDEST_VERSION


@dataclass(frozen=True)
class MachineFrame:
    """Stage metres from machine millimetres and back: ``stage = sign * (MPos - origin)``.

    Parameters
    ----------
    origin_mm : tuple of float
        MPos where the stage reads zero.
    signs : tuple of int
        +1 or -1 per axis; z is chosen so that +z moves the part towards the devices.
    low_mm, high_mm : tuple of float
        MPos between which the stage may be sent.
    """

    origin_mm: tuple[float, float, float]
    signs: tuple[int, int, int]
    low_mm: tuple[float, float, float]
    high_mm: tuple[float, float, float]

    def stage_m(self, machine_mm: tuple[float, float, float]) -> Position:
        """Stage position in metres of an MPos in millimetres."""
        x, y, z = (
            sign * (value - origin) * 1e-3
            for sign, value, origin in zip(self.signs, machine_mm, self.origin_mm, strict=True)
        )
        return x, y, z

    def machine_mm(self, stage_m: Position) -> tuple[float, float, float]:
        """MPos in millimetres of a stage position in metres."""
        x, y, z = (
            origin + sign * value * 1e3
            for sign, value, origin in zip(self.signs, stage_m, self.origin_mm, strict=True)
        )
        return x, y, z

    def limits(self) -> StageLimits:
        """The reach in stage metres."""
        ends = tuple(zip(self.stage_m(self.low_mm), self.stage_m(self.high_mm), strict=True))
        low, high = (tuple(pick(pair) for pair in ends) for pick in (min, max))
        return StageLimits((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def machine_frame(
    settings: dict[int, float],
    origin_mm: tuple[float, float, float] | None,
    signs: tuple[int, int, int],
) -> MachineFrame:
    """Frame and reach from the controller's own settings.

    With homing (``$22``) machine space is [-travel, 0] (``$130`` to ``$132``) and the stage's
    zero is by default its middle. grblHAL can call the switch zero (bit 3 of ``$22``): then an
    axis homed in the negative direction (``$23``) has [0, travel]. Without homing, machine zero
    is where the stage stood at power-up: that is the stage's zero then, and the travel bounds it
    on both sides.

    Parameters
    ----------
    settings : dict of int to float
        The controller's ``$`` settings.
    origin_mm : tuple of float or None
        The stage's zero in machine coordinates; None for the default.
    signs : tuple of int
        1 or -1 per axis: direction of the stage's axis in machine coordinates.
    """
    travel = [abs(settings.get(130 + i, 0.0)) for i in range(len(AXES))]
    homing, directions = int(settings.get(22, 0)), int(settings.get(23, 0))
    low, high = [-length for length in travel], list(travel)
    for i in range(len(AXES)) if homing & 1 else ():
        positive = homing & 8 and directions >> i & 1
        low[i], high[i] = (0.0, travel[i]) if positive else (-travel[i], 0.0)
    x, y, z = ((a + b) / 2.0 for a, b in zip(low, high, strict=True))
    return MachineFrame(
        origin_mm or (x, y, z), signs, (low[0], low[1], low[2]), (high[0], high[1], high[2])
    )
