"""Reading mcap files fast, and as far as they are whole.

One chunk is held at a time (a few where they overlap in time), its messages are views into it. A
file without a summary, which a killed recorder leaves, is followed record by record; chunks that
are damaged are left out and told.
"""

from __future__ import annotations

import heapq
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Qos,
)
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import parse_qos

from sl_bringup.bag.mcap_records import (
    CHUNK_HEAD,
    FOOTER_BODY,
    HEAD,
    INDEX_ENTRY,
    MAGIC,
    MESSAGE_HEAD,
    Fields,
    Op,
    zstd,
)

#: Of a topic whose schema is not in the file.
NO_TYPE = "__schemaless__"
#: Messages outside of chunks are read together up to this size.
RUN_BYTES = 1 << 21
_TAIL_BYTES = HEAD.size + FOOTER_BODY.size + len(MAGIC)
#: The summary's checksum and what follows it.
_AFTER_CRC = 4 + len(MAGIC)
_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
    "": MessageDefinitionFormat.NONE,
}


class Message(NamedTuple):
    """A message on its way out; ordered by time, then by place in the file."""

    log_ns: int
    place: tuple[int, int]
    channel: int
    data: memoryview


@dataclass
class _Chunk:
    """Where a chunk lies; an offset without chunk stands for a run of bare messages."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    #: Offsets of the message indexes by channel; None where they are not known.
    indexes: dict[int, int] | None = None
    bare: bool = False


@dataclass
class _Contents:
    """What is known of a file."""

    schemas: dict[int, tuple[str, str, str]] = field(default_factory=dict)
    channels: dict[int, Connection] = field(default_factory=dict)
    chunks: list[_Chunk] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)


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
        When it is no mcap file, or nothing of it is whole.
    """

    def __init__(self, path: Path, tell: Callable[[str], None]) -> None:
        self.path = path
        self._tell = tell
        self._known = _Contents()
        self._checked: set[int] = set()
        self._file = os.open(path, os.O_RDONLY)
        self._size = os.fstat(self._file).st_size
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    @property
    def connections(self) -> list[Connection]:
        """The topics, with their message counts where the file says them."""
        counts = self._known.counts
        channels = self._known.channels.items()
        return [c._replace(msgcount=counts.get(number, 0)) for number, c in channels]

    def messages(
        self, connections: Sequence[Connection], check: bool = True
    ) -> Iterator[tuple[Connection, int, memoryview]]:
        """Yield the messages of some topics in order of time.

        Parameters
        ----------
        connections : sequence of Connection
            Of this file.
        check : bool
            Read chunks as a whole and compare their checksums. Without, single messages are
            picked out of large chunks: quick where few are wanted.
        """
        wanted = {c.id: c for c in connections}
        chunks = [c for c in self._known.chunks if c.indexes is None or wanted.keys() & c.indexes]
        for message in _merged(chunks, partial(self._read, wanted=wanted, check=check)):
            yield wanted[message.channel], message.log_ns, message.data

    # -- opening ------------------------------------------------------------------------------

    def _open(self) -> None:
        if self._bytes(0, len(MAGIC)) != MAGIC:
            raise ReaderError("File magic is invalid." if self._size else "The file is empty.")
        opcode, start, length = self._record(len(MAGIC))
        if opcode != Op.HEADER or Fields(self._bytes(start, length)).text() != "ros2":
            raise ReaderError("Profile is not ros2.")
        if not self._read_summary():
            self._scan(start + length)

    def _read_summary(self) -> bool:
        """Take topics and chunks from the end of the file; false when there is no such end."""
        if self._size < _TAIL_BYTES:
            return False
        tail = self._bytes(self._size - _TAIL_BYTES, _TAIL_BYTES)
        opcode, length = HEAD.unpack_from(tail)
        start, _, crc = FOOTER_BODY.unpack_from(tail, HEAD.size)
        ended = tail[-len(MAGIC) :] == MAGIC and (opcode, length) == (Op.FOOTER, FOOTER_BODY.size)
        if not (ended and 0 < start < self._size):
            return False
        if crc and crc != zlib.crc32(self._bytes(start, self._size - _AFTER_CRC - start)):
            self._tell(f"{self.path.name}: the summary is damaged; read without it")
            return False
        try:
            for opcode, place, length in self._records(start, self._size - _TAIL_BYTES):
                self._take(opcode, self._bytes(place, length))
            whole = self._summary_is_whole()
        except (ReaderError, struct.error, ValueError):
            whole = False
        if not whole:
            self._known = _Contents()
        return whole

    def _summary_is_whole(self) -> bool:
        """Whether the summary names everything; some writers leave channels or chunks out."""
        return bool(self._known.channels) and bool(
            self._known.chunks or not sum(self._known.counts.values())
        )

    def _scan(self, start: int) -> None:
        """Follow the records one by one, as far as they are whole."""
        end, whole, problem = start, False, ""
        try:
            for opcode, place, length in self._records(start, self._size):
                if opcode in (Op.FOOTER, Op.DATA_END):
                    whole = True
                    break
                self._note(opcode, place, length)
                end = place + length
        except (ReaderError, struct.error, ValueError) as error:
            problem = f" ({error})"
        if not whole:
            if self._known.chunks:  # its index may be incomplete
                self._known.chunks[-1].indexes = None
            self._tell(
                f"{self.path.name}: the end is missing; {self._size - end} of {self._size} bytes "
                f"are unreadable{problem}"
            )

    def _records(self, start: int, end: int) -> Iterator[tuple[int, int, int]]:
        """Opcode, place and length of each record's content."""
        while start < end:
            opcode, place, length = self._record(start)
            yield opcode, place, length
            start = place + length

    def _record(self, start: int) -> tuple[int, int, int]:
        opcode, length = HEAD.unpack(self._bytes(start, HEAD.size))
        place = start + HEAD.size
        if not Op.HEADER <= opcode <= Op.DATA_END or place + length > self._size:
            raise ReaderError(f"no whole record at byte {start}")
        return opcode, place, length

    def _note(self, opcode: int, place: int, length: int) -> None:
        """Note one record of a file without summary."""
        chunks = self._known.chunks
        if opcode == Op.CHUNK:
            start_ns, end_ns, _, _ = CHUNK_HEAD.unpack(self._bytes(place, CHUNK_HEAD.size))
            chunks.append(_Chunk(start_ns, end_ns, place - HEAD.size, length + HEAD.size))
            self._take_from_chunk(chunks[-1])
        elif opcode == Op.MESSAGE:
            channel, _, log_ns, _ = MESSAGE_HEAD.unpack(self._bytes(place, MESSAGE_HEAD.size))
            self._known.counts[channel] = self._known.counts.get(channel, 0) + 1
            self._note_bare(log_ns, place - HEAD.size, length + HEAD.size)
        elif opcode == Op.MESSAGE_INDEX and chunks:
            channel, bytes_ = struct.unpack("<HI", self._bytes(place, 6))
            counts = self._known.counts
            counts[channel] = counts.get(channel, 0) + bytes_ // INDEX_ENTRY.size
            if chunks[-1].indexes is None:
                chunks[-1].indexes = {}
            chunks[-1].indexes[channel] = place - HEAD.size
        elif opcode in (Op.SCHEMA, Op.CHANNEL):
            self._take(opcode, self._bytes(place, length))

    def _note_bare(self, log_ns: int, offset: int, length: int) -> None:
        """Messages outside of chunks: runs of them are read as one."""
        last = self._known.chunks[-1] if self._known.chunks else None
        follows = last is not None and last.bare and last.offset + last.length == offset
        if last and follows and log_ns >= last.end_ns and last.length < RUN_BYTES:
            last.length += length
            last.end_ns = log_ns
        else:
            self._known.chunks.append(_Chunk(log_ns, log_ns, offset, length, bare=True))

    def _take_from_chunk(self, chunk: _Chunk) -> None:
        """Announcements within a chunk; a large first record is a message, and holds none."""
        try:
            records, _ = self._unpacked(chunk, check=False, announcements=True)
            for opcode, start, length in _walk(records):
                if opcode in (Op.SCHEMA, Op.CHANNEL):
                    self._take(opcode, bytes(records[start : start + length]))
        except Exception:  # told when its messages are read
            return

    def _take(self, opcode: int, content: bytes) -> None:
        fields, known = Fields(content), self._known
        if opcode == Op.SCHEMA:
            (number,) = fields.unpack("H")
            known.schemas[number] = fields.text(), fields.text(), fields.raw().decode()
        elif opcode == Op.CHANNEL:
            number, schema = fields.unpack("HH")
            if number not in known.channels:
                known.channels[number] = self._connection(number, schema, fields)
        elif opcode == Op.CHUNK_INDEX:
            start_ns, end_ns, offset, length = fields.unpack("QQQQ")
            entries = struct.iter_unpack("<HQ", fields.raw())
            known.chunks.append(_Chunk(start_ns, end_ns, offset, length, dict(entries) or None))
        elif opcode == Op.STATISTICS:
            fields.unpack("QHIIIIQQ")
            known.counts = dict(struct.iter_unpack("<HQ", fields.raw()))

    def _connection(self, number: int, schema: int, fields: Fields) -> Connection:
        name, encoding, definition = self._known.schemas.get(schema, (NO_TYPE, "", ""))
        topic, serialisation, metadata = fields.text(), fields.text(), fields.texts()
        return Connection(
            number,
            topic,
            name,
            MessageDefinition(_FORMATS.get(encoding, MessageDefinitionFormat.NONE), definition),
            metadata.get("topic_type_hash", ""),
            0,
            ConnectionExtRosbag2(serialisation, offered_qos(metadata)),
            self,
        )

    # -- reading ------------------------------------------------------------------------------

    def _bytes(self, start: int, length: int) -> bytes:
        data = os.pread(self._file, length, start)
        while len(data) < length:  # a single call gives 2 GiB at most
            more = os.pread(self._file, length - len(data), start + len(data))
            if not more:
                raise ReaderError(f"{length} bytes expected at byte {start}, found {len(data)}")
            data += more
        return data

    def _read(self, chunk: _Chunk, wanted: Mapping[int, Connection], check: bool) -> list[Message]:
        """Read the messages of a chunk in order of time; of a damaged one those that are whole."""
        found: list[Message] = []
        try:
            if not check and chunk.indexes and not chunk.bare:
                return self._picked(chunk, wanted)
            records, fault = self._unpacked(chunk, check)
            if fault:
                self._lost(chunk, fault)
                return []
            for opcode, start, length in _walk(records):
                if opcode == Op.MESSAGE:
                    channel, _, log_ns, _ = MESSAGE_HEAD.unpack_from(records, start)
                    if channel in wanted:
                        data = records[start + MESSAGE_HEAD.size : start + length]
                        found.append(Message(log_ns, (chunk.offset, start), channel, data))
        except Exception as error:  # a damaged file makes decoders fail in any way they can
            self._lost(chunk, str(error))
        return sorted(found)

    def _lost(self, chunk: _Chunk, why: str) -> None:
        if chunk.offset not in self._checked:
            self._checked.add(chunk.offset)
            self._tell(f"{self.path.name}: {chunk.length} bytes at byte {chunk.offset}: {why}")

    def _unpacked(
        self, chunk: _Chunk, check: bool, announcements: bool = False
    ) -> tuple[memoryview, str]:
        """Records of a chunk, and what is wrong with them."""
        if chunk.bare:
            return memoryview(self._bytes(chunk.offset, chunk.length)), ""
        place = chunk.offset + HEAD.size
        head = self._bytes(place, min(256, chunk.length - HEAD.size))
        _, _, size, crc = CHUNK_HEAD.unpack_from(head)
        fields = Fields(head[CHUNK_HEAD.size :])
        compression = fields.text()
        (stored,) = fields.unpack("Q")
        place += len(head) - fields.left
        if place + stored > chunk.offset + chunk.length:
            raise ReaderError("its records reach beyond its end")
        if (
            announcements
            and not compression
            and HEAD.unpack(self._bytes(place, 9))[0] == Op.MESSAGE
        ):
            return memoryview(b""), ""
        packed = self._bytes(place, stored)
        records = memoryview(_DECOMPRESSORS[compression](packed))
        if len(records) != size:
            return records, f"{len(records)} bytes in a chunk of {size}"
        wrong = check and crc and zlib.crc32(records) != crc
        return records, "its checksum is wrong" if wrong else ""

    def _picked(self, chunk: _Chunk, wanted: Mapping[int, Connection]) -> list[Message]:
        """Pick single messages out of a chunk by its index, unless it is compressed."""
        place = chunk.offset + HEAD.size
        head = self._bytes(place, min(256, chunk.length - HEAD.size))
        fields = Fields(head[CHUNK_HEAD.size :])
        if fields.text():  # the whole chunk is unpacked anyway, so its checksum costs little
            return self._read(_without_index(chunk), wanted, check=True)
        fields.unpack("Q")
        place += len(head) - fields.left
        found = []
        for channel in wanted.keys() & (chunk.indexes or {}).keys():
            _, start, length = self._record((chunk.indexes or {})[channel])
            for log_ns, offset in INDEX_ENTRY.iter_unpack(self._bytes(start + 6, length - 6)):
                _, at, size = self._record(place + offset)
                data = memoryview(self._bytes(at, size))[MESSAGE_HEAD.size :]
                found.append(Message(log_ns, (chunk.offset, offset), channel, data))
        return sorted(found)


