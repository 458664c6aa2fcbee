"""Pixels as GenICam cameras send them, and as this project keeps them.

Ten and twelve bits become 16-bit integers with the camera's own values (0 ... 1023, 0 ... 4095);
nothing is scaled. Packing: EMVA PFNC 2.4, section 6 ("p": least significant bit first), and GigE
Vision 2.0, section 25 ("Packed": the high bits in bytes of their own).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_camera.camera.camera import PixelFormat
from sl_common.kernel_cache import kernel

Unpacker = Any


@dataclass(frozen=True)
class WireFormat:
    """One pixel format on the wire.

    Parameters
    ----------
    name : str
        GenICam's name, the value of ``PixelFormat``.
    code : int
        PFNC code, as the stream says it.
    bits : int
        Significant bits of a pixel.
    wire_bits : int
        Bits on the wire.
    packing : {"none", "lsb", "gev"}
        How bits share bytes.
    """

    name: str
    code: int
    bits: int
    wire_bits: int
    packing: str = "none"

    def size(self, width: int, height: int) -> int:
        """Bytes of an image; packed pixels run on from row to row.

        Parameters
        ----------
        width, height : int
            Image size, pixels.
        """
        return (width * height * self.wire_bits + 7) // 8


WIRE_FORMATS = (
    WireFormat("Mono8", 0x01080001, 8, 8),
    WireFormat("Mono10", 0x01100003, 10, 16),
    WireFormat("Mono12", 0x01100005, 12, 16),
    WireFormat("Mono14", 0x01100025, 14, 16),
    WireFormat("Mono16", 0x01100007, 16, 16),
    WireFormat("Mono10p", 0x010A0046, 10, 10, "lsb"),
    WireFormat("Mono12p", 0x010C0047, 12, 12, "lsb"),
    WireFormat("Mono10Packed", 0x010C0004, 10, 12, "gev"),
    WireFormat("Mono12Packed", 0x010C0006, 12, 12, "gev"),
)
BY_CODE = {format_.code: format_ for format_ in WIRE_FORMATS}
BY_NAME = {format_.name: format_ for format_ in WIRE_FORMATS}

#: What a setting may become on the wire, the first that the camera has.
CHOICES: dict[PixelFormat, tuple[str, ...]] = {
    "mono8": ("Mono8",),
    "mono10": ("Mono10",),
    "mono10p": ("Mono10p", "Mono10Packed"),
    "mono12": ("Mono12",),
    "mono12p": ("Mono12p", "Mono12Packed"),
    "mono16": ("Mono16",),
}


def unpack(
    data: bytes | bytearray | memoryview, format_: WireFormat, width: int, height: int
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Pixels of one image.

    Parameters
    ----------
    data : bytes
        At least `WireFormat.size` bytes; without packing the result is a view into them.
    format_ : WireFormat
        How they are to be read.
    width, height : int
        Pixels.

    Returns
    -------
    ndarray, (height, width), uint8 or uint16

    Examples
    --------
    >>> unpack(bytes([0xBC, 0x3A, 0x12]), BY_NAME["Mono12p"], 2, 1).tolist()  # 0xABC, 0x123
    [[2748, 291]]
    """
    if format_.wire_bits in (8, 16):
        dtype = np.uint8 if format_.wire_bits == 8 else np.dtype("<u2")
        plain: NDArray[Any] = np.frombuffer(data, dtype, width * height)
        return plain.reshape(height, width)
    packed = np.frombuffer(data, np.uint8, format_.size(width, height))
    pixels = np.empty(width * height, np.uint16)
    if format_.packing == "gev":
        _unpack_gev(packed, pixels, format_.bits - 8)
    else:
        _unpack_lsb(packed, pixels, format_.bits)
    return pixels.reshape(height, width)


@kernel(error_model="python")
def _unpack_lsb(packed: NDArray[np.uint8], pixels: NDArray[np.uint16], bits: int) -> None:
    """Pixel i in bits i*n ... i*n + n-1 of a little-endian stream; n is above 8, at most 16."""
    mask = (1 << bits) - 1
    for i in range(pixels.size):
        bit = i * bits
        byte = bit >> 3
        word = np.uint32(packed[byte]) | np.uint32(packed[byte + 1]) << np.uint32(8)
        if (bit & 7) + bits > 16:
            word |= np.uint32(packed[byte + 2]) << np.uint32(16)
        pixels[i] = (word >> np.uint32(bit & 7)) & np.uint32(mask)


@kernel(error_model="python")
def _unpack_gev(packed: NDArray[np.uint8], pixels: NDArray[np.uint16], low_bits: int) -> None:
    """Two pixels in three bytes: high byte, both low parts (the first one's below), high byte."""
    mask = (1 << low_bits) - 1
    for i in range(pixels.size):
        byte = 3 * (i >> 1)
        odd = i & 1
        high = np.uint32(packed[byte + 2 * odd])
        low = (np.uint32(packed[byte + 1]) >> np.uint32(4 * odd)) & np.uint32(mask)
        pixels[i] = (high << np.uint32(low_bits)) | low
