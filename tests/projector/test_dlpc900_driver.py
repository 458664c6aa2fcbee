"""The DLPC900 driver against the emulated device, through the real pyusb."""

import dataclasses
import threading

import numpy as np
import pytest

from sl_common.clock import SystemClock
from sl_common.errors import ConfigError, DeviceError, DeviceLost, DeviceTimeout, SequenceError
from sl_projector.dlpc.dlpc900_driver import Dlpc900Settings
from sl_projector.dlpc.dmd import Timing, TriggerIn, TriggerOut, dmd_model
from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence, named
from support.devices.dlpc900_bench import FAST, START, Bench, open_bench
from support.patience import patience


@pytest.fixture
def bench():
    yield from open_bench()


# -- what is shown ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["paper", "precise", "precise-rows"])
def test_mirrors_are_the_sequences_frames(bench, name):
    sequence = named(name)
    bench.run_and_wait(sequence)
    bench.assert_shown(sequence)
    assert bench.emulator.errors == []


@pytest.mark.parametrize("model", ["DLP6500", "DLP9000", "DLP670S", "DLP500YX"])
def test_other_dmds_of_the_family_show_their_frames(model):
    bench = Bench(model)
    sequence = PatternSequence("few", dmd_model(model).size, named("precise-rows").patterns[::7])
    bench.driver.open()
    bench.run_and_wait(sequence)
    bench.assert_shown(sequence)
    bench.driver.close()


def test_400_patterns_and_1024_on_the_dlp5500(bench):
    # 1024 patterns of which 400 are distinct: equal ones share a plane.
    patterns = [Pattern("gray", "column", 0, 16, 1, shift % 400) for shift in range(1024)]
    sequence = PatternSequence("many", (1024, 768), tuple(patterns))
    bench.run_and_wait(sequence, Timing(83e-6))
    assert [index for _, index, _, _ in bench.edges] == list(range(1024))
    for mirrors, index, _, _ in bench.edges[::97]:
        np.testing.assert_array_equal(mirrors, sequence.frame(index) == 255)


def test_exposures_follow_each_other_without_drift():
    bench = Bench(clock=SystemClock())
    bench.driver.open()
    timing = Timing(exposure_s=1e-3, dark_s=200e-6)
    info = bench.run_and_wait(named("paper"), timing)
    starts = [start_ns for _, _, start_ns, _ in bench.edges]
    assert np.diff(starts).tolist() == [1_200_000] * 10
    assert bench.emulator.start_ns == starts
    assert {exposure_s for *_, exposure_s in bench.edges} == {1e-3}
    assert info.count == 11
    assert info.duration_s == pytest.approx(11 * 1.2e-3)
    assert abs(starts[0] - info.start_ns) <= info.start_uncertainty_ns + 1_000_000_000
    bench.driver.close()


def test_repeats_run_the_table_again(bench):
    info = bench.run_and_wait(named("paper"), repeats=3)
    assert info.count == len(bench.edges) == 33
    np.testing.assert_array_equal(bench.edges[12][0], bench.edges[1][0])


def test_endless_run_goes_on_until_stopped():
    bench = Bench(clock=SystemClock())
    bench.driver.open()
    enough = threading.Event()

    def edge(mirrors, index, start_ns, exposure_s):
        if index == 30:
            enough.set()

    bench.emulator.on_exposure = edge
    bench.driver.load(named("paper"), Timing(100e-6))
    assert bench.driver.run(repeats=0).count == 0
    assert enough.wait(10)
    assert bench.driver.status().running
    with pytest.raises(DeviceError, match="no finite run"):
        bench.driver.wait()
    with pytest.raises(DeviceError, match="is running"):
        bench.driver.run()
    bench.driver.stop()
    assert not bench.driver.status().running
    assert not bench.emulator.mirrors_now().any()
    bench.driver.close()


# -- what is sent ----------------------------------------------------------------------------


def test_commands_come_in_tis_order(bench):
    bench.recorder.reports.clear()
    bench.driver.load(named("precise"), FAST)
    bench.driver.run()
    commands = [c for flags, c, _ in bench.recorder.messages() if not flags & 0x80]
    order = list(dict.fromkeys(commands))
    assert order == [0x1A24, 0x1A1B, 0x1A34, 0x1A31, 0x1A2A, 0x1A2B]
    assert commands[-1] == START
    inits = [data[0] for _, c, data in bench.recorder.messages() if c == 0x1A2A]
    assert inits == [1, 0]


def test_image_data_asks_for_no_reply(bench):
    bench.recorder.reports.clear()
    bench.driver.load(named("precise"), FAST)
    flags = {c: f for f, c, _ in bench.recorder.messages()}
    assert flags[0x1A2B] == 0x00
    assert flags[0x1A34] == flags[0x1A2A] == 0x40


