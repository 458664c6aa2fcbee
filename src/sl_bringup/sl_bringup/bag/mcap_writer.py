"""Writing an mcap file that a killed process leaves readable.

Messages are gathered in chunks that are handed to the operating system when they are full or half
a second old. A large message is a chunk of its own: the small ones are then found without reading
the images, and an image is never compressed for nothing.
"""

from __future__ import annotations

import struct
import time
import zlib
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

from sl_bringup.bag.mcap_records import (
    CHUNK_HEAD,
    FOOTER_BODY,
    HEAD,
    INDEX_ENTRY,
    MAGIC,
    MESSAGE_HEAD,
    Op,
    record,
    text,
    texts,
    zstd,
)

#: A message from this size on is a chunk of its own.
LARGE_BYTES = 1 << 16
#: A chunk of small messages is full at this size, and written at this age.
CHUNK_BYTES, CHUNK_AGE_S = 1 << 18, 0.5


class _Chunk:
    """Messages that wait to be written together."""

    def __init__(self) -> None:
        self.parts: list[bytes | memoryview] = []
        self.bytes = 0
        self.crc = 0
        self.times: list[int] = []
        self.index: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)
        self.began_s = time.monotonic()

    def add(self, channel: int, number: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        head = HEAD.pack(Op.MESSAGE, MESSAGE_HEAD.size + len(data)) + MESSAGE_HEAD.pack(
            channel, number, log_ns, publish_ns
        )
        self.index[channel].append((log_ns, self.bytes))
        self.times.append(log_ns)
        for part in (head, data):
            self.parts.append(part)
            self.bytes += len(part)
            self.crc = zlib.crc32(part, self.crc)


class McapWriter:
    """One mcap file of profile ros2, open for writing.

    Parameters
    ----------
    path : Path
        The file; it must not exist.
    compress : bool
        Compress large messages too (small ones always are).
    metadata : mapping
        Written at the start, so that it is there whatever happens.
    """

    def __init__(self, path: Path, compress: bool, metadata: Mapping[str, str]) -> None:
        self.path = path
        self._file: BinaryIO = path.open("xb")
        self._compress = compress
        self._chunk = _Chunk()
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self._chunks: list[bytes] = []
        self.counts: dict[int, int] = {}
        self.start_ns, self.end_ns = 0, 0
        self._file.write(MAGIC + record(Op.HEADER, text("ros2"), text("slrig")))
        self._metadata = self._file.tell(), record(Op.METADATA, text("slrig"), texts(metadata))
        self._file.write(self._metadata[1])
        self._file.flush()

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._file.tell() + self._chunk.bytes

    @property
    def message_count(self) -> int:
        """Messages so far."""
        return sum(self.counts.values())

    def add_channel(self, topic: str, msgtype: str, definition: str, digest: str, qos: str) -> int:
        """Announce a topic, return the number of its channel.

        Parameters
        ----------
        topic, msgtype : str
            Full names.
        definition : str
            The ``.msg`` file with all that it uses.
        digest : str
            RIHS01 hash of the type.
        qos : str
            YAML list of the profiles that the publishers offer.
        """
        number = len(self._channels) + 1
        kept = {"offered_qos_profiles": qos, "topic_type_hash": digest}
        ids = struct.pack("<H", number)
        self._schemas.append(
            record(Op.SCHEMA, ids, text(msgtype), text("ros2msg"), text(definition))
        )
        self._channels.append(record(Op.CHANNEL, ids, ids, text(topic), text("cdr"), texts(kept)))
        self._file.write(self._schemas[-1] + self._channels[-1])
        self.counts[number] = 0
        return number

    def write(self, channel: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Write one message, as it came over the wire."""
        large = len(data) >= LARGE_BYTES
        if large:
            self._close_chunk()
        self.start_ns = log_ns if not self.message_count else min(log_ns, self.start_ns)
        self.end_ns = max(log_ns, self.end_ns)
        self._chunk.add(channel, self.counts[channel], log_ns, publish_ns, data)
        self.counts[channel] += 1
        if large or self._chunk.bytes >= CHUNK_BYTES:
            self._close_chunk(squeeze=not large or self._compress)

    def tick(self) -> None:
        """Hand over what has waited too long; call it several times a second."""
        if self._chunk.bytes and time.monotonic() - self._chunk.began_s >= CHUNK_AGE_S:
            self._close_chunk()

    def _close_chunk(self, squeeze: bool = True) -> None:
        chunk, self._chunk = self._chunk, _Chunk()
        if not chunk.bytes:
            return
        start = self._file.tell()
        span = min(chunk.times), max(chunk.times)
        packed = zstd.compress(b"".join(chunk.parts), level=1) if squeeze else b""
        squeezed = bool(packed) and len(packed) < chunk.bytes
        parts = [packed] if squeezed else chunk.parts
        stored = len(packed) if squeezed else chunk.bytes
        kind = text("zstd" if squeezed else "")
        head = CHUNK_HEAD.pack(*span, chunk.bytes, chunk.crc) + kind + struct.pack("<Q", stored)
        self._file.write(HEAD.pack(Op.CHUNK, len(head) + stored) + head)
        self._file.writelines(parts)
        self._index_chunk(chunk, start, span, kind + struct.pack("<QQ", stored, chunk.bytes))
        self._file.flush()

    def _index_chunk(self, chunk: _Chunk, start: int, span: tuple[int, int], sizes: bytes) -> None:
        """Write the chunk's message index, and keep its entry of the summary."""
        end = self._file.tell()
        offsets = b""
        for channel, entries in chunk.index.items():
            offsets += struct.pack("<HQ", channel, self._file.tell())
            packed = b"".join(INDEX_ENTRY.pack(*entry) for entry in entries)
            self._file.write(
                record(Op.MESSAGE_INDEX, struct.pack("<HI", channel, len(packed)), packed)
            )
        place = struct.pack("<QQQQ", *span, start, end - start)
        lengths = struct.pack("<I", len(offsets)), struct.pack("<Q", self._file.tell() - end)
        self._chunks.append(record(Op.CHUNK_INDEX, place, lengths[0], offsets, lengths[1], sizes))

    def close(self) -> None:
        """Write the summary and close the file."""
        self._close_chunk()
        self._file.write(record(Op.DATA_END, struct.pack("<I", 0)))
        summary, crc = self._file.tell(), 0
        offsets = b""
        for opcode, records in (
            (Op.SCHEMA, self._schemas), (Op.CHANNEL, self._channels),
            (Op.STATISTICS, [self._statistics()]), (Op.CHUNK_INDEX, self._chunks),
            (Op.METADATA_INDEX, [self._metadata_index()]),
        ):  # fmt: skip
            start = self._file.tell()
            self._file.writelines(records)
            crc = zlib.crc32(b"".join(records), crc)
            if records:
                place = struct.pack("<BQQ", opcode, start, self._file.tell() - start)
                offsets += record(Op.SUMMARY_OFFSET, place)
        offsets_start = self._file.tell()
        footer = HEAD.pack(Op.FOOTER, FOOTER_BODY.size) + struct.pack("<QQ", summary, offsets_start)
        crc = zlib.crc32(footer, zlib.crc32(offsets, crc))
        self._file.write(offsets + footer + struct.pack("<I", crc) + MAGIC)
        self._file.close()

    def _statistics(self) -> bytes:
        counts = b"".join(struct.pack("<HQ", *item) for item in self.counts.items())
        return record(
            Op.STATISTICS,
            struct.pack("<QHIIII", self.message_count, len(self._schemas), len(self._channels),
                        0, 1, len(self._chunks)),
            struct.pack("<QQI", self.start_ns, self.end_ns, len(counts)), counts,
        )  # fmt: skip

    def _metadata_index(self) -> bytes:
        offset, written = self._metadata
        return record(Op.METADATA_INDEX, struct.pack("<QQ", offset, len(written)), text("slrig"))
