"""DLPC350 commands that the DLPC900 does not share: bytes only, no state (TI DLPU010, DLPC350 API).

Messages and reports are the DLPC900's (`sl_projector.dlpc.dlpc900_protocol`).
"""

from __future__ import annotations

import struct

from sl_common.errors import ConfigError, DeviceRefused
from sl_projector.dlpc import dlpc900_protocol as common

PRODUCT_ID = 0x6401

VALIDATE = 0x1A1A
SOURCE = 0x1A22
TRIGGER_MODE = 0x1A23
MAILBOX_DATA = 0x1A34
MAILBOX = 0x1A33
VARIABLE_ENTRY = 0x1A3E
VARIABLE_ADDRESS = 0x1A3F
VARIABLE_CONFIG = 0x1A40
IMAGES_IN_FLASH = 0x1A42

NAMES = {
    **common.NAMES,
    VALIDATE: "pattern table validation",
    SOURCE: "pattern source",
    TRIGGER_MODE: "pattern trigger mode",
    MAILBOX_DATA: "mailbox data",
    MAILBOX: "mailbox",
    VARIABLE_ENTRY: "variable exposure entry",
    VARIABLE_ADDRESS: "variable exposure address",
    VARIABLE_CONFIG: "variable exposure configuration",
    IMAGES_IN_FLASH: "number of flash images",
}

MODE_PATTERN = 1
FROM_FLASH = 3
VARIABLE_INTERNAL = 3  # variable exposures, internal or external trigger
BY_TIME, RISING, FALLING, FOLLOWS = range(4)  # trigger of a pattern
CLOSED, IMAGE_TABLE, VARIABLE_TABLE = 0, 1, 3
BUSY = 0x80

#: One count of the trigger outputs' delays; this count is no delay.
DELAY_COUNT_S, NO_DELAY, MAX_DELAY = 107.2e-9, 0xBB, 0xD5

# Bits of the validation status; the others warn of trigger outputs.
_FAULTS = {
    0: "exposure or period out of range",
    1: "pattern number invalid",
    4: "exposure and period differ by less than 230 us",
}


def pattern_word(plane: int, *, leds: int, swap: bool, black: bool, trigger: int = BY_TIME) -> int:
    """Return the word of a 1-bit pattern: trigger, plane, depth 1, LEDs, options.

    Parameters
    ----------
    plane : int
        0 to 23.
    leds : int
        Bit 0 red, bit 1 green, bit 2 blue.
    swap : bool
        Go on to the next image of the image table first.
    black : bool
        Insert black after the exposure.
    trigger : {BY_TIME, RISING, FALLING, FOLLOWS}
        What it begins at; one that follows a triggered pattern shares its trigger.
    """
    return trigger | plane << 2 | 1 << 8 | leds << 12 | black << 17 | swap << 18


def variable_entry(word: int, exposure_us: int, period_us: int) -> bytes:
    """Pack a table entry (0x1A3E), 12 bytes.

    Parameters
    ----------
    word : int
        From `pattern_word`.
    exposure_us, period_us : int
        Exposure, and exposure with the dark time after it, microseconds.
    """
    return struct.pack("<III", word, exposure_us, period_us)


def variable_config(entries: int, images: int, endless: bool) -> bytes:
    """Pack the table's configuration (0x1A40); TRIG_OUT_2 marks every pattern.

    Parameters
    ----------
    entries, images : int
        Number of table entries and of entries of the image table.
    endless : bool
        Repeat until stopped; otherwise once.
    """
    return struct.pack("<HHBB", entries - 1, 0, images - 1, int(endless))


def image_table(images: list[int]) -> bytes:
    """Pack the image table. Of exactly two entries the second is sent first (so does TI's code)."""
    return bytes(images[::-1] if len(images) == 2 else images)


def trigger_in_delay(delay_s: float) -> bytes:
    """Pack trigger input 1's delay (0x1A35), in counts of 107.2 ns.

    Raises
    ------
    ConfigError
        When it is negative or does not fit 32 bits.

    Examples
    --------
    >>> trigger_in_delay(107.2e-6).hex()
    'e8030000'
    """
    count = round(delay_s / DELAY_COUNT_S)
    if not 0 <= count <= 0xFFFFFFFF:
        raise ConfigError(f"trigger input delay is {delay_s} s; expected 0 to 460 s")
    return struct.pack("<I", count)


def delay_count(delay_s: float) -> int:
    """Return a trigger output's delay in the controller's counts.

    Raises
    ------
    ConfigError
        When it is out of range, -20.05 to 2.787 us.

    Examples
    --------
    >>> delay_count(0.0)
    187
    """
    count = NO_DELAY + round(delay_s / DELAY_COUNT_S)
    if not 0 <= count <= MAX_DELAY:
        raise ConfigError(f"trigger output delay is {delay_s} s; expected -20.05e-6 to 2.787e-6 s")
    return count


def validation_faults(status: int) -> tuple[str, ...]:
    """Say what the validation found wrong.

    Examples
    --------
    >>> validation_faults(0x04)
    ()
    >>> validation_faults(0x02)
    ('pattern number invalid',)
    """
    return tuple(text for bit, text in _FAULTS.items() if status >> bit & 1)


def refusal(command: int) -> DeviceRefused:
    """Make the exception for a refused command; the controller gives no reason."""
    return DeviceRefused(f"DLPC350 refused 0x{command:04X} ({NAMES.get(command, 'command')})")
