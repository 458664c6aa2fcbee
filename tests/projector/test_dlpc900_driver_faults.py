"""Faults of the device and its bus: named, or survived, and the next scan is right."""

import threading
import time

import numpy as np
import pytest

from sl_common.clock import SystemClock
from sl_common.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout
from sl_projector.dlpc.dlpc900_port import Dlpc900Port
from sl_projector.dlpc.dmd import Timing
from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence, named
from support.devices.dlpc900_bench import FAST, START, Bench, open_bench


@pytest.fixture
def bench():
    yield from open_bench()


def assert_next_scan_is_right(bench):
    sequence = named("paper")
    bench.run_and_wait(sequence)
    bench.assert_shown(sequence)


@pytest.mark.parametrize("fault", ["lose_replies", "late_replies", "stale_replies", "stalls"])
def test_single_fault_of_the_bus_is_not_noticed(bench, fault):
    bench.faults.late_s = 1.5 * bench.settings.reply_timeout_s
    for _ in range(3):
        setattr(bench.faults, fault, 1)
        bench.driver.status()
    for sequence in (named("paper"), named("paper-rows")):
        setattr(bench.faults, fault, 1)
        bench.run_and_wait(sequence)
        bench.assert_shown(sequence)


def test_image_that_did_not_arrive_is_loaded_anew(bench):
    bench.driver.load(named("paper"), FAST)
    bench.emulator._memory.clear()
    with pytest.raises(DeviceRefused, match="error 7"):
        bench.driver.run()
    assert_next_scan_is_right(bench)


def test_short_reply_is_asked_for_again(bench):
    bench.faults.short_replies = 1
    assert bench.driver.status().ok
    assert_next_scan_is_right(bench)


def test_reply_without_data_is_asked_for_again(bench):
    bench.faults.empty_replies = 5
    assert bench.driver.status().ok
    bench.faults.empty_replies = 100
    with pytest.raises(DeviceError, match="with 0 bytes; expected at least 1"):
        bench.driver.status()
    bench.faults.empty_replies = 0
    assert_next_scan_is_right(bench)


@pytest.mark.parametrize("fault", ["lose_replies", "short_replies"])
def test_silent_device_times_out_and_the_next_open_mends_it(bench, fault):
    setattr(bench.faults, fault, 2)
    with pytest.raises(DeviceTimeout, match=r"did not|no answer"):
        bench.driver.load(named("paper"), FAST)
    bench.driver.open()
    assert_next_scan_is_right(bench)


def test_lost_reply_to_start_is_not_answered_by_a_second_start(bench):
    bench.driver.load(named("paper"), FAST)
    real = bench.emulator.receive

    def lose_start(report):
        answer = real(report)
        return [] if report[4:7] == bytes([0x24, 0x1A, 2]) else answer

    bench.emulator.receive = lose_start
    bench.recorder.reports.clear()
    with pytest.raises(DeviceTimeout):
        bench.driver.run()
    starts = [data for _, c, data in bench.recorder.messages() if c == START]
    assert starts.count(b"\x02") == 1
    bench.emulator.receive = real
    bench.driver.open()
    assert_next_scan_is_right(bench)


def test_refused_command_says_why_and_the_next_load_works(bench):
    bench.faults.refuse, bench.faults.refuse_code = 1, 8
    with pytest.raises(DeviceRefused, match=r"error 8, out of memory: .*refused on request"):
        bench.driver.load(named("paper"), FAST)
    assert_next_scan_is_right(bench)


class Queue:
    """A transport that keeps every report until it is read, as an operating system's may."""

    def __init__(self, device):
        self._device, self._reports = device, []

    def write(self, report, timeout_s):
        self._reports += self._device.receive(report)

    def read(self, timeout_s):
        if not self._reports:
            raise DeviceTimeout("nothing came")
        return self._reports.pop(0)


def test_letters_of_a_long_error_text_are_not_taken_for_an_answer(bench):
    """The text (0x0101) has 128 bytes, three reports; the second's second byte is a letter here."""
    bench.emulator._fail = lambda *_: setattr(bench.emulator, "_error_text", "A" * 127)
    bench.faults.refuse = 1
    port = Dlpc900Port(Queue(bench.emulator))
    port._sequence = ord("A") - 4  # refused, error code, text: then comes number 65, an A
    with pytest.raises(DeviceRefused, match="A" * 60):
        port.write(0x1A24, b"\0")
    assert port.read(0x1A0C) == b"\0"


def test_refused_image_data_is_found_though_it_has_no_reply(bench):
    # A chunk is not acknowledged: the error code read after it tells. The third one is refused.
    real = bench.emulator.receive

    chunks = iter([0, 0, 1])

    def refuse_data(report):
        if report[0] == 0 and report[4:6] == b"\x2b\x1a":
            bench.faults.refuse = next(chunks)
        return real(report)

    bench.emulator.receive = refuse_data
    with pytest.raises(DeviceRefused, match=r"error \d+, .*after loading image 0"):
        bench.driver.load(PatternSequence("s", (1024, 768), (Pattern("white"),) * 3), FAST)
    bench.emulator.receive, bench.faults.refuse = real, 0
    assert_next_scan_is_right(bench)


def test_permanent_stall_is_a_lost_device(bench):
    bench.faults.stalls = 2
    with pytest.raises(DeviceLost, match="stalled again"):
        bench.driver.status()
    bench.driver.open()
    assert_next_scan_is_right(bench)


def test_unplugged_device_is_lost_and_found_again(bench):
    bench.driver.load(named("paper"), FAST)
    bench.bus.unplug()
    with pytest.raises(DeviceLost, match="gone"):
        bench.driver.run()
    with pytest.raises(DeviceLost, match="no USB device 0451:c900"):
        bench.driver.open()
    bench.bus.plug_in()
    bench.driver.open()
    assert_next_scan_is_right(bench)


