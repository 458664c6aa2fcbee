"""The GRBL emulator against GRBL's documents, the driver's parsing, and the motion's formulas.

Expected values are from gnea/grbl 1.1h, ``doc/markdown/interface.md``, ``commands.md``,
``jogging.md``, ``settings.md``, and from transcripts of grbl-sim where those are silent.
"""

from __future__ import annotations

import math

import pytest

from sl_bench.stage.grbl_firmware import GrblFirmware
from sl_bench.stage.grbl_motion import Block, Braking, Ramp
from sl_camera.stage.grbl.grbl_protocol import (
    alarm_text,
    error_text,
    machine_frame,
    parse_report,
    parse_setting,
)
from sl_common.errors import DeviceRefused

TRAVEL = {130: 50.0, 131: 50.0, 132: 20.0}
BANNER = "Grbl 1.1h ['$' for help]"
LOCKED = "[MSG:'$H'|'$X' to unlock]"


class Host:
    """A host with its own clock."""

    def __init__(self, *, homed: bool = True, settings: dict[int, float] | None = None) -> None:
        self.now = 0.0
        self.grbl = GrblFirmware(settings, homed=homed)
        self.greeting = self.lines()

    def lines(self) -> list[str]:
        raw = self.grbl.take_output().decode()
        assert not raw or raw.endswith("\r\n")
        return [line for line in raw.split("\r\n") if line]

    def send(self, data: str | bytes) -> list[str]:
        raw = data if isinstance(data, bytes) else data.encode("latin-1")
        self.grbl.receive(raw, self.now)
        return self.lines()

    def wait(self, seconds: float) -> list[str]:
        self.now += seconds
        self.grbl.advance(self.now)
        return self.lines()

    def status(self) -> dict[str, str]:
        (line,) = self.send("?")
        state, *fields = line.strip("<>").split("|")
        return {"state": state} | dict(field.split(":", 1) for field in fields)


def test_greets_with_the_documented_banner() -> None:
    assert Host(homed=True).greeting == [BANNER]
    assert Host(homed=False).greeting == [BANNER, LOCKED]


def test_settings_are_printed_as_documented() -> None:
    lines = Host().send("$$\n")
    assert lines[-1] == "ok"
    assert "$110=1500.000" in lines
    assert "$22=1" in lines
    assert [int(line[1:].split("=")[0]) for line in lines[:-1]] == [
        *(0, 1, 2, 3, 4, 5, 6, 10, 11, 12, 13, 20, 21, 22, 23, 24, 25, 26, 27, 30, 31, 32),
        *(100, 101, 102, 110, 111, 112, 120, 121, 122, 130, 131, 132),
    ]


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("", "ok"),
        ("(comment) ; more", "ok"),
        ("g0 x-10 (lower case and a comment)", "ok"),
        ("G1X-10", "error:22"),
        ("G1X-10F100", "ok"),
        ("X-", "error:2"),
        ("X-1-", "error:1"),
        ("12", "error:1"),
        ("GX1", "error:2"),
        ("$foo", "error:3"),
        ("$99=1", "error:3"),
        ("$110=-1", "error:4"),
        ("$0=2", "error:6"),
        ("G5X1", "error:20"),
        ("G0G1X-10F10", "error:21"),
        ("G90G91", "error:21"),
        ("X-10X-11", "error:25"),
        ("G92", "error:26"),
        ("G4", "error:28"),
        ("G10L2P9X0", "error:29"),
        ("G80X-10", "error:31"),
        ("G0X-10P2", "error:36"),
        ("G1X-10F-5", "error:4"),
        ("$J=X-10", "error:22"),
        ("$JX-10", "error:16"),
        ("$J=G0X-10F10", "error:16"),
        ("$J=G53X-51F10", "error:15"),
        ("G0X-" + "0" * 75 + "10", "error:11"),  # 80 characters without the line end
        ("G0X-" + "0" * 73 + "10", "ok"),
    ],
)
def test_answers_every_line_once_as_documented(line: str, answer: str) -> None:
    assert Host().send(line + "\n") == [answer]


def test_carriage_return_is_a_line_end_too() -> None:
    assert Host().send("G21\r\n") == ["ok", "ok"]


def test_soft_limits_need_homing() -> None:
    host = Host(settings={22: 0, 20: 0})
    assert host.send("$20=1\n") == ["error:10"]
    assert host.send("$H\n") == ["error:5"]


def test_locked_controller_refuses_motion_until_unlocked() -> None:
    host = Host(homed=False)
    assert host.status()["state"] == "Alarm"
    assert host.send("G0X-1\n") == ["error:9"]
    assert host.send("$J=X-1F10\n") == ["error:8"]
    assert host.send("$X\n") == ["[MSG:Caution: Unlocked]", "ok"]
    assert host.status()["state"] == "Idle"


