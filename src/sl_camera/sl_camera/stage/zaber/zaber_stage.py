"""Stage driver for Zaber devices with the ASCII protocol, one axis of it per stage axis.

Own protocol code rather than the vendor's library: see ``docs/decisions``. Every command carries
a message number and a checksum, so a late or damaged reply is never taken for another.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sl_camera.stage.serial_lines import SerialLines
from sl_camera.stage.stage import Position, StageLimits, StageState
from sl_camera.stage.zaber.zaber_protocol import (
    FAULTS,
    REJECTIONS,
    UNREFERENCED,
    Reply,
    command,
    parse_reply,
)
from sl_common.errors import ConfigError, DeviceError, DeviceLost, DeviceRefused, DeviceTimeout

POLL_S = 0.05
NO_REFERENCE = "position counts from where it was switched on"
ABSENT = Reply(0, 0, None, accepted=True, busy=False, flag="--", data="0")
STILL_S = 5.0  # a move without a time-out is given up after standing still for so long


@dataclass(frozen=True)
class ZaberAxis:
    """Which axis of which device moves one axis of the stage.

    Parameters
    ----------
    device : int
        Address in the daisy chain, 1 to 99; 0: the stage has no such axis, it stands at zero.
    axis : int
        Axis of the device, from 1.
    microstep_m : float
        Length of a microstep, from the stage's data sheet.
    sign : int
        +1 or -1: the stage axis' direction in device positions.
    origin_steps : int, optional
        Device position where the stage axis reads zero; by default the middle of its limits.
    """

    device: int
    axis: int = 1
    microstep_m: float = 0.047625e-6
    sign: int = 1
    origin_steps: int | None = None


def zaber_axes(
    devices: Sequence[int] = (1, 2, 3),
    axes: Sequence[int] = (1, 1, 1),
    microsteps_m: Sequence[float] = (ZaberAxis.microstep_m,) * 3,
    signs: Sequence[int] = (1, 1, 1),
) -> list[ZaberAxis]:
    """Axes x, y, z from lists as a configuration has them.

    Parameters
    ----------
    devices, axes : sequence of int
        Address and axis number of x, y, z.
    microsteps_m : sequence of float
        Metres per microstep.
    signs : sequence of int
        1 or -1: direction of the stage's axis on the device.

    Raises
    ------
    ConfigError
        When a list does not have three values.
    """
    given: dict[str, Sequence[float]] = {"zaber_devices": devices, "zaber_axes": axes}
    given |= {"zaber_microstep_m": microsteps_m, "signs": signs}
    for name, values in given.items():
        if len(values) != 3:
            raise ConfigError(f"{name} has {len(values)} values; expected one for each of x, y, z")
    each = zip(devices, axes, microsteps_m, signs, strict=True)
    return [ZaberAxis(int(device), int(axis), step, sign) for device, axis, step, sign in each]


@dataclass
class _Reach:
    """An axis' limits and zero, in microsteps, as the device told at opening."""

    low: int
    high: int
    origin: int


