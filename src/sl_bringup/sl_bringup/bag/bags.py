"""Recordings read without ROS, as far as they are readable.

rosbag2 directories, bare ``.mcap`` and ``.db3`` files are read, with or without
``metadata.yaml``. A damaged bag gives what is readable, and says what is lost.
"""

from __future__ import annotations

import functools
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import zstandard
from rosbags.interfaces import Connection, ConnectionExtRosbag2
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from sl_bringup.bag.mcap_reader import NO_TYPE, McapFile
from sl_bringup.bag.sqlite_salvage import SalvagedFile
from sl_common.errors import BagError
from sl_common.topics import EVALUATED_TOPICS, IMAGE, NAMESPACE, TRIGGER, Topic


def interface_dir() -> Path:
    """Directory of the ``.msg`` files of ``sl_interfaces``.

    The source tree that this file lies in comes first, because those definitions fit this code;
    then what is installed (ament prefixes, then this Python's prefix).

    Raises
    ------
    BagError
        When there is none.
    """
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    places = [
        Path(__file__).resolve().parents[3] / "sl_interfaces" / "msg",
        *(Path(p) / "share" / "sl_interfaces" / "msg" for p in [*prefixes, sys.prefix]),
    ]
    for place in places:
        if (place / "PatternTrigger.msg").is_file():
            return place
    raise BagError(
        f"no message definitions of sl_interfaces in {', '.join(map(str, places))}; "
        "expected it to be installed"
    )