def test_report_fields_come_in_their_cadence() -> None:
    """WCO in the first report and every tenth when idle, Ov in the one after it."""
    host = Host()
    reports = [host.status() for _ in range(21)]
    assert [i for i, report in enumerate(reports) if "WCO" in report] == [0, 10, 20]
    assert [i for i, report in enumerate(reports) if "Ov" in report] == [1, 11]
    assert reports[0]["MPos"] == "-25.000,-25.000,-10.000"
    assert reports[1]["Ov"] == "100,100,100"


def test_work_position_is_machine_position_less_offset() -> None:
    host = Host(settings={10: 0})
    host.send("G10L20P1X0Y0Z0\n")
    report = host.status()
    assert report["WPos"] == "0.000,0.000,0.000"
    assert report["WCO"] == "-25.000,-25.000,-10.000"


def test_buffer_state_is_reported_where_asked_for() -> None:
    assert Host(settings={10: 3}).status()["Bf"] == "15,128"


def test_homing_ends_at_the_pull_off_in_negative_space() -> None:
    host = Host(homed=False)
    assert host.send("$H\n") == []
    assert host.send("?") == []  # an AVR answers no status while it homes
    lines = host.wait(60.0)
    assert lines[-1] == "ok"
    assert host.status()["MPos"] == "-1.000,-1.000,-1.000"
    assert host.grbl.carriage_mm(host.now) == pytest.approx((-1.0, -1.0, -1.0))


def test_homing_direction_can_be_inverted() -> None:
    host = Host(homed=False, settings={23: 4})
    host.send("$H\n")
    host.wait(60.0)
    assert host.status()["MPos"] == "-1.000,-1.000,-19.000"


def test_homing_takes_the_time_of_its_legs() -> None:
    """Z from -10: seek 10 mm at 15 mm/s, off 1, locate 1 mm at 2 mm/s, off 1; then X and Y 25."""
    z_s = 10 / 15 + 1 / 15 + 1 / 2 + 1 / 15 + 4 * 0.025
    xy_s = 25 / 15 + 1 / 15 + 1 / 2 + 1 / 15 + 4 * 0.025
    host = Host(homed=False)
    host.send("$H\n")
    assert host.wait(z_s + xy_s - 0.001) == []
    assert host.wait(0.002) == ["ok"]


def test_homing_without_switch_is_alarm_9() -> None:
    host = Host(homed=False)
    host.grbl.axes.dead_switches = frozenset({2})
    host.send("$H\n")
    lines = host.wait(60.0)
    assert lines[0] == "ALARM:9"
    assert lines[-2:] == [BANNER, LOCKED]


def test_reset_while_homing_is_alarm_6() -> None:
    host = Host(homed=False)
    host.send("$H\n")
    host.wait(0.5)
    lines = host.send(b"\x18")
    assert lines[0] == "ALARM:6"
    assert lines[-2:] == [BANNER, LOCKED]


def test_motion_takes_the_time_of_its_trapezoid() -> None:
    """10 mm in x at 25 mm/s and 250 mm/s^2: length / speed + speed / acceleration."""
    host = Host()
    assert host.send("G53G0X-15\n") == ["ok"]
    assert host.send("G4P0.01\n") == []
    duration_s = 10 / 25 + 25 / 250
    assert host.wait(duration_s / 2) == []
    report = host.status()
    assert report["state"] == "Run"
    assert report["MPos"] == "-20.000,-25.000,-10.000"  # half-way by symmetry
    assert report["FS"] == "1500,0"
    assert host.wait(duration_s / 2 + 0.005) == []
    assert host.status()["state"] == "Idle"
    assert host.wait(0.02) == ["ok"]
    assert host.status()["MPos"] == "-15.000,-25.000,-10.000"


def test_a_millimetre_in_z_takes_less_than_half_a_second() -> None:
    host = Host()
    host.send("G53G0Z-9\n")
    host.wait(0.5)
    assert host.status()["state"] == "Idle"
    assert host.status()["MPos"] == "-25.000,-25.000,-9.000"


def test_hold_decelerates_and_resume_goes_on() -> None:
    host = Host()
    host.send("G53G0X-5\n")
    host.wait(0.3)  # past the ramp of 0.1 s, at 25 mm/s
    host.send("!")
    assert host.status()["state"] == "Hold:1"
    host.wait(0.11)
    report = host.status()
    assert report["state"] == "Hold:0"
    # ramp 1.25 mm, 0.2 s at 25 mm/s, and v^2 / 2a = 1.25 mm of braking
    assert report["MPos"] == "-17.500,-25.000,-10.000"
    assert host.send("G21\n") == []  # no line is read in hold
    assert host.send("~") == ["ok"]
    host.wait(2.0)
    assert host.status()["MPos"] == "-5.000,-25.000,-10.000"


