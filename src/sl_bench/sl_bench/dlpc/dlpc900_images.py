"""The emulator's decoder of DLPC900 images, written from TI's document alone.

It shares nothing with the driver's encoder. Plain Python over runs: it is fast where an image
compresses well, which is what a projector is sent.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from sl_bench.dlpc.dlpc_emulator import Error, Refusal, invalid

HEADER_BYTES = 48
SIGNATURE = b"Spld"


class _Stream:
    """Bytes of an image's data, consumed from the front."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.at = 0

    def byte(self) -> int:
        """Take one byte."""
        if self.at >= len(self._data):
            raise invalid(f"image data ends after {self.at} bytes without an end mark")
        self.at += 1
        return self._data[self.at - 1]

    def take(self, count: int) -> bytes:
        """Take ``count`` bytes."""
        part = self._data[self.at : self.at + count]
        if len(part) < count:
            raise invalid(f"image data ends within {count} pixel bytes at {self.at}")
        self.at += count
        return part

    def length(self) -> int:
        """Take an enhanced RLE length: seven bits, or fifteen when bit 7 is set."""
        low = self.byte()
        return low if low < 0x80 else (low & 0x7F) | self.byte() << 7


class _Canvas:
    """Pixels in reading order; a line ends by itself when it is full."""

    def __init__(self, width: int, height: int) -> None:
        self.width = width
        self.pixels = np.zeros((width * height, 3), np.uint8)
        self.at = 0

    def _room(self, count: int) -> slice:
        if self.at + count > len(self.pixels) or self.at % self.width + count > self.width:
            raise invalid(f"{count} pixels at pixel {self.at} leave the line or the image")
        self.at += count
        return slice(self.at - count, self.at)

    def repeat(self, count: int, pixel: bytes) -> None:
        """Put one colour ``count`` times."""
        self.pixels[self._room(count)] = np.frombuffer(pixel, np.uint8)

    def literal(self, pixels: bytes) -> None:
        """Put pixels as they are."""
        room = self._room(len(pixels) // 3)
        self.pixels[room] = np.frombuffer(pixels, np.uint8).reshape(-1, 3)

    def copy_above(self, count: int) -> None:
        """Put ``count`` pixels of the line above."""
        if self.at < self.width:
            raise invalid("copy from the line above on the first line")
        room = self._room(count)
        above = slice(room.start - self.width, room.stop - self.width)
        self.pixels[room] = self.pixels[above]

    def end_line(self) -> None:
        """Go to the start of the next line, unless at the start of one."""
        self.at += -self.at % self.width


def _run_length(stream: _Stream, canvas: _Canvas) -> None:
    while True:
        count = stream.byte()
        if count:
            canvas.repeat(count, stream.take(3))
            continue
        count = stream.byte()
        if count == 0:
            canvas.end_line()
            stream.at += -stream.at % 4
        elif count == 1:
            return
        else:
            canvas.literal(stream.take(3 * count))


def _enhanced_run_length(stream: _Stream, canvas: _Canvas) -> None:
    while True:
        if stream.byte():
            stream.at -= 1
            canvas.repeat(stream.length(), stream.take(3))
            continue
        count = stream.length()
        if count == 0:
            canvas.end_line()
        elif count > 1:
            canvas.literal(stream.take(3 * count))
        elif (copied := stream.length()) > 0:
            canvas.copy_above(copied)
        else:
            return


def _uncompressed(data: bytes, width: int, height: int) -> NDArray[np.uint8]:
    line = 3 * width
    padded = (line + 15) // 16 * 16
    for stride in (padded, line):
        if len(data) == stride * height:
            rows = np.frombuffer(data, np.uint8).reshape(height, stride)
            return rows[:, :line].reshape(-1, 3)
    raise invalid(f"{len(data)} bytes of pixels; expected {padded * height}")


def decode_image(
    stream: bytes, width: int, height: int, *, strict: bool = True
) -> NDArray[np.uint8]:
    """Decode header and data into bit planes.

    Parameters
    ----------
    stream : bytes
        The 48-byte header and the encoded pixels. The header may count its own bytes or not, and
        bytes 24 and 29 may have either value: hosts do both.
    width, height : int
        What the controller drives; another size is a fault.
    strict : bool
        Whether a header that miscounts the bytes is a fault also where the data have an end mark
        (compressions 1 and 2). DMDConnect for Matlab writes the number of pixels there.

    Returns
    -------
    ndarray of uint8, shape (3, height, width)
        Plane k is bit ``k % 8`` of element ``k // 8``.

    Raises
    ------
    Refusal
        When the controller would refuse or garble it.
    """
    if len(stream) < HEADER_BYTES or stream[:4] != SIGNATURE:
        raise invalid(f"image begins with {stream[:4]!r}; expected {SIGNATURE!r}")
    columns, rows, counted = struct.unpack_from("<HHI", stream, 4)
    if (columns, rows) != (width, height):
        raise invalid(f"image of {columns}x{rows}; expected {width}x{height}")
    data = stream[HEADER_BYTES:]
    if (strict or stream[25] == 0) and counted not in (len(data), len(stream)):
        raise invalid(f"header counts {counted} bytes; got {len(data)}")
    pixels = _pixels(stream[25], data, width, height)
    # On the wire planes 16-23 come first.
    return np.ascontiguousarray(pixels[:, ::-1].T).reshape(3, height, width)


def _pixels(compression: int, data: bytes, width: int, height: int) -> NDArray[np.uint8]:
    if compression == 0:
        return _uncompressed(data, width, height)
    canvas, stream = _Canvas(width, height), _Stream(data)
    if compression == 1:
        _run_length(stream, canvas)
    elif compression == 2:
        _enhanced_run_length(stream, canvas)
    else:
        raise Refusal(Error.BAD_COMPRESSION, f"compression {compression}; expected 0, 1 or 2")
    canvas.end_line()
    if canvas.at != len(canvas.pixels):
        raise invalid(f"image ends after {canvas.at} of {len(canvas.pixels)} pixels")
    return canvas.pixels
