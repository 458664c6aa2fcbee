"""The bench's camera as a GigE Vision device: any GigE Vision host finds, sets and reads it.

GigE Vision control protocol (GVCP 1.2) on UDP port 3956 of one address, frames by
`sl_bench.camera.gige_stream`. It stands in for `CameraServer` and executes the same commands.
"""

from __future__ import annotations

import contextlib
import ipaddress
import math
import selectors
import socket
import struct
import threading
import time
from typing import Any

from numpy.typing import NDArray

from sl_bench.camera.endpoint import Endpoint, Execute
from sl_bench.camera.gige_features import EXPOSURE_US, SOURCES, Reg, camera_xml
from sl_bench.camera.gige_stream import CHUNK_SIZE, StreamFrame, StreamSender, wire_bytes
from sl_camera.camera.pixel_formats import BY_CODE, WIRE_FORMATS
from sl_camera.drivers import socket_protocol as wire
from sl_common.errors import SlError

PORT = 3956
SERIAL = "BENCH"
KEY, ACK_WANTED = 0x42, 0x01
DISCOVERY, RESEND, READ_REG, WRITE_REG, READ_MEM, WRITE_MEM = 0x02, 0x40, 0x80, 0x82, 0x84, 0x86
NOT_IMPLEMENTED, INVALID_PARAMETER, INVALID_ADDRESS, ACCESS_DENIED = 0x8001, 0x8002, 0x8003, 0x8006
DISCOVERY_SIZE = 0xF8
FIRE_TEST = 1 << 31
PACKET_SIZE = 8192
HEARTBEAT_MS = 3000
_POLL_S = 0.05

Host = tuple[str, int]


class _Refused(Exception):
    """A GVCP status other than success."""