def offered_qos(metadata: Mapping[str, str]) -> list[Qos]:
    """QoS that a topic was recorded with; none where it cannot be read: only players need it."""
    try:
        return parse_qos(metadata.get("offered_qos_profiles", ""))
    except Exception:
        return []


_DECOMPRESSORS: dict[str, Callable[[bytes], bytes]] = {
    "": lambda packed: packed,
    "lz4": lz4.frame.decompress,
    "zstd": zstd.decompress,
}


def _without_index(chunk: _Chunk) -> _Chunk:
    return _Chunk(chunk.start_ns, chunk.end_ns, chunk.offset, chunk.length)


def _walk(records: memoryview) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and length of the content of each record of a chunk."""
    at = 0
    while at < len(records):
        opcode, length = HEAD.unpack_from(records, at)
        at += HEAD.size
        if at + length > len(records):
            raise ReaderError(f"a record of {length} bytes reaches beyond its chunk")
        yield opcode, at, length
        at += length


def _merged(chunks: Sequence[_Chunk], read: Callable[[_Chunk], list[Message]]) -> Iterator[Message]:
    """Messages of all chunks in order of time; a chunk is read when its time comes."""
    waiting = sorted(chunks, key=lambda c: (c.start_ns, c.offset), reverse=True)
    heap: list[tuple[Message, Iterator[Message]]] = []
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
