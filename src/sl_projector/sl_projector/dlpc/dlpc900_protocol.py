"""DLPC900 command protocol: bytes only, no transport, no state (TI DLPU018J).

A message is a flag byte, a sequence byte, a length (command and data), a command and its data,
cut into reports of 64 bytes. Replies have the same header without the command.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from sl_common.errors import DeviceError, DeviceRefused

VENDOR_ID = 0x0451
PRODUCT_ID = 0xC900
REPORT_BYTES = 64
HEADER_BYTES = 4
MAX_MESSAGE_BYTES = 512  # the controller's command buffer
MAX_CHUNK_BYTES = MAX_MESSAGE_BYTES - HEADER_BYTES - 4  # less command and byte count: 504

FLAG_READ = 0x80
FLAG_REPLY = 0x40
FLAG_NACK = 0x20

ERROR_CODE = 0x0100
ERROR_TEXT = 0x0101
POWER = 0x0200
IDLE = 0x0201
VERSION = 0x0205
HARDWARE = 0x0206
LED_ENABLE = 0x1A07
HARDWARE_STATUS = 0x1A0A
SYSTEM_STATUS = 0x1A0B
MAIN_STATUS = 0x1A0C
DISPLAY_MODE = 0x1A1B
TRIGGER_OUT_1 = 0x1A1D
TRIGGER_OUT_2 = 0x1A1E
START_STOP = 0x1A24
IMAGE_INIT = (0x1A2A, 0x1A2C)  # primary, secondary controller
IMAGE_DATA = (0x1A2B, 0x1A2D)
LUT_CONFIG = 0x1A31
LUT_ENTRY = 0x1A34
TRIGGER_IN_1 = 0x1A35

NAMES = {
    ERROR_CODE: "error code",
    ERROR_TEXT: "error text",
    POWER: "power mode",
    IDLE: "DMD idle mode",
    VERSION: "version",
    HARDWARE: "hardware and firmware tag",
    LED_ENABLE: "LED enable",
    HARDWARE_STATUS: "hardware status",
    SYSTEM_STATUS: "system status",
    MAIN_STATUS: "main status",
    DISPLAY_MODE: "display mode",
    TRIGGER_OUT_1: "trigger output 1",
    TRIGGER_OUT_2: "trigger output 2",
    START_STOP: "pattern start/stop",
    IMAGE_INIT[0]: "image load start",
    IMAGE_INIT[1]: "image load start (secondary)",
    IMAGE_DATA[0]: "image data",
    IMAGE_DATA[1]: "image data (secondary)",
    LUT_CONFIG: "pattern table configuration",
    LUT_ENTRY: "pattern table entry",
    TRIGGER_IN_1: "trigger input 1",
}

ERRORS = {
    0: "no error",
    1: "batch file checksum error",
    2: "device failure",
    3: "invalid command number",
    4: "controller and DMD do not fit",
    5: "not allowed in the current mode",
    6: "invalid parameter",
    7: "a referred item is not present",
    8: "out of memory",
    9: "invalid image compression type",
    10: "pattern bit number out of range",
    11: "pattern image not in flash",
    12: "dark time out of range",
    13: "signal delay out of range",
    14: "exposure out of range",
    15: "pattern number out of range",
    16: "invalid pattern definition",
    17: "pattern image address out of range",
    255: "internal error",
}

POWER_NORMAL, POWER_STANDBY = 0, 1
MODE_ON_THE_FLY = 3
STOP, PAUSE, START = 0, 1, 2
LEDS_BY_SEQUENCER = 0x08

# (bit, healthy state, what the other state means)
_HARDWARE_BITS = (
    (0, 1, "initialisation failed"),
    (1, 0, "controller and DMD do not fit, or wrong firmware"),
    (2, 0, "DMD reset controller error"),
    (3, 0, "forced swap error"),
    (6, 0, "sequencer aborted"),
    (7, 0, "sequencer error"),
)
HARDWARE_SECONDARY = 1 << 4
HARDWARE_ABORT = 1 << 6
MAIN_PARKED = 1 << 0
MAIN_RUNNING = 1 << 1


@dataclass(frozen=True)
class Reply:
    """One decoded reply: its sequence byte, whether the device refused, its data."""

    sequence: int
    refused: bool
    data: bytes


def message(command: int, data: bytes = b"", *, read: bool, reply: bool, sequence: int) -> bytes:
    """Return a message without padding, at most 512 bytes.

    Parameters
    ----------
    command : int
        16 bits.
    data : bytes
        At most 506 bytes.
    read, reply : bool
        Ask for data; ask for a confirmation (implied by ``read``).
    sequence : int
        Number that the reply repeats, 0 to 255.

    Raises
    ------
    DeviceError
        When the data does not fit the controller's command buffer.
    """
    if len(data) > MAX_MESSAGE_BYTES - HEADER_BYTES - 2:
        raise DeviceError(f"command 0x{command:04X} with {len(data)} bytes; expected at most 506")
    flags = (FLAG_READ if read else 0) | (FLAG_REPLY if reply or read else 0)
    return struct.pack("<BBHH", flags, sequence & 0xFF, len(data) + 2, command) + data


def reports(packet: bytes) -> list[bytes]:
    """Cut a message into reports of 64 bytes, the last one padded with zeros."""
    cuts = range(0, len(packet), REPORT_BYTES)
    return [packet[i : i + REPORT_BYTES].ljust(REPORT_BYTES, b"\0") for i in cuts]


def decode_reply(report: bytes) -> Reply | None:
    """Decode one reply report; None when it is too short for what it announces.

    Replies longer than one report are cut to their first report, as TI's software does.
    """
    if len(report) < HEADER_BYTES:
        return None
    flags, sequence, length = struct.unpack_from("<BBH", report)
    held = min(length, REPORT_BYTES - HEADER_BYTES)
    data = report[HEADER_BYTES : HEADER_BYTES + held]
    return Reply(sequence, bool(flags & FLAG_NACK), data) if len(data) == held else None


def lut_entry(
    index: int,
    exposure_us: int,
    dark_us: int,
    image: int,
    bit: int,
    *,
    depth: int = 1,
    leds: int = 7,
    wait_trigger: bool = False,
    clear: bool = False,
    trigger_out_2: bool = True,
) -> bytes:
    """Pack one pattern table entry (0x1A34), 12 bytes.

    Parameters
    ----------
    index : int
        Position in the sequence.
    exposure_us, dark_us : int
        24 bits each.
    image, bit : int
        Image and the pattern's first plane in it.
    depth : int
        Bits per pixel, 1 to 8.
    leds : int
        Bit 0 red, bit 1 green, bit 2 blue.
    wait_trigger : bool
        Wait for TRIG_IN_1 before showing it.
    clear : bool
        Clear after the exposure; only used with 1 bit and an external trigger.
    trigger_out_2 : bool
        Raise TRIG_OUT_2 (on the wire the bit means "disabled").
    """
    options = int(clear) | (depth - 1) << 1 | leds << 4 | int(wait_trigger) << 7
    return (
        struct.pack("<H", index)
        + exposure_us.to_bytes(3, "little")
        + bytes([options])
        + dark_us.to_bytes(3, "little")
        + bytes([int(not trigger_out_2)])
        + struct.pack("<H", image | bit << 11)
    )


def lut_config(entries: int, exposures: int) -> bytes:
    """Pack the pattern table configuration (0x1A31): exposures 0 repeats for ever.

    Parameters
    ----------
    entries : int
        Number of table entries.
    exposures : int
        Number of exposures; 0 repeats until stopped.
    """
    return struct.pack("<HI", entries, exposures)


def image_init(image: int, total_bytes: int) -> bytes:
    """Pack an image load start (0x1A2A, 0x1A2C); the total includes the 48-byte header.

    Parameters
    ----------
    image : int
        Number of the image in the controller's memory.
    total_bytes : int
        Header and data.
    """
    return struct.pack("<HI", image, total_bytes)


def image_chunks(stream: bytes) -> list[bytes]:
    """Cut an encoded image into data of 0x1A2B: byte count and up to 504 bytes."""
    cuts = range(0, len(stream), MAX_CHUNK_BYTES)
    parts = (stream[i : i + MAX_CHUNK_BYTES] for i in cuts)
    return [struct.pack("<H", len(part)) + part for part in parts]


def trigger_out(rising_us: int, falling_us: int, inverted: bool) -> bytes:
    """Pack a trigger output's setting (0x1A1D, 0x1A1E).

    Parameters
    ----------
    rising_us, falling_us : int
        Delays of the edges, microseconds.
    inverted : bool
        Active low.
    """
    return struct.pack("<Bhh", int(inverted), rising_us, falling_us)


def trigger_in(delay_us: int, falling_edge: bool) -> bytes:
    """Pack trigger input 1's setting (0x1A35).

    Parameters
    ----------
    delay_us : int
        From the edge to the exposure, microseconds.
    falling_edge : bool
        Otherwise the rising edge counts.
    """
    return struct.pack("<HB", delay_us, int(falling_edge))


def hardware_problems(status: int) -> tuple[str, ...]:
    """Say what the hardware status register (0x1A0A) complains of.

    Examples
    --------
    >>> hardware_problems(0x01)
    ()
    >>> hardware_problems(0x41)
    ('sequencer aborted',)
    """
    return tuple(text for bit, good, text in _HARDWARE_BITS if (status >> bit) & 1 != good)


def firmware_version(data: bytes) -> str:
    """Decode the application version, the first of 0x0205's four.

    Examples
    --------
    >>> firmware_version(bytes([3, 0, 2, 6]) + bytes(12))
    '6.2.3'
    """
    patch, minor, major = struct.unpack_from("<HBB", data)
    return f"{major}.{minor}.{patch}"


def refusal(command: int, code: int, text: str = "") -> DeviceRefused:
    """Make the exception for a refused command.

    Parameters
    ----------
    command, code : int
        The command and TI's error code.
    text : str
        The device's own words, if any.
    """
    name = NAMES.get(command, "command")
    detail = ERRORS.get(code, "undefined error") + (f": {text}" if text else "")
    return DeviceRefused(f"DLPC900 refused 0x{command:04X} ({name}): error {code}, {detail}")
