"""Driver of TI's DLPC350 (LightCrafter 4500): 1-bit patterns from flash, over USB HID.

Implements `sl_projector.dlpc.dmd.ProjectorDriver`. Images are flashed beforehand
(`sl_projector.dlpc.dlpc350_flash`); `load` writes the tables that show them, with variable
exposures, and lets the controller validate them. Framing, replies and runs are the DLPC900's.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from typing import Any

from sl_common.clock import Clock
from sl_common.errors import ConfigError, DeviceError, DeviceRefused, DeviceTimeout, SequenceError
from sl_projector.dlpc import dlpc350_protocol as protocol
from sl_projector.dlpc import dlpc900_protocol as common
from sl_projector.dlpc.dlpc350_flash import Layout, flash_layout
from sl_projector.dlpc.dlpc900_driver import STATES, Dlpc900, Dlpc900Settings
from sl_projector.dlpc.dlpc900_port import Dlpc900Port
from sl_projector.dlpc.dmd import Loaded, LoadInfo, ProjectorStatus, Timing
from sl_projector.sequence.pattern_sequence import PatternSequence

MODEL = "DLP4500"
VALIDATE_TIMEOUT_S = 5.0
_POLL_S = 0.01


@dataclass(frozen=True)
class Dlpc350Settings(Dlpc900Settings):
    """What is set once at `Dlpc350.open`.

    Parameters
    ----------
    flash : tuple of PatternSequence
        The sequences that were flashed, in the order of `write_flash_images`.
    """

    flash: tuple[PatternSequence, ...] = ()


class Dlpc350Port(Dlpc900Port):
    """One open DLPC350: it refuses without a reason."""

    chip = "DLPC350"
    names = protocol.NAMES

    def _refuse(self, command: int, reply: common.Reply) -> None:
        if reply.refused:
            raise protocol.refusal(command)


class Dlpc350(Dlpc900):
    """A DLPC350 projector; see `ProjectorDriver` for what the methods promise.

    `run` with ``repeats`` above 1 writes the tables anew, as the controller cannot count.

    Parameters
    ----------
    device : str
        ``usb``, ``usb:SERIAL`` or ``socket:PATH`` (`sl_projector.hid.usb_transport.open_usb`).
    settings : Dlpc350Settings
        LEDs, trigger outputs, and what the flash holds.
    backend : optional
        pyusb backend in place of libusb.
    clock : Clock
        What runs are timed by.
    """

    _product_id = protocol.PRODUCT_ID
    _port_class = Dlpc350Port
    _pattern_mode = protocol.MODE_PATTERN

    def __init__(
        self,
        device: str = "usb",
        settings: Dlpc350Settings | None = None,
        *,
        backend: Any = None,
        clock: Clock | None = None,
    ) -> None:
        settings = settings or Dlpc350Settings()
        super().__init__(device, MODEL, settings, backend=backend, clock=clock)
        if settings.trigger_in is not None:
            protocol.trigger_in_delay(settings.trigger_in.delay_s)
        self._flash: Layout = flash_layout(settings.flash)
        self._flashed = ", ".join(sequence.name for sequence in settings.flash) or "nothing"

    # -- opening and state ----------------------------------------------------------------------

    def _prepare(self, port: Dlpc900Port) -> None:
        port.drain()
        self._wake(port)
        port.write(common.START_STOP, bytes([common.STOP]))
        self._set_triggers(port)
        self._identify(port)
        self._check_hardware(port, "opening")

    def _identify(self, port: Dlpc900Port) -> None:
        """Make sure of the flash; there is one DMD with this controller."""
        needed = 1 + max((image for image, _ in self._flash.values()), default=-1)
        try:
            found = port.read(protocol.IMAGES_IN_FLASH)[0]
        except DeviceRefused:
            return  # older firmware does not tell
        if found < needed:
            raise DeviceError(
                f"the flash holds {found} images; expected at least {needed} for {self._flashed}: "
                "write them with TI's tool (sl_projector.dlpc.dlpc350_flash)"
            )

    def _set_triggers(self, port: Dlpc900Port) -> None:
        one, two = self._settings.trigger_out_1, self._settings.trigger_out_2
        counts = [protocol.delay_count(d) for d in (one.rising_delay_s, one.falling_delay_s)]
        port.write(common.TRIGGER_OUT_1, bytes([one.inverted, *counts]))
        port.write(
            common.TRIGGER_OUT_2, bytes([two.inverted, protocol.delay_count(two.rising_delay_s)])
        )
        if (trigger := self._settings.trigger_in) is not None:
            port.write(common.TRIGGER_IN_1, protocol.trigger_in_delay(trigger.delay_s))

    def _checked(self, settings: Dlpc900Settings) -> Dlpc900Settings:
        return settings

    def _check_timing(self, timing: Timing) -> None:
        super()._check_timing(timing)
        if self._settings.trigger_in is not None and not timing.dark_us:
            raise ConfigError(
                "no dark time; a DLPC350 needs black before an external trigger, expected at "
                f"least {self._model.min_dark_us} us"
            )

    def _trigger(self, index: int, count: int) -> int:
        """What an entry of the table begins at; every ``count`` it begins anew."""
        trigger = self._settings.trigger_in
        if trigger is None:
            return protocol.BY_TIME
        if not trigger.waits(index % count):
            return protocol.FOLLOWS
        return protocol.FALLING if trigger.falling_edge else protocol.RISING

    def status(self) -> ProjectorStatus:
        """See `ProjectorDriver`."""
        port = self._opened()
        value = {name: port.read(name)[0] for name in STATES}
        return ProjectorStatus(
            model=self._model.name,
            firmware=common.firmware_version(port.read(common.VERSION, 4)),
            power="standby" if value[common.POWER] else "normal",
            running=bool(value[common.MAIN_STATUS] & common.MAIN_RUNNING),
            problems=self._problems(value),
            registers={common.NAMES[name]: value[name] for name in STATES},
        )

    def idle(self) -> None:
        """Park the mirrors (standby): this controller has no idle mode. `run` wakes it."""
        with self._lock:
            self.stop()
            self._opened().write(common.POWER, bytes([common.POWER_STANDBY]))
            self._idle = True

    def _leave_idle(self, port: Dlpc900Port) -> None:
        self._wake(port)
        self._idle = False

    # -- loading --------------------------------------------------------------------------------

    def _check_fit(self, sequence: PatternSequence) -> None:
        super()._check_fit(sequence)
        missing = [p for p in sequence.patterns if p not in self._flash]
        if missing:
            raise SequenceError(
                f"{len(missing)} of {len(sequence)} patterns of {sequence.name!r} are not in the "
                f"flash, the first is {missing[0]}; the configuration says that it holds "
                f"{self._flashed} (sl_projector.dlpc.dlpc350_flash writes the images)"
            )

    def _upload(
        self, port: Dlpc900Port, sequence: PatternSequence, timing: Timing, digest: str
    ) -> LoadInfo:
        messages, reports = port.messages, port.reports_out + port.reports_in
        places = tuple(self._flash[pattern] for pattern in sequence.patterns)
        self._loaded = None
        port.write(common.START_STOP, bytes([common.STOP]))
        self._leave_idle_if_set(port)
        port.write(common.DISPLAY_MODE, bytes([protocol.MODE_PATTERN]))
        port.write(protocol.SOURCE, bytes([protocol.FROM_FLASH]))
        self._write_tables(port, places, timing, repeats=1)
        self._check_hardware(port, "loading the sequence")
        self._loaded = Loaded(digest, places, timing, repeats=1)
        return LoadInfo(
            digest,
            uploaded=True,
            images=len({image for image, _ in places}),
            messages=port.messages - messages,
            reports=port.reports_out + port.reports_in - reports,
        )

    def _program(self, port: Dlpc900Port, loaded: Loaded, timing: Timing, repeats: int) -> None:
        if (timing, repeats) == (loaded.timing, loaded.repeats):
            return
        if len(loaded.places) * repeats > self._model.max_patterns:
            raise ConfigError(
                f"repeats={repeats} of {len(loaded.places)} patterns; expected at most "
                f"{self._model.max_patterns} exposures with a DLPC350"
            )
        self._loaded = None  # until the tables are whole again
        self._write_tables(port, loaded.places, timing, repeats)
        self._loaded = Loaded(loaded.digest, loaded.places, timing, repeats)

    def _write_tables(
        self, port: Dlpc900Port, places: tuple[tuple[int, int], ...], timing: Timing, repeats: int
    ) -> None:
        shown = places * max(repeats, 1)
        # Every change of image is a buffer swap, which takes the next entry of the image table.
        images = [image for image, _ in itertools.groupby(shown, key=lambda place: place[0])]
        if len(images) > 0x100:
            raise SequenceError(
                f"{len(images)} changes of flash image in {len(shown)} exposures; expected at most "
                "256: flash the sequence so that its patterns follow each other"
            )
        port.write(
            protocol.VARIABLE_CONFIG,
            protocol.variable_config(len(shown), len(images), endless=repeats == 0),
        )
        port.write(protocol.TRIGGER_MODE, bytes([protocol.VARIABLE_INTERNAL]))
        self._write_images(port, images)
        self._write_patterns(port, shown, len(places), timing)
        self._validate(port)

    def _write_images(self, port: Dlpc900Port, images: list[int]) -> None:
        port.write(protocol.MAILBOX, bytes([protocol.IMAGE_TABLE]))
        port.write(protocol.VARIABLE_ADDRESS, bytes(2))
        port.write(protocol.MAILBOX_DATA, protocol.image_table(images))
        port.write(protocol.MAILBOX, bytes([protocol.CLOSED]))

    def _write_patterns(
        self, port: Dlpc900Port, shown: tuple[tuple[int, int], ...], count: int, timing: Timing
    ) -> None:
        port.write(protocol.MAILBOX, bytes([protocol.VARIABLE_TABLE]))
        period_us = timing.exposure_us + timing.dark_us
        before = -1
        for index, (image, plane) in enumerate(shown):
            word = protocol.pattern_word(
                plane,
                leds=self._settings.leds,
                swap=image != before,
                black=timing.dark_us > 0,
                trigger=self._trigger(index, count),
            )
            port.write(protocol.VARIABLE_ADDRESS, index.to_bytes(2, "little"))
            entry = protocol.variable_entry(word, timing.exposure_us, period_us)
            port.write(protocol.VARIABLE_ENTRY, entry)
            before = image
        port.write(protocol.MAILBOX, bytes([protocol.CLOSED]))

    def _validate(self, port: Dlpc900Port) -> None:
        port.write(protocol.VALIDATE, bytes(1))
        deadline_s = time.monotonic() + VALIDATE_TIMEOUT_S
        while (status := port.read(protocol.VALIDATE)[0]) & protocol.BUSY:
            if time.monotonic() > deadline_s:
                raise DeviceTimeout(
                    f"DLPC350 still validates its tables after {VALIDATE_TIMEOUT_S} s"
                )
            time.sleep(_POLL_S)
        if faults := protocol.validation_faults(status):
            raise DeviceRefused(f"DLPC350 finds its tables invalid: {', '.join(faults)}")
