"""Every fault that the stage emulators can make: a clear state, nothing moves, recovery."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sl_bench.stage.grbl_emulator import GrblEmulator
from sl_bench.stage.zaber_emulator import ZaberEmulator
from sl_camera.stage.grbl.grbl_stage import GrblStage
from sl_camera.stage.manual_stage import ManualStage
from sl_camera.stage.zaber.zaber_protocol import checksum, command, parse_reply
from sl_camera.stage.zaber.zaber_stage import ZaberStage, zaber_axes
from sl_common.errors import ConfigError, DeviceError, DeviceLost, DeviceRefused, DeviceTimeout
from support.devices.stage_bench import Clock, Mover
from support.patience import wait


class Rig:
    """A homed GRBL stage on its emulator."""

    def __init__(self, folder: Path) -> None:
        self.clock = Clock()
        self.emulator = GrblEmulator(clock=self.clock, homed=True, seed=1).start()
        self.emulator.link(folder / "stage")
        self.stage = GrblStage(str(folder / "stage"), reply_timeout_s=0.4)
        self.stage.open()

    def close(self) -> None:
        self.stage.close()
        self.emulator.close()

    def stands(self) -> bool:
        before = self.emulator.position_m()
        time.sleep(0.03)
        return self.emulator.position_m() == before


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.close()


@pytest.fixture
def zaber() -> Iterator[tuple[ZaberStage, ZaberEmulator, Clock]]:
    clock = Clock()
    with ZaberEmulator(clock=clock, homed=True) as emulator:
        stage = ZaberStage(emulator.port, reply_timeout_s=0.2)
        stage.open()
        yield stage, emulator, clock
        stage.close()


# -- GRBL -----------------------------------------------------------------------------------------


def test_noise_in_front_of_an_answer(rig: Rig) -> None:
    """The answer is spoilt, so it counts as lost; nothing is left moving, the next move works."""
    rig.emulator.noise()
    with pytest.raises(DeviceTimeout, match="G0"):
        rig.stage.move_to(0.001, 0.0, 0.0)
    assert rig.stands()
    rig.stage.move_to(0.002, 0.0, 0.0)
    assert rig.emulator.position_m()[0] == pytest.approx(0.002, abs=1e-9)


def test_lost_answer_to_a_move(rig: Rig) -> None:
    rig.emulator.lose_replies(1)
    with pytest.raises(DeviceTimeout, match="no answer"):
        rig.stage.move_to(0.001, 0.0, 0.0)
    assert rig.stands()
    assert rig.stage.state().kind == "idle"
    rig.stage.move_to(0.0, 0.0, 0.0)


def test_lost_answer_to_the_end_of_a_move(rig: Rig) -> None:
    """The motion is done and its report says so: no reason to fail."""
    stage = rig.stage
    stage.command("G4P0")  # the answer to this one arrives
    threading.Timer(0.05, lambda: rig.emulator.lose_replies(1)).start()
    rig.clock.run_at(2.0)
    stage.move_to(0.01, 0.0, 0.0)
    assert rig.emulator.position_m()[0] == pytest.approx(0.01, abs=1e-9)
    rig.clock.run_at(25.0)
    stage.move_to(0.0, 0.0, 0.0)  # after a reset that set the conversation to zero


def test_stale_answer_is_not_taken_for_the_next(rig: Rig) -> None:
    """A late ``ok`` arrives while a refused line waits for its own answer."""
    rig.emulator.delay_replies(1, 0.6)
    with pytest.raises(DeviceTimeout):
        rig.stage.command("G21")
    with pytest.raises(DeviceRefused, match="error:20"):
        rig.stage.command("G5")
    time.sleep(0.3)
    with pytest.raises(DeviceRefused, match="error:20"):
        rig.stage.command("G5")


def test_silent_controller_is_lost_and_comes_back(rig: Rig) -> None:
    rig.emulator.fall_silent()
    time.sleep(0.15)
    state = rig.stage.state()
    assert state.kind == "lost"
    assert "no status" in state.text
    with pytest.raises(DeviceLost):
        rig.stage.move_to(0.0, 0.0, 0.0)
    rig.emulator.fall_silent(False)
    assert rig.stage.state().kind == "idle"
    rig.stage.move_to(0.001, 0.0, 0.0)


def test_alarm_in_motion(rig: Rig) -> None:
    rig.clock.run_at(2.0)
    mover = Mover(rig.stage, 0.02, 0.0, 0.0)
    rig.emulator.alarm(3)
    assert "ALARM:3" in str(mover.ended())
    assert rig.stands()
    assert not rig.stage.state().referenced
    rig.stage.clear()
    assert rig.stage.state().kind == "idle"


def test_limit_switch_names_itself_and_stays_until_cleared(rig: Rig) -> None:
    rig.emulator.close_switch(2)
    wait(lambda: rig.stage.state().kind == "alarm", "the stage")
    assert "limit switch" in rig.stage.state().text
    with pytest.raises(DeviceRefused, match="limit switch"):
        rig.stage.move_to(0.0, 0.0, 0.0)
    rig.emulator.open_switches()
    assert rig.stage.state().kind == "alarm"
    rig.stage.clear()
    rig.stage.home()
    assert rig.stage.state().referenced


def test_missing_home_switch(rig: Rig) -> None:
    rig.emulator.remove_switches(2)
    with pytest.raises(DeviceError, match="ALARM:9"):
        rig.stage.home()
    assert rig.stage.state().kind == "alarm"
    assert not rig.stage.state().referenced
    rig.emulator.remove_switches()
    rig.stage.clear()
    rig.stage.home()


def test_soft_limit_of_the_controller_keeps_the_position(rig: Rig) -> None:
    before = rig.stage.position_m()
    with pytest.raises(DeviceError, match="ALARM:2"):
        rig.stage.command("G53G0X1")
    assert rig.stage.state().kind == "alarm"
    rig.stage.clear()
    assert rig.stage.position_m() == before


@pytest.mark.parametrize("moving", [False, True])
def test_power_cycle_is_noticed_and_costs_the_reference(rig: Rig, moving: bool) -> None:
    if moving:
        rig.clock.run_at(2.0)
        mover = Mover(rig.stage, 0.02, 0.0, 0.0)
    rig.emulator.power_cycle()
    wait(lambda: rig.stage.state().kind == "alarm", "the stage")
    if moving:
        assert "restarted" in str(mover.ended())
    assert "restarted" in rig.stage.state().text
    assert not rig.stage.state().referenced
    with pytest.raises(DeviceRefused, match="restarted"):
        rig.stage.move_to(0.0, 0.0, 0.0)
    rig.clock.run_at(25.0)
    rig.stage.clear()
    rig.stage.home()
    rig.stage.move_to(0.001, 0.0, 0.0)
    assert rig.emulator.position_m()[0] == pytest.approx(0.001, abs=1e-9)


@pytest.mark.parametrize("moving", [False, True])
def test_unplugged_and_plugged_again(rig: Rig, moving: bool) -> None:
    if moving:
        rig.clock.run_at(2.0)
        mover = Mover(rig.stage, 0.02, 0.0, 0.0)
    rig.emulator.disconnect()
    wait(lambda: rig.stage.state().kind == "lost", "the stage")
    if moving:
        assert isinstance(mover.ended(), DeviceLost)
    with pytest.raises(DeviceLost):
        rig.stage.position_m()
    with pytest.raises(DeviceLost, match="cannot open"):
        rig.stage.open()
    rig.emulator.reconnect()
    rig.stage.open()
    assert rig.stage.state().kind == "idle"
    assert rig.stands()
    assert rig.stage.position_m() == pytest.approx(rig.emulator.position_m(), abs=1e-6)


def test_a_stage_that_answers_but_does_not_move(rig: Rig) -> None:
    rig.emulator.jam()
    with pytest.raises(DeviceError, match="stands at MPos"):
        rig.stage.move_to(0.001, 0.0, 0.0)


def test_lost_steps_are_the_emulators_secret(rig: Rig) -> None:
    """No driver can see them: the counter is right and the carriage is not."""
    rig.emulator.lose_steps(0.1)
    rig.stage.move_to(0.01, 0.0, 0.0)
    assert rig.stage.position_m()[0] == pytest.approx(0.01)
    assert rig.emulator.position_m()[0] == pytest.approx(0.009)


def test_the_port_has_one_owner(rig: Rig) -> None:
    with pytest.raises(DeviceLost, match="cannot open"):
        GrblStage(rig.emulator.port).open()


def test_work_positions_in_inches_are_understood(rig: Rig) -> None:
    for line in ("$10=0", "$13=1", "G10L20P1X0Y0Z0", "$$"):
        rig.stage.command(line)
    rig.stage.move_to(0.0127, 0.0, 0.0)
    # four decimals of an inch: half of 2.54 um
    assert rig.stage.position_m() == pytest.approx((0.0127, 0.0, 0.0), abs=1.3e-6)


def test_jog_stops_where_it_is_told_to(rig: Rig) -> None:
    rig.clock.run_at(2.0)
    rig.stage.jog_by(0.02, 0.0, 0.0, speed_m_s=0.02)
    assert rig.stage.state().kind == "moving"
    rig.stage.stop()
    assert rig.stage.state().kind == "idle"
    assert rig.stands()
    assert 0.0 < rig.emulator.position_m()[0] < 0.02
    with pytest.raises(DeviceRefused, match="nothing was sent"):
        rig.stage.jog_by(0.03, 0.0, 0.0, speed_m_s=0.02)


def test_something_else_on_the_port() -> None:
    with ZaberEmulator() as emulator, pytest.raises(DeviceTimeout, match="banner"):
        GrblStage(emulator.port, reply_timeout_s=0.1).open()


def test_no_such_port(tmp_path: Path) -> None:
    with pytest.raises(DeviceLost, match="cannot open"):
        GrblStage(str(tmp_path / "nothing")).open()


# -- Zaber ----------------------------------------------------------------------------------------


def test_zaber_messages_as_documented() -> None:
    """The reply is hardware.md's example; checksum and message number as it defines them."""
    reply = parse_reply("@01 0 OK IDLE -- 0")
    assert (reply.device, reply.axis, reply.number) == (1, 0, None)
    assert (reply.accepted, reply.busy, reply.flag, reply.data) == (True, False, "--", "0")
    sent = command(1, 2, 7, "move abs 10000")
    assert sent.startswith(b"/01 2 07 move abs 10000:")
    body, lrc = sent.strip()[1:].split(b":")
    assert (sum(body) + int(lrc, 16)) % 256 == 0
    assert parse_reply("@01 1 07 RJ BUSY WR BADDATA").data == "BADDATA"


