"""Reading mcap files fast, and damaged ones as far as possible.

The library `mcap` decodes records, unpacks chunks and compares their checksums. Ours is the way
through a file: to records by their offsets, past those that nobody asked for, with every length
checked before it is followed (``docs/decisions/0012``). One chunk is held at a time (a few where
they overlap in time), and messages are views into it. A file without a summary, which a killed
recorder leaves, is followed record by record; damaged chunks are left out and reported.
"""

from __future__ import annotations

import heapq
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Footer, Header, MessageIndex, Schema
from mcap.stream_reader import CRCValidationError, get_chunk_data_stream
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC as MAGIC
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Qos,
)
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos

#: Type of a topic whose schema is not in the file.
NO_TYPE = "__schemaless__"
#: Messages outside of chunks are read together up to this size.
RUN_BYTES = 1 << 21
#: Opcode and length of the content, before every record.
_HEAD = struct.Struct("<BQ")
#: Channel, sequence, log time, publish time; the payload follows.
_MESSAGE_HEAD = struct.Struct("<HIQQ")
#: From the start of a chunk that is not compressed to its first record.
_CHUNK_HEAD_BYTES = _HEAD.size + 40
#: Of the footer's fields, and of an entry of a message index.
_FOOTER_BYTES, _INDEX_ENTRY_BYTES = 20, 16
_NO_SCHEMA = Schema(0, b"", "", NO_TYPE)
_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
    "": MessageDefinitionFormat.NONE,
}
#: What decoding does with damaged bytes; a damaged text is a ValueError.
_FAULTS = (ReaderError, McapError, ValueError, struct.error, OSError)


class _Message(NamedTuple):
    """A message on its way out; ordered by time, then by place in the file."""

    log_ns: int
    place: tuple[int, int]
    channel: int
    data: memoryview


@dataclass
class _Chunk:
    """Where a chunk is; with ``bare`` a run of messages outside of chunks.

    ``indexes`` has the offsets of its message indexes by channel, None where they are not known.
    """

    start_ns: int
    end_ns: int
    offset: int
    length: int
    indexes: dict[int, int] | None = None
    packed: bool = False
    bare: bool = False


class _Section(ReadDataStream):
    """A part of a file for the decoders of `mcap`, which do not notice that bytes are missing."""

    def __init__(self, file: BinaryIO, start: int, length: int) -> None:
        super().__init__(file)
        self._start, self._length = start, length
        file.seek(start)

    def read(self, length: int) -> bytes:
        """Read exactly this many bytes; a damaged length is noticed before memory is taken."""
        left = self._length - self.count
        data = super().read(length) if length <= left else b""
        if len(data) < length:
            place = self._start + self.count
            raise ReaderError(f"{length} bytes expected at byte {place}, found {left}")
        return data


