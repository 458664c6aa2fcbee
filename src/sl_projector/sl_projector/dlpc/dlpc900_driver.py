"""Driver of TI's DLPC900: patterns on the fly, 1 bit, over USB HID.

Implements `sl_projector.dlpc.dmd.ProjectorDriver`. Order of commands after TI DLPU018J, pattern on
the fly example: stop, mode, table entries, table configuration, images in reverse order, start.
"""

from __future__ import annotations

import contextlib
import threading
import time
from dataclasses import dataclass, field
from typing import Any

from sl_common.clock import Clock, SystemClock
from sl_common.errors import ConfigError, DeviceError, DeviceTimeout, SequenceError
from sl_projector.dlpc import dlpc900_protocol as protocol
from sl_projector.dlpc.dlpc900_codec import encode_patterns, map_planes, warm_up
from sl_projector.dlpc.dlpc900_port import REPLY_TIMEOUT_S, Dlpc900Port
from sl_projector.dlpc.dmd import (
    DEFAULT_MODEL,
    MAX_EXPOSURE_US,
    MODELS,
    DmdModel,
    Loaded,
    LoadInfo,
    ProjectorStatus,
    RunInfo,
    Timing,
    TriggerIn,
    TriggerOut,
    dmd_model,
    sequence_digest,
)
from sl_projector.hid.usb_transport import open_usb
from sl_projector.sequence.pattern_sequence import PatternSequence

WAKE_TIMEOUT_S = 10.0
# TI's older SDK allows 120 us where 105 us are possible untriggered.
EXTERNAL_TRIGGER_MARGIN_US = 15
_POLL_S = 0.05
_END_POLL_S = 0.002
_WAIT_MARGIN_S = 3.0
# How much sooner than computed a run may end: host and device clocks, and the start's latency.
_EARLY_S, _EARLY_RELATIVE = 0.005, 1e-3
_IDLE_OFF_VALUES = (0, 3)  # older and newer firmware
_REGISTERS = (protocol.HARDWARE_STATUS, protocol.SYSTEM_STATUS, protocol.MAIN_STATUS)
STATES = (*_REGISTERS, protocol.POWER)


@dataclass(frozen=True)
class Dlpc900Settings:
    """What is set once at `Dlpc900.open`.

    Parameters
    ----------
    leds : int
        LEDs lit during exposures: bit 0 red, bit 1 green, bit 2 blue.
    trigger_out_1, trigger_out_2 : TriggerOut
        Output 1 is active through the exposure, output 2 marks its start.
    trigger_in : TriggerIn or None
        None: patterns follow each other by time.
    reply_timeout_s : float
        How long to wait for the reply to a command.
    """

    leds: int = 7
    trigger_out_1: TriggerOut = field(default_factory=TriggerOut)
    trigger_out_2: TriggerOut = field(default_factory=TriggerOut)
    trigger_in: TriggerIn | None = None
    reply_timeout_s: float = REPLY_TIMEOUT_S

    def __post_init__(self) -> None:
        if not 0 <= self.leds <= 7:
            raise ConfigError(f"leds={self.leds}; expected 0 to 7 (1 red, 2 green, 4 blue)")


