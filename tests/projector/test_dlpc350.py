"""The DLPC350 driver against TI's documented bytes and an emulator that shows its flash."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from sl_bench.dlpc.dlpc350_emulator import IDENTITY, Dlpc350Emulator
from sl_bench.dlpc.usb_server import EmulatedUsb
from sl_common.errors import (
    ConfigError,
    DeviceError,
    DeviceLost,
    DeviceRefused,
    DeviceTimeout,
    SequenceError,
)
from sl_projector.dlpc import dlpc350_protocol as protocol
from sl_projector.dlpc.dlpc350_driver import Dlpc350, Dlpc350Settings
from sl_projector.dlpc.dlpc350_flash import flash_layout, write_flash_images
from sl_projector.dlpc.dmd import Timing, TriggerIn, TriggerOut, dmd_model
from sl_projector.hid.usb_socket import LinkBackend
from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence, named
from support.devices.dlpc900_bench import Recorder, VirtualClock
from support.patience import wait

SIZE = dmd_model("DLP4500").size
TIMING = Timing(2e-3, 500e-6)


def sequence(name: str) -> PatternSequence:
    return named(name, SIZE)


@pytest.fixture(scope="module")
def flash(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """25 and 24 further patterns: three images, of which `precise` needs two."""
    sequences = (sequence("precise"), sequence("precise-rows"))
    return write_flash_images(sequences, tmp_path_factory.mktemp("flash"))


class Bench:
    """Emulator, bus and driver; what the camera would see in ``edges``."""

    def __init__(self, flash: list[Path], **settings: object) -> None:
        self.clock = VirtualClock()
        self.edges: list[tuple[np.ndarray, int, int, float]] = []
        self.emulator = Dlpc350Emulator(flash, self.clock, lambda *edge: self.edges.append(edge))
        self.recorder = Recorder(self.emulator)  # type: ignore[arg-type]
        self.bus = EmulatedUsb(self.recorder, IDENTITY)
        fields = {
            "reply_timeout_s": 0.2,
            "flash": (sequence("precise"), sequence("precise-rows")),
            **settings,
        }
        self.driver = Dlpc350(
            settings=Dlpc350Settings(**fields),  # type: ignore[arg-type]
            backend=LinkBackend(self.bus.connect()), clock=self.clock,
        )  # fmt: skip

    def sent(self, command: int) -> list[bytes]:
        return [data for _, sent, data in self.recorder.messages() if sent == command]


@pytest.fixture
def bench(flash: list[Path]) -> Iterator[Bench]:
    bench = Bench(flash)
    bench.driver.open()
    yield bench
    bench.driver.close()


# -- bytes ----------------------------------------------------------------------------------------


def test_pattern_word_has_its_fields_where_the_api_has_them() -> None:
    """TI's DLPC350 API: trigger 1:0, number 7:2, depth 11:8, LEDs 14:12, black 17, swap 18."""
    word = protocol.pattern_word(23, leds=5, swap=True, black=False)
    assert word & 3 == 0
    assert (word >> 2) & 0x3F == 23
    assert (word >> 8) & 0xF == 1
    assert (word >> 12) & 7 == 5
    assert word >> 16 == 0b100
    assert protocol.pattern_word(0, leds=7, swap=False, black=True) >> 16 == 0b010


def test_tables_are_packed_as_the_api_packs_them() -> None:
    entry = protocol.variable_entry(0x00047158, 1000, 1500)
    assert entry.hex() == "58710400e8030000dc050000"
    # Entries, patterns per TRIG_OUT_2 and images, each less one, then the repeat flag.
    assert protocol.variable_config(300, 12, True).hex() == "2b0100000b01"
    assert protocol.image_table([3]) == b"\x03"
    assert protocol.image_table([3, 4]) == b"\x04\x03"  # TI's API sends two the other way round
    assert protocol.image_table([3, 4, 5]) == b"\x03\x04\x05"


@pytest.mark.parametrize(("delay_s", "count"), [(0.0, 0xBB), (-20.05e-6, 0), (2.787e-6, 0xD5)])
def test_trigger_delays_count_in_107_ns(delay_s: float, count: int) -> None:
    assert protocol.delay_count(delay_s) == count


def test_trigger_delays_out_of_range_are_refused(flash: list[Path]) -> None:
    bench = Bench(flash, trigger_out_1=TriggerOut(10e-6))
    with pytest.raises(ConfigError, match="delay"):
        bench.driver.open()
    with pytest.raises(ConfigError, match="trigger input delay"):
        Dlpc350(settings=Dlpc350Settings(trigger_in=TriggerIn(-1e-6)))


# -- flash ----------------------------------------------------------------------------------------


