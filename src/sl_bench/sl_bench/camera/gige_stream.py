"""Frames as GigE Vision stream packets (GVSP 2.0, 16-bit block ids), sent and sent again.

A packet is status (u16), block id (u16), format and packet id (u32), then its data, all big endian:
leader (packet 0), payload (1 ... n), trailer (n + 1).
"""

from __future__ import annotations

import random
import socket
import struct
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_bench.camera.gige_features import CHUNK_IDS, IMAGE_CHUNK

#: IP, UDP and GVSP headers count in GevSCPSPacketSize.
OVERHEAD = 36
LEADER, TRAILER, PAYLOAD = 1, 2, 3
IMAGE, EXTENDED_CHUNKS = 0x0001, 0x4000
UNAVAILABLE = 0x800C
#: Frames that can be sent again.
KEPT = 8
LAST_BLOCK = 65535


@dataclass(frozen=True)
class StreamFrame:
    """One frame to be sent."""

    #: Counted by the camera from 1; becomes the block id.
    number: int
    #: Pixels as they go over the wire.
    data: bytes
    #: (width, height) and (x, y) of the region, pixels.
    size: tuple[int, int]
    offset: tuple[int, int]
    #: PFNC code.
    pixel_format: int
    #: Start of the exposure, the camera's clock, nanoseconds.
    ticks: int
    exposure_s: float
    #: Whether number, time and exposure follow the pixels.
    chunks: bool
    #: False: the second half of the pixels never comes, not even when asked for again.
    complete: bool

    @property
    def block(self) -> int:
        """Block id: 1 ... 65535, never 0."""
        return (self.number - 1) % LAST_BLOCK + 1


def _chunk_bytes(frame: StreamFrame) -> bytes:
    """Chunks behind the pixels: data, id, length, the first one's data being the pixels."""
    values = {
        "FrameID": struct.pack(">Q", frame.number),
        "Timestamp": struct.pack(">Q", frame.ticks),
        "ExposureTime": struct.pack(">d", frame.exposure_s * 1e6),
    }
    text = struct.pack(">II", IMAGE_CHUNK, len(frame.data))
    for name, value in values.items():
        text += value + struct.pack(">II", CHUNK_IDS[name], len(value))
    return text


#: Bytes that the chunks add to a frame.
CHUNK_SIZE = 8 + len(CHUNK_IDS) * 16


class _Packets:
    """The packets of one frame; ``packet_size`` is in bytes with all headers."""

    def __init__(self, frame: StreamFrame, packet_size: int) -> None:
        self._frame = frame
        self._step = max(packet_size, OVERHEAD + 64) - OVERHEAD
        data = frame.data + _chunk_bytes(frame) if frame.chunks else frame.data
        self._data = memoryview(data)
        self.count = 2 + -(-len(data) // self._step)
        self.sendable = self.count if frame.complete else self.count // 2

    def packet(self, number: int) -> list[bytes | memoryview]:
        """Parts of one packet; of one that is not kept, the status that says so."""
        if number >= self.sendable and number < self.count and not self._frame.complete:
            return [struct.pack(">HHI", UNAVAILABLE, self._frame.block, PAYLOAD << 24 | number)]
        if number == 0:
            return [self._head(LEADER, 0), self._leader()]
        if number == self.count - 1:
            return [self._head(TRAILER, number), self._trailer()]
        start = (number - 1) * self._step
        return [self._head(PAYLOAD, number), self._data[start : start + self._step]]

    def _head(self, kind: int, number: int) -> bytes:
        return struct.pack(">HHI", 0, self._frame.block, kind << 24 | number)

    def _kind(self) -> int:
        return IMAGE | (EXTENDED_CHUNKS if self._frame.chunks else 0)

    def _leader(self) -> bytes:
        f = self._frame
        return struct.pack(
            ">HHQIIIIIHH", 0, self._kind(), f.ticks, f.pixel_format, *f.size, *f.offset, 0, 0
        )

    def _trailer(self) -> bytes:
        return struct.pack(">HHI", 0, self._kind(), self._frame.size[1])


class StreamSender:
    """Sends frames to the host's stream port.

    Parameters
    ----------
    address : str
        Own network address.

    Attributes
    ----------
    lose : float
        Fault: share of the packets that get lost, 0 to 1.
    resend : bool
        Whether packets that the host misses are sent again.
    """

    def __init__(self, address: str) -> None:
        self.lose = 0.0
        self.resend = True
        self._random = random.Random(0)
        self._kept: OrderedDict[int, _Packets] = OrderedDict()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 22)
        self._socket.bind((address, 0))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def send(self, frame: StreamFrame, packet_size: int, to: tuple[str, int]) -> None:
        """Send all packets of a frame, less those that get lost on request.

        Parameters
        ----------
        frame : StreamFrame
            The frame.
        packet_size : int
            Bytes of a packet with all its headers.
        to : tuple
            Address and port of the host.
        """
        packets = _Packets(frame, packet_size)
        self._kept[frame.block] = packets
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        for number in range(packets.sendable):
            if not (self.lose and self._random.random() < self.lose):
                self._socket.sendmsg(packets.packet(number), [], 0, to)

    def send_again(self, block: int, numbers: range, to: tuple[str, int]) -> None:
        """Send packets again that the host missed.

        Parameters
        ----------
        block : int
            Block id of their frame.
        numbers : range
            The packets.
        to : tuple
            Address and port of the host.
        """
        packets = self._kept.get(block)
        if packets is None or not self.resend:
            return
        for number in numbers[: max(packets.count - numbers.start, 0)]:
            self._socket.sendmsg(packets.packet(number), [], 0, to)


def wire_bytes(pixels: NDArray[Any], packed_bits: int) -> bytes:
    """Pixels as they go over the wire.

    Parameters
    ----------
    pixels : ndarray, (H, W) uint8 or uint16
        The image.
    packed_bits : {0, 10, 12}
        Bits per pixel of a packed format (PFNC "p"); 0 for whole bytes.
    """
    if packed_bits == 0:
        return np.ascontiguousarray(pixels).tobytes()
    flat = pixels.reshape(-1).astype("<u2")
    bits = np.unpackbits(flat.view(np.uint8).reshape(-1, 2), axis=1, bitorder="little")
    return np.packbits(bits[:, :packed_bits].reshape(-1), bitorder="little").tobytes()
