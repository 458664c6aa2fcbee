"""Registers of the emulated DLPC900 that are only stored: command, bytes at power-up.

TI's guide describes the first group. The second is what public host programs (TI's own among them)
write or read besides: a device that refused it would stop them before they load a pattern.
"""

from __future__ import annotations

import struct

FLIP_COLUMNS, FLIP_ROWS = 0x1008, 0x1009
INVERT_DATA = 0x1A30
#: Registers of the trigger outputs 1 and 2.
TRIGGER_OUT = {1: 0x1A1D, 2: 0x1A1E}
TRIGGER_IN_DELAY = 0x1A35
ACTIVE_BLOCKS = 0x1A40

STORED = {
    0x1000: bytes(16),
    FLIP_COLUMNS: b"\x00",
    FLIP_ROWS: b"\x00",
    0x1100: bytes(6),
    0x1A00: b"\x00",
    0x1A07: b"\x08",
    TRIGGER_OUT[1]: bytes(5),
    TRIGGER_OUT[2]: bytes(5),
    TRIGGER_IN_DELAY: struct.pack("<HB", 105, 0),
    0x1A36: b"\x00",
    ACTIVE_BLOCKS: b"\x00\x10",
    0x0202: b"\x00",  # controller that is asked
    0x0609: b"\x00",  # park
    0x0B01: bytes(3),  # LED currents
    0x1203: b"\x00",  # test pattern
    0x1204: bytes(12),  # its colours
    0x1A01: b"\x00",  # video connector
    0x1A02: b"\x00",  # pixel format
    0x1A03: b"\x00",  # port and clock
    0x1A05: b"\x00",  # LED PWM polarity
    0x1A1F: bytes(5),  # LED delays: red, green, blue
    0x1A20: bytes(5),
    0x1A21: bytes(5),
    INVERT_DATA: b"\x00",
    0x1A33: b"\x00",  # mailbox of TI's older SDK
    0x1A37: b"\x00",  # channel swap
    0x1A3B: bytes(2),  # gamma
    0x1A3C: bytes(18),  # parallel port
    0x1A43: bytes(4),  # LED pulse width
    0x1A48: b"\x00",  # DMD supply faults
    0x1A49: b"\x00",  # DMD connection
}
