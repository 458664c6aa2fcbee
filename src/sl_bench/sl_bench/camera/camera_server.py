"""Server side of `sl_camera.drivers.socket_protocol`: one client at a time on a Unix socket."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_bench.camera.endpoint import Endpoint, Execute
from sl_camera.drivers import socket_protocol as wire
from sl_common.errors import SlError

#: A client that does not read for this long is disconnected.
SEND_TIMEOUT_S = 5.0
_POLL_S = 0.1


class CameraServer(Endpoint):
    """Answers commands and sends frames.

    Parameters
    ----------
    path : path
        The socket; made by `start`, removed by `close`.
    execute : callable
        See `Endpoint`.
    """

    def __init__(self, path: str | Path, execute: Execute) -> None:
        super().__init__(execute, "camera server")
        self._path = Path(path)
        self._client: socket.socket | None = None
        self._send_lock = threading.Lock()
        self._listener: socket.socket | None = None

    def send(self, header: wire.Header, pixels: NDArray[Any]) -> None:
        """See `Endpoint`."""
        data = memoryview(np.ascontiguousarray(pixels).reshape(-1).view(np.uint8).data)
        self._write(header.pack(), data[: header.payload])

    def _open(self) -> None:
        self._path.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(self._path))
        self._listener.listen(1)
        self._listener.settimeout(_POLL_S)

    def _shut(self) -> None:
        listener, self._listener = self._listener, None
        if listener is not None:
            listener.close()
            self._path.unlink(missing_ok=True)

    def _drop_host(self) -> None:
        client = self._client
        if client is not None:
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def _write(self, *parts: bytes | memoryview) -> None:
        with self._send_lock:
            client = self._client
            if client is None:
                return
            try:
                for part in parts:
                    client.sendall(part)
            except OSError:
                self._drop_host()

    def _loop(self) -> None:
        while not self._stop.is_set():
            if self._gone:
                self._shut()
                self._stop.wait(0.01)
                continue
            if self._listener is None:
                self._open()
            assert self._listener is not None
            with contextlib.suppress(TimeoutError):
                client, _ = self._listener.accept()
                self._serve(client)

    def _serve(self, client: socket.socket) -> None:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 22)
        client.settimeout(SEND_TIMEOUT_S)
        self._client = client
        try:
            self._answer_lines(client)
        except OSError:
            pass  # gone: the next client may come
        finally:
            with self._send_lock:
                self._client = None
                client.close()

    def _answer_lines(self, client: socket.socket) -> None:
        pending = b""
        while not self._stop.is_set() and len(pending) < wire.MAX_LINE:
            try:
                received = client.recv(4096)
            except TimeoutError:
                continue
            if not received:
                return
            *lines, pending = (pending + received).split(b"\n")
            for line in lines:
                answer = self._answer(line)
                if answer is not None:
                    self._write(wire.reply(answer))

    def _answer(self, line: bytes) -> dict[str, Any] | None:
        try:
            command = json.loads(line)
            if not isinstance(command, dict) or "op" not in command:
                return {"ok": False, "error": f"{line[:80]!r} is no command; expected an 'op'"}
            return self._execute(command)
        except (SlError, ValueError, TypeError) as error:
            return {"ok": False, "error": str(error)}
