"""The process that stands in for the hardware: one world, three emulators, a control socket.

``python -m sl_bench.process.bench --config FILE --runtime-dir DIR`` says ``bench compiling`` when
it starts and ``bench ready`` when all endpoints accept: ``usb.sock`` (the DLPC900), ``camera.sock``
(or GigE Vision, see `BenchSettings.camera_gige`), ``stage`` (a serial port) and ``control.sock`` in
the runtime directory. It ends on SIGINT or SIGTERM and removes them.
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_bench.camera.camera_emulator import CameraEmulator, Exposure, Position
from sl_bench.camera.camera_faults import CameraFaults
from sl_bench.camera.endpoint import Endpoint, Execute
from sl_bench.camera.gige_camera import GigeCamera
from sl_bench.dlpc.dlpc900_emulator import Dlpc900Emulator
from sl_bench.dlpc.dlpc_faults import DlpcFaults
from sl_bench.dlpc.usb_server import EmulatedUsb, UsbSocketServer
from sl_bench.process.bench_control import ControlServer
from sl_bench.process.bench_settings import BenchSettings, read_settings
from sl_bench.stage.grbl_emulator import GrblEmulator
from sl_bench.world.mounting import Mounting
from sl_bench.world.surfaces import make_surface
from sl_bench.world.true_rig import rig_document, write_rig
from sl_bench.world.world import World
from sl_common.errors import ConfigError, SlError

#: Faults of the stage that the control socket may ask for: methods of `GrblEmulator`.
STAGE_FAULTS = frozenset(
    {"noise", "lose_replies", "delay_replies", "fall_silent", "alarm", "close_switch"}
    | {"open_switches", "remove_switches", "jam", "lose_steps", "power_cycle"}
)
#: Faults of the DMD that are fields.
DMD_FAULTS = frozenset(f.name for f in fields(DlpcFaults) if not f.name.startswith("_"))

#: The stage rests when it is found in the same place twice, this time apart.
REST_S = 0.02


class Bench:
    """World and emulators, connected; a context manager.

    Parameters
    ----------
    settings : BenchSettings
        What it is made of.
    runtime_dir : path
        Where the endpoints are; made when missing.
    """

    def __init__(self, settings: BenchSettings, runtime_dir: str | Path) -> None:
        self._dir = Path(runtime_dir)
        self._dir.mkdir(parents=True, exist_ok=True)
        self._mounting = Mounting(
            settings.stage_scale,
            settings.stage_squareness_rad,
            settings.plate_tilt_rad,
            settings.part_offset_m,
        )
        self._lamp = 1.0
        rig = settings.make_rig()
        surface = make_surface(settings.surface, **settings.surface_parameters)
        self.world = World(rig, surface, settings.make_optics(), settings.finish)
        self.dmd = Dlpc900Emulator(settings.make_model(rig))
        self.usb = EmulatedUsb(self.dmd)
        self.stage = GrblEmulator(
            {130 + axis: travel * 1e3 for axis, travel in enumerate(settings.stage_travel_m)},
            homed=settings.stage_homed,
            seed=settings.seed,
        )
        self.gige: GigeCamera | None = None
        self._gige_address = settings.camera_gige
        self.camera = CameraEmulator(
            self._serve_gige if settings.camera_gige else self._dir / "camera.sock",
            self._render,
            rig.camera.image_size,
            stage_m=self.stage.position_at,
            mirrors_now=self.dmd.mirrors_now,
            max_rate_hz=settings.camera_frame_rate_hz,
            readout_s=settings.camera_readout_s,
            pixel_format="mono8" if self.world.optics.bits == 8 else "mono16",
        )
        self.dmd.on_exposure = self.camera.on_exposure
        self._timers: list[threading.Timer] = []
        self._world_lock = threading.Lock()
        self._parts = 0
        self._ended = threading.Event()
        self._preparer = threading.Thread(target=self._prepare_loop, name="preparer", daemon=True)

    def start(self) -> None:
        """Open all endpoints, then render a first frame, so that no scan waits for the compiler."""
        self._usb_server = UsbSocketServer(str(self._dir / "usb.sock"), self.usb)
        self.stage.start()
        self.stage.link(self._dir / "stage")
        self.camera.start()
        self._control = ControlServer(self._dir / "control.sock", self.execute)
        self._control.start()
        self._render(Exposure(0, [(self.dmd.mirrors_now(), 0.01)], 0.01, self.stage.position_m()))
        self._preparer.start()

    def close(self) -> None:
        """Close and remove all endpoints."""
        self._ended.set()
        self._preparer.join()
        for timer in self._timers:
            timer.cancel()
        self._control.close()
        self.camera.close()
        self.stage.close()
        self._usb_server.close()

    def __enter__(self) -> Bench:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _serve_gige(self, execute: Execute) -> Endpoint:
        size, bits = self.world.rig.camera.image_size, self.world.optics.bits
        self.gige = GigeCamera(execute, size, bits, self._gige_address)
        return self.gige

    def _render(self, exposure: Exposure) -> NDArray[Any]:
        # The lamp scales time, not mirrors, so that the world's cache of noise-free frames holds.
        shown = [(mirrors, seconds * self._lamp) for mirrors, seconds in exposure.shown]
        with self._world_lock:
            self._move_part(exposure.stage_m)
            return self.world.expose(shown, exposure.exposure_s, exposure.number)

    def _prepare_loop(self) -> None:
        """Trace the rays as soon as the stage rests in a new place, or with a new part.

        The first frame of a scan right after that would else wait for it, half a second or so.
        """
        before = ready = (self._parts, self.stage.position_m())
        while not self._ended.wait(REST_S):
            now = (self._parts, self.stage.position_m())
            if now == before != ready:
                with self._world_lock:
                    self._move_part(now[1])
                    self.world.ambient_e_per_s()
                ready = now
            before = now

    def _move_part(self, stage_m: Position) -> None:
        self.world.move(*self._mounting.pose(stage_m))

    # -- control ----------------------------------------------------------------------------

    def execute(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Do what one request of the control socket asks; see `sl_bench.process.bench_control`."""
        actions: dict[str, Callable[[Any], dict[str, Any]]] = {
            "put": self._put,
            "lamp": self._set_lamp,
            "fault": self._fault,
            "truth": self._truth,
            "state": self._state,
        }
        if len(request) != 1 or next(iter(request)) not in actions:
            raise ConfigError(f"request {list(request)}; expected one of {list(actions)}")
        ((name, argument),) = request.items()
        return actions[name](argument)

    def _put(self, part: Mapping[str, Any]) -> dict[str, Any]:
        unknown = set(part) - {"surface", "parameters", "finish"}
        if unknown or "surface" not in part:
            raise ConfigError(f"put {dict(part)}; expected surface, and parameters, finish")
        surface = make_surface(part["surface"], **part.get("parameters", {}))
        with self._world_lock:
            self.world.put(surface, part.get("finish"))
            self._parts += 1
        return {}

    def _set_lamp(self, brightness: float) -> dict[str, Any]:
        if not (math.isfinite(brightness) and 0 <= brightness <= 100):
            raise ConfigError(f"lamp={brightness}; expected 0 to 100")
        self._lamp = float(brightness)
        return {}

    def _truth(self, what: Any) -> dict[str, Any]:
        if what == "rig":
            return {"rig": rig_document(self.world.rig)}
        if not isinstance(what, dict) or set(what) != {"points"}:
            raise ConfigError(f"truth {what!r}; expected 'rig' or {{'points': [[u, v], ...]}}")
        pixels = np.array(what["points"], dtype=np.float64).reshape(-1, 2)
        with self._world_lock:
            self._move_part(self.stage.position_m())
            points, lit = self.world.truth_points(pixels), self.world.truth_lit(pixels)
        return {
            "points_m": [p.tolist() if np.isfinite(p).all() else None for p in points],
            "lit": lit.tolist(),
        }

    def _state(self, _: object) -> dict[str, Any]:
        return {
            "stage_m": list(self.stage.position_m()),
            "lamp": self._lamp,
            "camera": self.camera.state(),
            "projector": {
                "running": self.dmd.running,
                "messages": self.dmd.messages,
                "errors": self.dmd.errors[-5:],
            },
        }

    # -- faults -----------------------------------------------------------------------------

    def _fault(self, request: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        devices = {
            "camera": self._fault_camera,
            "projector": self._fault_dmd,
            "stage": self._fault_stage,
        }
        unknown = set(request) - set(devices)
        if unknown:
            raise ConfigError(f"no device is called {sorted(unknown)}; expected {list(devices)}")
        if not request:
            self._clear_faults()
        for device, faults in request.items():
            devices[device](dict(faults))
        return {}

    def _clear_faults(self) -> None:
        self.camera.faults = CameraFaults()
        self._fault_packets(0.0, True)
        self._fault_dmd({name: getattr(DlpcFaults(), name) for name in DMD_FAULTS})
        self._fault_stage({"open_switches": None, "jam": False, "fall_silent": False})
        self._fault_stage({"lose_replies": 0, "delay_replies": [0, 0.0], "lose_steps": 0.0})
        self.stage.remove_switches()

    def _fault_camera(self, faults: dict[str, Any]) -> None:
        seconds = faults.pop("disconnect_s", None)
        self._fault_packets(faults.pop("lose_packets", 0.0), faults.pop("resend", True))
        if faults or seconds is None:
            self.camera.faults = CameraFaults(**faults)
        if seconds is not None:
            self.camera.disconnect(float(seconds))

    def _fault_packets(self, lose: float, resend: bool) -> None:
        """Lose this part of the packets of a GigE Vision camera."""
        if self.gige is not None:
            self.gige.stream.lose, self.gige.stream.resend = float(lose), bool(resend)
        elif lose:
            raise ConfigError("lose_packets; this camera sends none, expected camera_gige")

    def _fault_dmd(self, faults: dict[str, Any]) -> None:
        seconds, cycle = faults.pop("unplug_s", None), faults.pop("power_cycle", False)
        _check_faults("projector", faults, DMD_FAULTS)
        for name, value in faults.items():
            setattr(self.dmd.faults, name, set(value) if name.endswith("_edges") else value)
        if cycle:
            self.usb.power_cycle()
        if seconds is not None:
            self.usb.unplug()
            self._later(float(seconds), self.usb.plug_in)

    def _fault_stage(self, faults: dict[str, Any]) -> None:
        seconds = faults.pop("unplug_s", None)
        _check_faults("stage", faults, STAGE_FAULTS)
        for name, argument in faults.items():
            arguments = argument if isinstance(argument, list) else [argument]
            getattr(self.stage, name)(*([] if argument is None else arguments))
        if seconds is not None:
            self.stage.disconnect()
            self._later(float(seconds), self.stage.reconnect)

    def _later(self, seconds: float, action: Callable[[], None]) -> None:
        timer = threading.Timer(seconds, action)
        timer.daemon = True
        self._timers = [t for t in self._timers if t.is_alive()] + [timer]
        timer.start()


def _check_faults(device: str, faults: Mapping[str, Any], known: frozenset[str]) -> None:
    if set(faults) - known:
        raise ConfigError(f"{device} faults {sorted(faults)}; expected of {sorted(known)}")


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m sl_bench.process.bench", description=__doc__)
    parser.add_argument("--config", help="ROS parameter file with a section /sl/bench")
    parser.add_argument("--runtime-dir", help="directory of the endpoints")
    parser.add_argument(
        "--write-calibration", metavar="FILE", help="write the true rig as a calibration and end"
    )
    return parser.parse_args(argv)


def _serve(settings: BenchSettings, runtime_dir: str) -> None:
    """Run until a signal asks to end."""
    if not runtime_dir:
        raise ConfigError("no runtime directory; expected --runtime-dir or runtime_dir in the file")
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    os.nice(settings.niceness)
    _say("bench compiling")  # or finding it done
    with Bench(settings, runtime_dir):
        _say("bench ready")
        ended.wait()


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bench, or write its true rig; return the exit status."""
    arguments = _arguments(argv)
    try:
        settings = read_settings(arguments.config) if arguments.config else BenchSettings()
        if arguments.write_calibration:
            write_rig(arguments.write_calibration, settings.make_rig())
        else:
            _serve(settings, arguments.runtime_dir or settings.runtime_dir)
    except (SlError, OSError) as error:
        sys.stderr.write(f"bench: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