def test_unplugged_in_a_run(bench):
    bench.driver.load(named("paper"), FAST)
    bench.driver.run()
    bench.bus.unplug()
    with pytest.raises(DeviceLost):
        bench.driver.wait()
    bench.driver.close()


def test_power_cycle_is_a_lost_device_and_the_sequence_is_loaded_anew(bench):
    bench.driver.load(named("paper"), FAST)
    bench.bus.power_cycle()
    with pytest.raises(DeviceLost):
        bench.driver.run()
    bench.driver.open()
    assert bench.driver.load(named("paper"), FAST).uploaded
    assert_next_scan_is_right(bench)


def test_reset_without_leaving_the_bus_is_noticed(bench):
    bench.driver.load(named("paper"), FAST)
    bench.emulator.power_cycle()
    with pytest.raises(DeviceError, match=r"display mode is 1, expected 3.*load again"):
        bench.driver.run()
    assert_next_scan_is_right(bench)


def test_kernel_driver_is_detached(bench):
    bench.driver.close()
    bench.faults.kernel_driver = True
    bench.driver.open()
    assert not bench.faults.kernel_driver
    assert_next_scan_is_right(bench)


def test_device_taken_by_another_program(bench):
    bench.driver.close()
    bench.faults.taken = True
    with pytest.raises(DeviceLost, match="another program"):
        bench.driver.open()
    bench.faults.taken = False
    bench.driver.open()
    assert_next_scan_is_right(bench)


def test_two_drivers_cannot_have_the_device(bench):
    other = bench.make_driver()
    with pytest.raises(DeviceLost, match="another program"):
        other.open()
    bench.driver.close()
    other.open()
    other.close()


def test_sequencer_abort_is_reported(bench):
    bench.driver.load(named("paper"), FAST)
    bench.faults.abort_at = 4
    bench.driver.run()
    with pytest.raises(DeviceError, match="sequencer aborted"):
        bench.driver.wait()
    assert len(bench.edges) == 4
    assert_next_scan_is_right(bench)
    assert bench.driver.status().ok


def test_run_that_ends_early_without_an_abort_is_reported():
    bench = Bench(clock=SystemClock())
    bench.driver.open()
    bench.driver.load(named("paper"), Timing(0.5))
    bench.driver.run()
    bench.emulator.receive(bytes.fromhex("00 09 03 00 24 1A 00"))  # a stop from elsewhere
    with pytest.raises(DeviceError, match=r"ended after 0\.\d+ s; expected 5\.500 s"):
        bench.driver.wait()
    bench.driver.close()


class SlowStatusBench(Bench):
    """The run stands still until its status is asked for, and ends before that is answered."""

    def __init__(self):
        self.asked = threading.Event()
        super().__init__()
        self.recorder.receive = self.receive

    def _edge(self, mirrors, index, start_ns, exposure_s):
        assert self.asked.wait(10)
        super()._edge(mirrors, index, start_ns, exposure_s)

    def receive(self, report):
        if self.emulator.running:
            self.asked.set()
            while self.emulator.running:
                time.sleep(1e-3)
        return self.emulator.receive(report)


def test_run_that_ends_while_its_status_is_under_way_is_not_early():
    bench = SlowStatusBench()
    bench.driver.open()
    bench.run_and_wait(named("paper"), Timing(0.5))  # raises when the run seems too short
    assert len(bench.edges) == len(named("paper"))
    bench.driver.close()


def test_stop_from_another_thread_ends_a_wait():
    bench = Bench(clock=SystemClock())
    bench.driver.open()
    bench.driver.load(named("paper"), Timing(1.0))
    bench.driver.run()
    stopper = threading.Timer(0.05, bench.driver.stop)
    stopper.start()
    with pytest.raises(DeviceError, match="stopped before its end"):
        bench.driver.wait()
    stopper.join()
    bench.driver.close()


def test_trigger_edges_are_lost_and_doubled_on_request(bench):
    bench.faults.lost_edges, bench.faults.doubled_edges = {3}, {5}
    bench.run_and_wait(named("paper"))
    assert [index for _, index, _, _ in bench.edges] == [0, 1, 2, 4, 5, 5, 6, 7, 8, 9, 10]
    assert_next_scan_is_right(bench)


@pytest.mark.parametrize("seed", range(2))
def test_random_faults_end_in_a_right_scan_or_an_error(seed):
    rng = np.random.default_rng(seed)
    bench = Bench(reply_timeout_s=0.1)
    bench.faults.late_s = 0.15
    bench.driver.open()
    names = ["refuse", "lose_replies", "late_replies", "stale_replies", "short_replies", "stalls"]
    outcomes = set()
    for _ in range(15):
        name = names[rng.integers(len(names))]
        sequence = named(["paper", "paper-rows"][rng.integers(2)])
        real, fuse, times = bench.emulator.receive, [int(rng.integers(60))], int(rng.integers(1, 4))

        def receive(report, real=real, fuse=fuse, name=name, count=times):
            fuse[0] -= 1
            if fuse[0] == 0:
                setattr(bench.faults, name, count)
            return real(report)

        bench.emulator.receive = receive
        try:
            bench.run_and_wait(sequence)
        except DeviceError:
            outcomes.add("error")
            bench.emulator.receive = real
            for each in names:
                setattr(bench.faults, each, 0)
            bench.driver.open()
        else:
            outcomes.add("shown")
            bench.assert_shown(sequence)
        bench.emulator.receive = real
        for each in names:
            setattr(bench.faults, each, 0)
    assert outcomes == {"error", "shown"}
    bench.driver.open()
    assert_next_scan_is_right(bench)
    bench.driver.close()