@pytest.mark.parametrize("line", ["", "@1 0 OK", "#01 0 hello", "@01 0 OK IDLE -- 0:00"])
def test_zaber_lines_that_are_no_replies(line: str) -> None:
    assert checksum("01 0 OK IDLE -- 0") != 0
    with pytest.raises(ValueError):
        parse_reply(line)


@pytest.mark.parametrize("fault", [ZaberEmulator.noise, ZaberEmulator.lose_replies])
def test_zaber_asks_again(
    zaber: tuple[ZaberStage, ZaberEmulator, Clock], fault: Callable[[ZaberEmulator], None]
) -> None:
    stage, emulator, _ = zaber
    fault(emulator)
    stage.move_to(0.001, 0.0, 0.0)
    assert emulator.position_m()[0] == pytest.approx(0.001, abs=0.05e-6)


def test_zaber_emergency_stop_stays_until_released(
    zaber: tuple[ZaberStage, ZaberEmulator, Clock],
) -> None:
    stage, emulator, clock = zaber
    clock.run_at(2.0)
    mover = Mover(stage, 0.02, 0.02, 0.0)
    emulator.fault(1, "FH", stays=True)
    assert "emergency stop" in str(mover.ended())
    wait(lambda: not any(device.busy for device in emulator.devices), "the stage")
    with pytest.raises(DeviceRefused, match="still there"):
        stage.clear()
    emulator.release()
    assert stage.state().kind == "alarm"
    stage.clear()
    stage.move_to(0.0, 0.0, 0.0)


