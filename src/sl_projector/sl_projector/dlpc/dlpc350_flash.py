"""What a DLPC350's flash holds: 24 one-bit patterns per image, written once with TI's tool.

The controller cannot be sent images while it runs; they are part of its firmware. `flash_layout`
says where each pattern of some sequences lies, `write_flash_images` writes the images in that
order, to be put into the firmware with TI's LightCrafter 4500 GUI ("Firmware, flash images").
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import SequenceError
from sl_projector.dlpc.dlpc900_codec import pack_planes
from sl_projector.dlpc.dmd import PLANES_PER_IMAGE
from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence

#: The image table with variable exposures has so many entries.
MAX_FLASH_IMAGES = 256

Layout = dict[Pattern, tuple[int, int]]


def flash_layout(sequences: Sequence[PatternSequence]) -> Layout:
    """Return where each pattern lies: (flash image, plane), each pattern once, as first met.

    Raises
    ------
    SequenceError
        When the sequences are for different DMDs, or too many.
    """
    sizes = {sequence.dmd_size for sequence in sequences}
    if len(sizes) > 1:
        raise SequenceError(f"sequences for DMDs of {sorted(sizes)}; expected one size in a flash")
    patterns = dict.fromkeys(p for sequence in sequences for p in sequence.patterns)
    if len(patterns) > MAX_FLASH_IMAGES * PLANES_PER_IMAGE:
        raise SequenceError(
            f"{len(patterns)} patterns; expected at most {MAX_FLASH_IMAGES * PLANES_PER_IMAGE}"
        )
    return {pattern: divmod(i, PLANES_PER_IMAGE) for i, pattern in enumerate(patterns)}


def write_flash_images(sequences: Sequence[PatternSequence], directory: str | Path) -> list[Path]:
    """Write the flash images as 24-bit BMP, numbered in the order in which they are to be flashed.

    Parameters
    ----------
    sequences : sequence of PatternSequence
        The same, in the same order, as in `Dlpc350Settings.flash`.
    directory : path
        Made when missing.

    Returns
    -------
    list of Path
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    patterns = list(flash_layout(sequences))
    files = []
    for number, first in enumerate(range(0, len(patterns), PLANES_PER_IMAGE)):
        group = patterns[first : first + PLANES_PER_IMAGE]
        words = pack_planes([pattern.frame(sequences[0].dmd_size) for pattern in group])
        file = directory / f"flash_{number:03d}.bmp"
        part = file.with_suffix(".part")
        part.write_bytes(bmp(words))
        part.replace(file)
        files.append(file)
    return files


def bmp(words: NDArray[np.uint32]) -> bytes:
    """Pack words of 24 planes, shape (rows, columns), into a BMP file.

    Planes 0-7 are the bits of green, 8-15 of red, 16-23 of blue (TI DLPU010, pattern numbers of a
    24-bit image). BMP stores blue, green, red, and the bottom row first, rows padded to 4 bytes.
    """
    rows, columns = words.shape
    pixels = np.stack([words >> 16, words, words >> 8], axis=-1).astype(np.uint8)
    padded = np.zeros((rows, -(-columns * 3 // 4) * 4), np.uint8)
    padded[:, : columns * 3] = pixels[::-1].reshape(rows, columns * 3)
    head = struct.pack("<2sIHHI", b"BM", 54 + padded.size, 0, 0, 54)
    info = struct.pack("<IiiHHIIiiII", 40, columns, rows, 1, 24, 0, padded.size, 2835, 2835, 0, 0)
    return head + info + padded.tobytes()