def test_reset_after_hold_keeps_the_position() -> None:
    host = Host()
    host.send("G53G0X-5\n")
    host.wait(0.3)
    host.send("!")
    host.wait(0.2)
    assert host.send(b"\x18") == [BANNER]
    report = host.status()
    assert (report["state"], report["MPos"]) == ("Idle", "-17.500,-25.000,-10.000")


def test_reset_in_motion_is_alarm_3() -> None:
    host = Host()
    host.send("G53G0X-5\n")
    host.wait(0.3)
    assert host.send(b"\x18") == ["ALARM:3", BANNER, LOCKED]


def test_soft_limit_is_alarm_2_and_needs_a_reset() -> None:
    host = Host()
    assert host.send("G53G0X1\n") == ["ALARM:2", "[MSG:Reset to continue]"]
    assert host.send("?$X\n") == []
    lines = host.send(b"\x18")
    assert lines[-2:] == [BANNER, LOCKED]
    assert host.send("$X\n") == ["[MSG:Caution: Unlocked]", "ok"]
    assert host.status()["MPos"] == "-25.000,-25.000,-10.000"


def test_soft_limit_in_motion_halts_smoothly_first() -> None:
    host = Host()
    host.send("G53G0X-5\n")
    host.wait(0.3)
    assert host.send("G53G0X1\n") == []
    assert host.wait(0.09) == []
    assert host.wait(0.02) == ["ALARM:2", "[MSG:Reset to continue]"]
    host.send(b"\x18")
    assert host.status()["MPos"] == "-17.500,-25.000,-10.000"


def test_hard_limit_is_alarm_1() -> None:
    host = Host()
    host.send("G53G0X-5\n")
    host.wait(0.3)
    host.grbl.close_switch(0)
    assert host.lines() == ["ALARM:1", "[MSG:Reset to continue]"]
    host.wait(1.0)
    host.send(b"\x18")
    assert host.status()["Pn"] == "X"


def test_jog_leaves_the_modes_alone_and_can_be_cancelled() -> None:
    host = Host()
    assert host.send("$J=G91X10F600\n") == ["ok"]
    assert host.status()["state"] == "Jog"
    assert host.send("G0X-10\n") == ["error:9"]
    host.wait(0.5)
    host.send(b"\x85")
    host.wait(0.5)
    report = host.status()
    assert report["state"] == "Idle"
    # v = 10 mm/s, a = 250: ramp 0.2 mm in 0.04 s, 0.46 s at 10 mm/s, 0.2 mm of braking
    assert report["MPos"] == "-20.000,-25.000,-10.000"
    assert any("G90" in line and "G0 " in line for line in host.send("$G\n"))


def test_hold_cancels_a_jog() -> None:
    host = Host()
    host.send("$J=G91X10F600\n")
    host.wait(0.5)
    host.send("!")
    host.wait(0.5)
    assert host.status()["state"] == "Idle"


def test_planner_takes_fifteen_blocks_then_makes_the_host_wait() -> None:
    host = Host()
    answers = [host.send(f"G91G0X{1 if i % 2 else -1}\n") for i in range(15)]
    assert answers == [["ok"]] * 15
    assert host.send("G91G0X1\n") == []
    assert host.wait(0.2) == ["ok"]


def test_receive_buffer_holds_128_bytes() -> None:
    host = Host()
    host.send("G4P1\n")
    host.send("G21\n" * 40)  # 160 bytes, of which 32 lines fit
    lines = host.wait(1.1) + host.wait(0.1)
    assert lines == ["ok"] * 33


def test_feed_override_changes_the_next_block() -> None:
    host = Host()
    host.send(b"\x92\x92\x92\x92\x92")
    assert host.status()["WCO"]
    assert host.status()["Ov"] == "50,100,100"
    host.send("G1X-15F600\n")
    host.wait(0.5)
    assert host.status()["FS"] == "300,0"


def test_check_mode_parses_and_does_not_move() -> None:
    host = Host()
    assert host.send("$C\n") == ["[MSG:Enabled]", "ok"]
    assert host.send("G53G0X-5\n") == ["ok"]
    host.wait(2.0)
    report = host.status()
    assert (report["state"], report["MPos"]) == ("Check", "-25.000,-25.000,-10.000")


def test_power_cycle_forgets_the_position_but_not_the_carriage() -> None:
    host = Host()
    host.grbl.power_cycle()
    assert host.lines() == [BANNER, LOCKED]
    assert host.status()["MPos"] == "0.000,0.000,0.000"
    assert host.grbl.carriage_mm(host.now) == (-25.0, -25.0, -10.0)


