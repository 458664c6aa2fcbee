"""Zaber's ASCII protocol as data: commands, replies, checksum, flags in words.

Source: Zaber ASCII protocol as in the vendor's own libraries (``hardware.md`` section 4.3).
"""

from __future__ import annotations

import re
from dataclasses import dataclass

FAULTS = {
    "FF": "critical system error",
    "FN": "the peripheral is not supported",
    "FZ": "the axis is inactive",
    "FH": "the hardware emergency stop is pressed",
    "FV": "the supply voltage is out of range",
    "FO": "the driver was switched off by a command",
    "FC": "the inrush current is too high",
    "FM": "the motor is too hot",
    "FD": "the driver is disabled",
    "FQ": "encoder error",
    "FI": "index error",
    "FA": "analog encoder error",
    "FR": "the overdrive limit is exceeded",
    "FS": "stalled and stopped",
    "FB": "a stream left its bounds",
    "FP": "a path deviates too far",
    "FE": "a limit was reached",
    "FT": "twist error",
}
UNREFERENCED = frozenset({"WR", "WH"})
REJECTIONS = {
    "BADDATA": "the value is malformed or out of range",
    "BADCOMMAND": "the command is not known",
    "AGAIN": "the device is busy, ask again",
    "BADAXIS": "there is no such axis",
    "FULL": "the device has no room for it",
    "STATUSBUSY": "not possible while moving",
    "DEVICEONLY": "the command is for the whole device",
    "BADMESSAGEID": "the message number is malformed",
    "NOACCESS": "the access level is too low",
    "PARKED": "the axis is parked",
    "DRIVERDISABLED": "the driver is disabled",
    "INACTIVE": "the axis is inactive",
}

_REPLY = re.compile(
    r"@(\d\d) (\d) (?:(\d\d) )?(OK|RJ) (BUSY|IDLE) (--|[A-Z][A-Z0-9]) ?([^:]*)(?::([0-9A-F]{2}))?"
)


def checksum(text: str) -> int:
    """LRC of a message without its first character: all bytes and it add up to 0 modulo 256."""
    return -sum(text.encode("ascii")) & 0xFF


def command(device: int, axis: int, number: int, data: str) -> bytes:
    """Encode a command, with message number and checksum, so that no stale reply is taken.

    Parameters
    ----------
    device, axis : int
        Address; axis 0 is the whole device.
    number : int
        Message number, 0 to 99.
    data : str
        Command and its arguments; empty asks for the status.
    """
    body = f"{device:02d} {axis} {number:02d} {data}".rstrip()
    return f"/{body}:{checksum(body):02X}\n".encode("ascii")


@dataclass(frozen=True)
class Reply:
    """One reply of a device.

    Parameters
    ----------
    device, axis : int
        Who answers; axis 0 is the whole device.
    number : int or None
        The command's message number.
    accepted : bool
        ``OK``; otherwise ``RJ``, with the reason in ``data``.
    busy : bool
        The axis moves.
    flag : str
        The most important warning, ``--`` for none.
    data : str
        What was asked for.
    """

    device: int
    axis: int
    number: int | None
    accepted: bool
    busy: bool
    flag: str
    data: str


def parse_reply(line: str) -> Reply:
    """Read a reply; its checksum is verified where it carries one.

    Raises
    ------
    ValueError
        It is no reply (alerts and info lines are not), or the checksum is wrong.
    """
    match = _REPLY.fullmatch(line)
    if match is None:
        raise ValueError(f"no Zaber reply: {line!r}")
    device, axis, number, status, busy, flag, data, lrc = match.groups()
    if lrc is not None and checksum(line[1:-3]) != int(lrc, 16):
        raise ValueError(f"wrong checksum in {line!r}, expected {checksum(line[1:-3]):02X}")
    return Reply(
        int(device),
        int(axis),
        None if number is None else int(number),
        status == "OK",
        busy == "BUSY",
        flag,
        data.strip(),
    )