def test_the_status_thread_does_not_come_between_image_data_and_its_error(bench):
    bench.recorder.reports.clear()
    over = threading.Event()

    def ask():
        while not over.is_set():
            bench.driver.status()

    thread = threading.Thread(target=ask)
    thread.start()
    bench.driver.load(named("precise"), FAST)
    over.set()
    thread.join()
    commands = [command for _, command, _ in bench.recorder.messages()]
    after = {commands[i + 1] for i, command in enumerate(commands) if command == 0x1A2B}
    assert after == {0x0100}


def test_precise_is_uploaded_in_150_messages(bench):
    bench.recorder.reports.clear()
    info = bench.driver.load(named("precise"), FAST)
    assert info.messages == len(bench.recorder.messages()) <= 150


def test_loading_again_sends_nothing_and_starting_little(bench):
    bench.driver.load(named("precise"), FAST)
    bench.recorder.reports.clear()
    assert not bench.driver.load(named("precise"), FAST).uploaded
    assert bench.recorder.reports == []
    bench.driver.run(FAST)
    # At 1 ms a report each way, five messages are far inside the 60 ms that are allowed.
    assert len(bench.recorder.reports) <= 5


def test_another_timing_keeps_the_images(bench):
    bench.run_and_wait(named("paper"))
    bench.recorder.reports.clear()
    bench.run_and_wait(named("paper"), Timing(2e-3, 100e-6))
    assert 0x1A2A not in [c for _, c, _ in bench.recorder.messages()]
    bench.assert_shown(named("paper"))
    assert np.diff([start for _, _, start, _ in bench.edges]).tolist() == [2_100_000] * 10


def test_leds_and_triggers_are_set():
    bench = Bench(
        leds=2,
        trigger_out_1=TriggerOut(30e-6, 40e-6),
        trigger_out_2=TriggerOut(250e-6, -20e-6, inverted=True),
    )
    bench.driver.open()
    bench.driver.load(named("paper"), FAST)
    sent = {c: data for _, c, data in bench.recorder.messages()}
    assert sent[0x1A1D].hex(" ") == "00 1e 00 28 00"
    assert sent[0x1A1E].hex(" ") == "01 fa 00 ec ff"
    assert sent[0x1A34][5] >> 4 & 7 == 2
    bench.driver.run()
    bench.driver.wait()
    # The camera hangs on output 2: its edges come 250 us after the exposures begin.
    delays = {edge[2] - start for edge, start in zip(bench.edges, bench.emulator.start_ns)}  # noqa: B905
    assert delays == {250_000}
    bench.driver.close()


def test_external_trigger_advances_one_pattern_an_edge():
    bench = Bench(clock=SystemClock(), trigger_in=TriggerIn(delay_s=200e-6))
    bench.driver.open()
    sequence = named("paper")
    shown = threading.Semaphore(0)
    bench.emulator.on_exposure = lambda *exposure: (bench.edges.append(exposure), shown.release())
    bench.driver.load(sequence, FAST)
    bench.driver.run()
    for count in range(len(sequence)):
        assert len(bench.edges) == count
        edge_ns = bench.clock.now_ns()
        while not bench.emulator.trigger_in(edge_ns):
            edge_ns = bench.clock.now_ns()
        assert shown.acquire(timeout=patience(10.0))
        assert bench.edges[-1][2] == edge_ns + 200_000
    bench.driver.wait(timeout_s=patience(10.0))
    bench.assert_shown(sequence)
    bench.driver.close()


def test_external_trigger_of_the_first_pattern_only():
    """TI: a trigger is attached to its pattern, so one entry of the table may have it alone."""
    bench = Bench(clock=SystemClock(), trigger_in=TriggerIn(200e-6, first_only=True))
    bench.driver.open()
    sequence = named("paper")
    bench.driver.load(sequence, FAST)
    entries = [data for _, c, data in bench.recorder.messages() if c == 0x1A34]
    assert [data[5] >> 7 for data in entries] == [1] + [0] * (len(sequence) - 1)
    shown = threading.Semaphore(0)
    bench.emulator.on_exposure = lambda *exposure: (bench.edges.append(exposure), shown.release())
    bench.driver.run(repeats=2)
    edges_ns = []
    for _ in range(2):
        edge_ns = bench.clock.now_ns()
        while not bench.emulator.trigger_in(edge_ns):
            edge_ns = bench.clock.now_ns()
        edges_ns.append(edge_ns)
        for _ in sequence.patterns:  # one edge shows them all
            assert shown.acquire(timeout=patience(60.0))
    bench.driver.wait(timeout_s=patience(60.0))
    count = len(sequence)
    starts = [
        edge + 200_000 + i * FAST.exposure_us * 1000 for edge in edges_ns for i in range(count)
    ]
    assert [start_ns for _, _, start_ns, _ in bench.edges] == starts
    for mirrors, index, _, _ in bench.edges:
        np.testing.assert_array_equal(mirrors, sequence.frame(index % count) == 255)
    bench.driver.close()


