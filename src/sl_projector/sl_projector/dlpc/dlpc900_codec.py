"""DLPC900 images: 24 one-bit planes packed into pixels of 3 bytes, and TI's three compressions.

A pixel is a 24-bit word, plane k its bit k, sent with the most significant byte first (TI
DLPU018I, splash image format). Rows go top first.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import SequenceError
from sl_common.kernel_cache import kernel
from sl_projector.dlpc.dmd import PLANES_PER_IMAGE, DmdModel
from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence

UNCOMPRESSED, RLE, ENHANCED_RLE = 0, 1, 2
MAX_IMAGES = 18
IMAGE_HEADER_BYTES = 48

Words = NDArray[np.uint32]
Bytes = NDArray[np.uint8]


@kernel(error_model="python")
def _set_plane(words: Words, mirrors: Bytes, plane: int) -> None:
    for row in range(words.shape[0]):
        for column in range(words.shape[1]):
            if mirrors[row, column]:
                words[row, column] |= np.uint32(1 << plane)


def pack_planes(frames: Sequence[NDArray[np.uint8]]) -> Words:
    """Pack up to 24 frames into words: shape (rows, columns), bit k from ``frames[k]``.

    A mirror is on where its frame is not zero.
    """
    words = np.zeros(frames[0].shape, np.uint32)
    for plane, frame in enumerate(frames):
        _set_plane(words, frame, plane)
    return words


@kernel(error_model="python")
def _put_pixel(out: Bytes, at: int, word: int) -> int:
    out[at] = (word >> 16) & 0xFF
    out[at + 1] = (word >> 8) & 0xFF
    out[at + 2] = word & 0xFF
    return at + 3


@kernel(error_model="python")
def _repeat_length(line: Words, column: int, longest: int) -> int:
    end = min(line.size, column + longest)
    stop = column + 1
    while stop < end and line[stop] == line[column]:
        stop += 1
    return stop - column


@kernel(error_model="python")
def _copy_length(line: Words, above: Words, column: int, longest: int) -> int:
    end = min(line.size, column + longest)
    stop = column
    while stop < end and line[stop] == above[stop]:
        stop += 1
    return stop - column


@kernel(error_model="python")
def _literal_length(line: Words, above: Words, column: int, longest: int, has_above: bool) -> int:
    # A literal run ends at a repeat or copy of two pixels or more: a single one saves nothing
    # once the next literal run's own count bytes are paid.
    end = min(line.size, column + longest)
    stop = column + 1
    while stop < end:
        if _repeat_length(line, stop, 2) == 2:
            break
        if has_above and _copy_length(line, above, stop, 2) == 2:
            break
        stop += 1
    return stop - column


@kernel(error_model="python")
def _put_literals(out: Bytes, at: int, line: Words, column: int, count: int) -> int:
    for pixel in range(column, column + count):
        at = _put_pixel(out, at, line[pixel])
    return at


@kernel(error_model="python")
def _rle_line(out: Bytes, at: int, line: Words) -> int:
    column = 0
    while column < line.size:
        count = _repeat_length(line, column, 255)
        literals = _literal_length(line, line, column, 255, False) if count == 1 else 0
        if literals > 1:
            count = literals
            out[at] = 0
            out[at + 1] = count
            at = _put_literals(out, at + 2, line, column, count)
        else:
            out[at] = count
            at = _put_pixel(out, at + 1, line[column])
        column += count
    return at


@kernel(error_model="python")
def _rle(words: Words, out: Bytes) -> int:
    at = 0
    for row in range(words.shape[0]):
        at = _rle_line(out, at, words[row])
        if row < words.shape[0] - 1:
            at += 2  # end of line; then the next four-byte boundary, both zeros
            at += -at % 4
    out[at + 1] = 1
    at += 2
    return at + -at % 16


@kernel(error_model="python")
def _put_count(out: Bytes, at: int, count: int) -> int:
    if count < 128:
        out[at] = count
        return at + 1
    out[at] = (count & 0x7F) | 0x80
    out[at + 1] = count >> 7
    return at + 2


@kernel(error_model="python")
def _enhanced_run(
    out: Bytes, at: int, line: Words, above: Words, column: int, has_above: bool
) -> tuple[int, int]:
    copies = _copy_length(line, above, column, line.size) if has_above else 0
    repeats = _repeat_length(line, column, line.size)
    if copies >= repeats:
        out[at] = 0
        out[at + 1] = 1
        return _put_count(out, at + 2, copies), copies
    literals = _literal_length(line, above, column, line.size, has_above) if repeats == 1 else 0
    if literals > 1:
        out[at] = 0
        at = _put_count(out, at + 1, literals)
        return _put_literals(out, at, line, column, literals), literals
    at = _put_count(out, at, repeats)
    return _put_pixel(out, at, line[column]), repeats


@kernel(error_model="python")
def _enhanced_rle(words: Words, out: Bytes) -> int:
    at = 0
    for row in range(words.shape[0]):
        column = 0
        while column < words.shape[1]:
            at, count = _enhanced_run(out, at, words[row], words[row - 1], column, row > 0)
            column += count
    out[at + 1] = 1  # 00 01 00: end of image
    return at + 3


def _worst_case_bytes(words: Words) -> int:
    # A pixel costs at most four bytes (a repeat of one), a row eight more.
    rows, columns = (int(side) for side in words.shape)
    return rows * (4 * columns + 8) + 32


def encode_rle(words: Words) -> bytes:
    """Compress with TI's RLE (compression 1); the data ends on a 16-byte boundary."""
    out = np.zeros(_worst_case_bytes(words), np.uint8)
    return out[: _rle(words, out)].tobytes()


