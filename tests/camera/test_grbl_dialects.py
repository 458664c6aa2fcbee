"""The GRBL driver on controllers that speak a little differently from the one of the bench."""

from __future__ import annotations

import re
import time
from collections.abc import Callable

import pytest

from sl_bench.stage.grbl_emulator import GrblEmulator
from sl_camera.stage.grbl.grbl_protocol import is_supported, parse_setting
from sl_camera.stage.grbl.grbl_stage import GrblStage
from sl_common.errors import DeviceError, DeviceRefused, DeviceTimeout
from support.devices.stage_bench import Clock, Mover
from support.patience import wait

Change = Callable[[bytes, bytes], bytes]


class Foreign(GrblEmulator):
    """A controller whose answers are rewritten: ``change(received, sent) -> sent``."""

    def __init__(self, change: Change, settings: dict[int, float] | None = None) -> None:
        self.clock = Clock()
        super().__init__(settings, clock=self.clock)
        self._change = change

    def _exchange(self, received: bytes) -> bytes:
        return self._change(received, super()._exchange(received))


def banner(text: bytes) -> Change:
    return lambda _, sent: sent.replace(b"Grbl 1.1h ['$' for help]", text)


def comments(_: bytes, sent: bytes) -> bytes:
    return re.sub(rb"(\$\d+=[\d.]+)\r", rb"\1 (some setting, some unit)\r", sent)


def few_settings(_: bytes, sent: bytes) -> bytes:
    """No rates, no accelerations, nothing of motors; only what says where the axes may go."""
    return re.sub(rb"\$(1[12][012]|2[3-9]|1\d|\d)=[\d.]+\r\n", b"", sent)


def fields(_: bytes, sent: bytes) -> bytes:
    """Grbl-Mega and grblHAL have more axes and more fields."""
    more = re.sub(rb"MPos:([-\d.,]+)", rb"MPos:\1,0.000,0.000", sent)
    return more.replace(b"|FS:", b"|Bf:35,1023|Ln:0|F:")


class SlowStart:
    """Says nothing for a while after it was switched on, then what it has to say."""

    def __init__(self, seconds: float) -> None:
        self._begin_s = time.monotonic() + seconds
        self._held = b""

    def __call__(self, _: bytes, sent: bytes) -> bytes:
        self._held += sent
        if time.monotonic() < self._begin_s:
            return b""
        said, self._held = self._held, b""
        return said


DIALECTS: dict[str, tuple[Callable[[], Change], dict[int, float]]] = {
    "1.1f": (lambda: banner(b"Grbl 1.1f ['$' for help]"), {}),
    "grblHAL": (lambda: banner(b"GrblHAL 1.1f ['$' or '$HELP' for help]"), {}),
    "FluidNC": (lambda: banner(b"Grbl 3.7 [FluidNC v3.7.8 (wifi) '$' for help]"), {}),
    "line feeds only": (lambda: lambda _, sent: sent.replace(b"\r\n", b"\n"), {}),
    "echo": (lambda: lambda received, sent: received + sent, {}),
    "blank memory": (lambda: banner(b"error:7\r\n\r\nGrbl 1.1h ['$' for help]"), {}),
    "comments": (lambda: comments, {}),
    "few settings": (lambda: few_settings, {}),
    "more axes and fields": (lambda: fields, {}),
    "work positions": (lambda: lambda _, sent: sent, {10: 0}),
    "all reports": (lambda: lambda _, sent: sent, {10: 3}),
    "inches": (lambda: lambda _, sent: sent, {13: 1}),
    "neither homing nor limits": (lambda: lambda _, sent: sent, {20: 0, 21: 0, 22: 0}),
    "slow start": (lambda: SlowStart(1.5), {}),
}


