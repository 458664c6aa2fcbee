"""Wire format of a camera that is served over a local stream socket.

Client to server: one JSON object per line, UTF-8. ``{"op": "configure", "exposure_s": 0.03,
"gain": 1.0, "trigger": "hardware", "region": [x, y, width, height] or null, "pixel_format":
"mono8"}``, ``{"op": "arm"}``, ``{"op": "disarm"}`` are each answered by one reply. ``{"op":
"trigger"}`` is not answered; a frame follows.

Server to client: packets, each a header of 40 bytes (little endian) and its payload.

======  ====  ==========================================================================
offset  type  field
======  ====  ==========================================================================
0       4s    ``SLC1``
4       u8    kind: 0 reply, 1 frame
5       u8    bytes per pixel: 1 or 2 (0 in a reply)
6       u16   0
8       u32   width, pixels
12      u32   height, pixels
16      u32   frame id, counted by the camera, wraps
20      u32   payload bytes; fewer than width x height x bytes per pixel: incomplete frame
24      i64   start of the exposure, host clock, nanoseconds since the epoch
32      f64   exposure, seconds
======  ====  ==========================================================================

A reply's payload is a JSON object: ``{"ok": true, "image_size": [width, height]}`` or ``{"ok":
false, "error": "..."}``. Frames that were taken before a reply are sent before it.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any

from sl_common.errors import DeviceError

MAGIC = b"SLC1"
REPLY, FRAME = 0, 1
MAX_PAYLOAD = 1 << 28
MAX_LINE = 1 << 16
_HEADER = struct.Struct("<4sBBHIIIIqd")
HEADER_SIZE = _HEADER.size


@dataclass(frozen=True, slots=True)
class Header:
    """What precedes every payload; see the module's table."""

    kind: int
    payload: int
    pixel_bytes: int = 0
    width: int = 0
    height: int = 0
    frame_id: int = 0
    stamp_ns: int = 0
    exposure_s: float = 0.0

    def pack(self) -> bytes:
        """Return the 40 bytes."""
        image = (self.pixel_bytes, 0, self.width, self.height, self.frame_id)
        return _HEADER.pack(MAGIC, self.kind, *image, self.payload, self.stamp_ns, self.exposure_s)

    @property
    def full_payload(self) -> int:
        """Payload bytes of a complete frame."""
        return self.width * self.height * self.pixel_bytes


def parse_header(data: bytes | bytearray) -> Header:
    """Read a header.

    Raises
    ------
    DeviceError
        When it is none, or of a frame that cannot be.
    """
    magic, kind, pixel_bytes, _, width, height, frame_id, payload, stamp, exposure = _HEADER.unpack(
        data
    )
    header = Header(kind, payload, pixel_bytes, width, height, frame_id, stamp, exposure)
    if magic != MAGIC or kind not in (REPLY, FRAME) or payload > MAX_PAYLOAD:
        raise DeviceError(f"camera sent header {bytes(data).hex()}; expected {MAGIC.hex()}...")
    frame_fits = pixel_bytes in (1, 2) and 0 < header.full_payload <= MAX_PAYLOAD
    if kind == FRAME and not (frame_fits and payload <= header.full_payload):
        raise DeviceError(
            f"camera sent a frame of {width} x {height} pixels of {pixel_bytes} bytes with "
            f"{payload} bytes; expected at most one image of at most {MAX_PAYLOAD} bytes"
        )
    return header


def reply(content: dict[str, Any]) -> bytes:
    """Return a reply packet."""
    text = json.dumps(content).encode()
    return Header(REPLY, len(text)).pack() + text


def command(op: str, **fields: object) -> bytes:
    """Return a command line.

    Parameters
    ----------
    op : str
        Name of the command.
    **fields
        Its arguments, as JSON values.
    """
    return json.dumps({"op": op, **fields}).encode() + b"\n"
