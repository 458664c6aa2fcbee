"""Driver of a camera that is served over a local stream socket (the bench's, or a bridge's)."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_camera.camera.camera import CameraSettings, CameraStatistics, Frame, FrameStatus
from sl_camera.drivers import socket_protocol as wire
from sl_common.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout

#: A reply may wait behind a frame that the camera is just exposing.
REPLY_TIMEOUT_S = 5.0
#: Between two attempts to find a lost camera again.
RETRY_S = 0.2
SOCKET_BUFFER = 1 << 22
SOFTWARE_LATENCY_S = 0.005


class SocketCamera:
    """A `CameraDriver` on a Unix socket.

    Frames are received straight into a ring of reused buffers; nothing is copied.

    Parameters
    ----------
    path : path
        The socket.
    ring : int
        Buffers; a frame's pixels stay as they are until ``ring - 1`` further frames were read.
    """

    def __init__(self, path: str | Path, ring: int = 4) -> None:
        self._path = Path(path)
        self._ring = [bytearray() for _ in range(max(ring, 2))]
        self._turn = 0
        self._socket: socket.socket | None = None
        self._send_lock = threading.Lock()
        self._settings: CameraSettings | None = None
        self._armed = False
        self._image_size = (0, 0)
        self._counts = CameraStatistics()
        self._last_id: int | None = None
        self._header = bytearray(wire.HEADER_SIZE)
        self._begin_packet()

    @property
    def ring(self) -> int:
        """Number of buffers."""
        return len(self._ring)

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) that the camera agreed to; (0, 0) before `configure`."""
        return self._image_size

    @property
    def latency_s(self) -> float:
        """From a software trigger to the exposure: the way through the socket."""
        return SOFTWARE_LATENCY_S

    # -- what the owner calls ---------------------------------------------------------------

    def open(self) -> None:
        """Connect; see `CameraDriver.open`."""
        self._drop()
        self._counts, self._last_id = CameraStatistics(), None
        self._connect()

    def configure(self, settings: CameraSettings) -> None:
        """Set the camera up and disarm it; see `CameraDriver.configure`."""
        answer = self._ask("configure", **asdict(settings))
        self._settings, self._armed = settings, False
        width, height = answer["image_size"]
        self._image_size = (int(width), int(height))

    def arm(self) -> None:
        """Start to wait for triggers; see `CameraDriver.arm`."""
        self._ask("arm")
        self._armed = True
        self._last_id = None

    def disarm(self) -> None:
        """Stop taking frames; frames not yet read are gone."""
        self._ask("disarm")
        self._armed = False

    def software_trigger(self) -> None:
        """Expose one frame now; from any thread."""
        self._send(wire.command("trigger"))

    def read(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame; see `CameraDriver.read`. Reconnects a lost camera."""
        if self._socket is None:
            self._reconnect(timeout_s)
        header = self._packet(time.monotonic() + timeout_s)
        if header is None or header.kind != wire.FRAME:
            return None
        return self._frame(header)

    def statistics(self) -> CameraStatistics:
        """Counts since `open`."""
        return replace(self._counts)

    def close(self) -> None:
        """Disconnect; never raises."""
        self._drop()

    # -- connection -------------------------------------------------------------------------

    def _connect(self) -> None:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BUFFER)
            connection.settimeout(REPLY_TIMEOUT_S)
            connection.connect(str(self._path))
        except OSError as error:
            connection.close()
            raise DeviceLost(f"no camera at {self._path}: {error}; expected a socket") from error
        self._socket = connection
        self._begin_packet()

    def _reconnect(self, timeout_s: float) -> None:
        """Find the camera again and bring it to where it was."""
        try:
            self._connect()
            if self._settings is not None:
                armed = self._armed
                self.configure(self._settings)
                if armed:
                    self.arm()
        except DeviceError as error:
            self._drop()
            time.sleep(min(RETRY_S, max(timeout_s, 0.0)))
            raise DeviceLost(f"the camera is still gone: {error}") from error
        self._counts.reconnects += 1

    def _drop(self) -> None:
        connection, self._socket = self._socket, None
        if connection is not None:
            with contextlib.suppress(OSError):
                connection.close()

    def _lost(self, why: object) -> DeviceLost:
        self._drop()
        return DeviceLost(f"the camera at {self._path} is gone: {why}")

    # -- commands ---------------------------------------------------------------------------

    def _send(self, line: bytes) -> None:
        connection = self._socket
        if connection is None:
            raise DeviceLost(f"the camera at {self._path} is not connected")
        try:
            with self._send_lock:
                connection.sendall(line)
        except OSError as error:
            raise self._lost(error) from error

    def _ask(self, op: str, **fields: object) -> dict[str, Any]:
        """Send a command and wait for its reply; frames in between are old and dropped."""
        if self._socket is None:
            self._connect()
        self._send(wire.command(op, **fields))
        deadline = time.monotonic() + REPLY_TIMEOUT_S
        while (header := self._packet(deadline)) is not None:
            if header.kind == wire.REPLY:
                return self._answer(op, bytes(self._ring[self._turn][: header.payload]))
        self._drop()
        raise DeviceTimeout(f"the camera did not answer {op!r} within {REPLY_TIMEOUT_S:g} s")

    def _answer(self, op: str, text: bytes) -> dict[str, Any]:
        try:
            answer = json.loads(text)
            ok = bool(answer["ok"])
        except (ValueError, KeyError, TypeError) as error:
            raise self._lost(f"it answered {text[:80]!r}, expected JSON with 'ok'") from error
        if not ok:
            raise DeviceRefused(f"the camera refused {op!r}: {answer.get('error', 'no reason')}")
        return dict(answer)

    # -- packets ----------------------------------------------------------------------------

    def _begin_packet(self) -> None:
        """Expect a header next; a packet may arrive over several calls of `read`."""
        self._expected: wire.Header | None = None
        self._filled = 0

    def _packet(self, deadline: float) -> wire.Header | None:
        """Next whole packet, its payload in the ring's current buffer; None at the deadline."""
        if self._expected is None:
            if not self._fill(memoryview(self._header), deadline):
                return None
            try:
                self._expected = wire.parse_header(self._header)
            except DeviceError as error:
                raise self._lost(error) from error
            self._filled = 0
            self._next_buffer(max(self._expected.payload, self._expected.full_payload))
        buffer = memoryview(self._ring[self._turn])[: self._expected.payload]
        if not self._fill(buffer, deadline):
            return None
        header = self._expected
        self._begin_packet()
        return header

    def _next_buffer(self, size: int) -> None:
        self._turn = (self._turn + 1) % len(self._ring)
        if len(self._ring[self._turn]) < size:
            # A new one: frames that were handed out still look into the old.
            self._ring[self._turn] = bytearray(size)

    def _fill(self, view: memoryview, deadline: float) -> bool:
        """Receive until the view is full; False at the deadline, with what came so far kept."""
        connection = self._socket
        if connection is None:
            raise DeviceLost(f"the camera at {self._path} is not connected")
        while self._filled < len(view):
            # Zero would make the socket non-blocking, which reports emptiness by another error.
            connection.settimeout(max(deadline - time.monotonic(), 1e-4))
            try:
                got = connection.recv_into(view[self._filled :])
            except TimeoutError:
                return False
            except OSError as error:
                raise self._lost(error) from error
            if got == 0:
                raise self._lost("it closed the connection")
            self._filled += got
        return True

    def _frame(self, header: wire.Header) -> Frame:
        self._count(header)
        complete = header.payload == header.full_payload
        dtype = np.uint8 if header.pixel_bytes == 1 else np.dtype("<u2")
        flat: NDArray[Any] = np.frombuffer(
            self._ring[self._turn], dtype, header.width * header.height
        )
        if not complete:
            flat.view(np.uint8)[header.payload :] = 0
        return Frame(
            flat.reshape(header.height, header.width),
            header.frame_id,
            header.stamp_ns,
            header.exposure_s,
            FrameStatus.OK if complete else FrameStatus.INCOMPLETE,
        )

    def _count(self, header: wire.Header) -> None:
        """Count lost frame ids; the counter wraps at 32 bits."""
        self._counts.received += 1
        self._counts.incomplete += header.payload != header.full_payload
        if self._last_id is not None:
            ahead = (header.frame_id - self._last_id) % (1 << 32)
            if ahead >= 1 << 31 or ahead == 0:
                # A frame that was counted as lost came late after all; a duplicate is none.
                self._counts.lost = max(0, self._counts.lost - (ahead != 0))
                return
            self._counts.lost += ahead - 1
        self._last_id = header.frame_id
