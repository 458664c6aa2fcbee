"""The bench's control socket: one JSON object per line, one line of JSON in reply.

====================================================  =============================================
request                                               effect
====================================================  =============================================
``{"put": {"surface": "coin", "parameters": {...},    exchange the part; "parameters" and "finish"
"finish": "matt"}}``                                  may be missing
``{"lamp": 0.5}``                                     projector light, 1 is normal, 0 is off
``{"fault": {"camera": {"drop": 0.01, "seed": 1}}}``  faults of the camera from here on
                                                      (`CameraFaults`), or ``{"disconnect_s": 1}``
``{"fault": {"projector": {"refuse": 1}}}``           fields of `DlpcFaults`, or ``{"unplug_s":
                                                      1}``, ``{"power_cycle": true}``
``{"fault": {"stage": {"alarm": 1}}}``                a fault method of `GrblEmulator`, its argument
                                                      (a list where there are several), or
                                                      ``{"unplug_s": 1}``
``{"fault": {}}``                                     all faults off
``{"truth": "rig"}``                                  the true rig as a calibration document
``{"truth": {"points": [[u, v], ...]}}``              true world points at camera pixels, and
                                                      whether they are lit
``{"state": true}``                                   where everything stands
====================================================  =============================================

Replies are ``{"ok": true, ...}`` or ``{"ok": false, "error": "..."}``.
"""

from __future__ import annotations

import contextlib
import json
import socket
import socketserver
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sl_common.errors import DeviceLost, DeviceRefused, SlError

_POLL_S = 0.1
MAX_LINE = 1 << 20


class _Connection(socketserver.StreamRequestHandler):
    """One client: line by line, until it is gone."""

    server: ControlServer

    def handle(self) -> None:
        with contextlib.suppress(OSError):
            while line := self.rfile.readline(MAX_LINE):
                self.wfile.write(json.dumps(self._answer(line)).encode() + b"\n")

    def _answer(self, line: bytes) -> dict[str, Any]:
        try:
            request = json.loads(line)
            if not isinstance(request, dict):
                return {"ok": False, "error": f"{line[:80]!r} is no JSON object"}
            return {"ok": True, **self.server.execute(request)}
        except (SlError, ValueError, TypeError) as error:
            return {"ok": False, "error": str(error)}


class ControlServer(socketserver.ThreadingUnixStreamServer):
    """Serves the control socket, a thread per connection.

    Parameters
    ----------
    path : path
        The socket; removed at `close`.
    execute : callable
        ``execute(request) -> reply``; an `SlError` becomes the reply.
    """

    daemon_threads = True

    def __init__(
        self, path: str | Path, execute: Callable[[dict[str, Any]], dict[str, Any]]
    ) -> None:
        self.execute = execute
        self._path = Path(path)
        self._path.unlink(missing_ok=True)
        super().__init__(str(path), _Connection)

    def start(self) -> None:
        """Accept connections from here on."""
        threading.Thread(
            target=self.serve_forever, args=(_POLL_S,), name="bench control", daemon=True
        ).start()

    def close(self) -> None:
        """Stop serving, after `start`, and remove the socket."""
        self.shutdown()
        self.server_close()
        self._path.unlink(missing_ok=True)


class BenchControl:
    """Talks to a running bench; a context manager.

    Parameters
    ----------
    path : path
        ``control.sock`` in the bench's runtime directory, or the directory.
    timeout_s : float
        Longest wait for a reply, seconds.

    Raises
    ------
    DeviceLost
        When there is no bench.
    """

    def __init__(self, path: str | Path, timeout_s: float = 30.0) -> None:
        path = Path(path)
        path = path / "control.sock" if path.is_dir() else path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(timeout_s)
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            raise DeviceLost(f"no bench at {path}: {error}; is it running?") from error
        self._stream = self._socket.makefile("rwb")

    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Send any request of the module's table, return the reply.

        Raises
        ------
        DeviceRefused
            When the bench refuses; with its reason.
        DeviceLost
            When the bench is gone.
        """
        try:
            self._stream.write(json.dumps(request).encode() + b"\n")
            self._stream.flush()
            line = self._stream.readline()
        except OSError as error:
            raise DeviceLost(f"the bench is gone: {error}") from error
        if not line:
            raise DeviceLost("the bench closed the connection")
        reply: dict[str, Any] = json.loads(line)
        if not reply["ok"]:
            raise DeviceRefused(f"the bench refused: {reply['error']}")
        return reply

    def put(self, surface: str, finish: str | None = None, **parameters: object) -> None:
        """Exchange the part.

        Parameters
        ----------
        surface, finish : str
            Names, see `make_surface` and `make_finish`; the finish stays unless given.
        **parameters
            Of the surface.
        """
        request = {"surface": surface, "parameters": parameters}
        self.ask({"put": request if finish is None else {**request, "finish": finish}})

    def lamp(self, brightness: float) -> None:
        """Set the projector's light, 1 is normal."""
        self.ask({"lamp": brightness})

    def fault(self, device: str, **faults: object) -> None:
        """Make a device fail.

        Parameters
        ----------
        device : {"camera", "projector", "stage"}
            The device.
        **faults
            See the module's table.
        """
        self.ask({"fault": {device: faults}})

    def clear_faults(self) -> None:
        """Let everything work again."""
        self.ask({"fault": {}})

    def state(self) -> dict[str, Any]:
        """Return where everything stands."""
        return self.ask({"state": True})

    def true_rig(self) -> dict[str, Any]:
        """Return the true rig as a calibration document."""
        return dict(self.ask({"truth": "rig"})["rig"])

    def true_points(self, pixels: Sequence[Sequence[float]]) -> dict[str, Any]:
        """Return ``points_m`` (None where there is nothing) and ``lit`` at camera pixels."""
        return self.ask({"truth": {"points": [list(map(float, p)) for p in pixels]}})

    def close(self) -> None:
        """Disconnect."""
        with contextlib.suppress(OSError):
            self._stream.close()
        self._socket.close()

    def __enter__(self) -> BenchControl:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