def test_zaber_power_cycle_costs_the_reference(
    zaber: tuple[ZaberStage, ZaberEmulator, Clock],
) -> None:
    stage, emulator, _ = zaber
    emulator.power_cycle()
    assert stage.state().kind == "not_homed"
    with pytest.raises(DeviceRefused, match="not_homed"):
        stage.move_to(0.0, 0.0, 0.0)
    stage.home()
    stage.move_to(0.001, 0.0, 0.0)
    assert emulator.position_m()[0] == pytest.approx(0.001, abs=0.05e-6)


def test_zaber_without_its_reference_moves_after_clear_and_says_so(
    zaber: tuple[ZaberStage, ZaberEmulator, Clock],
) -> None:
    stage, emulator, _ = zaber
    emulator.power_cycle()
    before = emulator.position_m()
    stage.clear()
    state = stage.state()
    assert (state.kind, state.referenced) == ("idle", False)
    assert "switched on" in state.text
    x, y, z = stage.position_m()
    stage.move_to(x + 0.001, y, z)
    assert emulator.position_m()[0] - before[0] == pytest.approx(0.001, abs=0.05e-6)
    emulator.fault(2, "FS")
    stage.clear()
    assert not stage.state().referenced
    stage.home()
    assert stage.state().referenced


def test_zaber_that_insists_on_homing_says_so(
    zaber: tuple[ZaberStage, ZaberEmulator, Clock],
) -> None:
    stage, emulator, _ = zaber
    emulator.power_cycle()
    emulator.devices[1].stuck_flags.add("WR")
    with pytest.raises(DeviceRefused, match="axis 1 takes no moves before home"):
        stage.clear()
    assert stage.state().kind == "not_homed"


