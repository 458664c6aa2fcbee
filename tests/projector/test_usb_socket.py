"""The emulated device lent to another process over a Unix socket."""

import os
import socket
import threading

import numpy as np
import pytest
import usb.core

from sl_bench.dlpc.usb_server import UsbSocketServer
from sl_common.errors import ConfigError, DeviceLost
from sl_projector.dlpc.dlpc900_driver import Dlpc900
from sl_projector.dlpc.dmd import Timing
from sl_projector.hid.usb_transport import open_usb
from sl_projector.sequence.pattern_sequence import named
from support.devices.dlpc900_bench import Bench

VENDOR, PRODUCT = 0x0451, 0xC900


@pytest.fixture
def bench(tmp_path):
    made = Bench()
    made.path = str(tmp_path / "dmd")
    made.server = UsbSocketServer(made.path, made.bus)
    yield made
    made.server.close()


def driver(bench):
    return Dlpc900(f"socket:{bench.path}", settings=bench.settings, clock=bench.clock)


def scan(bench, projector):
    bench.edges.clear()
    projector.load(named("paper"), Timing(1e-3))
    projector.run()
    projector.wait()
    for mirrors, index, _, _ in bench.edges:
        np.testing.assert_array_equal(mirrors, named("paper").frame(index) == 255)
    assert len(bench.edges) == 11


def test_scan_through_the_socket(bench):
    projector = driver(bench)
    projector.open()
    scan(bench, projector)
    projector.close()


def test_next_process_gets_the_device_when_the_first_ends(bench):
    for _ in range(3):
        projector = driver(bench)
        projector.open()
        scan(bench, projector)
        projector.close()


def test_second_process_is_told_that_the_device_is_taken(bench):
    first, second = driver(bench), driver(bench)
    first.open()
    with pytest.raises(DeviceLost, match="another program"):
        second.open()
    first.close()


def test_process_that_dies_gives_the_device_back(bench):
    first = driver(bench)
    first.open()
    for connection in list(bench.server.connections):
        connection.shutdown(socket.SHUT_RDWR)
    with pytest.raises(DeviceLost):
        first.status()
    deadline = threading.Event()
    while bench.bus.claimed:
        assert not deadline.wait(0.01)
    second = driver(bench)
    second.open()
    scan(bench, second)
    second.close()


def test_bench_that_ends_is_a_lost_device(bench):
    projector = driver(bench)
    projector.open()
    bench.server.close()
    with pytest.raises(DeviceLost):
        projector.status()
    with pytest.raises(DeviceLost, match="no USB device"):
        projector.open()
    bench.server = UsbSocketServer(bench.path, bench.bus)
    projector.open()
    scan(bench, projector)
    projector.close()


def test_nonsense_on_the_socket_harms_nobody(bench):
    for noise in (b"\xff" * 64, b"\x06\0\0\0" + b"\x63" * 6, b"\x01\0\0\0\x03", b"\0\0\0\0"):
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stranger:
            stranger.connect(bench.path)
            stranger.sendall(noise)
    projector = driver(bench)
    projector.open()
    scan(bench, projector)
    projector.close()


def test_nothing_is_leaked_by_opening_often(bench):
    projector = driver(bench)
    projector.open()
    projector.close()
    handles, threads = len(os.listdir("/proc/self/fd")), threading.active_count()  # noqa: PTH208
    for _ in range(20):
        projector.open()
    projector.close()
    settled = threading.Event()
    for _ in range(200):
        if threading.active_count() <= threads:
            break
        settled.wait(0.01)
    assert threading.active_count() <= threads
    assert len(os.listdir("/proc/self/fd")) <= handles  # noqa: PTH208


def test_device_is_chosen_by_its_serial_number(bench):
    transport = open_usb("usb:EMU0001", VENDOR, PRODUCT, backend=bench.find()._ctx.backend)
    transport.close()
    with pytest.raises(DeviceLost, match="at 'usb:OTHER'"):
        open_usb("usb:OTHER", VENDOR, PRODUCT, backend=bench.find()._ctx.backend)


@pytest.mark.parametrize("device", ["", "serial", "socket", "socket:", "hid:1"])
def test_device_strings_of_another_form_are_refused(device):
    with pytest.raises(ConfigError, match="expected 'usb', 'usb:SERIAL' or 'socket:PATH'"):
        open_usb(device, VENDOR, PRODUCT)


def test_foreign_program_finds_an_ordinary_hid_device(bench):
    device = bench.find()
    device.set_configuration()
    endpoints = device.get_active_configuration()[(0, 0)].endpoints()
    assert [(e.bEndpointAddress, e.bmAttributes, e.wMaxPacketSize) for e in endpoints] == [
        (0x01, 3, 64),
        (0x81, 3, 64),
    ]
    assert device.serial_number == "EMU0001"
    usb.util.claim_interface(device, 0)
    device.write(1, bytes.fromhex("C0 11 02 00 06 02"))
    assert bytes(device.read(0x81, 64))[:5] == bytes.fromhex("C0 11 21 00 05")
    with pytest.raises(usb.core.USBTimeoutError):
        device.read(0x81, 64, 10)
    usb.util.dispose_resources(device)