def test_flash_images_hold_24_patterns_each_in_green_red_blue(flash: list[Path]) -> None:
    """Read by OpenCV: planes 0-7 are the bits of green, 8-15 of red, 16-23 of blue (TI DLPU010)."""
    patterns = [*sequence("precise").patterns]
    patterns += [p for p in sequence("precise-rows").patterns if p not in patterns]
    assert len(flash) == 3
    blue_green_red = [cv2.imread(str(file)) for file in flash]
    for i, pattern in enumerate(patterns):
        channel = (1, 2, 0)[i % 24 // 8]
        plane = blue_green_red[i // 24][:, :, channel] >> (i % 8) & 1
        assert np.array_equal(plane * 255, pattern.frame(SIZE)), f"pattern {i}"


def test_a_pattern_is_flashed_once_and_all_are_of_one_size() -> None:
    paper, precise = sequence("paper"), sequence("precise")
    layout = flash_layout((paper, precise, paper))
    assert len(layout) == len({*paper.patterns, *precise.patterns})
    assert [layout[p] for p in paper.patterns] == [(0, i) for i in range(11)]
    with pytest.raises(SequenceError, match="one size"):
        flash_layout((paper, named("paper", (1024, 768))))


def test_sequences_that_were_not_flashed_are_refused_before_anything_is_sent(bench: Bench) -> None:
    before = len(bench.recorder.reports)
    other = PatternSequence("other", SIZE, (Pattern("white"), Pattern("gray", bits=3)))
    with pytest.raises(SequenceError, match="1 of 2 patterns of 'other' are not in the flash"):
        bench.driver.load(other)
    assert len(bench.recorder.reports) == before


def test_a_flash_with_fewer_images_than_configured_is_told(flash: list[Path]) -> None:
    with pytest.raises(DeviceError, match="holds 2 images; expected at least 3"):
        Bench(flash[:2]).driver.open()


# -- showing --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "images"), [("precise", 2), ("precise-rows", 3)])
def test_the_mirrors_show_the_sequence(bench: Bench, name: str, images: int) -> None:
    shown = sequence(name)
    info = bench.driver.load(shown, TIMING)
    assert (info.uploaded, info.images) == (True, images)
    run = bench.driver.run()
    bench.driver.wait()
    assert len(bench.edges) == run.count == len(shown)
    for i, (mirrors, index, start_ns, exposure_s) in enumerate(bench.edges):
        assert np.array_equal(mirrors, shown.frame(i) > 0), f"pattern {i}"
        assert (index, exposure_s) == (i, pytest.approx(2e-3))
        assert start_ns - bench.edges[0][2] == i * 2_500_000
    assert bench.emulator.errors == []


def test_repeats_are_written_out_and_endless_runs_are_the_controllers(bench: Bench) -> None:
    paper = PatternSequence("some", SIZE, sequence("precise").patterns[:3])
    bench.driver.load(paper, TIMING)
    assert bench.driver.run(repeats=4).count == 12
    bench.driver.wait()
    assert [np.array_equal(e[0], paper.frame(i % 3) > 0) for i, e in enumerate(bench.edges)] == (
        [True] * 12
    )
    bench.driver.run(repeats=0)
    assert bench.driver.status().running
    bench.driver.stop()
    assert bench.sent(0x1A40)[-1][-1] == 1
    with pytest.raises(ConfigError, match="1824"):
        bench.driver.run(repeats=700)


def test_loading_goes_in_the_documented_order(bench: Bench) -> None:
    bench.recorder.reports.clear()
    bench.driver.load(sequence("precise"), TIMING)
    order = [command for flags, command, _ in bench.recorder.messages() if not flags & 0x80]
    first = [order.index(c) for c in (0x1A24, 0x1A1B, 0x1A22, 0x1A40, 0x1A23, 0x1A33, 0x1A1A)]
    assert first == sorted(first)
    assert bench.sent(0x1A34) == [b"\x01\x00"]
    assert [data[0] for data in bench.sent(0x1A33)] == [1, 0, 3, 0]
    assert len(bench.sent(0x1A3E)) == 25


def test_what_the_validation_finds_is_told(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    word = protocol.pattern_word
    monkeypatch.setattr(protocol, "pattern_word", lambda _plane, **kw: word(40, **kw))
    with pytest.raises(DeviceRefused, match="pattern number invalid"):
        bench.driver.load(sequence("precise"))
    monkeypatch.undo()
    with pytest.raises(DeviceError, match="no sequence"):
        bench.driver.run()
    assert bench.driver.load(sequence("precise")).uploaded


# -- external trigger -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("trigger", "kinds"),
    [
        # TI's API: 0 internal, 1 rising, 2 falling edge, 3 follows without a trigger of its own
        (TriggerIn(1e-3), [1, 1, 1, 1, 1, 1]),
        (TriggerIn(1e-3, falling_edge=True), [2, 2, 2, 2, 2, 2]),
        (TriggerIn(1e-3, first_only=True), [1, 3, 3, 1, 3, 3]),
    ],
)
def test_patterns_wait_for_the_trigger_input(
    flash: list[Path], trigger: TriggerIn, kinds: list[int]
) -> None:
    bench = Bench(flash, trigger_in=trigger)
    bench.driver.open()
    assert bench.sent(0x1A35) == [(9328).to_bytes(4, "little")]  # 1 ms in counts of 107.2 ns
    some = PatternSequence("some", SIZE, sequence("precise").patterns[:3])
    with pytest.raises(ConfigError, match="black before an external trigger"):
        bench.driver.load(some, Timing(2e-3))
    bench.driver.load(some, TIMING)
    bench.driver.run(repeats=2)
    words = [int.from_bytes(data[:4], "little") for data in bench.sent(0x1A3E)[-6:]]
    assert [word & 3 for word in words] == kinds
    assert all(word >> 17 & 1 for word in words)
    for shown, kind in enumerate(kinds):
        if kind in (1, 2):
            wait(lambda: bench.emulator.trigger_in(bench.clock.now_ns()), "the exposure", 60.0)
        wait(lambda wanted=shown + 1: len(bench.edges) >= wanted, "the exposure", 60.0)
    bench.driver.wait(timeout_s=1e6)
    assert [np.array_equal(e[0], some.frame(i % 3) > 0) for i, e in enumerate(bench.edges)] == (
        [True] * 6
    )
    bench.driver.close()


# -- faults ---------------------------------------------------------------------------------------


def run_anew(bench: Bench) -> None:
    """Open, load, show: the next scan is right."""
    bench.driver.open()
    bench.edges.clear()
    bench.driver.load(sequence("precise"), TIMING)
    bench.driver.run()
    bench.driver.wait(timeout_s=1e6)
    for i, (mirrors, index, _, _) in enumerate(bench.edges):
        assert index == i
        np.testing.assert_array_equal(mirrors, sequence("precise").frame(i) > 0)
    assert len(bench.edges) == 25


@pytest.mark.parametrize("fault", ["late_replies", "stale_replies", "short_replies", "stalls"])
def test_a_single_fault_of_the_bus_is_not_noticed(bench: Bench, fault: str) -> None:
    bench.emulator.faults.late_s = 0.3
    setattr(bench.emulator.faults, fault, 1)
    assert bench.driver.status().ok
    run_anew(bench)


@pytest.mark.parametrize(
    ("fault", "error"),
    [("late_replies", DeviceTimeout), ("short_replies", DeviceTimeout), ("stalls", DeviceLost)],
)
def test_a_lasting_fault_of_the_bus_is_told(
    bench: Bench, fault: str, error: type[DeviceError]
) -> None:
    bench.emulator.faults.late_s = 1e3
    setattr(bench.emulator.faults, fault, 1000)
    with pytest.raises(error):
        bench.driver.status()
    setattr(bench.emulator.faults, fault, 0)
    run_anew(bench)


def test_a_kernel_driver_is_detached_and_another_program_is_told(bench: Bench) -> None:
    bench.driver.close()
    bench.emulator.faults.kernel_driver = True
    bench.driver.open()
    bench.driver.close()
    bench.emulator.faults.taken = True
    with pytest.raises(DeviceLost, match="another program"):
        bench.driver.open()
    bench.emulator.faults.taken = False
    run_anew(bench)


def test_unplugged_in_a_run(bench: Bench) -> None:
    bench.driver.load(sequence("precise"), TIMING)
    bench.driver.run()
    bench.bus.unplug()
    with pytest.raises(DeviceLost):
        bench.driver.wait()
    bench.bus.plug_in()
    run_anew(bench)


def test_trigger_edges_are_lost_and_doubled_on_request(bench: Bench) -> None:
    bench.driver.load(sequence("precise"), TIMING)
    bench.emulator.faults.lost_edges = {1}
    bench.emulator.faults.doubled_edges = {3}
    bench.driver.run()
    bench.driver.wait(timeout_s=1e6)
    assert [index for _, index, _, _ in bench.edges] == [0, 2, 3, 3, *range(4, 25)]
    run_anew(bench)


def test_a_refused_command_is_named(bench: Bench) -> None:
    bench.emulator.faults.refuse = 1
    with pytest.raises(DeviceRefused, match="DLPC350 refused 0x1A24"):
        bench.driver.load(sequence("precise"))
    assert bench.driver.load(sequence("precise")).uploaded


def test_a_lost_reply_is_asked_for_again_and_silence_is_told(bench: Bench) -> None:
    bench.emulator.faults.lose_replies = 1
    assert bench.driver.status().ok
    bench.emulator.faults.lose_replies = 2
    with pytest.raises(DeviceTimeout, match="no answer in time"):
        bench.driver.status()


def test_an_aborted_run_is_told_and_the_next_one_is_whole(bench: Bench) -> None:
    bench.driver.load(sequence("precise"), TIMING)
    bench.emulator.faults.abort_at = 5
    bench.driver.run()
    with pytest.raises(DeviceError, match="DLPC350 after the run: sequencer aborted"):
        bench.driver.wait()
    bench.driver.open()
    bench.driver.load(sequence("precise"), TIMING)
    bench.driver.run()
    bench.driver.wait()


def test_a_power_cycle_or_an_unplugged_cable_needs_a_new_load(bench: Bench) -> None:
    bench.driver.load(sequence("precise"), TIMING)
    bench.emulator.power_cycle()
    with pytest.raises(DeviceError, match="load again"):
        bench.driver.run()
    bench.bus.unplug()
    with pytest.raises(DeviceLost):
        bench.driver.status()
    bench.bus.plug_in()
    bench.driver.open()
    bench.driver.load(sequence("precise"), TIMING)
    bench.driver.run()
    bench.driver.wait()