@pytest.mark.parametrize("name", DIALECTS)
def test_connect_move_hold_resume_alarm_unlock_reset(name: str) -> None:
    make, settings = DIALECTS[name]
    with Foreign(make(), settings) as emulator:
        stage = GrblStage(emulator.port)
        stage.open()
        if stage.state().kind == "not_homed":  # ['$H'|'$X' to unlock]
            with pytest.raises(DeviceRefused, match="not_homed"):
                stage.move_to(0.001, 0.0, 0.0)
            stage.home()
        stage.move_to(0.001, -0.002, 0.003)
        low = stage.limits_m().low_m
        origin = emulator.position_m()
        assert stage.position_m() == pytest.approx((0.001, -0.002, 0.003), abs=1e-6)
        stage.move_to(0.002, -0.002, 0.003)
        assert emulator.position_m()[0] - origin[0] == pytest.approx(0.001, abs=1e-6)

        emulator.clock.run_at(0.1)  # nothing is over before it was seen to go on
        stage.jog_by(0.01, 0.0, 0.0, speed_m_s=0.005)
        wait(lambda: stage.state().kind == "moving", "the stage")
        stage.hold()  # ends a jog
        assert stage.state().kind == "idle"
        stage.jog_by(0.005, 0.0, 0.0, speed_m_s=0.005)
        stage.stop()
        mover = Mover(stage, -0.005, 0.0, 0.0)
        stage.hold()
        assert stage.state().kind == "hold"
        stage.resume()
        emulator.clock.run_at(25.0)
        assert mover.ended() is None
        assert stage.position_m()[0] == pytest.approx(-0.005, abs=1e-6)

        with pytest.raises(DeviceRefused, match="soft limit"):
            stage.move_to(low[0] - 0.001, 0.0, 0.0)
        emulator.alarm(1)
        wait(lambda: stage.state().kind == "alarm", "the stage")
        with pytest.raises(DeviceRefused, match="limit switch"):
            stage.move_to(0.0, 0.0, 0.0)
        stage.clear()
        assert stage.state().kind == "idle"
        stage.move_to(0.0, 0.0, 0.0)
        stage.close()


@pytest.mark.parametrize("code", range(1, 11))
def test_every_alarm_is_named_and_cleared(code: int) -> None:
    with Foreign(lambda _, sent: sent) as emulator:
        stage = GrblStage(emulator.port)
        stage.open()
        stage.home()
        emulator.alarm(code)
        wait(lambda: stage.state().kind == "alarm", "the stage")
        assert f"ALARM:{code}: " in stage.state().text
        assert "not known" not in stage.state().text
        stage.clear()
        assert stage.state().kind == "idle"
        assert stage.state().referenced == (code in (2, 4, 5))
        stage.close()


def test_the_offset_of_work_positions_is_waited_for() -> None:
    """Without WCO the machine position is not known; a controller that never sends it has none."""
    without = re.compile(rb"\|WCO:[-\d.,]+")
    with Foreign(lambda _, sent: without.sub(b"", sent), {10: 0}) as emulator:
        stage = GrblStage(emulator.port)
        stage.open()
        stage.home()
        stage.move_to(0.001, 0.0, 0.0)
        assert emulator.position_m()[0] == pytest.approx(0.001, abs=1e-6)
        stage.close()


@pytest.mark.parametrize(
    ("text", "good"),
    [
        ("Grbl 1.1h ['$' for help]", True),
        ("GrblHAL 1.1f ['$' or '$HELP' for help]", True),
        ("Grbl 3.7 [FluidNC v3.7.8 (wifi) '$' for help]", True),
        ("Grbl 0.9j ['$' for help]", False),
        ("Marlin 2.1", False),
        ("grbl", False),
    ],
)
def test_versions(text: str, good: bool) -> None:
    assert is_supported(text) is good


def test_settings_may_have_comments() -> None:
    assert parse_setting("$110=500.000 (x max rate, mm/min)") == (110, 500.0)


def test_an_older_grbl_and_a_mute_port_are_refused() -> None:
    with Foreign(banner(b"Grbl 0.9j ['$' for help]")) as old, Foreign(lambda *_: b"") as mute:
        with pytest.raises(DeviceError, match=r"0\.9j.*expected GRBL"):
            GrblStage(old.port).open()
        with pytest.raises(DeviceTimeout, match="no GRBL banner"):
            GrblStage(mute.port, reply_timeout_s=0.3).open()