class Dlpc900:
    """A DLPC900 projector; see `ProjectorDriver` for what the methods promise.

    Parameters
    ----------
    device : str
        ``usb``, ``usb:SERIAL`` or ``socket:PATH`` (`sl_projector.hid.usb_transport.open_usb`).
    model : str or DmdModel
        The DMD; `open` checks that the device agrees.
    settings : Dlpc900Settings
        LEDs and triggers.
    backend : optional
        pyusb backend in place of libusb.
    clock : Clock
        What runs are timed by.
    """

    _product_id = protocol.PRODUCT_ID
    _port_class = Dlpc900Port
    _pattern_mode = protocol.MODE_ON_THE_FLY

    def __init__(
        self,
        device: str = "usb",
        model: str | DmdModel = DEFAULT_MODEL,
        settings: Dlpc900Settings | None = None,
        *,
        backend: Any = None,
        clock: Clock | None = None,
    ) -> None:
        self._device = device
        self._model = dmd_model(model) if isinstance(model, str) else model
        self._settings = self._checked(settings or Dlpc900Settings())
        self._backend = backend
        self._clock: Clock = clock or SystemClock()
        self._lock = threading.RLock()
        self._stopped = threading.Event()
        self._port: Dlpc900Port | None = None
        self._loaded: Loaded | None = None
        self._run: RunInfo | None = None
        self._idle = False

    def _checked(self, settings: Dlpc900Settings) -> Dlpc900Settings:
        least_us = self._model.block_load_us[-1]
        trigger = settings.trigger_in
        if trigger is not None and not least_us <= round(trigger.delay_s * 1e6) <= 0xFFFF:
            raise ConfigError(
                f"trigger input delay is {trigger.delay_s} s; expected {least_us} to 65535 us "
                f"with a {self._model.name}"
            )
        return settings

    @property
    def model(self) -> DmdModel:
        """See `ProjectorDriver`."""
        return self._model

    # -- opening and closing -------------------------------------------------------------------

    def open(self) -> None:
        """See `ProjectorDriver`."""
        warm_up()
        with self._lock:
            self._release()
            transport = open_usb(self._device, protocol.VENDOR_ID, self._product_id, self._backend)
            self._port = self._port_class(transport, self._settings.reply_timeout_s, self._clock)
            try:
                self._prepare(self._port)
            except DeviceError:
                self._release()
                raise

    def look(self) -> ProjectorStatus:
        """Connect, ask how the device is, and disconnect; nothing about it changes.

        Raises
        ------
        DeviceLost
            When it is not there or another program has it.
        DeviceError
            When it is of another model or does not answer.
        """
        with self._lock:
            self._release()
            transport = open_usb(self._device, protocol.VENDOR_ID, self._product_id, self._backend)
            self._port = self._port_class(transport, self._settings.reply_timeout_s, self._clock)
            try:
                self._port.drain()
                self._identify(self._port)
                return self.status()
            finally:
                self._release()

    def _release(self) -> None:
        self._stopped.set()
        self._loaded = self._run = None
        self._idle = False
        if self._port is not None:
            self._port.close()
            self._port = None

    def _prepare(self, port: Dlpc900Port) -> None:
        port.drain()
        self._wake(port)
        self._identify(port)
        port.write(protocol.START_STOP, bytes([protocol.STOP]))
        self._leave_idle(port)
        port.write(protocol.LED_ENABLE, bytes([protocol.LEDS_BY_SEQUENCER]))
        self._set_triggers(port)
        self._check_hardware(port, "opening")

    def _identify(self, port: Dlpc900Port) -> None:
        """Make sure of the DMD."""
        code = port.read(protocol.HARDWARE)[0]
        if code != self._model.hardware_code:
            known = {m.hardware_code: m.name for m in MODELS.values()}
            raise DeviceError(
                f"device has a {known.get(code, f'DMD of unknown code {code}')}; expected "
                f"{self._model.name} as configured"
            )

    def _wake(self, port: Dlpc900Port) -> None:
        if port.read(protocol.POWER)[0] == protocol.POWER_NORMAL:
            return
        port.write(protocol.POWER, bytes([protocol.POWER_NORMAL]))
        deadline_s = time.monotonic() + WAKE_TIMEOUT_S
        while port.read(protocol.MAIN_STATUS)[0] & protocol.MAIN_PARKED:
            if time.monotonic() > deadline_s:
                raise DeviceTimeout(f"DMD mirrors still parked {WAKE_TIMEOUT_S} s after wake-up")
            self._clock.wait_until(self._clock.now_ns() + int(_POLL_S * 1e9), threading.Event())

    def _leave_idle(self, port: Dlpc900Port) -> None:
        for value in _IDLE_OFF_VALUES:
            if port.read(protocol.IDLE)[0] != 1:
                break
            port.write(protocol.IDLE, bytes([value]))
        self._idle = False

    def _set_triggers(self, port: Dlpc900Port) -> None:
        outputs = (
            (protocol.TRIGGER_OUT_1, self._settings.trigger_out_1),
            (protocol.TRIGGER_OUT_2, self._settings.trigger_out_2),
        )
        for command, out in outputs:
            rising_us, falling_us = (
                round(1e6 * delay_s) for delay_s in (out.rising_delay_s, out.falling_delay_s)
            )
            port.write(command, protocol.trigger_out(rising_us, falling_us, out.inverted))
        if (trigger := self._settings.trigger_in) is not None:
            setting = protocol.trigger_in(round(trigger.delay_s * 1e6), trigger.falling_edge)
            port.write(protocol.TRIGGER_IN_1, setting)

    def close(self) -> None:
        """See `ProjectorDriver`."""
        with self._lock, contextlib.suppress(DeviceError):
            if self._port is not None:
                self._port.write(protocol.START_STOP, bytes([protocol.STOP]))
                self._port.write(protocol.POWER, bytes([protocol.POWER_STANDBY]))
        with self._lock:
            self._release()

    # -- state ---------------------------------------------------------------------------------

    def _opened(self) -> Dlpc900Port:
        if self._port is None:
            raise DeviceError("projector is not open; expected open() first")
        return self._port

    def _check_hardware(self, port: Dlpc900Port, step: str) -> None:
        if problems := self._problems({name: port.read(name)[0] for name in STATES}):
            raise DeviceError(f"{port.chip} after {step}: {', '.join(problems)}")

    def status(self) -> ProjectorStatus:
        """See `ProjectorDriver`."""
        port = self._opened()
        names = (protocol.ERROR_CODE, *STATES, protocol.IDLE)
        value = {name: port.read(name)[0] for name in names}
        tag = port.read(protocol.HARDWARE)[1:].split(b"\0")[0].decode("ascii", "replace")
        version = protocol.firmware_version(port.read(protocol.VERSION, 4))
        return ProjectorStatus(
            model=self._model.name,
            firmware=f"{tag} {version}".strip(),
            power=self._power(value),
            running=bool(value[protocol.MAIN_STATUS] & protocol.MAIN_RUNNING),
            problems=self._problems(value),
            registers={protocol.NAMES[name]: value[name] for name in names},
        )

    def _power(self, value: dict[int, int]) -> str:
        if value[protocol.POWER]:
            return "standby"
        return "idle" if value[protocol.IDLE] == 1 else "normal"

    def _problems(self, value: dict[int, int]) -> tuple[str, ...]:
        status = value[protocol.HARDWARE_STATUS]
        problems = list(protocol.hardware_problems(status))
        if self._model.dual and not status & protocol.HARDWARE_SECONDARY:
            problems.append("secondary controller missing")
        if not value[protocol.SYSTEM_STATUS] & 1:
            problems.append("internal memory test failed")
        if value[protocol.MAIN_STATUS] & protocol.MAIN_PARKED and not value[protocol.POWER]:
            problems.append("mirrors parked")
        return tuple(problems)

    # -- loading -------------------------------------------------------------------------------

    def load(self, sequence: PatternSequence, timing: Timing | None = None) -> LoadInfo:
        """See `ProjectorDriver`."""
        with self._lock:
            port = self._opened()
            loaded = self._loaded
            timing = timing or (loaded.timing if loaded else Timing())
            self._check_fit(sequence)
            self._check_timing(timing)
            digest = sequence_digest(sequence)
            if loaded is not None and loaded.digest == digest:
                self._program(port, loaded, timing, loaded.repeats)
                return LoadInfo(digest, uploaded=False)
            return self._upload(port, sequence, timing, digest)

    def _check_fit(self, sequence: PatternSequence) -> None:
        if sequence.dmd_size != self._model.size:
            raise SequenceError(
                f"sequence {sequence.name!r} is for a DMD of {sequence.dmd_size}; expected "
                f"{self._model.size} of the {self._model.name}"
            )
        if len(sequence) > self._model.max_patterns:
            raise SequenceError(
                f"sequence {sequence.name!r} has {len(sequence)} patterns; expected at most "
                f"{self._model.max_patterns} with a {self._model.name}"
            )

    def _check_timing(self, timing: Timing) -> None:
        least_us = self._model.min_exposure_us[0]
        if self._settings.trigger_in is not None:
            least_us += EXTERNAL_TRIGGER_MARGIN_US
        if not least_us <= timing.exposure_us <= MAX_EXPOSURE_US:
            raise ConfigError(
                f"exposure of {timing.exposure_us} us; expected {least_us} to {MAX_EXPOSURE_US} us "
                f"with a {self._model.name}"
            )
        least_us = self._model.min_dark_us
        if timing.dark_us != 0 and not least_us <= timing.dark_us <= MAX_EXPOSURE_US:
            raise ConfigError(
                f"dark time of {timing.dark_us} us; expected 0 or {least_us} to "
                f"{MAX_EXPOSURE_US} us"
            )

    def _upload(
        self, port: Dlpc900Port, sequence: PatternSequence, timing: Timing, digest: str
    ) -> LoadInfo:
        planes = map_planes(sequence)
        images = [encode_patterns(patterns, self._model) for patterns in planes.images]
        messages, reports = port.messages, port.reports_out + port.reports_in
        self._set_mode(port)
        self._define_patterns(port, planes.places, timing)
        self._configure(port, len(planes.places), repeats=1)
        self._send_images(port, images)
        self._check_hardware(port, "loading the sequence")
        self._loaded = Loaded(digest, planes.places, timing, repeats=1)
        return LoadInfo(
            digest,
            uploaded=True,
            images=len(images),
            image_bytes=sum(len(stream) for image in images for stream in image),
            messages=port.messages - messages,
            reports=port.reports_out + port.reports_in - reports,
        )

    def _set_mode(self, port: Dlpc900Port) -> None:
        self._loaded = None
        port.write(protocol.START_STOP, bytes([protocol.STOP]))
        self._leave_idle_if_set(port)
        port.write(protocol.DISPLAY_MODE, bytes([protocol.MODE_ON_THE_FLY]))
        # Others report errors without another stop after a change of mode.
        port.write(protocol.START_STOP, bytes([protocol.STOP]))

    def _leave_idle_if_set(self, port: Dlpc900Port) -> None:
        if self._idle:
            self._leave_idle(port)

    def _program(self, port: Dlpc900Port, loaded: Loaded, timing: Timing, repeats: int) -> None:
        """Bring the pattern table to another timing or count; the images stay."""
        if (timing, repeats) == (loaded.timing, loaded.repeats):
            return
        self._loaded = None  # until the table is whole again
        if timing != loaded.timing:
            self._define_patterns(port, loaded.places, timing)
        self._configure(port, len(loaded.places), repeats)
        self._loaded = Loaded(loaded.digest, loaded.places, timing, repeats)

    def _configure(self, port: Dlpc900Port, count: int, repeats: int) -> None:
        port.write(protocol.LUT_CONFIG, protocol.lut_config(count, count * repeats))

    def _define_patterns(
        self, port: Dlpc900Port, places: tuple[tuple[int, int], ...], timing: Timing
    ) -> None:
        trigger, leds = self._settings.trigger_in, self._settings.leds
        for index, (image, bit) in enumerate(places):
            triggered = trigger is not None and trigger.waits(index)
            times_us = (timing.exposure_us, timing.dark_us)
            entry = protocol.lut_entry(
                index, *times_us, image, bit, leds=leds, wait_trigger=triggered, clear=triggered
            )
            port.write(protocol.LUT_ENTRY, entry)

    def _send_images(self, port: Dlpc900Port, images: list[tuple[bytes, ...]]) -> None:
        for number in reversed(range(len(images))):
            for controller, stream in enumerate(images[number]):
                init = protocol.image_init(number, len(stream))
                port.write(protocol.IMAGE_INIT[controller], init)
                step = f"loading image {number} to controller {controller}"
                for chunk in protocol.image_chunks(stream):
                    port.send(protocol.IMAGE_DATA[controller], chunk, step)

    # -- running -------------------------------------------------------------------------------

    def run(self, timing: Timing | None = None, repeats: int = 1) -> RunInfo:
        """See `ProjectorDriver`."""
        with self._lock:
            port, loaded = self._opened(), self._loaded
            if loaded is None:
                raise DeviceError("no sequence is loaded; expected load() first")
            timing = timing or loaded.timing
            self._check_timing(timing)
            self._leave_idle_if_set(port)
            self._check_ready(port)
            self._program(port, loaded, timing, repeats)
            self._stopped.clear()
            began_ns, ended_ns = self._start(port)
            self._run = RunInfo(
                start_ns=(began_ns + ended_ns) // 2,
                start_uncertainty_ns=(ended_ns - began_ns) // 2,
                count=len(loaded.places) * repeats,
                timing=timing,
            )
            return self._run

    def _start(self, port: Dlpc900Port) -> tuple[int, int]:
        try:
            return port.write_once(protocol.START_STOP, bytes([protocol.START]))
        except DeviceError:
            self._loaded = None  # what the device holds is not to be trusted: load it anew
            raise

    def _check_ready(self, port: Dlpc900Port) -> None:
        mode = port.read(protocol.DISPLAY_MODE)[0]
        if mode != self._pattern_mode:
            self._loaded = None
            raise DeviceError(
                f"display mode is {mode}, expected {self._pattern_mode} with the loaded "
                "sequence: the device was reset or another program used it; load again"
            )
        if port.read(protocol.MAIN_STATUS)[0] & protocol.MAIN_RUNNING:
            raise DeviceError("a sequence is running; expected wait() or stop() before run()")

    def wait(self, timeout_s: float | None = None) -> None:
        """See `ProjectorDriver`."""
        port, run = self._opened(), self._run
        if run is None or run.count == 0:
            raise DeviceError("no finite run to wait for; expected run() with repeats > 0")
        limit_s = run.duration_s + _WAIT_MARGIN_S if timeout_s is None else timeout_s
        deadline_ns = run.start_ns + int(limit_s * 1e9)
        ended_ns = self._poll_until_over(port, run, deadline_ns)
        if self._stopped.is_set():
            raise DeviceError("the run was stopped before its end")
        self._run = None
        try:
            self._check_hardware(port, "the run")
        except DeviceError:
            self.stop()
            self._loaded = None
            raise
        self._check_duration(run, ended_ns)

    def _poll_until_over(self, port: Dlpc900Port, run: RunInfo, deadline_ns: int) -> int:
        """Return a time by which the sequencer was at rest."""
        end_ns = run.start_ns + int(run.duration_s * 1e9)
        while not self._stopped.is_set():
            running = port.read(protocol.MAIN_STATUS)[0] & protocol.MAIN_RUNNING
            # After the reply, which may be slow: the run may have ended while it was under way.
            now_ns = self._clock.now_ns()
            if not running:
                return now_ns
            if now_ns > deadline_ns:
                self.stop()
                raise DeviceTimeout(
                    f"the run did not end within {(deadline_ns - run.start_ns) * 1e-9:.3f} s; "
                    f"expected {run.duration_s:.3f} s"
                )
            before_end_ns = min(now_ns + int(_POLL_S * 1e9), end_ns)
            wake_ns = max(before_end_ns, now_ns + int(_END_POLL_S * 1e9))
            self._clock.wait_until(wake_ns, self._stopped)
        return self._clock.now_ns()

    def _check_duration(self, run: RunInfo, ended_ns: int) -> None:
        lasted_s = (ended_ns - run.start_ns) * 1e-9
        margin_s = _EARLY_S + run.start_uncertainty_ns * 1e-9
        least_s = run.duration_s * (1 - _EARLY_RELATIVE) - margin_s
        if self._settings.trigger_in is None and lasted_s < least_s:
            raise DeviceError(
                f"the run ended after {lasted_s:.3f} s; expected {run.duration_s:.3f} s"
            )

    def stop(self) -> None:
        """See `ProjectorDriver`."""
        self._stopped.set()
        with self._lock:
            self._run = None
            if self._port is not None:
                self._port.write(protocol.START_STOP, bytes([protocol.STOP]))

    def idle(self) -> None:
        """See `ProjectorDriver`."""
        with self._lock:
            self.stop()
            self._opened().write(protocol.IDLE, b"\x01")
            self._idle = True
