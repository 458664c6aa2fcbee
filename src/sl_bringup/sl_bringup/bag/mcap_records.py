"""Records of mcap files (mcap.dev/spec): what both their writer and their reader need to know."""

from __future__ import annotations

import struct
import sys
from collections.abc import Mapping
from enum import IntEnum

if sys.version_info >= (3, 14):
    from compression import zstd
else:  # what rosbags itself depends on
    from backports import zstd

__all__ = ["zstd"]

MAGIC = b"\x89MCAP0\r\n"


class Op(IntEnum):
    """Opcodes: what a record is."""

    HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
    STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(0x0B, 0x10)


#: Opcode and length of the content, before every record.
HEAD = struct.Struct("<BQ")
#: Channel, sequence, log time, publish time; the payload follows.
MESSAGE_HEAD = struct.Struct("<HIQQ")
#: Start, end, uncompressed size, crc; compression (text), compressed size and the records follow.
CHUNK_HEAD = struct.Struct("<QQQI")
#: Log time and offset within the uncompressed chunk.
INDEX_ENTRY = struct.Struct("<QQ")
#: Start of the summary, of its offsets, crc.
FOOTER_BODY = struct.Struct("<QQI")


def record(opcode: int, *parts: bytes) -> bytes:
    """One whole record."""
    body = b"".join(parts)
    return HEAD.pack(opcode, len(body)) + body


def text(value: str) -> bytes:
    """String with its length before it."""
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def texts(values: Mapping[str, str]) -> bytes:
    """Map of strings, preceded by its length in bytes."""
    data = b"".join(text(key) + text(value) for key, value in values.items())
    return struct.pack("<I", len(data)) + data


class Fields:
    """Reads the fields of a record one after the other.

    Parameters
    ----------
    data : bytes
        Content of the record.
    """

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def unpack(self, layout: str) -> tuple[int, ...]:
        """Numbers as `struct` lays them out (little endian)."""
        found = struct.unpack_from("<" + layout, self._data, self._at)
        self._at += struct.calcsize("<" + layout)
        return found

    def text(self) -> str:
        """Next string."""
        return self.raw().decode()

    def raw(self) -> bytes:
        """Bytes that have their length, 32 bit, before them."""
        (length,) = self.unpack("I")
        found = self._data[self._at : self._at + length]
        if len(found) != length:
            raise ValueError(f"a field of {length} bytes has {len(found)}")
        self._at += length
        return found

    def texts(self) -> dict[str, str]:
        """Map of strings."""
        inner = Fields(self.raw())
        found = {}
        while inner.left:
            key = inner.text()
            found[key] = inner.text()
        return found

    @property
    def left(self) -> int:
        """Bytes not read yet."""
        return len(self._data) - self._at
