"""The GRBL driver on controllers that do less than GRBL, or something else, or say it late.

Each behaviour was seen on foreign software on a pseudo-terminal: the simulator of cncjs (says
``Hold`` and moves on, ``ok`` before a motion has begun, alarms without a line), mock-fluidnc
(knows no jog cancel, answers a dwell at once), the grblHAL simulator (after a refused jog it
refuses moves), grbl-sim on a busy machine (late banners, two questions with one answer).
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator

import pytest

from sl_bench.stage.grbl_emulator import GrblEmulator
from sl_camera.stage.grbl.grbl_conversation import GrblConversation
from sl_camera.stage.grbl.grbl_protocol import machine_frame, parse_report
from sl_camera.stage.grbl.grbl_stage import GrblStage
from sl_common.errors import DeviceError, DeviceRefused
from support.devices.stage_bench import Clock, Mover
from support.patience import wait

Change = Callable[[bytes, bytes], bytes]


class Odd(GrblEmulator):
    """A homed controller that does not hear some bytes and whose answers are rewritten."""

    def __init__(self) -> None:
        self.clock = Clock()
        super().__init__(clock=self.clock, homed=True)
        self.deaf_to = b""
        self.heard = b""
        self.change: Change = lambda _, sent: sent

    def _exchange(self, received: bytes) -> bytes:
        self.heard += received
        passed = received.translate(None, self.deaf_to)
        return self.change(received, super()._exchange(passed))

    def stands(self) -> bool:
        before = self.position_m()
        time.sleep(0.03)
        return self.position_m() == before


@pytest.fixture
def odd() -> Iterator[Odd]:
    emulator = Odd()
    emulator.start()
    yield emulator
    emulator.close()


@pytest.fixture
def stage(odd: Odd) -> Iterator[GrblStage]:
    driver = GrblStage(odd.port)
    driver.open()
    yield driver
    driver.close()


def under_way(odd: Odd, stage: GrblStage, x_m: float) -> Mover:
    """A move that the carriage has begun."""
    start = odd.position_m()
    mover = Mover(stage, x_m, 0.0, 0.0)
    wait(lambda: odd.position_m() != start, "the stage")
    return mover


def test_words_are_apart_and_jogs_relative(odd: Odd, stage: GrblStage) -> None:
    """As in the examples of GRBL's documents; simple simulators understand nothing else."""
    stage.move_to(0.001, 0.0, 0.0)
    stage.jog_by(0.0005, 0.0, -0.00025, speed_m_s=0.01)
    assert b"G0 G53 G21 G90 G94 X-24.0000 Y-25.0000 Z-10.0000\n" in odd.heard
    assert b"$J=G91 G21 X0.5000 Y0.0000 Z-0.2500 F600.0\n" in odd.heard
    wait(lambda: stage.state().kind == "idle", "the stage")
    assert stage.position_m() == pytest.approx((0.0015, 0.0, -0.00025), abs=1e-6)


def test_a_jog_that_begins_late_is_moving_when_the_call_returns(odd: Odd, stage: GrblStage) -> None:
    before = b"<Idle|MPos:-25.000,-25.000,-10.000|FS:0,0>"
    lies: list[bytes] = []

    def late(received: bytes, sent: bytes) -> bytes:
        if b"$J" in received:
            lies.append(before)
        if lies and b"<" in sent:
            return re.sub(rb"<[^>]*>", lies.pop(), sent)
        return sent

    odd.change = late
    odd.clock.run_at(0.1)
    stage.jog_by(0.01, 0.0, 0.0, speed_m_s=0.01)
    assert not lies
    assert stage.state().kind == "moving"
    stage.stop()


@pytest.mark.parametrize("state", [b"Hold", b"Hold:0"])
def test_a_hold_is_believed_when_the_stage_rests(odd: Odd, stage: GrblStage, state: bytes) -> None:
    """A controller that says Hold and moves on, to the end of the move."""
    odd.deaf_to = b"!"
    odd.clock.run_at(1.0)
    mover = under_way(odd, stage, 0.002)  # over before it is told to be deaf
    odd.change = lambda _, sent: sent.replace(b"<Run", b"<" + state)
    stage.hold()
    assert odd.stands()
    assert mover.ended() is None