class ZaberStage:
    """A three-axis stage of Zaber devices on one port. Implements ``StageDriver``.

    Parameters
    ----------
    port : str
        Serial device.
    axes : sequence of ZaberAxis
        For x, y, z. An axis with an index or home sensor needs ``home()`` after power-up.
    baud : int
        115200 on current firmware.
    reply_timeout_s : float
        Longest wait for a reply; replies do not wait for motion.
    """

    def __init__(
        self,
        port: str,
        axes: Sequence[ZaberAxis] = (ZaberAxis(1), ZaberAxis(2), ZaberAxis(3)),
        *,
        baud: int = 115200,
        reply_timeout_s: float = 1.0,
    ) -> None:
        self.port, self.baud = port, baud
        self._axes, self._reply_timeout_s = tuple(axes), reply_timeout_s
        self._reach: list[_Reach] = []
        self._link: SerialLines | None = None
        self._lost = "not open"
        self._cv = threading.Condition()
        self._line_lock = threading.Lock()
        self._motion_lock = threading.Lock()
        self._number = 0
        self._reply: Reply | None = None
        self._activity = ""
        self._held = self._stopped = False
        self._given_up = False  # the reference, by `clear`; the devices do not remember that
        self._alarm = ""
        self.noise_lines = 0

    # -- connecting ---------------------------------------------------------------------------

    def open(self) -> None:
        """Connect, stop what moves, read the limits."""
        self.close()
        self._held = self._stopped = False
        self._alarm, self._lost = "", ""
        self._link = SerialLines(self.port, self.baud, self._on_line, self._on_lost)
        try:
            self._each("stop")
            self._wait_all_idle(STILL_S)
            self._reach = [self._read_reach(axis) for axis in self._axes]
        except DeviceError:
            self.close()
            raise

    def close(self) -> None:
        """Let go of the port; a running motion is stopped first. Never raises."""
        link = self._link
        if link is None:
            return
        if self._activity:
            with contextlib.suppress(DeviceError):
                self._each("stop")
        self._link = None
        link.close()
        self._on_lost("closed")

    def _read_reach(self, axis: ZaberAxis) -> _Reach:
        low = int(self._ask(axis, "get limit.min").data)
        high = int(self._ask(axis, "get limit.max").data)
        middle = (low + high) // 2
        return _Reach(low, high, middle if axis.origin_steps is None else axis.origin_steps)

    # -- talking ------------------------------------------------------------------------------

    def _on_lost(self, reason: str) -> None:
        with self._cv:
            self._lost = self._lost or reason
            self._cv.notify_all()

    def _on_line(self, line: str) -> None:
        if line.startswith(("#", "!")):  # info and alerts: nobody waits for them
            return
        with self._cv:
            try:
                reply = parse_reply(line)
            except ValueError:
                self.noise_lines += 1
                return
            if reply.number == self._number:
                self._reply = reply
                self._cv.notify_all()

    def _ask(self, axis: ZaberAxis, data: str) -> Reply:
        """One command, its own reply; asked again once where the reply is lost or damaged.

        Every command used here may be sent twice with the same effect.
        """
        if not axis.device:
            return ABSENT
        with self._line_lock:
            for _ in range(2):
                reply = self._exchange(axis, data)
                if reply is not None:
                    break
            else:
                raise DeviceTimeout(
                    f"Zaber device {axis.device} axis {axis.axis} on {self.port} does not answer "
                    f"{data!r} within {self._reply_timeout_s:g} s"
                )
        if not reply.accepted:
            why = REJECTIONS.get(reply.data, "meaning not known")
            why += f"; {reply.flag}: {FAULTS[reply.flag]}" if reply.flag in FAULTS else ""
            raise DeviceRefused(
                f"Zaber device {axis.device} axis {axis.axis} rejects {data!r}: "
                f"{reply.data} ({why})"
            )
        return reply

    def _exchange(self, axis: ZaberAxis, data: str) -> Reply | None:
        link = self._link
        if link is None or self._lost:
            raise DeviceLost(f"stage on {self.port}: {self._lost or 'not open'}")
        with self._cv:
            self._number = (self._number + 1) % 100
            self._reply = None
        link.write(command(axis.device, axis.axis, self._number, data))
        with self._cv:
            self._cv.wait_for(lambda: self._reply or self._lost, self._reply_timeout_s)
            if self._lost:
                raise DeviceLost(f"stage on {self.port}: {self._lost}")
            return self._reply

    def _each(self, data: str) -> list[Reply]:
        return [self._ask(axis, data) for axis in self._axes]

    # -- state --------------------------------------------------------------------------------

    def state(self) -> StageState:
        """What the stage is doing, from all axes' flags."""
        if self._lost:
            return StageState("lost", self._lost)
        try:
            replies = self._each("")
        except DeviceError as error:
            return StageState("lost", str(error))
        return self._interpret(replies)

    def _interpret(self, replies: list[Reply]) -> StageState:
        flags = {reply.flag for reply in replies}
        self._note_faults(flags)
        referenced = not flags & UNREFERENCED and not self._given_up
        if self._alarm:
            return StageState("alarm", self._alarm, referenced)
        if self._activity == "homing":
            return StageState("homing", "searching the reference")
        if self._held:
            return StageState("hold", "halted; resume or stop", referenced)
        if self._activity or any(reply.busy for reply in replies):
            return StageState("moving", "moving", referenced)
        if flags & UNREFERENCED:
            return StageState("not_homed", "no reference since power-up")
        return StageState("idle", "" if referenced else NO_REFERENCE, referenced)

    def _note_faults(self, flags: set[str]) -> None:
        """A fault stays an alarm until ``clear``, even where the flag goes by itself."""
        faults = sorted(flag for flag in flags if flag.startswith("F"))
        if faults and not self._alarm:
            self._alarm = f"{faults[0]}: {FAULTS.get(faults[0], 'meaning not known')}"

    def position_m(self) -> Position:
        """Where the stage stands, metres."""
        replies = self._each("get pos")
        x, y, z = (
            axis.sign * (int(reply.data) - reach.origin) * axis.microstep_m
            for axis, reach, reply in zip(self._axes, self._reach, replies, strict=True)
        )
        return x, y, z

    def limits_m(self) -> StageLimits:
        """Reach as the devices' ``limit.min`` and ``limit.max`` have it."""
        if self._lost or not self._reach:
            raise DeviceLost(f"stage on {self.port}: {self._lost or 'not open'}")
        ends = [
            sorted(
                axis.sign * (end - reach.origin) * axis.microstep_m
                for end in (reach.low, reach.high)
            )
            for axis, reach in zip(self._axes, self._reach, strict=True)
        ]
        (x0, x1), (y0, y1), (z0, z1) = ends
        return StageLimits((x0, y0, z0), (x1, y1, z1))

    def _require(self, *kinds: str) -> None:
        state = self.state()
        if state.kind == "lost":
            raise DeviceLost(f"stage on {self.port}: {state.text}")
        if state.kind not in kinds:
            wanted = " or ".join(kinds)
            raise DeviceRefused(f"stage is {state.kind} ({state.text}), expected {wanted}")

    # -- motion -------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _owning_motion(self, activity: str, *kinds: str) -> Iterator[None]:
        """Be the one who moves; what goes wrong inside leaves the stage standing."""
        if not self._motion_lock.acquire(blocking=False):
            raise DeviceRefused("stage is moving for another caller, expected idle")
        try:
            self._require(*kinds)
            self._stopped, self._activity = False, activity
            yield
        except DeviceError:
            with contextlib.suppress(DeviceError):
                self._stop_axes()
            raise
        finally:
            self._activity, self._held = "", False
            self._motion_lock.release()

    def home(self, *, timeout_s: float = 120.0) -> None:
        """``home`` for z, then x and y together."""
        with self._owning_motion("homing", "idle", "not_homed"):
            deadline = time.monotonic() + timeout_s
            self._ask(self._axes[2], "home")
            self._wait_all_idle(timeout_s)
            for axis in self._axes[:2]:
                self._ask(axis, "home")
            self._wait_all_idle(deadline - time.monotonic())
            self._given_up = False

    def move_to(
        self, x_m: float, y_m: float, z_m: float, *, timeout_s: float | None = None
    ) -> None:
        """See `StageDriver`; all axes start at once."""
        self.limits_m().require_inside((x_m, y_m, z_m))
        targets = [
            round(axis.sign * value / axis.microstep_m) + reach.origin
            for axis, reach, value in zip(self._axes, self._reach, (x_m, y_m, z_m), strict=True)
        ]
        with self._owning_motion("moving", "idle"):
            while True:
                self._send_to(targets)
                self._wait_all_idle(timeout_s)
                if not self._held:
                    break
                self._wait_resumed()
            self._verify(targets)

    def _send_to(self, targets: list[int]) -> None:
        for axis, reach, target in zip(self._axes, self._reach, targets, strict=True):
            # metres round to a microstep beyond the end at the very limit
            self._ask(axis, f"move abs {min(max(target, reach.low), reach.high)}")

    def _wait_all_idle(self, timeout_s: float | None) -> None:
        """Poll until no axis moves; a fault, ``stop()`` or too long a time raises."""
        left_s, places, last = timeout_s or STILL_S, [""], time.monotonic()
        while True:
            replies = self._each("get pos")
            self._note_faults({reply.flag for reply in replies})
            if self._alarm or self._stopped:
                raise DeviceError(self._alarm or "the stage was stopped on the way")
            if not any(reply.busy for reply in replies):
                return
            now, before = time.monotonic(), places
            places = [reply.data for reply in replies]
            left_s = STILL_S if timeout_s is None and places != before else left_s - (now - last)
            last = now
            if left_s <= 0.0:
                raise DeviceTimeout(f"stage not there within {timeout_s or STILL_S:g} s")
            time.sleep(POLL_S)

    def _wait_resumed(self) -> None:
        with self._cv:
            self._cv.wait_for(lambda: not self._held or self._stopped or self._lost)
        if self._stopped or self._alarm:
            raise DeviceError(self._alarm or "the stage was stopped on the way")

    def _verify(self, targets: list[int]) -> None:
        found = [int(reply.data) for reply in self._each("get pos")]
        if any(abs(a - b) > 1 for a, b in zip(found, targets, strict=True)):
            raise DeviceError(f"the stage stands at {found} microsteps, expected {targets}")

    def hold(self) -> None:
        """Stop all axes and remember where they were going; Zaber has no hold of its own."""
        self._require("idle", "moving", "hold")
        self._held = True
        self._stop_axes()

    def resume(self) -> None:
        """Go on to the target of the move that was held."""
        self._require("hold")
        with self._cv:
            self._held = False
            self._cv.notify_all()

    def stop(self) -> None:
        """Stop all axes and forget the target. While homing: alarm."""
        homing = self._activity == "homing"
        with self._cv:
            self._stopped = bool(self._activity)
            self._held = False
            self._cv.notify_all()
        self._stop_axes()
        if homing:
            self._alarm = "homing was stopped"

    def _stop_axes(self) -> None:
        """Decelerate all axes and wait until they stand."""
        self._each("stop")
        deadline = time.monotonic() + STILL_S
        while any(reply.busy for reply in self._each("")):
            if time.monotonic() > deadline:
                raise DeviceTimeout(f"the axes do not stand {STILL_S:g} s after a stop")
            time.sleep(POLL_S)

    def clear(self) -> None:
        """``warnings clear`` and ``driver enable``; then ``set pos`` where there is no reference.

        An axis that does not know where it stands takes no moves. Told that its count is right, it
        counts from where it was switched on; the ends of its travel are then elsewhere.
        """
        kind = self.state().kind
        if kind == "alarm":
            self._clear_faults()
        if kind in ("alarm", "not_homed"):
            self._give_up_reference()

    def _give_up_reference(self) -> None:
        for axis in self._axes:
            if self._ask(axis, "").flag in UNREFERENCED:
                self._given_up = True
                self._ask(axis, f"set pos {self._ask(axis, 'get pos').data}")
                if self._ask(axis, "").flag in UNREFERENCED:
                    raise DeviceRefused(
                        f"Zaber device {axis.device} axis {axis.axis} takes no moves before home"
                    )

    def _clear_faults(self) -> None:
        self._each("warnings clear")
        for axis in self._axes:
            with contextlib.suppress(DeviceRefused):  # firmware 6 has no such command
                self._ask(axis, "driver enable")
        flags = {reply.flag for reply in self._each("")}
        self._alarm = ""
        self._note_faults(flags)
        if self._alarm:
            raise DeviceRefused(f"the cause is still there: {self._alarm}")
