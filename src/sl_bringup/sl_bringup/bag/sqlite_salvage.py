"""Reading sqlite3 files of recordings that are cut or damaged, message by message.

SQLite itself refuses a file that is shorter than its header says. A message is found by its number
when all pages on the way to it are in the file (``docs/decisions/0013``).
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2 import ReaderError

from sl_bringup.bag.mcap_reader import offered_qos

#: The end is assumed after this many numbers in a row without a readable message.
PATIENCE = 20_000
#: What SQLite and the decoding of its text do with damaged pages.
_FAULTS = (sqlite3.Error, UnicodeDecodeError, OverflowError, MemoryError)


class SalvagedFile:
    """One damaged ``.db3`` file, open for reading.

    Parameters
    ----------
    path : Path
        The file.
    tell : callable
        Gets a line that says how much is lost, once the messages have been read.

    Raises
    ------
    ReaderError
        When not even the list of topics can be read.
    """

    def __init__(self, path: Path, tell: Callable[[str], None]) -> None:
        self._path, self._tell = path, tell
        try:
            address = f"{path.resolve().as_uri()}?immutable=1"
            self._database = sqlite3.connect(address, uri=True, check_same_thread=False)
        except _FAULTS as error:
            raise ReaderError(f"{path.name} cannot be opened: {error}") from None
        try:
            # With it, SQLite reads a file that is shorter than its header says.
            self._database.execute("PRAGMA writable_schema=ON")
            self.connections = self._topics()
        except _FAULTS as error:
            self.close()
            raise ReaderError(f"{path.name} has no readable list of topics: {error}") from None

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def messages(
        self, connections: Sequence[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield the messages of some topics in the order in which they were recorded."""
        wanted = {c.id: c for c in connections}
        number = last = unreadable = 0
        while number - last < PATIENCE:
            number += 1
            try:
                row = self._row(number)
            except _FAULTS:
                unreadable += 1
                continue
            if row is not None:
                last = number
                if row[0] in wanted:
                    yield wanted[row[0]], row[1], row[2]
        what = f"at least {unreadable} messages are" if unreadable < PATIENCE else "the rest is"
        self._tell(f"{self._path.name}: damaged; {what} unreadable, the last one read is {last}")

    def _row(self, number: int) -> tuple[int, int, bytes] | None:
        found = self._database.execute(
            "SELECT topic_id, timestamp, data FROM messages WHERE id=?", (number,)
        ).fetchone()
        whole = found is not None and [type(v) for v in found] == [int, int, bytes]
        return found if whole else None

    def _topics(self) -> list[Connection]:
        columns = {row[1] for row in self._database.execute("PRAGMA table_info(topics)")}
        optional = [
            name if name in columns else "''"
            for name in ("offered_qos_profiles", "type_description_hash")
        ]
        rows = self._database.execute(
            f"SELECT id, name, type, serialization_format, {', '.join(optional)} FROM topics"
        )
        return [self._connection(*row) for row in rows]

    def _connection(
        self, number: int, name: str, kind: str, serialisation: str, qos: str, digest: str
    ) -> Connection:
        definition = MessageDefinition(MessageDefinitionFormat.NONE, "")
        ext = ConnectionExtRosbag2(serialisation, offered_qos({"offered_qos_profiles": qos}))
        return Connection(number, name, kind, definition, digest, 0, ext, self)