@pytest.mark.parametrize("silent", [False, True])
def test_a_stop_that_is_not_heard_ends_in_a_reset(odd: Odd, stage: GrblStage, silent: bool) -> None:
    odd.clock.run_at(0.1)
    odd.deaf_to = b"!\x85"
    if silent:  # says nothing of the lost position
        odd.change = lambda _, sent: re.sub(rb"ALARM:3\r\n|\[MSG[^\r]*\r\n", b"", sent)
    mover = under_way(odd, stage, 0.024)
    with pytest.raises(DeviceError, match="the position is lost"):
        stage.stop()
    assert odd.stands()
    assert odd.position_m()[0] < 0.024
    assert mover.ended() is not None
    state = stage.state()
    assert (state.kind, state.referenced) == ("alarm", False)
    with pytest.raises(DeviceRefused, match="position is lost"):
        stage.move_to(0.0, 0.0, 0.0)
    stage.clear()
    assert stage.state().kind == "idle"


def test_a_jog_is_held_where_its_cancel_is_not_known(odd: Odd, stage: GrblStage) -> None:
    odd.clock.run_at(0.1)
    odd.deaf_to = b"\x85"
    stage.jog_by(0.024, 0.0, 0.0, speed_m_s=0.02)
    stage.stop()
    assert odd.stands()
    assert odd.position_m()[0] < 0.024
    assert stage.state().kind == "idle"
    assert odd.heard.index(b"\x85") < odd.heard.index(b"!")


def test_stopped_after_the_dwell_was_answered(odd: Odd, stage: GrblStage) -> None:
    """An ``ok`` that comes too early leaves the end of the move to the reports."""
    odd.deaf_to = b"P"  # "G4 0.01", which is refused instead of waiting
    odd.change = lambda _, sent: re.sub(rb"error:\d+", b"ok", sent)
    odd.clock.run_at(0.1)
    mover = under_way(odd, stage, 0.024)
    wait(lambda: b"G4 P" in odd.heard, "the stage")
    stage.stop()
    assert stage.state().kind == "idle"
    assert "the controller was stopped" in str(mover.ended())
    assert odd.stands()


def test_an_alarm_without_its_line(odd: Odd, stage: GrblStage) -> None:
    stage.home()
    assert stage.state().referenced
    odd.clock.run_at(0.1)
    odd.change = lambda _, sent: re.sub(rb"ALARM:\d\r\n", b"", sent)
    mover = under_way(odd, stage, 0.02)
    # the dwell has been read, else it is refused
    wait(lambda: odd.heard.rfind(b"?") > odd.heard.find(b"G4 P0.01\n") >= 0, "the stage")
    odd.alarm(3)
    assert "did not say why" in str(mover.ended())
    state = stage.state()
    assert (state.kind, state.referenced) == ("alarm", False)
    stage.clear()
    assert (stage.state().kind, stage.state().referenced) == ("idle", False)


@pytest.mark.parametrize("refused", ["$J=G53 X1 F100", "$SLIP", "G5"])
def test_grblhal_is_made_to_listen_again_after_a_refusal(odd: Odd, refused: str) -> None:
    """grblHAL (protocol.c): no G-code is read after an error before a ``$`` line is accepted."""
    error = b""

    def grblhal(received: bytes, sent: bytes) -> bytes:
        nonlocal error
        if error and received.startswith(b"G"):
            return error
        if sent.startswith(b"error"):
            error = sent
        elif sent.endswith(b"ok\r\n"):
            error = b""
        return sent.replace(b"Grbl 1.1h ['$'", b"GrblHAL 1.1f ['$' or '$HELP'")

    odd.change = grblhal
    stage = GrblStage(odd.port)
    stage.open()
    with pytest.raises(DeviceRefused, match="error:"):
        stage.command(refused)
    stage.move_to(0.001, 0.0, 0.0)
    assert odd.position_m()[0] == pytest.approx(0.001, abs=1e-9)
    stage.close()