class McapFile:
    """One mcap file of profile ros2, open for reading.

    Parameters
    ----------
    path : Path
        The file.
    tell : callable
        Gets a line for everything that is lost.

    Raises
    ------
    ReaderError
        When it is no mcap file, or nothing in it is readable.
    """

    def __init__(self, path: Path, tell: Callable[[str], None]) -> None:
        self.path = path
        self._tell = tell
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Connection] = {}
        self._chunks: list[_Chunk] = []
        self._counts: Counter[int] = Counter()
        self._reported: set[int] = set()
        self._file = path.open("rb")
        self._size = path.stat().st_size
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def connections(self) -> list[Connection]:
        """The topics, with their message counts where the file says them."""
        return [c._replace(msgcount=self._counts[c.id]) for c in self._channels.values()]

    def messages(
        self, connections: Sequence[Connection], check: bool = True
    ) -> Iterator[tuple[Connection, int, memoryview]]:
        """Yield the messages of some topics in order of time.

        Parameters
        ----------
        connections : sequence of Connection
            Of this file.
        check : bool
            Read whole chunks and compare their checksums. Without, single messages are picked out
            of large chunks, which is quick where few are wanted.

        Yields
        ------
        tuple of Connection, int, memoryview
            The topic, when it was recorded (nanoseconds since the epoch), and its CDR.
        """
        wanted = {c.id: c for c in connections}
        chunks = [c for c in self._chunks if c.indexes is None or wanted.keys() & c.indexes]
        for message in _merged(chunks, partial(self._read, wanted=wanted, check=check)):
            yield wanted[message.channel], message.log_ns, message.data

    # -- opening ------------------------------------------------------------------------------

    def _open(self) -> None:
        try:
            reader = SeekingReader(self._file, record_size_limit=self._size)
        except (McapError, struct.error):
            raise ReaderError(
                "File magic is invalid." if self._size else "The file is empty."
            ) from None
        opcode, start, length = self._record(len(MAGIC))
        if opcode != Opcode.HEADER or Header.read(self._section(start, length)).profile != "ros2":
            raise ReaderError("Profile is not ros2.")
        if not self._read_summary(reader):
            self._scan(start + length)

    def _read_summary(self, reader: SeekingReader) -> bool:
        """Take topics and chunks from the end of the file; false when that is not possible."""
        try:
            summary = reader.get_summary()
            if summary is None or not _is_complete(summary):
                return False
            place = self._size - len(MAGIC) - _FOOTER_BYTES
            footer = Footer.read(self._section(place, _FOOTER_BYTES))
            # Its last field is the checksum of all that is before it.
            size = self._size - len(MAGIC) - 4 - footer.summary_start
            crc = zlib.crc32(self._section(footer.summary_start, size).read(size))
        except _FAULTS:
            return False
        if footer.summary_crc not in (0, crc):
            self._tell(f"{self.path.name}: the summary is damaged; read without it")
            return False
        self._take_summary(summary)
        return True

    def _take_summary(self, summary: Summary) -> None:
        self._schemas = summary.schemas
        for channel in summary.channels.values():
            self._add(channel)
        for index in summary.chunk_indexes:
            span = index.message_start_time, index.message_end_time
            place = index.chunk_start_offset, index.chunk_length
            indexes = index.message_index_offsets or None
            self._chunks.append(_Chunk(*span, *place, indexes, bool(index.compression)))
        if summary.statistics:
            self._counts.update(summary.statistics.channel_message_counts)

    def _scan(self, start: int) -> None:
        """Follow the records one by one, as far as they are readable."""
        end, ended, problem = start, False, ""
        try:
            for opcode, place, length in self._records(start, self._size):
                if opcode in (Opcode.FOOTER, Opcode.DATA_END):
                    ended = True
                    break
                self._note(opcode, place, length)
                end = place + length
        except _FAULTS as error:
            problem = f" ({error})"
        if not ended:
            if self._chunks:  # its index may be incomplete
                self._chunks[-1].indexes = None
            self._tell(
                f"{self.path.name}: the end is missing; {self._size - end} of {self._size} bytes "
                f"are unreadable{problem}"
            )

    def _section(self, start: int, length: int) -> _Section:
        return _Section(self._file, start, length)

    def _records(self, start: int, end: int) -> Iterator[tuple[int, int, int]]:
        """Opcode, place and length of each record's content."""
        while start < end:
            opcode, place, length = self._record(start)
            yield opcode, place, length
            start = place + length

    def _record(self, start: int) -> tuple[int, int, int]:
        if 0 <= start <= self._size - _HEAD.size:
            opcode, length = _HEAD.unpack(self._section(start, _HEAD.size).read(_HEAD.size))
            place = start + _HEAD.size
            if Opcode.HEADER <= opcode <= Opcode.DATA_END and place + length <= self._size:
                return opcode, place, length
        raise ReaderError(f"no complete record at byte {start}")

    def _note(self, opcode: int, place: int, length: int) -> None:
        """Note one record of a file without summary."""
        chunks, section = self._chunks, self._section(place, length)
        if opcode == Opcode.CHUNK:
            start_ns, end_ns = section.read8(), section.read8()
            chunks.append(_Chunk(start_ns, end_ns, place - _HEAD.size, length + _HEAD.size))
            with suppress(Exception):  # reported when its messages are read
                self._take_from_chunk(chunks[-1], section)
        elif opcode == Opcode.MESSAGE:
            channel, _, log_ns, _ = _MESSAGE_HEAD.unpack(section.read(_MESSAGE_HEAD.size))
            self._counts[channel] += 1
            self._note_bare(log_ns, place - _HEAD.size, length + _HEAD.size)
        elif opcode == Opcode.MESSAGE_INDEX and chunks:
            channel, size = section.read2(), section.read4()
            self._counts[channel] += size // _INDEX_ENTRY_BYTES
            indexes = chunks[-1].indexes or {}
            chunks[-1].indexes = {**indexes, channel: place - _HEAD.size}
        else:
            self._take(opcode, section)

    def _note_bare(self, log_ns: int, offset: int, length: int) -> None:
        """Messages outside of chunks: runs of them are read as one."""
        last = self._chunks[-1] if self._chunks else None
        follows = last is not None and last.bare and last.offset + last.length == offset
        if last and follows and log_ns >= last.end_ns and last.length < RUN_BYTES:
            last.length += length
            last.end_ns = log_ns
        else:
            self._chunks.append(_Chunk(log_ns, log_ns, offset, length, bare=True))

    def _take_from_chunk(self, chunk: _Chunk, section: _Section) -> None:
        """Take announcements within a chunk; ``section`` stands behind the chunk's times."""
        section.read(12)
        chunk.packed = bool(section.read_prefixed_string())
        if chunk.packed:
            records = self._unpacked(chunk, check=False)
            for opcode, start, length in _walk(records):
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    content = BytesIO(records[start : start + length])
                    self._take(opcode, _Section(content, 0, length))
        else:
            end = chunk.offset + chunk.length
            for opcode, place, length in self._records(chunk.offset + _CHUNK_HEAD_BYTES, end):
                self._take(opcode, self._section(place, length))

    def _take(self, opcode: int, section: _Section) -> None:
        """Take what a record announces; others hold nothing of interest here."""
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(section)
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            self._add(Channel.read(section))

    def _add(self, channel: Channel) -> None:
        """Announce a topic; each is announced in several places."""
        if channel.id in self._channels:
            return
        schema = self._schemas.get(channel.schema_id, _NO_SCHEMA)
        kind = _FORMATS.get(schema.encoding, MessageDefinitionFormat.NONE)
        self._channels[channel.id] = Connection(
            channel.id,
            channel.topic,
            schema.name,
            MessageDefinition(kind, schema.data.decode()),
            channel.metadata.get("topic_type_hash", ""),
            0,
            ConnectionExtRosbag2(channel.message_encoding, offered_qos(channel.metadata)),
            self,
        )

    # -- reading ------------------------------------------------------------------------------

    def _read(self, chunk: _Chunk, wanted: Mapping[int, Connection], check: bool) -> list[_Message]:
        """Read the messages of a chunk in order of time; of a damaged one what is readable."""
        found: list[_Message] = []
        try:
            if chunk.indexes and not (check or chunk.packed):
                return sorted(self._picked(chunk, wanted))
            # What is unpacked as a whole costs little to be checked.
            records = self._unpacked(chunk, check or chunk.packed)
            for opcode, start, length in _walk(records):
                if opcode == Opcode.MESSAGE:
                    channel, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(records, start)
                    if channel in wanted:
                        data = records[start + _MESSAGE_HEAD.size : start + length]
                        found.append(_Message(log_ns, (chunk.offset, start), channel, data))
        except Exception as error:  # a damaged file makes decoders fail in any way they can
            self._lost(chunk, str(error))
        return sorted(found)

    def _lost(self, chunk: _Chunk, why: str) -> None:
        if chunk.offset not in self._reported:
            self._reported.add(chunk.offset)
            self._tell(f"{self.path.name}: {chunk.length} bytes at byte {chunk.offset}: {why}")

    def _unpacked(self, chunk: _Chunk, check: bool) -> memoryview:
        """Records of a chunk, or a run of messages outside of chunks."""
        if chunk.bare:
            return memoryview(self._section(chunk.offset, chunk.length).read(chunk.length))
        content = chunk.offset + _HEAD.size, chunk.length - _HEAD.size
        record = Chunk.read(self._section(*content))
        try:
            stream, size = get_chunk_data_stream(record, validate_crc=check)
        except CRCValidationError:
            raise ReaderError("its checksum is wrong") from None
        if size != record.uncompressed_size:
            raise ReaderError(f"{size} bytes in a chunk of {record.uncompressed_size}")
        return memoryview(stream.read(size))  # all at once is not copied

    def _picked(self, chunk: _Chunk, wanted: Mapping[int, Connection]) -> Iterator[_Message]:
        """Pick single messages out of a chunk that is not compressed, by its indexes."""
        indexes = chunk.indexes or {}
        for channel in wanted.keys() & indexes.keys():
            _, place, length = self._record(indexes[channel])
            for log_ns, offset in MessageIndex.read(self._section(place, length)).records:
                _, start, size = self._record(chunk.offset + _CHUNK_HEAD_BYTES + offset)
                data = memoryview(self._section(start, size).read(size))[_MESSAGE_HEAD.size :]
                yield _Message(log_ns, (chunk.offset, offset), channel, data)