def test_untriggered_wait_for_an_external_trigger_times_out():
    bench = Bench(clock=SystemClock(), trigger_in=TriggerIn())
    bench.driver.open()
    bench.driver.load(named("paper"), FAST)
    bench.driver.run()
    with pytest.raises(DeviceTimeout, match=r"did not end within 0\.050 s"):
        bench.driver.wait(timeout_s=0.05)
    assert not bench.emulator.running
    bench.driver.close()


# -- what is refused before anything is sent ---------------------------------------------------


@pytest.mark.parametrize(
    ("timing", "words"),
    [
        (Timing(82e-6), "exposure of 82 us; expected 83 to 16777215"),
        (Timing(17.0), "exposure of 17000000 us"),
        (Timing(1e-3, 50e-6), "dark time of 50 us; expected 0 or 83"),
    ],
)
def test_timing_out_of_range_is_refused_before_sending(bench, timing, words):
    bench.recorder.reports.clear()
    with pytest.raises(ConfigError, match=words):
        bench.driver.load(named("paper"), timing)
    assert bench.recorder.reports == []


def test_sequence_that_does_not_fit_is_refused_before_sending(bench):
    bench.recorder.reports.clear()
    with pytest.raises(SequenceError, match=r"DMD of \(64, 64\); expected \(1024, 768\)"):
        bench.driver.load(PatternSequence("s", (64, 64), (Pattern("white"),)))
    with pytest.raises(SequenceError, match="1025 patterns; expected at most 1024"):
        bench.driver.load(PatternSequence("s", (1024, 768), (Pattern("white"),) * 1025))
    stripes = tuple(Pattern("gray", "column", 0, 16, 1, shift) for shift in range(433))
    with pytest.raises(SequenceError, match="at most 18 images"):
        bench.driver.load(PatternSequence("s", (1024, 768), stripes))
    assert bench.recorder.reports == []


def test_settings_out_of_range_are_refused():
    with pytest.raises(ConfigError, match="leds=8"):
        Dlpc900Settings(leds=8)
    with pytest.raises(ConfigError, match=r"delay is 0\.021 s"):
        TriggerOut(rising_delay_s=0.021)
    with pytest.raises(ConfigError, match="inverted"):
        TriggerOut(0.0, 1e-6, inverted=True)
    with pytest.raises(ConfigError, match="trigger input delay"):
        Bench(trigger_in=TriggerIn(delay_s=50e-6))


def test_methods_say_when_the_device_is_not_open():
    driver = Bench().driver
    with pytest.raises(DeviceError, match="not open"):
        driver.load(named("paper"))
    with pytest.raises(DeviceError, match="not open"):
        driver.status()
    driver.stop()
    driver.close()


def test_connection_closed_by_another_thread_is_not_opened_again(bench):
    port = bench.driver._port
    bench.driver.close()
    with pytest.raises(DeviceLost, match="was closed"):
        port.read(0x0100)
    assert not bench.bus.claimed


def test_run_without_a_sequence_is_refused(bench):
    with pytest.raises(DeviceError, match="no sequence is loaded"):
        bench.driver.run()


# -- state -----------------------------------------------------------------------------------


def test_status_of_a_healthy_device(bench):
    status = bench.driver.status()
    assert status.ok
    assert (status.model, status.power, status.running) == ("DLP5500", "normal", False)


def test_status_complains_of_a_missing_secondary_controller():
    bench = Bench("DLP9000")
    bench.driver.open()
    # A DMD of two controllers whose second does not answer.
    bench.emulator.model = dataclasses.replace(bench.emulator.model, dual=False)
    assert bench.driver.status().problems == ("secondary controller missing",)
    with pytest.raises(
        DeviceError, match="after loading the sequence: secondary controller missing"
    ):
        bench.driver.load(named("paper", (2560, 1600)), FAST)
    bench.driver.close()


def test_device_of_another_model_is_refused():
    bench = Bench("DLP6500")
    with pytest.raises(DeviceError, match="has a DLP6500; expected DLP5500"):
        bench.make_driver("DLP5500").open()
    assert not bench.bus.claimed


def test_idle_and_standby_end_when_needed(bench):
    bench.driver.load(named("paper"), FAST)
    bench.driver.idle()
    assert bench.driver.status().power == "idle"
    bench.run_and_wait(named("paper"))
    bench.assert_shown(named("paper"))
    bench.driver.close()
    assert not bench.bus.claimed
    bench.driver.open()
    assert bench.driver.status().power == "normal"


def test_close_leaves_the_device_on_standby(bench):
    bench.driver.close()
    assert bench.emulator.receive(bytes.fromhex("C0 01 02 00 00 02"))[0][4] == 1
