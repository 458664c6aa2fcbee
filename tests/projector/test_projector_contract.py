"""What every projector driver promises (`ProjectorDriver`), on every driver.

On a real projector as well: ``pytest tests/test_projector_contract.py --hardware dlpc900=usb``
(or ``dlpc900=usb:SERIAL``; another DMD than the DLP5500 as ``dlpc900=usb@DLP6500``; a LightCrafter
4500 whose flash holds `paper` as ``dlpc900=usb@DLP4500``). It will flash.
"""

from contextlib import contextmanager

import pytest

from sl_bench.dlpc.dlpc350_emulator import IDENTITY, Dlpc350Emulator
from sl_bench.dlpc.usb_server import EmulatedUsb, UsbSocketServer
from sl_common.clock import SystemClock
from sl_common.errors import ConfigError, DeviceError, SequenceError
from sl_projector.dlpc.dlpc350_driver import Dlpc350, Dlpc350Settings
from sl_projector.dlpc.dlpc350_flash import write_flash_images
from sl_projector.dlpc.dlpc900_driver import Dlpc900
from sl_projector.dlpc.dmd import DEFAULT_MODEL, ProjectorDriver, Timing, dmd_model
from sl_projector.hid.usb_socket import LinkBackend
from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence, named
from support.devices.dlpc900_bench import Bench

TIMING = Timing(2e-3, 500e-6)
HARDWARE = "dlpc900="


@contextmanager
def emulated(tmp_path):
    bench = Bench(clock=SystemClock())
    yield bench.driver


@contextmanager
def in_another_process(tmp_path):
    bench = Bench(clock=SystemClock())
    server = UsbSocketServer(str(tmp_path / "usb"), bench.bus)
    yield Dlpc900(f"socket:{tmp_path / 'usb'}", settings=bench.settings)
    server.close()


@contextmanager
def lightcrafter(tmp_path):
    flash = (named("paper", dmd_model("DLP4500").size),)
    emulator = Dlpc350Emulator(write_flash_images(flash, tmp_path))
    bus = EmulatedUsb(emulator, IDENTITY)
    settings = Dlpc350Settings(reply_timeout_s=0.5, flash=flash)
    yield Dlpc350(settings=settings, backend=LinkBackend(bus.connect()))


@contextmanager
def real(address):
    device, _, model = address.partition("@")
    if model == "DLP4500":
        flash = (named("paper", dmd_model(model).size),)
        yield Dlpc350(device, Dlpc350Settings(flash=flash))
    else:
        yield Dlpc900(device, model or DEFAULT_MODEL)


KINDS = {"emulated": emulated, "socket": in_another_process, "dlpc350": lightcrafter}


def pytest_generate_tests(metafunc):
    asked = metafunc.config.getoption("--hardware")
    real_ones = [kind for kind in asked if kind.startswith(HARDWARE)]
    metafunc.parametrize("kind", ["emulated", "socket", "dlpc350", *real_ones])


@pytest.fixture
def driver(kind, tmp_path):
    if kind.startswith(HARDWARE):
        context = real(kind.removeprefix(HARDWARE))
    else:
        context = KINDS[kind](tmp_path)
    with context as made:
        made.open()
        yield made
        made.close()


@pytest.fixture
def sequence(driver):
    return named("paper", driver.model.size)


def test_has_every_method_of_the_protocol(driver):
    wanted = {name for name in vars(ProjectorDriver) if not name.startswith("_")}
    assert wanted <= set(dir(driver))
    assert {"open", "load", "run", "wait", "stop", "idle", "close", "status", "model"} == wanted


def test_open_device_is_well_and_dark(driver):
    status = driver.status()
    assert status.problems == ()
    assert not status.running


def test_opening_again_forgets_the_sequence(driver, sequence):
    driver.load(sequence, TIMING)
    driver.open()
    with pytest.raises(DeviceError):
        driver.run()
    assert driver.load(sequence, TIMING).uploaded


def test_run_lasts_as_long_as_it_says_and_can_be_repeated(driver, sequence):
    driver.load(sequence, TIMING)
    for repeats in (1, 2):
        info = driver.run(TIMING, repeats)
        assert info.count == repeats * len(sequence)
        # Whole microseconds: 2000 of exposure and 500 of dark time for each pattern.
        assert info.duration_s == pytest.approx(repeats * len(sequence) * 2.5e-3)
        driver.wait()
        assert not driver.status().running
        assert SystemClock().now_ns() >= info.start_ns + 0.9e9 * info.duration_s


def test_loading_again_uploads_nothing(driver, sequence):
    first = driver.load(sequence, TIMING)
    again = driver.load(PatternSequence("renamed", sequence.dmd_size, sequence.patterns), TIMING)
    assert (first.uploaded, again.uploaded) == (True, False)
    assert first.digest == again.digest
    other = PatternSequence("other", sequence.dmd_size, sequence.patterns[::-1])
    assert driver.load(other, TIMING).digest != first.digest


def test_run_in_a_run_is_refused(driver, sequence):
    driver.load(sequence, Timing(0.1))
    driver.run()
    assert driver.status().running
    with pytest.raises(DeviceError):
        driver.run()
    driver.stop()
    assert not driver.status().running


def test_endless_run_ends_at_stop_and_the_sequence_stays(driver, sequence):
    driver.load(sequence, TIMING)
    assert driver.run(repeats=0).count == 0
    driver.stop()
    driver.stop()
    assert not driver.load(sequence, TIMING).uploaded
    driver.run(repeats=1)
    driver.wait()


def test_what_does_not_fit_is_refused_and_harms_nothing(driver, sequence):
    driver.load(sequence, TIMING)
    with pytest.raises(ConfigError):
        driver.load(sequence, Timing(1e-6))
    with pytest.raises(ConfigError):
        driver.run(Timing(60.0))
    with pytest.raises(SequenceError):
        driver.load(PatternSequence("small", (8, 8), (Pattern("white"),)))
    driver.run()
    driver.wait()


def test_idle_mirrors_wake_for_a_run(driver, sequence):
    driver.load(sequence, TIMING)
    driver.idle()
    driver.idle()
    driver.run()
    driver.wait()


def test_closed_device_refuses_until_opened(driver, sequence):
    driver.close()
    driver.close()
    for method in (driver.status, driver.run, driver.wait, lambda: driver.load(sequence)):
        with pytest.raises(DeviceError):
            method()
    driver.stop()
    driver.open()
    driver.load(sequence, TIMING)
    driver.run()
    driver.wait()