def test_zaber_unplugged(zaber: tuple[ZaberStage, ZaberEmulator, Clock]) -> None:
    stage, emulator, clock = zaber
    clock.run_at(2.0)
    mover = Mover(stage, 0.02, 0.0, 0.0)
    emulator.disconnect()
    assert isinstance(mover.ended(), DeviceLost)
    assert stage.state().kind == "lost"


# -- manual ---------------------------------------------------------------------------------------


def test_the_operator_is_told_what_to_do_and_may_say_what_the_scales_say() -> None:
    stage = ManualStage()
    stage.open()
    stage.clear()
    mover = Mover(stage, 0.001, 0.0, -0.002)
    assert "x = 1.000, y = 0.000, z = -2.000 mm" in stage.state().text
    with pytest.raises(DeviceRefused):
        stage.confirm((1.0, 0.0, 0.0))
    stage.hold()
    with pytest.raises(DeviceRefused, match="hold"):
        stage.confirm()
    stage.resume()
    stage.confirm((0.00101, 0.0, -0.002))
    assert mover.ended() is None
    assert stage.position_m() == (0.00101, 0.0, -0.002)
    with pytest.raises(DeviceRefused, match="nothing to confirm"):
        stage.confirm()


def test_the_emulator_remembers_where_the_carriage_stood(rig: Rig) -> None:
    """So that a camera that is served late sees the part where it was, not where it went since."""
    rig.clock.run_at(1.0)
    before_ns = time.time_ns()
    mover = Mover(rig.stage, 0.002, 0.0, 0.0)
    assert mover.ended() is None
    wait(
        lambda: rig.emulator.position_at(time.time_ns())[0] == pytest.approx(0.002, abs=1e-9),
        "the stage",
    )
    after_ns = time.time_ns()
    assert rig.emulator.position_at(before_ns)[0] == 0.0
    times_ns = [before_ns + i * (after_ns - before_ns) // 50 for i in range(51)]
    places = [rig.emulator.position_at(at)[0] for at in times_ns]
    assert places == sorted(places)
    assert any(0.0 < place < 0.002 for place in places)
    assert rig.emulator.position_at(after_ns + 10**9)[0] == pytest.approx(0.002, abs=1e-9)


def test_zaber_controller_of_several_axes() -> None:
    """Zaber's X-MCC: `/01 2 ...` is the second axis of the first device."""
    with ZaberEmulator(homed=True, one_controller=True, clock=Clock()) as emulator:
        stage = ZaberStage(emulator.port, zaber_axes((1, 1, 1), (1, 3, 2)), reply_timeout_s=0.2)
        stage.open()
        stage.move_to(1e-3, 2e-3, 3e-3)
        assert emulator.position_m() == pytest.approx((1e-3, 3e-3, 2e-3), abs=0.05e-6)
        stage.close()


@pytest.mark.parametrize(
    "lists", [{"devices": (1, 2)}, {"axes": (1,)}, {"microsteps_m": ()}, {"signs": (1, 1, 1, 1)}]
)
def test_zaber_lists_that_are_not_of_three_axes(lists: dict[str, tuple[int, ...]]) -> None:
    with pytest.raises(ConfigError, match="expected one for each of x, y, z"):
        zaber_axes(**lists)