@functools.cache
def typestore() -> Typestore:
    """ROS 2 Jazzy's types and those of ``sl_interfaces``."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for path in sorted(interface_dir().glob("*.msg")):
        types.update(get_types_from_msg(path.read_text(), f"sl_interfaces/msg/{path.stem}"))
    store.register(types)
    return store


def make_message(msgtype: str, **fields: Any) -> Any:
    """Make a message without ROS; see `sl_common.messages.MakeMessage`.

    Parameters
    ----------
    msgtype : str
        ``package/msg/Type``.
    **fields
        Its fields; those left out have the type's default.
    """
    return typestore().types[msgtype](**fields)


@dataclass(frozen=True)
class Recorded:
    """One message of a bag.

    Parameters
    ----------
    topic : Topic
        Which topic it is of.
    received_ns : int
        When it was recorded, nanoseconds since the epoch.
    message : object
        With the fields of its ``.msg`` file; arrays are numpy views.
    """

    topic: Topic
    received_ns: int
    message: Any


@dataclass(frozen=True)
class Raw:
    """One message as it was on the wire.

    Parameters
    ----------
    topic : Topic
        Which topic it is of.
    received_ns : int
        When it was recorded, nanoseconds since the epoch.
    data : buffer
        CDR with its header.
    """

    topic: Topic
    received_ns: int
    data: bytes | memoryview


class _Storage(Protocol):
    @property
    def connections(self) -> list[Connection]: ...

    def messages(
        self, connections: Sequence[Connection]
    ) -> Iterator[tuple[Connection, int, bytes | memoryview]]: ...


@dataclass(frozen=True)
class _File:
    """One open file of a bag.

    ``digests`` are the types' hashes by topic where the bag says them; ``unpack`` undoes the
    compression of single messages.
    """

    name: str
    storage: _Storage
    digests: Mapping[str, str] = field(default_factory=dict)
    unpack: Callable[[bytes], bytes] | None = None


@dataclass
class Bag:
    """An open recording.

    Parameters
    ----------
    path : Path
        Where it is.
    namespace : str
        Namespace of the rig in it.
    lost : list of str
        What could not be read, in words; grows while messages are read.
    notes : list of str
        What is odd about it but costs nothing.
    """

    path: Path
    namespace: str
    lost: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    _files: list[_File] = field(default_factory=list)

    def messages(self, *topics: Topic, quick: bool = False) -> Iterator[Recorded]:
        """Yield the messages of the given topics (default: what an evaluation reads) as recorded.

        Parameters
        ----------
        topics : Topic
            Which.
        quick : bool
            Pick few messages out of many, without a look at checksums.

        Notes
        -----
        A message that does not fit its definition is left out and told in ``lost``.

        Raises
        ------
        BagError
            When a topic has another type, or another version of it.
        """
        for raw in self.raw(*topics or EVALUATED_TOPICS, quick=quick):
            try:
                message = typestore().deserialize_cdr(raw.data, raw.topic.msgtype)
            except Exception as exc:
                self.lose(
                    f"a message of {len(raw.data)} bytes on {raw.topic.name} is no "
                    f"{raw.topic.msgtype}: {_reason(exc)}"
                )
                continue
            yield Recorded(raw.topic, raw.received_ns, message)

    def raw(self, *topics: Topic, quick: bool = False) -> Iterator[Raw]:
        """Yield the messages of the given topics as they were on the wire.

        Parameters
        ----------
        *topics : Topic
            All topics when none is named.
        quick : bool
            Skip what only a damaged file needs.
        """
        wanted = {f"{self.namespace}/{topic.name}": topic for topic in topics}
        for file in self._files:
            connections = [c for c in file.storage.connections if c.topic in wanted]
            if connections:
                yield from self._read(file, connections, wanted, quick)

    def everything(self) -> Iterator[tuple[Connection, int, bytes | memoryview]]:
        """Yield every message of every topic: its connection, when it was recorded, CDR."""
        for file in self._files:
            yield from self._packets(file, file.storage.connections, quick=False)

    def has(self, topic: Topic) -> bool:
        """Whether the topic is in the bag."""
        return f"{self.namespace}/{topic.name}" in topic_names(self)

    def lose(self, line: str) -> None:
        """Note once what could not be read."""
        if line not in self.lost:
            self.lost.append(line)

    def _read(
        self,
        file: _File,
        connections: Sequence[Connection],
        wanted: Mapping[str, Topic],
        quick: bool,
    ) -> Iterator[Raw]:
        known = [connection for connection in connections if connection.msgtype != NO_TYPE]
        for connection in connections:
            if connection not in known:
                self.lose(f"{file.name}: what type {connection.topic} has cannot be read")
                continue
            digest = connection.digest or file.digests.get(connection.topic, "")
            _check_type(connection, digest, wanted[connection.topic], self.path)
        if not known:  # the readers take none for all
            return
        for connection, received_ns, data in self._packets(file, known, quick):
            yield Raw(wanted[connection.topic], received_ns, data)

    def _packets(
        self, file: _File, connections: Sequence[Connection], quick: bool
    ) -> Iterator[tuple[Connection, int, bytes | memoryview]]:
        """Messages of a file as far as it can be read."""
        storage = file.storage
        messages = (
            storage.messages(connections, check=not quick)
            if isinstance(storage, McapFile)
            else storage.messages(connections)
        )
        while True:
            try:
                connection, received_ns, packed = next(messages)
                data = file.unpack(bytes(packed)) if file.unpack else packed
            except StopIteration:
                return
            except Exception as exc:  # a damaged file makes the reader fail in any way it can
                self.lose(f"{file.name}: unreadable from here on ({_reason(exc)})")
                return
            yield connection, received_ns, data


def _check_type(connection: Connection, digest: str, topic: Topic, path: Path) -> None:
    if connection.msgtype != topic.msgtype:
        raise BagError(
            f"{path}: {connection.topic} is of type {connection.msgtype}; expected {topic.msgtype}"
        )
    expected = typestore().hash_rihs01(topic.msgtype)
    if digest.startswith("RIHS01_") and digest != expected:
        raise BagError(
            f"{path}: {connection.topic} was recorded with another version of {topic.msgtype} "
            f"({digest[:15]}...); expected {expected[:15]}..."
        )


@contextmanager
def open_bag(path: str | Path, namespace: str | None = None) -> Iterator[Bag]:
    """Open a recording.

    Parameters
    ----------
    path : path
        A rosbag2 directory, or one ``.mcap`` or ``.db3`` file.
    namespace : str, optional
        Namespace of the rig, where the bag has several.

    Raises
    ------
    BagError
        When nothing can be read, or it is not clear which rig is meant.
    """
    path = Path(path)
    if not path.exists():
        raise BagError(f"there is no bag {path}")
    bag = Bag(path, "")
    with ExitStack() as stack:
        _open_files(bag, stack)
        bag.namespace = _namespace(bag, namespace)
        yield bag


def _open_files(bag: Bag, stack: ExitStack) -> None:
    """Open the bag as its metadata says; when that fails, every file of it that can be read."""
    try:
        opened = _open_directory if bag.path.is_dir() else _open_file
        bag._files += opened(bag, bag.path, stack)
    except Exception as exc:
        _refuse_formats(exc, bag.path)
        harmless, why = _why_not_as_told(exc) if bag.path.is_dir() else (False, _reason(exc))
        (bag.notes.append if harmless else bag.lose)(f"{bag.path.name}: {why}")
        for path in _storage_files(bag.path):
            bag._files += _open_damaged(bag, path, stack)
        if not bag._files:
            told = "; ".join([*bag.notes, *bag.lost])
            raise BagError(
                f"{bag.path} cannot be read: {told}; expected a rosbag2 directory or an .mcap or "
                ".db3 file"
            ) from None


def _why_not_as_told(exc: Exception) -> tuple[bool, str]:
    """Whether it costs nothing that the metadata cannot be followed, and why they cannot."""
    if isinstance(exc, FileNotFoundError):
        return True, "no metadata.yaml, read file by file"
    if isinstance(exc, ReaderError) and "magic" in str(exc):  # what is lost is told by the file
        return True, "the recording was not ended, read file by file"
    return False, _reason(exc)


def _refuse_formats(exc: Exception, path: Path) -> None:
    """A bag that is whole but in a format we do not know is not to be read half."""
    if isinstance(exc, ReaderError) and "not supported" in str(exc):
        raise BagError(f"{path} cannot be read: {_reason(exc)}; expected cdr in mcap or sqlite3")


def _open_directory(bag: Bag, path: Path, stack: ExitStack) -> list[_File]:
    """Open the files that metadata.yaml names.

    The files are read one by one: rosbags' own reading of a directory drops every message whose
    QoS is worded differently in metadata and file, without a word.
    """
    reader = DirectoryReader(path)
    reader.open()
    stack.callback(reader.close)
    if unnamed := {p.name for p in _storage_files(path)} - _named_files(reader):
        raise ReaderError(f"metadata.yaml does not name {', '.join(sorted(unnamed))}")
    held = sum(c.msgcount for storage in reader.storages for c in storage.connections)
    recorded = reader.metadata.message_count
    if held != recorded:
        tell = bag.lose if held < recorded else bag.notes.append
        tell(f"{path.name}: the files hold {held} messages, {recorded} were recorded")
    unpack = zstandard.decompress if reader.metadata.compression_mode == "message" else None
    digests = {c.topic: c.digest for c in reader.connections}
    return [
        _File(path.name, _fast(bag, storage, stack), digests, unpack) for storage in reader.storages
    ]


def _named_files(reader: DirectoryReader) -> set[str]:
    """Names of the files that the metadata name; compressed ones lie elsewhere meanwhile."""
    storages: Sequence[Any] = reader.storages
    return {Path(str(storage.path)).name for storage in storages}


def _fast(bag: Bag, storage: Any, stack: ExitStack) -> _Storage:
    if isinstance(storage, McapReader):
        return _open_mcap(bag, Path(str(storage.path)), stack)
    return storage  # type: ignore[no-any-return]


def _open_mcap(bag: Bag, path: Path, stack: ExitStack) -> McapFile:
    file = McapFile(path, bag.lose)
    stack.callback(file.close)
    return file


def _open_file(bag: Bag, path: Path, stack: ExitStack) -> list[_File]:
    """Open one file, of an mcap file that is damaged what is whole."""
    if path.suffix == ".mcap":
        mcap = _open_mcap(bag, path, stack)
        _check_cdr(mcap.connections)
        return [_File(path.name, mcap)]
    reader = Reader(path)
    reader.open()
    stack.callback(reader.close)
    _check_cdr(reader.connections)
    return [_File(path.name, reader.storage)]


def _check_cdr(connections: Sequence[Connection]) -> None:
    extensions = [c.ext for c in connections if isinstance(c.ext, ConnectionExtRosbag2)]
    formats = {ext.serialization_format for ext in extensions}
    if formats - {"cdr"}:
        raise ReaderError(f"Serialization format {formats!r} is not supported.")


def _storage_files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    found = [p for p in path.iterdir() if p.suffix in (".mcap", ".db3") and p.is_file()]
    return sorted(found, key=natural_key)


def _open_damaged(bag: Bag, path: Path, stack: ExitStack) -> list[_File]:
    """Open a file if that is possible."""
    try:
        return _open_file(bag, path, stack)
    except Exception as exc:
        _refuse_formats(exc, path)
        fault = exc
    if path.suffix == ".db3":
        try:
            return [_salvaged(bag, path, stack)]
        except ReaderError as exc:
            fault = exc
    if path != bag.path:
        bag.lose(f"{path.name}: {_reason(fault)}")
    return []


def _salvaged(bag: Bag, path: Path, stack: ExitStack) -> _File:
    salvaged = SalvagedFile(path, bag.lose)
    stack.callback(salvaged.close)
    _check_cdr(salvaged.connections)
    return _File(path.name, salvaged)


def _namespace(bag: Bag, wanted: str | None) -> str:
    """Namespace of the rig in the bag: the one under which images or triggers were recorded."""
    names = topic_names(bag)
    found = sorted(
        {
            name.removesuffix(f"/{topic.name}")
            for name in names
            for topic in (TRIGGER, IMAGE)
            if name.endswith(f"/{topic.name}")
        }
    )
    if wanted is not None:
        return "/" + wanted.strip("/")
    if len(found) > 1:
        raise BagError(
            f"{bag.path} has several rigs: {', '.join(found)}; expected one of them to be named"
        )
    return found[0] if found else NAMESPACE


def topic_names(bag: Bag) -> list[str]:
    """All topics in the bag, sorted."""
    return sorted({c.topic for file in bag._files for c in file.storage.connections})


def _reason(exc: BaseException) -> str:
    text = " ".join(str(exc).split()) or type(exc).__name__
    return text if len(text) <= 200 else text[:197] + "..."


def natural_key(path: Path) -> list[tuple[int, int | str]]:
    """Sort key that puts ``frame_10`` after ``frame_9``."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(0, int(part)) if part.isdigit() else (1, part) for part in parts if part]
