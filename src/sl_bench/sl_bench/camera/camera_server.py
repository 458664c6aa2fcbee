"""Server side of `sl_camera.drivers.socket_protocol`: one client at a time on a Unix socket."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_camera.drivers import socket_protocol as wire
from sl_common.errors import SlError

#: A client that does not read for so long is thrown out.
SEND_TIMEOUT_S = 5.0
_POLL_S = 0.1


class CameraServer:
    """Answers commands and sends frames.

    Parameters
    ----------
    path : path
        The socket; made by `start`, removed by `close`.
    execute : callable
        ``execute(command) -> reply``, both dictionaries; None where the command has no reply.
        A `SlError` becomes a refusal.
    """

    def __init__(
        self, path: str | Path, execute: Callable[[dict[str, Any]], dict[str, Any] | None]
    ) -> None:
        self._path = Path(path)
        self._execute = execute
        self._client: socket.socket | None = None
        self._send_lock = threading.Lock()
        self._stop = threading.Event()
        self._gone_until = 0.0
        self._listener: socket.socket | None = None
        self._thread = threading.Thread(target=self._loop, name="camera server", daemon=True)

    def start(self) -> None:
        """Accept clients from here on."""
        self._listener = self._listen()
        self._thread.start()

    def close(self) -> None:
        """Throw the client out and remove the socket."""
        self._stop.set()
        self._hang_up()
        if self._thread.is_alive():
            self._thread.join()
        self._unlisten()

    def disconnect(self, seconds: float) -> None:
        """Be gone for a while, as if unplugged."""
        self._gone_until = time.monotonic() + seconds
        self._hang_up()

    def send(self, header: wire.Header, pixels: NDArray[Any]) -> None:
        """Send one frame, whole or (where the header says so) cut; nothing without a client."""
        data = memoryview(np.ascontiguousarray(pixels).reshape(-1).view(np.uint8).data)
        self._write(header.pack(), data[: header.payload])

    # -- inside -----------------------------------------------------------------------------

    def _listen(self) -> socket.socket:
        self._path.unlink(missing_ok=True)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        listener.bind(str(self._path))
        listener.listen(1)
        listener.settimeout(_POLL_S)
        return listener

    def _unlisten(self) -> None:
        listener, self._listener = self._listener, None
        if listener is not None:
            listener.close()
            self._path.unlink(missing_ok=True)

    def _hang_up(self) -> None:
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
                self._hang_up()

    def _loop(self) -> None:
        while not self._stop.is_set():
            if time.monotonic() < self._gone_until:
                self._unlisten()
                self._stop.wait(0.01)
                continue
            if self._listener is None:
                self._listener = self._listen()
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