@pytest.mark.parametrize(("length", "peak"), [(0.4, math.sqrt(0.4 * 250)), (10.0, 25.0)])
def test_ramp_follows_its_formulas(length: float, peak: float) -> None:
    ramp = Ramp(length, 25.0, 250.0)
    assert ramp.peak == pytest.approx(peak)
    step = ramp.duration / 1000
    assert ramp.at(0.0) == (0.0, 0.0)
    assert ramp.at(ramp.duration) == (length, 0.0)
    for i in range(1, 1000):
        t = i * step
        # the speed is the derivative of the distance: central difference, error of order a * step
        slope = (ramp.at(t + step / 2)[0] - ramp.at(t - step / 2)[0]) / step
        assert ramp.at(t)[1] == pytest.approx(slope, abs=250.0 * step)


def test_braking_takes_v_squared_over_two_a() -> None:
    assert Braking(10.0, 200.0).at(math.inf) == (pytest.approx(10.0**2 / 400.0), 0.0)


def test_the_slowest_axis_limits_a_diagonal() -> None:
    block = Block((0.0, 0.0, 0.0), (3.0, 0.0, 4.0), math.inf, is_jog=False)
    ramp = block.ramp(0.0, (25.0, 25.0, 15.0), (250.0, 250.0, 200.0))
    assert ramp.speed == pytest.approx(min(25.0 / 0.6, 15.0 / 0.8))
    assert ramp.acceleration == pytest.approx(min(250.0 / 0.6, 200.0 / 0.8))


# -- the driver's side ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "state", "substate", "position", "offset"),
    [
        # interface.md, and transcripts of grbl-sim and the grblHAL simulator
        ("<Idle|MPos:0.000,0.000,0.000|FS:0.0,0>", "Idle", 0, (0, 0, 0), None),
        ("<Hold:1|MPos:-0.456,0.000,0.000|FS:0,0|Pn:PXYZRHS>", "Hold", 1, (-0.456, 0, 0), None),
        (
            "<Idle|WPos:1.000,2.000,3.000|Bf:100,1023|FS:0,0|WCO:0.500,0.000,-1.000>",
            *("Idle", 0, (1, 2, 3), (0.5, 0, -1)),
        ),
        (
            "<Alarm:2|MPos:0.000,0.000,0.000,7.000|Bf:100,1023|FS:0,0|A:|TLR:0>",
            *("Alarm", 2, (0, 0, 0), None),
        ),
    ],
)
def test_reports_are_read(
    line: str, state: str, substate: int, position: tuple[float, ...], offset: object
) -> None:
    report = parse_report(line)
    assert (report.state, report.substate) == (state, substate)
    assert report.position == position
    assert report.offset == offset
    assert report.is_machine == ("MPos" in line)


@pytest.mark.parametrize(
    "line",
    [
        "<>",
        "<Idle>",
        "Idle|MPos:0,0,0",
        "<Idle|MPos:0,0>",
        "<Idle|MPos:a,b,c>",
        "<Id\ufffd|MPos:0,0,0",
    ],
)
def test_damaged_reports_are_refused(line: str) -> None:
    with pytest.raises(ValueError):
        parse_report(line)


def test_settings_are_read() -> None:
    assert parse_setting("$130=200.000") == (130, 200.0)
    assert parse_setting("$74=my network") is None  # grblHAL has texts
    assert parse_setting("$N0=G54") is None


def test_codes_are_put_into_words() -> None:
    assert "soft limits need homing" in error_text("error:10")
    assert "limit switch" in alarm_text(1)
    assert "not known" in error_text("error:99")


def test_machine_space_is_negative_and_zero_in_its_middle() -> None:
    frame = machine_frame(TRAVEL | {22: 1}, None, (1, 1, -1))
    assert frame.stage_m((0.0, -50.0, -20.0)) == pytest.approx((0.025, -0.025, 0.01))
    assert frame.machine_mm((0.025, 0.0, 0.01)) == pytest.approx((0.0, -25.0, -20.0))
    limits = frame.limits()
    assert limits.low_m == pytest.approx((-0.025, -0.025, -0.01))
    assert limits.high_m == pytest.approx((0.025, 0.025, 0.01))
    limits.require_inside((0.025, 0.0, 0.0))
    with pytest.raises(DeviceRefused, match=r"25\.001"):
        limits.require_inside((0.025001, 0.0, 0.0))


def test_without_homing_zero_is_where_it_was_switched_on() -> None:
    frame = machine_frame(TRAVEL | {22: 0}, None, (1, 1, 1))
    assert frame.stage_m((0.0, 0.0, 0.0)) == (0.0, 0.0, 0.0)
    assert frame.limits().high_m == pytest.approx((0.05, 0.05, 0.02))
