"""A recording as it grows: a rosbag2 directory of one or several mcap files.

Messages are written as they came over the wire. ``metadata.yaml`` is there from the first second on
and kept up to date, so that a killed recorder leaves a list of its files and topics; only the right
counts, and the summary at the end of its last file, are then missing.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9

from sl_bringup.bag.bags import typestore
from sl_bringup.bag.mcap_writer import McapWriter
from sl_common.documents import write_text
from sl_common.errors import BagError

#: Time between two writings of the metadata.
METADATA_S = 5.0
METADATA = "metadata.yaml"


@dataclass(frozen=True)
class _Known:
    """A topic that has been announced."""

    name: str
    msgtype: str
    digest: str
    definition: str
    qos: tuple[Qos, ...]


class BagRecorder:
    """A rosbag2 directory, open for writing; a context manager.

    Parameters
    ----------
    path : Path
        The directory; it must not exist.
    custom : mapping
        For the metadata: software version and such.
    split_bytes : int
        Begin another file when one has this many bytes; 0: never.
    compress : bool
        Compress images too. Noise hardly gets smaller: 10 % for 7 ms of a core per image.

    Raises
    ------
    BagError
        When the path is taken or cannot be written.
    """

    def __init__(
        self,
        path: Path,
        custom: Mapping[str, str] | None = None,
        split_bytes: int = 0,
        compress: bool = False,
    ) -> None:
        self.path = path
        self._custom = dict(custom or {})
        self._split_bytes, self._compress = split_bytes, compress
        self._topics: dict[str, _Known] = {}
        self._channels: dict[str, int] = {}
        self._latched: dict[str, tuple[int, int, bytes]] = {}
        self._files: list[dict[str, Any]] = []
        self.counts: dict[str, int] = {}
        self._closed_bytes = 0
        self._written_s = float("-inf")
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            raise BagError(f"{path} exists already; expected a name that is free") from None
        except OSError as exc:
            raise BagError(f"cannot write {path}: {exc.strerror or exc}") from None
        self._writer = self._open()

    def __enter__(self) -> BagRecorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._closed_bytes + self._writer.size

    def add_topic(self, name: str, msgtype: str, qos: Qos) -> None:
        """Announce a topic.

        Parameters
        ----------
        name, msgtype : str
            Full names.
        qos : Qos
            What a player is to offer.

        Raises
        ------
        BagError
            When the type's definition is not known.
        """
        if msgtype not in typestore().fielddefs:
            raise BagError(f"{name}: the definition of {msgtype} is not known")
        definition, _ = typestore().generate_msgdef(msgtype, ros_version=2)
        digest = typestore().hash_rihs01(msgtype)
        self._topics[name] = _Known(name, msgtype, digest, definition, (qos,))
        self.counts[name] = 0

    def write(self, name: str, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Write a message of an announced topic.

        Parameters
        ----------
        name : str
            Of the topic.
        log_ns, publish_ns : int
            When it was received and sent, nanoseconds since the epoch.
        data : bytes
            CDR, with its header.
        """
        if self._split_bytes and self._writer.size >= self._split_bytes:
            self._split(log_ns)
        if self._is_latched(name):
            self._latched[name] = (log_ns, publish_ns, data)
        self._put(name, log_ns, publish_ns, data)
        self.counts[name] += 1

    def tick(self) -> None:
        """Hand over what has waited too long; call it several times a second."""
        self._writer.tick()
        if time.monotonic() - self._written_s >= METADATA_S:
            self._write_metadata([*self._files, _entry(self._writer)])

    def close(self) -> None:
        """End the file and write the metadata."""
        self._end_file()
        self._write_metadata(self._files)

    def _put(self, name: str, log_ns: int, publish_ns: int, data: bytes) -> None:
        if name not in self._channels:
            topic = self._topics[name]
            qos = yaml.safe_dump(dump_qos_v9(list(topic.qos))).strip()
            self._channels[name] = self._writer.add_channel(
                name, topic.msgtype, topic.definition, topic.digest, qos
            )
        self._writer.write(self._channels[name], log_ns, publish_ns, data)

    def _is_latched(self, name: str) -> bool:
        return any(q.durability.name == "TRANSIENT_LOCAL" for q in self._topics[name].qos)

    def _open(self) -> McapWriter:
        file = self.path / f"{self.path.name}_{len(self._files)}.mcap"
        try:
            return McapWriter(file, self._compress, self._custom)
        except OSError as exc:
            raise BagError(f"cannot write {file}: {exc.strerror or exc}") from None

    def _end_file(self) -> None:
        writer = self._writer
        writer.close()
        self._closed_bytes += writer.path.stat().st_size
        self._files.append(_entry(writer))

    def _split(self, log_ns: int) -> None:
        """Begin another file; what is latched is repeated, so that each file can be used alone."""
        self._end_file()
        self._channels.clear()
        self._writer = self._open()
        for name, (_, publish_ns, data) in self._latched.items():
            self._put(name, log_ns, publish_ns, data)
            self.counts[name] += 1
        self._write_metadata([*self._files, _entry(self._writer)])

    def _write_metadata(self, files: Sequence[Mapping[str, Any]]) -> None:
        self._written_s = time.monotonic()
        write_text(self.path / METADATA, self._metadata(files))

    def _metadata(self, files: Sequence[Mapping[str, Any]]) -> str:
        used = [f for f in files if f["message_count"]]
        start = min((_start(f) for f in used), default=0)
        end = max((_start(f) + f["duration"]["nanoseconds"] for f in used), default=0)
        content = {
            "version": 9,
            "storage_identifier": "mcap",
            "duration": {"nanoseconds": end - start},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": sum(f["message_count"] for f in files),
            "topics_with_message_count": [self._topic_metadata(t) for t in self._topics.values()],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [f["path"] for f in files],
            "files": list(files),
            "custom_data": self._custom or None,
            "ros_distro": "jazzy",
        }
        return yaml.safe_dump({"rosbag2_bagfile_information": content}, sort_keys=False)

    def _topic_metadata(self, topic: _Known) -> dict[str, Any]:
        return {
            "topic_metadata": {
                "name": topic.name,
                "type": topic.msgtype,
                "serialization_format": "cdr",
                "offered_qos_profiles": dump_qos_v9(list(topic.qos)),
                "type_description_hash": topic.digest,
            },
            "message_count": self.counts[topic.name],
        }


def _start(file: Mapping[str, Any]) -> int:
    start: int = file["starting_time"]["nanoseconds_since_epoch"]
    return start


def _entry(writer: McapWriter) -> dict[str, Any]:
    """What the metadata say of a file."""
    return {
        "path": writer.path.name,
        "starting_time": {"nanoseconds_since_epoch": writer.start_ns},
        "duration": {"nanoseconds": writer.end_ns - writer.start_ns},
        "message_count": writer.message_count,
    }
