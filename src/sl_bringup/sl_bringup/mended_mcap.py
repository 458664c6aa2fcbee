"""An mcap file whose end is missing, made readable: what a killed recorder leaves.

An mcap file is a chain of records (opcode, length, content; mcap.dev/spec). The chain is
followed as far as it holds, and a file is presented that ends there, with an empty footer: such
a file is valid, only without an index.
"""

from __future__ import annotations

import io
import os
import struct
from pathlib import Path
from typing import BinaryIO, cast

MAGIC = b"\x89MCAP0\r\n"
_HEADER = struct.Struct("<BQ")
#: Footer record (opcode 2) without summary, without checksum, and the closing magic.
_TAIL = _HEADER.pack(0x02, 20) + bytes(20) + MAGIC
_LAST_OPCODE = 0x0F
_FOOTER, _DATA_END = 0x02, 0x0F


def intact_bytes(path: Path) -> int:
    """Length of the part of the file that consists of whole records; 0 when it is no mcap file."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return 0
        end = file.tell()
        while len(head := file.read(_HEADER.size)) == _HEADER.size:
            opcode, length = _HEADER.unpack(head)
            stop = end + _HEADER.size + length
            if not 0x01 <= opcode <= _LAST_OPCODE or stop > size or opcode in (_FOOTER, _DATA_END):
                break
            end = file.seek(stop)
    return end


class _Spliced(io.RawIOBase):
    """The first ``length`` bytes of a file, then ``tail``, as one read-only file."""

    def __init__(self, file: BinaryIO, length: int, tail: bytes) -> None:
        self._file, self._length, self._tail = file, length, tail
        self._position = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        base = {
            os.SEEK_SET: 0,
            os.SEEK_CUR: self._position,
            os.SEEK_END: self._length + len(self._tail),
        }[whence]
        self._position = base + offset
        return self._position

    def tell(self) -> int:
        return self._position

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        if self._position < self._length:
            self._file.seek(self._position)
            data = self._file.read(min(len(buffer), self._length - self._position))
        else:
            start = self._position - self._length
            data = self._tail[start : start + len(buffer)]
        buffer[: len(data)] = data
        self._position += len(data)
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()


class MendedPath:
    """Stands for the intact part of a damaged mcap file where a path is asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.intact = intact_bytes(path)

    def __str__(self) -> str:
        return str(self.path)

    def open(self, mode: str = "rb") -> BinaryIO:
        """Open for reading; every other mode is meaningless here."""
        spliced = _Spliced(self.path.open("rb"), self.intact, _TAIL)
        return cast(BinaryIO, io.BufferedReader(spliced, 1 << 20))
