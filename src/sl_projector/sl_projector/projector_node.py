"""The projector's node: projects named sequences and announces every exposed pattern."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sl_interfaces.msg import RigCalibration

from sl_common import topics
from sl_common.base_node import Health, RigNode, device_health, run
from sl_common.clock import next_scan_id
from sl_common.device_link import DeviceLink
from sl_common.errors import (
    ConfigError,
    DeviceLost,
    DeviceRefused,
    DeviceTimeout,
    SequenceError,
    SlError,
)
from sl_projector.dlpc.dlpc350_driver import Dlpc350, Dlpc350Settings
from sl_projector.dlpc.dlpc900_driver import Dlpc900, Dlpc900Settings
from sl_projector.dlpc.dmd import (
    DEFAULT_MODEL,
    MODELS,
    ProjectorDriver,
    ProjectorStatus,
    RunInfo,
    Timing,
    TriggerOut,
    dmd_model,
)
from sl_projector.sequence.messages import trigger_to_msg
from sl_projector.sequence.pattern_sequence import NAMED, PatternSequence, named
from sl_projector.sequence.sequence_file import load_sequence


def find_in_directory(name: str, directory: str, dmd_size: tuple[int, int]) -> PatternSequence:
    """Return a built-in sequence, or one from a file that lies directly in a directory.

    Anyone in the ROS domain can call the service, so a name never leads out of the directory.

    Parameters
    ----------
    name : str
        Of the sequence, or of its file with or without ``.yaml``.
    directory : str
        Where files lie; empty: built-in sequences only.
    dmd_size : tuple of int
        (columns, rows) of a built-in sequence, DMD pixels.

    Raises
    ------
    SequenceError
        When there is none of that name, or its file cannot be used.
    """
    if name in NAMED:
        return named(name, dmd_size)
    if not directory:
        raise SequenceError(
            f"no sequence is called {name!r}; expected one of {sorted(NAMED)} "
            "(the projector's parameter sequence_dir is empty, so files cannot be named)"
        )
    files = {file.name: file for file in Path(directory).glob("*.y*ml") if file.is_file()}
    found = files.get(name) or files.get(f"{name}.yaml")
    if found is None:
        raise SequenceError(
            f"no sequence is called {name!r}; expected one of {sorted(NAMED)} or of the files "
            f"{sorted(files)} in sequence_dir"
        )
    return load_sequence(found)


class ProjectorNode(RigNode):
    """Drives one DMD.

    Parameters
    ----------
    make_driver : callable, optional
        Makes the (closed) driver of a DMD; by default TI's DLPC900 over USB, as the parameters say.
    options
        Passed to `rclpy.node.Node`.
    """

    def __init__(
        self, make_driver: Callable[[], ProjectorDriver] | None = None, **options: Any
    ) -> None:
        super().__init__("projector", **options)
        self._declare_parameters()
        self._make_driver = make_driver or self._make_configured
        self._busy = threading.Lock()
        self._stop = threading.Event()
        self._halted = threading.Event()
        self._showing = ""
        self._last_id = 0
        self._last_run = time.monotonic()
        self._status: ProjectorStatus | None = None
        self._triggers = self.advertise(topics.TRIGGER)
        self._camera_info = self.advertise(topics.PROJECTOR_INFO)
        self.listen(topics.CALIBRATION, self._on_calibration)
        self.serve_work(topics.PROJECT, self._project)
        self.serve_work(topics.STOP_PROJECTOR, self._halt)
        self._link = DeviceLink("projector", self._connect, self.say)
        self._link.start()
        self._poller = threading.Thread(target=self._poll, name="projector status", daemon=True)
        self._poller.start()

    def _declare_parameters(self) -> None:
        self._model = dmd_model(
            self.declare("dmd_model", DEFAULT_MODEL, f"DMD: one of {sorted(MODELS)}")
        )
        self._device = self.declare(
            "device", "usb", "usb, usb:SERIAL, or socket:PATH for one that another process serves"
        )
        self._leds = self.declare("leds", 7, "LEDs: 1 red + 2 green + 4 blue", 0, 7)
        self._outputs = self._declare_outputs()
        self.declare("sequence", "precise", "sequence of a request that names none", live=True)
        self._flash = self.declare(
            "flash_sequences", ["precise"], "DLPC350: the sequences in its flash, in order"
        )
        self._directory = self.declare(
            "sequence_dir", "", "directory whose sequence files may be asked for by name"
        )
        self.declare("exposure_s", 0.034, "exposure of each pattern, s", 1e-5, 16.0, live=True)
        self.declare("dark_s", 0.0, "dark time after each exposure, s", 0.0, 16.0, live=True)
        self._idle_after_s = self.declare(
            "idle_after_s", 300.0, "without a scan for so long the mirrors are spared, s", 1.0, 1e6
        )

    def _declare_outputs(self) -> tuple[TriggerOut, TriggerOut]:
        rising = self.declare(
            "trigger_out_rising_delay_s", [0.0, 0.0],
            "TRIG_OUT_1, TRIG_OUT_2: delay of the rising edge, -20e-6 to 20e-3 s",
        )  # fmt: skip
        falling = self.declare(
            "trigger_out_falling_delay_s", [0.0, 0.0], "the same of the falling edge, s"
        )
        inverted = self.declare("trigger_out_inverted", [False, False], "polarity of both outputs")
        if {len(rising), len(falling), len(inverted)} != {2}:
            raise ConfigError("trigger_out_...: expected a value for each of the two outputs")
        one, two = (TriggerOut(*of) for of in zip(rising, falling, inverted, strict=True))
        return one, two

    def health(self) -> Health:
        """Device, what it shows, what it complains about."""
        level, message = device_health(self._link.connected, self._link.reason)
        status = self._status
        values: dict[str, object] = {"showing": self._showing or "nothing"}
        if status is not None and self._link.connected:
            values |= {"model": status.model, "firmware": status.firmware, "power": status.power}
            if status.problems:
                level, message = "error", "; ".join(status.problems)
        values["times lost"] = self._link.losses
        return Health(level, message, self._model.name, self._device, values)

    def close(self) -> None:
        """Stop the mirrors and give the device back."""
        self._stop.set()
        self._halted.set()
        self._link.close()
        self._poller.join(timeout=5.0)
        super().close()

    def _make_configured(self) -> ProjectorDriver:
        if self._model.controller == "DLPC350":
            flash = tuple(named(name, self._model.size) for name in self._flash)
            settings = Dlpc350Settings(self._leds, *self._outputs, flash=flash)
            return Dlpc350(self._device, settings)
        return Dlpc900(self._device, self._model, Dlpc900Settings(self._leds, *self._outputs))

    def _connect(self) -> ProjectorDriver:
        driver = self._make_driver()
        try:
            driver.open()
        except SlError:
            driver.close()
            raise
        return driver

    def _poll(self) -> None:
        """Ask the device once a second how it is; a device that is gone is noticed here."""
        while not self._stop.wait(1.0):
            if (driver := self._link.current) is None:
                continue
            try:
                self._status = driver.status()
                self._spare_mirrors(driver)
            except SlError as error:
                self._check_lost(driver, error)
            except Exception as error:  # nobody else watches the device
                self._link.lost(driver, error)

    def _spare_mirrors(self, driver: ProjectorDriver) -> None:
        if time.monotonic() - self._last_run < self._idle_after_s:
            return
        if self._busy.acquire(blocking=False):
            try:
                driver.idle()
                self._last_run = time.monotonic()
            finally:
                self._busy.release()

    def _check_lost(self, driver: ProjectorDriver, error: SlError) -> None:
        """Open the device anew when it is gone or silent; other errors concern the request only."""
        self.note(str(error))
        if isinstance(error, (DeviceLost, DeviceTimeout)):
            self._link.lost(driver, error)

    def _on_calibration(self, message: RigCalibration) -> None:
        """Publish the projector of the calibration in force, as an inverse camera."""
        self._camera_info.publish(message.projector)

    def _project(self, request: Any, response: Any) -> None:
        if not self._busy.acquire(blocking=False):
            raise DeviceRefused(f"the projector is busy: it shows {self._showing}")
        try:
            self._show(request, response)
        finally:
            self._showing = ""
            self._busy.release()

    def _halt(self, _request: Any, response: Any) -> None:
        """End a projection; whoever asked for it gets an error."""
        self._halted.set()
        self._link.device().stop()
        response.success, response.message = True, "stopped"

    def _show(self, request: Any, response: Any) -> None:
        """Load, start, announce each pattern as it is exposed, wait for the end."""
        driver = self._link.device()
        sequence = self._sequence(request.sequence)
        timing = self._timing(request.exposure_s)
        response.scan_id = self._take_id(request.scan_id)
        self._showing = f"{sequence.name} for scan {response.scan_id}"
        self._halted.clear()
        try:
            driver.load(sequence, timing)
            info = driver.run(timing)
            self._last_run = time.monotonic()
            response.count = self._announce(sequence, response.scan_id, info)
            driver.wait()
        except SlError as error:
            self._check_lost(driver, error)
            raise
        response.success = True
        response.message = f"{response.count} patterns of {sequence.name} shown"

    def _sequence(self, name: str) -> PatternSequence:
        wanted = name or str(self.get_parameter("sequence").value)
        sequence = find_in_directory(wanted, self._directory, self._model.size)
        if sequence.dmd_size != self._model.size:
            raise SequenceError(
                f"sequence {wanted!r} is made for a DMD of {sequence.dmd_size}; expected "
                f"{self._model.size}, the {self._model.name}'s"
            )
        return sequence

    def _timing(self, exposure_s: float) -> Timing:
        if not 0.0 <= exposure_s <= 16.0:
            raise ConfigError(f"exposure_s={exposure_s}; expected 0 (the default) to 16 s")
        exposure = exposure_s or float(self.get_parameter("exposure_s").value)
        return Timing(exposure, float(self.get_parameter("dark_s").value))

    def _take_id(self, wanted: int) -> int:
        self._last_id = wanted or next_scan_id(self._last_id)
        return self._last_id

    def _announce(self, sequence: PatternSequence, scan_id: int, info: RunInfo) -> int:
        """Publish each trigger when its exposure begins; return how many were."""
        for index in range(len(sequence)):
            start_ns = info.start_ns + round(index * info.timing.period_s * 1e9)
            if self._halted.wait(max(0.0, (start_ns - time.time_ns()) * 1e-9)):
                raise DeviceRefused("the projection was stopped")
            self._triggers.publish(
                trigger_to_msg(sequence, index, scan_id, start_ns, info.timing.exposure_s)
            )
        return len(sequence)


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run(ProjectorNode, args)


if __name__ == "__main__":
    main()