def encode_enhanced_rle(words: Words) -> bytes:
    """Compress with TI's enhanced RLE (compression 2): repeats, literals, copies of the line."""
    out = np.zeros(_worst_case_bytes(words), np.uint8)
    return out[: _enhanced_rle(words, out)].tobytes()


def encode_uncompressed(words: Words) -> bytes:
    """Write three bytes a pixel, rows padded to a multiple of 16 bytes (compression 0)."""
    rows, columns = words.shape
    out = np.zeros((rows, -(-3 * columns // 16) * 16), np.uint8)
    for byte in range(3):
        out[:, byte : 3 * columns : 3] = words >> (16 - 8 * byte)
    return out.tobytes()


def image_header(columns: int, rows: int, data_bytes: int, compression: int) -> bytes:
    """Return the 48-byte header in the form that TI's own software writes.

    Parameters
    ----------
    columns, rows : int
        Size of the image, pixels.
    data_bytes : int
        Bytes after the header.
    compression : {UNCOMPRESSED, RLE, ENHANCED_RLE}
        How they are coded.
    """
    unused = b"\xff" * 8
    fields = (b"Spld", columns, rows, data_bytes, unused, 0, 1, compression, 1, 0, 1)
    return struct.pack("<4sHHI8sIBBBHB18x", *fields)


def encode_image(words: Words) -> bytes:
    """Return header and data in the smallest of the three compressions.

    Parameters
    ----------
    words : ndarray of uint32, shape (rows, columns)
        Bit k of a word is plane k of the image.
    """
    encoded = [(ENHANCED_RLE, encode_enhanced_rle(words)), (RLE, encode_rle(words))]
    rows, columns = words.shape
    if min(len(data) for _, data in encoded) > 3 * columns * rows:
        encoded.append((UNCOMPRESSED, encode_uncompressed(words)))
    compression, data = min(encoded, key=lambda pair: len(pair[1]))
    return image_header(columns, rows, len(data), compression) + data


@dataclass(frozen=True)
class PlaneMap:
    """Where each pattern of a sequence lies.

    Parameters
    ----------
    places : tuple of (image, bit)
        One for each pattern, in projection order; equal patterns share a plane.
    images : tuple of tuple of Pattern
        The patterns in each image, plane 0 first.
    """

    places: tuple[tuple[int, int], ...]
    images: tuple[tuple[Pattern, ...], ...]


def _canonical(pattern: Pattern) -> Pattern:
    """Give patterns that set the same mirrors the same name."""
    if pattern.kind == "gray":
        return pattern
    return Pattern("white" if (pattern.kind == "white") != pattern.inverted else "black")


def _group(pattern: Pattern) -> str:
    return pattern.axis if pattern.kind == "gray" else "blank"


def _fill(patterns: list[Pattern]) -> list[list[Pattern]]:
    cuts = range(0, len(patterns), PLANES_PER_IMAGE)
    return [patterns[i : i + PLANES_PER_IMAGE] for i in cuts]


def map_planes(sequence: PatternSequence) -> PlaneMap:
    """Distribute a sequence's patterns over images of 24 planes.

    Column and row patterns are kept apart, because an image whose rows are all equal, or each of
    one colour, compresses to some kilobytes and a mixture of both to hundreds. Blank frames go
    where there is room; a frame left over costs least when it is blank.

    Raises
    ------
    SequenceError
        When the distinct patterns need more than 18 images.
    """
    distinct = list(dict.fromkeys(_canonical(p) for p in sequence.patterns))
    of = {g: [p for p in distinct if _group(p) == g] for g in ("column", "row", "blank")}
    images = _fill(of["column"]) + _fill(of["row"])
    for blank in of["blank"]:
        free = next((i for i in images if len(i) < PLANES_PER_IMAGE), None)
        if free is None:
            images.append(free := [])
        free.append(blank)
    if len(images) > MAX_IMAGES:
        raise SequenceError(
            f"sequence {sequence.name!r} has {len(distinct)} distinct patterns in {len(images)} "
            f"images of {PLANES_PER_IMAGE}; expected at most {MAX_IMAGES} images on the fly"
        )
    places = {p: (i, bit) for i, image in enumerate(images) for bit, p in enumerate(image)}
    return PlaneMap(
        tuple(places[_canonical(p)] for p in sequence.patterns),
        tuple(tuple(image) for image in images),
    )


def encode_patterns(patterns: Sequence[Pattern], model: DmdModel) -> tuple[bytes, ...]:
    """Return an image's bytes, one stream for each controller (primary first).

    With two controllers each gets its half of the columns, with a header of its own.

    Parameters
    ----------
    patterns : sequence of Pattern
        Up to 24; the first is plane 0.
    model : DmdModel
        Size, and whether two controllers share the columns.
    """
    words = pack_planes([p.frame(model.size) for p in patterns])
    halves = np.hsplit(words, 2) if model.dual else [words]
    return tuple(encode_image(np.ascontiguousarray(half)) for half in halves)


def warm_up() -> None:
    """Compile the encoders (once per installation) or load them, before they are needed."""
    encode_image(pack_planes([np.zeros((8, 8), np.uint8)]))
