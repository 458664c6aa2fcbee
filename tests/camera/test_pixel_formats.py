"""Packed pixels, frame numbers and device clocks, against the standards' own layouts."""

from __future__ import annotations

import numpy as np
import pytest

from sl_camera.camera.camera import PIXEL_BITS, CameraSettings, Frame
from sl_camera.camera.device_clock import DeviceClock
from sl_camera.camera.frame_ids import GVSP_PERIOD, FrameIds
from sl_camera.camera.pixel_formats import BY_CODE, BY_NAME, CHOICES, unpack


def lsb_stream(values: list[int], bits: int) -> bytes:
    """PFNC 2.4, 6.1: one long number, the first pixel in its lowest bits, little endian."""
    number = sum(value << (i * bits) for i, value in enumerate(values))
    return number.to_bytes((len(values) * bits + 7) // 8, "little")


def test_twelve_bits_packed_as_the_standard_draws_them() -> None:
    # PFNC 2.4, figure of Mono12p: byte 0 is P0[7:0], byte 1 is P1[3:0] P0[11:8], byte 2 P1[11:4].
    data = bytes([0xBC, 0x3A, 0x12])
    assert unpack(data, BY_NAME["Mono12p"], 2, 1).tolist() == [[0xABC, 0x123]]
    # GigE Vision 2.0, figure of GVSP_PIX_MONO12_PACKED: P0[11:4], P1[3:0] P0[3:0], P1[11:4].
    data = bytes([0xAB, 0x3C, 0x12])
    assert unpack(data, BY_NAME["Mono12Packed"], 2, 1).tolist() == [[0xABC, 0x123]]
    # GVSP_PIX_MONO10_PACKED: P0[9:2], then P0[1:0] in bits 1:0 and P1[1:0] in bits 5:4, P1[9:2].
    data = bytes([0b10101010, 0b0011_0001, 0b00000111])
    assert unpack(data, BY_NAME["Mono10Packed"], 2, 1).tolist() == [[0b1010101001, 0b11111]]


@pytest.mark.parametrize(("name", "bits"), [("Mono10p", 10), ("Mono12p", 12)])
@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (8, 64)])
def test_packed_rows_run_on(name: str, bits: int, shape: tuple[int, int]) -> None:
    values = np.random.default_rng(4).integers(0, 1 << bits, shape)
    data = lsb_stream(values.ravel().tolist(), bits)
    height, width = shape
    assert len(data) == BY_NAME[name].size(width, height)
    image = unpack(data, BY_NAME[name], width, height)
    assert image.dtype == np.uint16
    assert np.array_equal(image, values)


def test_unpacked_pixels_are_not_copied_and_not_scaled() -> None:
    values = np.array([[0, 4095], [17, 1024]], "<u2")
    image = unpack(values.tobytes() + b"chunk data", BY_NAME["Mono12"], 2, 2)
    assert image.tolist() == values.tolist()
    assert image.base is not None
    assert unpack(bytes(range(6)), BY_NAME["Mono8"], 3, 2).tolist() == [[0, 1, 2], [3, 4, 5]]


def test_every_setting_has_a_format_of_its_depth() -> None:
    for setting, names in CHOICES.items():
        assert {BY_NAME[name].bits for name in names} == {PIXEL_BITS[setting]}
        CameraSettings(pixel_format=setting)
    # PFNC codes hold the bits on the wire in bits 16 to 23.
    assert all((code >> 16) & 0xFF == f.wire_bits for code, f in BY_CODE.items())


def test_a_frame_of_twelve_bits_is_full_at_4095() -> None:
    image = np.zeros((2, 2), np.uint16)
    assert Frame(image, 1, 0, 0.1, bits=12).full_scale_dn == 4095
    assert Frame(image, 1, 0, 0.1).full_scale_dn == 65535
    assert Frame(image.astype(np.uint8), 1, 0, 0.1).full_scale_dn == 255


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        ([65534, 65535, 1, 2], 0),
        ([65535, 2], 1),
        ([7, 7], 0),
        ([3, 5, 4], 0),  # late, not lost
        ([10, 20], 9),
        ([5, 1], 0),
    ],
)
def test_lost_frames_by_number(numbers: list[int], lost: int) -> None:
    ids = FrameIds(GVSP_PERIOD)
    for number in numbers:
        ids.take(number)
    assert ids.lost == lost


def test_numbering_may_begin_anywhere_after_arming() -> None:
    ids = FrameIds(GVSP_PERIOD)
    for number in (100, 102):
        ids.take(number)
    ids.start()
    for number in (1, 2):
        ids.take(number)
    assert ids.lost == 1


def test_a_latched_clock_is_right_to_half_its_reading() -> None:
    """Device clock = host clock - 5 s; the tightest reading took 20 us, the others more."""
    clock = DeviceClock()
    start = 10**18
    offset = 5_000_000_000
    readings = [
        (start, start + 900_000 - offset, start + 1_000_000),
        (start, start + 15_000 - offset, start + 20_000),
    ]
    clock.arrival(start - offset, start + 7_000_000, 0.004)
    clock.latch(readings)
    assert clock.latched
    assert abs(clock.host_ns(start - offset) - start) <= 10_000


def test_a_worse_reading_waits_until_the_clocks_may_have_drifted_as_far() -> None:
    """A reading of +-10 us, then ones of +-5 ms: at 100 ppm they are no worse after 50 s."""
    clock = DeviceClock()
    start, second = 10**18, 10**9
    clock.latch([(start, start + 10_000, start + 20_000)])
    later = start + 10 * second
    clock.latch([(later, later + 9_000_000, later + 10_000_000)])
    assert clock.host_ns(start) == start
    later = start + 60 * second
    clock.latch([(later, later + 9_000_000, later + 10_000_000)])
    assert clock.host_ns(start) == start - 4_000_000


def test_without_a_latch_the_least_delayed_arrival_counts() -> None:
    clock = DeviceClock()
    for delay_ms in (9, 6, 12):
        clock.arrival(1_000_000_000, 10**18 + delay_ms * 1_000_000, 0.004)
    assert clock.host_ns(1_000_000_000) == 10**18 + 2_000_000
    for _ in range(40):  # drift: the old minimum is forgotten
        clock.arrival(1_000_000_000, 10**18 + 8_000_000, 0.004)
    assert clock.host_ns(1_000_000_000) == 10**18 + 4_000_000
