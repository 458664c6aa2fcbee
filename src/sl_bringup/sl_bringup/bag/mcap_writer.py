"""Writing an mcap file that a killed process leaves readable.

Messages are gathered in chunks that are handed to the operating system when they are full or half
a second old. A large message is a chunk of its own: the small ones are then found without reading
the images, and an image is never compressed for nothing. Records are encoded by the library `mcap`;
its own writer has neither of these (``docs/decisions/0012``).
"""

from __future__ import annotations

import struct
import time
import zlib
from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC as MAGIC

#: A message from this size on is a chunk of its own.
LARGE_BYTES = 1 << 16
#: A chunk of small messages is full at this size, and written at this age.
CHUNK_BYTES, CHUNK_AGE_S = 1 << 18, 0.5
_NAME = "slrig"


class _Chunk:
    """Messages that wait to be written together."""

    def __init__(self) -> None:
        self.records = RecordBuilder()
        self.index: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)
        self.began_s = time.monotonic()

    def add(self, message: Message) -> None:
        self.index[message.channel_id].append((message.log_time, self.records.count))
        message.write(self.records)

    @property
    def span(self) -> tuple[int, int]:
        times = [log_ns for entries in self.index.values() for log_ns, _ in entries]
        return min(times), max(times)


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
        self._file = path.open("xb")
        self._compress = compress
        self._chunk = _Chunk()
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self.counts: Counter[int] = Counter()
        self.start_ns, self.end_ns = 0, 0
        self._file.write(MAGIC)
        self._put(Header("ros2", _NAME))
        start = self._file.tell()
        self._put(Metadata(_NAME, dict(metadata)))
        self._metadata = MetadataIndex(start, self._file.tell() - start, _NAME)
        self._file.flush()

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._file.tell() + self._chunk.records.count

    @property
    def message_count(self) -> int:
        """Messages so far."""
        return self.counts.total()

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
        metadata = {"offered_qos_profiles": qos, "topic_type_hash": digest}
        self._schemas.append(Schema(number, definition.encode(), "ros2msg", msgtype))
        self._channels.append(Channel(number, topic, "cdr", metadata, number))
        self._put(self._schemas[-1], self._channels[-1])
        self.counts[number] = 0
        return number

    def write(self, channel: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Write one message.

        Parameters
        ----------
        channel : int
            From `add_channel`.
        log_ns, publish_ns : int
            When it was received and sent, nanoseconds since the epoch.
        data : bytes
            CDR, with its header.
        """
        large = len(data) >= LARGE_BYTES
        if large:
            self._close_chunk()
        self.start_ns = log_ns if not self.message_count else min(log_ns, self.start_ns)
        self.end_ns = max(log_ns, self.end_ns)
        self._chunk.add(Message(channel, log_ns, data, publish_ns, self.counts[channel]))
        self.counts[channel] += 1
        if large or self._chunk.records.count >= CHUNK_BYTES:
            self._close_chunk(compress=not large or self._compress)

    def tick(self) -> None:
        """Hand over what has waited too long; call it several times a second."""
        if self._chunk.index and time.monotonic() - self._chunk.began_s >= CHUNK_AGE_S:
            self._close_chunk()

    def close(self) -> None:
        """Write the summary and close the file."""
        self._close_chunk()
        self._put(DataEnd(0))
        self._file.write(self._summary(self._file.tell()) + MAGIC)
        self._file.close()

    def _put(self, *records: McapRecord) -> None:
        builder = RecordBuilder()
        for record in records:
            record.write(builder)
        self._file.write(builder.end())

    def _close_chunk(self, compress: bool = True) -> None:
        chunk, self._chunk = self._chunk, _Chunk()
        if not chunk.index:
            return
        plain = chunk.records.end()
        packed = zstandard.compress(plain, 1) if compress else plain
        kind, data = ("zstd", packed) if len(packed) < len(plain) else ("", plain)
        start, (start_ns, end_ns) = self._file.tell(), chunk.span
        self._put(Chunk(kind, data, end_ns, start_ns, zlib.crc32(plain), len(plain)))
        end, offsets = self._file.tell(), {}
        for channel, entries in chunk.index.items():
            offsets[channel] = self._file.tell()
            self._put(MessageIndex(channel, entries))
        self._file.flush()
        self._chunks.append(
            ChunkIndex(
                chunk_length=end - start,
                chunk_start_offset=start,
                compression=kind,
                compressed_size=len(data),
                message_end_time=end_ns,
                message_index_length=self._file.tell() - end,
                message_index_offsets=offsets,
                message_start_time=start_ns,
                uncompressed_size=len(plain),
            )
        )

    def _summary(self, start: int) -> bytes:
        """Everything between the end of the data and the last magic."""
        groups: dict[Opcode, list[McapRecord]] = {
            Opcode.SCHEMA: [*self._schemas],
            Opcode.CHANNEL: [*self._channels],
            Opcode.STATISTICS: [self._statistics()],
            Opcode.CHUNK_INDEX: [*self._chunks],
            Opcode.METADATA_INDEX: [self._metadata],
        }
        builder, offsets = RecordBuilder(), []
        for opcode, records in groups.items():
            at = builder.count
            for record in records:
                record.write(builder)
            if records:
                offsets.append(SummaryOffset(opcode, start + at, builder.count - at))
        offsets_start = start + builder.count
        for offset in offsets:
            offset.write(builder)
        Footer(start, offsets_start, 0).write(builder)
        # The checksum is the footer's last field and covers all that is before it.
        covered: bytes = builder.end()[:-4]
        return covered + struct.pack("<I", zlib.crc32(covered))

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self.counts,
            chunk_count=len(self._chunks),
            message_count=self.message_count,
            message_end_time=self.end_ns,
            message_start_time=self.start_ns,
            metadata_count=1,
            schema_count=len(self._schemas),
        )