def test_a_controller_that_stops_half_way_is_pushed(odd: Odd, stage: GrblStage) -> None:
    """grbl-sim short of processor time: idle in the middle of a move, until a cycle start."""
    odd.clock.run_at(1.0)
    stalled = False

    def stall(received: bytes, sent: bytes) -> bytes:
        nonlocal stalled
        if stalled and b"~" in received:
            stalled = False
        if b"~" not in odd.heard and not stalled and odd.position_m()[0] > 0.002:
            stalled = True
            odd.firmware.receive(b"!", odd.clock())
        return sent.replace(b"<Hold:0", b"<Idle") if stalled else sent

    odd.change = stall
    stage.move_to(0.02, 0.0, 0.0)
    assert b"~" in odd.heard
    assert odd.position_m()[0] == pytest.approx(0.02, abs=1e-9)


def test_the_banner_of_a_repeated_reset_is_no_power_cycle(odd: Odd, stage: GrblStage) -> None:
    """Every reset is answered when the next byte arrives, so the first is repeated."""
    late: list[bytes] = []

    def delayed(_: bytes, sent: bytes) -> bytes:
        if b"Grbl" not in sent:
            return sent
        late.append(sent)
        return b"" if len(late) == 1 else late[0] + sent

    odd.change = delayed
    odd.alarm(2)
    wait(lambda: stage.state().kind == "alarm", "the stage")
    stage.clear()
    assert odd.heard.count(b"\x18") > 1
    assert stage.state().kind == "idle"
    odd.change = lambda _, sent: sent
    stage.move_to(0.001, 0.0, 0.0)


def test_a_place_that_jitters_is_not_waited_for(odd: Odd, stage: GrblStage) -> None:
    """The counter goes to and fro beside the target: no nearer, so it is not there."""
    places = [b"-20.000", b"-20.050"]

    def jitter(_: bytes, sent: bytes) -> bytes:
        if b"<" in sent:
            places.reverse()
        return re.sub(rb"(<\w+\|MPos:)[^,]*", rb"\g<1>" + places[0], sent)

    odd.change = jitter
    with pytest.raises(DeviceError, match="stands at MPos"):
        stage.move_to(0.001, 0.0, 0.0)


def test_a_report_is_not_newer_than_its_question(odd: Odd) -> None:
    """Also where two questions are out: the second report answers the second one."""
    odd.change = lambda _, sent: b""
    talk = GrblConversation(odd.port, 115200, 1.0)
    try:
        times = [time.time_ns()]
        for _ in range(2):
            talk.write(b"?")
            times.append(time.time_ns())
        for first, last in ((times[0], times[1]), (times[1], times[2])):
            talk._on_line("<Idle|MPos:0.000,0.000,0.000|FS:0,0>")
            assert first <= talk.measured_ns <= last
    finally:
        talk.close()


@pytest.mark.parametrize(
    ("state", "halted", "braking"),
    [
        ("Hold:0", True, False),
        ("Hold:1", False, True),
        ("Hold", True, False),
        ("Door:0", True, False),
        ("Door:1", True, False),
        ("Door:2", False, True),
        ("Door:3", False, True),
        ("Run", False, False),
        ("Idle", False, False),
    ],
)
def test_what_a_hold_and_a_door_say(state: str, halted: bool, braking: bool) -> None:
    """interface.md: Hold 0 complete, 1 in progress; Door 0 closed, 1 stopped and ajar, 2 hold or
    retract in progress, 3 resuming."""
    report = parse_report(f"<{state}|MPos:0.000,0.000,0.000|FS:0,0>")
    assert (report.is_halted, report.is_braking) == (halted, braking)


def test_grblhal_may_count_from_the_switch() -> None:
    """``$22`` bit 3: the switch is zero, and ``$23`` says on which side the travel lies."""
    settings = {22: 9, 23: 0b101, 130: 50.0, 131: 40.0, 132: 20.0}
    frame = machine_frame(settings, None, (1, 1, 1))
    assert (frame.low_mm, frame.high_mm) == ((0.0, -40.0, 0.0), (50.0, 0.0, 20.0))
    assert frame.origin_mm == (25.0, -20.0, 10.0)
    assert machine_frame(settings | {22: 1}, None, (1, 1, 1)).low_mm == (-50.0, -40.0, -20.0)