class GigeCamera(Endpoint):
    """A GigE Vision camera in front of a `CameraEmulator`.

    After a disconnection everything is as after power-up.

    Parameters
    ----------
    execute : callable
        See `Endpoint`.
    image_size : tuple of int
        (width, height) of the sensor, pixels.
    bits : int
        Significant bits of its pixels.
    address : str
        Network address; on one address of a machine there is one camera.
    """

    def __init__(
        self,
        execute: Execute,
        image_size: tuple[int, int],
        bits: int = 8,
        address: str = "127.0.0.1",
    ) -> None:
        super().__init__(execute, "gige control")
        self._size = image_size
        self._formats = {f.name: f.code for f in WIRE_FORMATS if f.bits == bits}
        self._formats = {n: c for n, c in self._formats.items() if not n.endswith("Packed")}
        self._address = address
        self._xml = camera_xml(self._formats)
        # A camera counts from when it was switched on, not from 1970.
        self._epoch_ns = time.time_ns() - 3_600_000_000_000
        self._controller: Host | None = None
        self._heard = 0.0
        self._acquiring = False
        self._lock = threading.Lock()
        self._drop_host()

    def _open(self) -> None:
        self._sockets = [self._bind(self._address)]
        with contextlib.suppress(OSError):  # discovery by broadcast; the address alone serves too
            self._sockets.append(self._bind("255.255.255.255"))
        self.stream = StreamSender(self._address)

    def _shut(self) -> None:
        for opened in self._sockets:
            opened.close()
        with self._lock:
            self.stream.close()

    def send(self, header: wire.Header, pixels: NDArray[Any]) -> None:
        """See `Endpoint`."""
        port = self._word(Reg.STREAM_PORT) & 0xFFFF
        if not (self._acquiring and port) or self._gone:
            return
        format_ = BY_CODE[self._word(Reg.PIXEL_FORMAT)]
        packed = format_.bits if format_.packing == "lsb" else 0
        frame = StreamFrame(
            header.frame_id,
            wire_bytes(pixels, packed),
            (pixels.shape[1], pixels.shape[0]),
            (self._word(Reg.OFFSET_X), self._word(Reg.OFFSET_Y)),
            format_.code,
            header.stamp_ns - self._epoch_ns,
            header.exposure_s,
            bool(self._word(Reg.CHUNK_MODE)),
            header.payload == header.full_payload,
        )
        with self._lock:
            if not self._stop.is_set():
                self.stream.send(frame, self._word(Reg.PACKET_SIZE) & 0xFFFF, self._host(port))

    # -- registers --------------------------------------------------------------------------

    def _drop_host(self) -> None:
        """Registers as after power-up, and nobody in control."""
        width, height = self._size
        self._memory = bytearray(Reg.XML) + self._xml
        texts = {
            Reg.MANUFACTURER: "slrig",
            Reg.MODEL: "Bench",
            Reg.DEVICE_VERSION: "1",
            Reg.MANUFACTURER_INFO: "simulated",
            Reg.SERIAL: SERIAL,
            Reg.XML_URL: f"Local:bench.xml;{Reg.XML:x};{len(self._xml):x}",
        }
        for address, text in texts.items():
            self._memory[address : address + len(text)] = text.encode()
        words = {
            Reg.VERSION: 0x00010002,
            Reg.DEVICE_MODE: 0x80000001,
            Reg.N_INTERFACES: 1,
            Reg.N_STREAMS: 1,
            Reg.CAPABILITY: 0x4000_0006,
            Reg.HEARTBEAT_MS: HEARTBEAT_MS,
            Reg.IP_ADDRESS: int(ipaddress.IPv4Address(self._address)),
            Reg.SUBNET_MASK: 0xFF000000,
            Reg.PACKET_SIZE: PACKET_SIZE,
            Reg.WIDTH: width,
            Reg.HEIGHT: height,
            Reg.SENSOR_WIDTH: width,
            Reg.SENSOR_HEIGHT: height,
            Reg.PIXEL_FORMAT: next(iter(self._formats.values())),
        }
        for address, value in words.items():
            self._put(address, value)
        struct.pack_into(">d", self._memory, Reg.EXPOSURE, 10_000.0)
        struct.pack_into(">Q", self._memory, Reg.TICK_FREQUENCY, 10**9)
        self._put(Reg.PAYLOAD, self._payload())
        self._controller, self._heard, self._acquiring = None, 0.0, False

    def _word(self, address: int) -> int:
        return int.from_bytes(self._memory[address : address + 4], "big")

    def _put(self, address: int, value: int) -> None:
        self._memory[address : address + 4] = (value & 0xFFFFFFFF).to_bytes(4, "big")

    def _double(self, address: int) -> float:
        return float(struct.unpack_from(">d", self._memory, address)[0])

    def _payload(self) -> int:
        format_ = BY_CODE[self._word(Reg.PIXEL_FORMAT)]
        size = format_.size(self._word(Reg.WIDTH), self._word(Reg.HEIGHT))
        return size + (CHUNK_SIZE if self._word(Reg.CHUNK_MODE) else 0)

    def _written(self, address: int, value: int) -> None:
        """Do what a write means beyond being remembered."""
        if address == Reg.ACQUISITION_START:
            self._begin()
        elif address == Reg.ACQUISITION_STOP:
            self._acquiring = False
            self._do({"op": "disarm"})
        elif address == Reg.TRIGGER_SOFTWARE and self._acquiring:
            self._do({"op": "trigger"})
        elif address == Reg.TIMESTAMP_CONTROL and value & 2:
            ticks = time.time_ns() - self._epoch_ns
            struct.pack_into(">Q", self._memory, Reg.TIMESTAMP, ticks)
        elif address == Reg.PACKET_SIZE and value & FIRE_TEST:
            self._fire_test(value & 0xFFFF)
        elif address == Reg.PIXEL_FORMAT and value not in self._formats.values():
            self._put(Reg.PIXEL_FORMAT, next(iter(self._formats.values())))
            raise _Refused(INVALID_PARAMETER)
        self._put(Reg.PAYLOAD, self._payload())

    def _begin(self) -> None:
        """Hand the settings to the camera and arm it."""
        source = "hardware" if self._word(Reg.TRIGGER_SOURCE) != SOURCES["Software"] else "software"
        region = (Reg.OFFSET_X, Reg.OFFSET_Y, Reg.WIDTH, Reg.HEIGHT)
        exposure_us = min(max(self._double(Reg.EXPOSURE), EXPOSURE_US[0]), EXPOSURE_US[1])
        settings = {
            "exposure_s": exposure_us * 1e-6,
            "gain": math.pow(10.0, self._double(Reg.GAIN) / 20.0),
            "trigger": source if self._word(Reg.TRIGGER_MODE) else "free",
            "region": [self._word(address) for address in region],
            "pixel_format": "mono8" if "Mono8" in self._formats else "mono16",
        }
        self._do({"op": "configure", **settings})
        self._acquiring = True
        self._do({"op": "arm"})

    def _do(self, command: dict[str, Any]) -> None:
        try:
            self._execute(command)
        except SlError as error:
            raise _Refused(INVALID_PARAMETER) from error

    def _fire_test(self, size: int) -> None:
        """Send one packet of a size, so that the host sees whether it arrives."""
        port = self._word(Reg.STREAM_PORT) & 0xFFFF
        if port and size > 28:
            with self._lock, contextlib.suppress(OSError):
                self._sockets[0].sendto(bytes(size - 28), self._host(port))

    def _host(self, port: int) -> Host:
        return str(ipaddress.IPv4Address(self._word(Reg.STREAM_ADDRESS))), port

    # -- control protocol -------------------------------------------------------------------

    def _bind(self, address: str) -> socket.socket:
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        if address != self._address:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            opened.bind((address, PORT))
        except OSError:
            opened.close()
            raise
        return opened

    def _loop(self) -> None:
        with selectors.DefaultSelector() as selector:
            for opened in self._sockets:
                selector.register(opened, selectors.EVENT_READ)
            while not self._stop.is_set():
                for key, _ in selector.select(_POLL_S):
                    self._receive(key.fileobj)  # type: ignore[arg-type]
                self._check_heartbeat()

    def _receive(self, opened: socket.socket) -> None:
        data, host = opened.recvfrom(2048)
        if self._gone or len(data) < 8 or data[0] != KEY:
            return
        flags, command, size, request = struct.unpack_from(">BHHH", data, 1)
        status, answer = 0, b""
        try:
            answer = self._answer(command, data[8 : 8 + size], host)
        except _Refused as refusal:
            status = int(refusal.args[0])
        except (struct.error, IndexError):
            status = INVALID_PARAMETER
        if flags & ACK_WANTED or command == DISCOVERY:
            head = struct.pack(">HHHH", status, command + 1, len(answer), request)
            with contextlib.suppress(OSError):
                self._sockets[0].sendto(head + answer, host)

    def _answer(self, command: int, body: bytes, host: Host) -> bytes:
        if host == self._controller:
            self._heard = time.monotonic()
        if command == DISCOVERY:
            return bytes(self._memory[:DISCOVERY_SIZE])
        if command == READ_REG:
            addresses = struct.unpack(f">{len(body) // 4}I", body)
            return b"".join(self._read(a, 4) for a in addresses)
        if command == READ_MEM:
            address, size = struct.unpack(">II", body)
            return body[:4] + self._read(address, size & 0xFFFF)
        if command in (WRITE_REG, WRITE_MEM):
            return self._take_writes(command, body, host)
        if command == RESEND:
            channel_block, first, last = struct.unpack_from(">III", body)
            packets = range(first & 0xFFFFFF, (last & 0xFFFFFF) + 1)
            to = self._host(self._word(Reg.STREAM_PORT) & 0xFFFF)
            with self._lock:
                self.stream.send_again(channel_block & 0xFFFF, packets, to)
            return b""
        raise _Refused(NOT_IMPLEMENTED)

    def _take_writes(self, command: int, body: bytes, host: Host) -> bytes:
        if command == WRITE_MEM:
            (address,) = struct.unpack_from(">I", body)
            self._write(address, body[4:], host)
            return struct.pack(">I", len(body) - 4)
        pairs = list(struct.iter_unpack(">II", body))
        for address, value in pairs:
            self._write(address, struct.pack(">I", value), host)
        return struct.pack(">I", len(pairs))

    def _read(self, address: int, size: int) -> bytes:
        if address + size > len(self._memory) and address < Reg.XML:
            raise _Refused(INVALID_ADDRESS)
        # Hosts read the description in whole words, beyond its end.
        return bytes(self._memory[address : address + size]).ljust(size, b"\0")

    def _write(self, address: int, data: bytes, host: Host) -> None:
        if address % 4 or address + len(data) > Reg.XML:
            raise _Refused(INVALID_ADDRESS)
        if self._controller not in (None, host):
            raise _Refused(ACCESS_DENIED)
        value = int.from_bytes(data[:4], "big")
        if address == Reg.PRIVILEGE:
            self._controller = host if value else None
            self._heard = time.monotonic()
        elif self._controller is None:
            raise _Refused(ACCESS_DENIED)
        self._memory[address : address + len(data)] = data
        self._written(address, value)

    def _check_heartbeat(self) -> None:
        """Drop a host that fell silent."""
        silent_s = time.monotonic() - self._heard
        if self._controller is not None and silent_s * 1e3 > self._word(Reg.HEARTBEAT_MS):
            self._controller, self._acquiring = None, False
            self._put(Reg.PRIVILEGE, 0)
            with contextlib.suppress(_Refused):
                self._do({"op": "disarm"})