def _is_complete(summary: Summary) -> bool:
    """Whether a summary names everything; some writers leave channels or chunks out."""
    told, channels, chunks = summary.statistics, summary.channels, summary.chunk_indexes
    if told is None or len(channels) < told.channel_count or len(chunks) < told.chunk_count:
        return False
    return bool(chunks or not told.message_count)  # else the messages are outside of chunks


def offered_qos(metadata: Mapping[str, str]) -> list[Qos]:
    """QoS that a topic was recorded with; none where it cannot be read: only players need it."""
    try:
        return parse_qos(metadata.get("offered_qos_profiles", ""))
    except Exception:
        return []


def _walk(records: memoryview) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and length of the content of each record of a chunk."""
    at = 0
    while at < len(records):
        opcode, length = _HEAD.unpack_from(records, at)
        at += _HEAD.size
        if at + length > len(records):
            raise ReaderError(f"a record of {length} bytes reaches beyond its chunk")
        yield opcode, at, length
        at += length


def _merged(
    chunks: Sequence[_Chunk], read: Callable[[_Chunk], list[_Message]]
) -> Iterator[_Message]:
    """Messages of all chunks in order of time; a chunk is read when its time comes."""
    waiting = sorted(chunks, key=lambda c: (c.start_ns, c.offset), reverse=True)
    heap: list[tuple[_Message, Iterator[_Message]]] = []
    while waiting or heap:
        while waiting and (not heap or waiting[-1].start_ns <= heap[0][0].log_ns):
            rest = iter(read(waiting.pop()))
            if (first := next(rest, None)) is not None:
                heapq.heappush(heap, (first, rest))
        if heap:
            message, rest = heap[0]
            yield message
            if (following := next(rest, None)) is None:
                heapq.heappop(heap)
            else:
                heapq.heapreplace(heap, (following, rest))
