"""The emulated DLPC900 against what TI's programmer's guide says of the device."""

import struct
import threading

import numpy as np
import pytest

from sl_bench.dlpc.dlpc900_emulator import Dlpc900Emulator
from support.devices.dlpc900_bench import VirtualClock

# Written out here, not taken from the driver: the header of one blank image of 1024x768 in
# enhanced RLE, whose rows are copies of the first.
BLACK = bytes.fromhex("80 08 000000") + bytes.fromhex("00 01 80 08") * 767 + b"\0\1\0"
WHITE = bytes.fromhex("80 08 FFFFFF") + bytes.fromhex("00 01 80 08") * 767 + b"\0\1\0"


def image(data, width=1024, height=768):
    return (
        b"Spld" + struct.pack("<HHI", width, height, len(data)) + b"\xff" * 8 + bytes(4)
        + bytes([1, 2, 1, 0, 0, 1]) + bytes(18) + data
    )  # fmt: skip


class Host:
    """A host program reduced to bytes."""

    def __init__(self, model="DLP5500", **options):
        self.edges = []
        options.setdefault("clock", VirtualClock())
        self.device = Dlpc900Emulator(
            model, on_exposure=lambda *edge: self.edges.append(edge), **options
        )

    def send(self, flags, command, data=b""):
        packet = struct.pack("<BBHH", flags, 0x5A, len(data) + 2, command) + data
        replies = []
        for at in range(0, len(packet), 64):
            replies += self.device.receive(packet[at : at + 64].ljust(64, b"\0"))
        return replies

    def write(self, command, *data):
        """Return the error code that a write ends with."""
        (reply,) = self.send(0x40, command, bytes(data))
        assert reply[1] == 0x5A
        code = self.read(0x0100)[0]
        assert bool(reply[0] & 0x20) == bool(code)
        return code

    def read(self, command):
        reply = self.send(0xC0, command)[0]
        length = int.from_bytes(reply[2:4], "little")
        return reply[4 : 4 + length]

    def define(self, index=0, exposure_us=1000, options=0x70, dark_us=0, flags=0, place=0):
        return self.write(
            0x1A34,
            *struct.pack("<H", index), *exposure_us.to_bytes(3, "little"), options,
            *dark_us.to_bytes(3, "little"), flags, *struct.pack("<H", place),
        )  # fmt: skip

    def upload(self, number, stream, init=0x1A2A):
        assert self.write(init, *struct.pack("<HI", number, len(stream))) == 0
        for at in range(0, len(stream), 504):
            part = stream[at : at + 504]
            assert self.send(0x00, init + 1, struct.pack("<H", len(part)) + part) == []
        return self.read(0x0100)[0]

    def finish(self):
        while self.device.running:
            threading.Event().wait(0.001)


@pytest.fixture
def host():
    made = Host()
    assert made.write(0x1A1B, 3) == 0
    return made


@pytest.mark.parametrize(
    ("entry", "code"),
    [
        ({}, 0),
        ({"exposure_us": 83}, 0),
        ({"exposure_us": 82}, 14),
        ({"exposure_us": 303, "options": 0x72}, 14),  # 2 bit: at least 304 us
        ({"exposure_us": 304, "options": 0x72}, 0),
        ({"dark_us": 82}, 12),
        ({"dark_us": 83}, 0),
        ({"place": 24 << 11}, 10),
        ({"place": 23 << 11}, 0),
        ({"place": 23 << 11, "options": 0x72, "exposure_us": 400}, 16),
        ({"index": 1023}, 0),
        ({"index": 1024}, 15),
        ({"place": 18}, 6),
        ({"place": 17}, 0),
    ],
)
def test_pattern_definition_limits(host, entry, code):
    assert host.define(**entry) == code


# TI's table of block loads: 1, 2, 4 and 15 blocks of a DLP5500, 8 of a DLP9000.
@pytest.mark.parametrize(
    ("model", "blocks", "least_us"),
    [
        ("DLP5500", 1, 25), ("DLP5500", 2, 30), ("DLP5500", 4, 28), ("DLP5500", 15, 83),
        ("DLP9000", 8, 61),
    ],
)  # fmt: skip
def test_fewer_active_blocks_allow_shorter_exposures_of_one_bit(model, blocks, least_us):
    host = Host(model)
    assert host.write(0x1A1B, 3) == 0
    assert host.write(0x1A40, 0, blocks) == 0
    assert host.define(exposure_us=least_us) == 0
    assert host.define(exposure_us=least_us - 1) == 14
    assert host.define(exposure_us=303, options=0x72) == 14  # two bits


def test_pattern_commands_need_a_pattern_mode(host):
    assert host.write(0x1A1B, 0) == 0
    assert host.define() == 5
    assert host.write(0x1A31, 1, 0, 0, 0, 0, 0) == 5
    assert host.write(0x1A2A, 0, 0, 100, 0, 0, 0) == 5
    assert host.write(0x1A24, 2) == 5
    assert host.write(0x1A1B, 4) == 6


def test_power_up_state():
    host = Host()
    assert host.read(0x1A1B) == b"\x01"
    assert host.read(0x1A07) == b"\x08"
    assert host.read(0x1A0A) == b"\x01"
    assert host.read(0x1A0B) == b"\x01"
    assert host.read(0x1A0C) == b"\x00"
    assert host.read(0x0206)[0] == 5
    assert struct.unpack("<HB", host.read(0x1A35)) == (105, 0)
    assert Host("DLP9000").read(0x1A0A) == b"\x11"


def test_error_is_latched_until_the_next_command(host):
    assert host.write(0x1A24, 7) == 6
    assert host.read(0x0100) == b"\x06"
    assert host.send(0xC0, 0x0101)[0][4:].startswith(b"0x1A24: Invalid command parameter\0")
    assert host.read(0x0100) == b"\x06"
    assert host.write(0x1A24, 0) == 0
    assert host.read(0x0100) == b"\x00"


def test_unknown_command_and_error_code_as_a_write_are_invalid_commands(host):
    assert host.write(0x7777, 1) == 3
    assert host.write(0x0100, 1) == 3


def test_no_reply_unless_asked(host):
    assert host.send(0x00, 0x1A24, b"\0") == []


def test_trigger_limits(host):
    delays = struct.pack("<Bhh", 0, -20, 20000)
    assert host.write(0x1A1D, *delays) == 0
    assert host.read(0x1A1D) == delays
    assert host.write(0x1A1E, *struct.pack("<Bhh", 0, -21, 0)) == 13
    assert host.write(0x1A1E, *struct.pack("<Bhh", 0, 0, 20001)) == 13
    assert host.write(0x1A1E, *struct.pack("<Bhh", 1, 0, 1)) == 13
    assert host.write(0x1A35, *struct.pack("<HB", 82, 0)) == 13


def test_start_needs_table_and_images(host):
    assert host.write(0x1A24, 2) == 7
    assert host.define() == 0
    assert host.write(0x1A31, 2, 0, 0, 0, 0, 0) == 16  # entry 1 is not defined
    assert host.write(0x1A31, 1, 0, 1, 0, 0, 0) == 0
    assert host.write(0x1A24, 2) == 7
    assert host.upload(0, image(WHITE)) == 0
    assert host.write(0x1A24, 2) == 0
    host.finish()
    assert [edge[0].all() for edge in host.edges] == [True]


def test_image_sums_must_agree(host):
    good = image(WHITE)
    assert host.write(0x1A2A, *struct.pack("<HI", 0, len(good) - 1)) == 0
    for at in range(0, len(good), 504):
        part = good[at : at + 504]
        host.send(0x00, 0x1A2B, struct.pack("<H", len(part)) + part)
    assert host.read(0x0100) == b"\x06"
    assert host.write(0x1A2B, 1, 0, 0) == 7  # data without a start
    assert host.write(0x1A2C, *struct.pack("<HI", 0, 100)) == 6  # there is no secondary
    assert host.upload(0, image(WHITE)[:25] + b"\x07" + image(WHITE)[26:]) == 9


def test_tis_on_the_fly_example_runs():
    # DLPU018I, pattern on the fly: the guide's own bytes; its image's contents are not printed.
    host = Host("DLP6500")
    picture = bytes.fromhex("80 0F 000001") + bytes.fromhex("00 01 80 0F") * 1079 + b"\0\1\0"
    stream = image(picture, 1920, 1080)
    padding = 6057 - len(stream)
    stream = image(picture + bytes(padding), 1920, 1080)
    assert host.write(0x1A1B, *bytes.fromhex("03")) == 0
    assert host.write(0x1A34, *bytes.fromhex("00 00 C8 00 00 11 00 00 00 00 00 00")) == 0
    assert host.write(0x1A34, *bytes.fromhex("01 00 90 01 00 23 00 00 00 00 00 08")) == 0
    assert host.write(0x1A31, *bytes.fromhex("02 00 00 00 00 00")) == 0
    assert host.write(0x1A2A, *bytes.fromhex("00 00 A9 17 00 00")) == 0
    for at in range(0, 12 * 504, 504):
        host.send(0x00, 0x1A2B, bytes.fromhex("F8 01") + stream[at : at + 504])
    host.send(0x00, 0x1A2B, bytes.fromhex("09 00") + stream[12 * 504 :])
    assert host.read(0x0100) == b"\x00"
    assert host.write(0x1A24, *bytes.fromhex("02")) == 0
    while len(host.edges) < 5:
        threading.Event().wait(0.001)
    assert host.read(0x1A0C) == b"\x02"
    assert host.write(0x1A24, *bytes.fromhex("00")) == 0
    assert host.read(0x1A0C) == b"\x00"
    # 200 us, then 400 us, for ever; pattern 0 is plane 0, which is on, pattern 1 planes 1-2.
    starts = host.device.start_ns[:5]
    assert np.diff(starts).tolist() == [200_000, 400_000, 200_000, 400_000]
    assert host.edges[0][0].all()
    assert not host.edges[1][0].any()


def two_patterns(host, dark_us=0, flags=0, options=0x70, shown=2):
    assert host.define(0, place=0, dark_us=dark_us, flags=flags, options=options) == 0
    assert host.define(1, place=1, dark_us=dark_us, options=options) == 0
    assert host.write(0x1A31, *struct.pack("<HI", 2, shown)) == 0
    assert host.upload(1, image(BLACK)) == 0
    assert host.upload(0, image(WHITE)) == 0


def test_count_may_be_more_or_less_than_the_table(host):
    two_patterns(host, shown=5)
    assert host.write(0x1A24, 2) == 0
    host.finish()
    assert [bool(edge[0].any()) for edge in host.edges] == [True, False, True, False, True]
    assert host.write(0x1A31, *struct.pack("<HI", 2, 1)) == 0
    host.edges.clear()
    assert host.write(0x1A24, 2) == 0
    host.finish()
    assert len(host.edges) == 1


def test_disabled_trigger_out_2_gives_no_edge(host):
    two_patterns(host, flags=1)
    host.write(0x1A24, 2)
    host.finish()
    assert [edge[1] for edge in host.edges] == [1]
    assert len(host.device.start_ns) == 2


@pytest.mark.parametrize(("dark_us", "edges"), [(0, [0]), (200, [0, 1])])
def test_trigger_out_1_stays_high_without_dark_time(dark_us, edges):
    host = Host(camera_output=1)
    host.write(0x1A1B, 3)
    two_patterns(host, dark_us=dark_us)
    host.write(0x1A24, 2)
    host.finish()
    assert [edge[1] for edge in host.edges] == edges


def test_pause_shows_the_same_pattern_again_and_stop_begins_anew():
    reached = threading.Event()

    def listen(mirrors, index, start_ns, exposure_s):
        if index == 1:
            reached.set()

    for command, first in ((1, 1), (0, 0)):
        host = Host(clock=None)
        host.write(0x1A1B, 3)
        host.device.on_exposure = listen
        host.define(0, place=0, exposure_us=2000)
        host.define(1, place=1, exposure_us=10_000_000)
        host.write(0x1A31, *struct.pack("<HI", 2, 2))
        host.upload(1, image(BLACK))
        host.upload(0, image(WHITE))
        reached.clear()
        host.write(0x1A24, 2)
        assert reached.wait(10)
        host.write(0x1A24, command)
        seen = threading.Event()
        indices = []
        host.device.on_exposure = lambda m, i, t, e, n=indices, s=seen: (n.append(i), s.set())
        host.write(0x1A24, 2)
        assert seen.wait(10)
        host.write(0x1A24, 0)
        assert indices[0] == first


def test_mirrors_now_follow_exposure_and_dark_time():
    host = Host(clock=None)
    host.write(0x1A1B, 3)
    begun = threading.Event()
    host.device.on_exposure = lambda *edge: begun.set()
    assert not host.device.mirrors_now().any()
    two_patterns(host, dark_us=10_000_000, shown=1)
    host.write(0x1A24, 2)
    assert begun.wait(10)
    while host.device.mirrors_now().any():  # 1 ms of exposure, then ten seconds of dark
        threading.Event().wait(0.001)
    assert host.device.running
    host.write(0x1A24, 0)
    assert not host.device.running


def test_changes_are_refused_while_running():
    host = Host(clock=None)
    host.write(0x1A1B, 3)
    assert host.define(0, place=0, exposure_us=10_000_000) == 0
    assert host.write(0x1A31, 1, 0, 0, 0, 0, 0) == 0
    assert host.upload(0, image(WHITE)) == 0
    assert host.write(0x1A24, 2) == 0
    assert host.define() == 5
    assert host.write(0x1A31, 1, 0, 0, 0, 0, 0) == 5
    assert host.write(0x1A1B, 1) == 5
    assert host.write(0x1A1D, 0, 0, 0, 0, 0) == 5
    assert host.write(0x1A24, 0) == 0
    assert host.define() == 0


def test_strict_device_forgets_images_with_another_table():
    host = Host(strict=True)
    host.write(0x1A1B, 3)
    two_patterns(host)
    assert host.define(0, exposure_us=2000) == 0  # another exposure only
    assert host.write(0x1A31, *struct.pack("<HI", 2, 4)) == 0
    assert host.write(0x1A24, 2) == 0
    host.finish()
    assert host.write(0x1A31, *struct.pack("<HI", 1, 1)) == 0
    assert host.write(0x1A24, 2) == 7


def test_patterns_are_reordered_without_loading_them_again(host):
    two_patterns(host)
    order = struct.pack("<HI3H", 3, 5, 1, 1, 0)
    assert host.write(0x1A32, *order) == 0
    assert host.write(0x1A24, 2) == 0
    host.finish()
    assert [bool(mirrors.all()) for mirrors, *_ in host.edges] == [False, False, True] + [False] * 2
    assert host.write(0x1A32, *struct.pack("<HI2H", 3, 5, 1, 1)) == 6  # an index is missing
    assert host.write(0x1A32, *struct.pack("<HI1H", 1, 1, 2)) == 15  # never defined


def test_mailbox_commands_of_tis_older_sdk_change_nothing(host):
    two_patterns(host)
    for command, *data in ((0x1A33, 2), (0x1A32, 0, 0), (0x1A33, 0)):
        assert host.write(command, *data) == 0
    assert host.write(0x1A24, 2) == 0
    host.finish()
    assert len(host.edges) == 2


def test_inverted_data_turn_the_mirrors_over(host):
    two_patterns(host)
    for inverted in (1, 0):
        assert host.write(0x1A30, inverted) == 0
        assert host.device.pattern(0).all() == (not inverted)
        assert host.device.pattern(1).any() == bool(inverted)


def test_compressed_image_with_a_miscounted_header_is_shown_unless_strict(host):
    """DMDConnect (Matlab) writes the number of pixels where the bytes are to be counted."""
    stream = image(WHITE)
    stream = stream[:8] + struct.pack("<I", 1024 * 768) + stream[12:]
    assert host.upload(0, stream) == 0
    strict = Host(strict=True)
    assert strict.write(0x1A1B, 3) == 0
    assert strict.upload(0, stream) == 6


def test_empty_part_after_the_last_one_harms_nothing(host):
    assert host.upload(0, image(WHITE)) == 0
    assert host.write(0x1A2B, 0, 0) == 0
    assert host.write(0x1A2B, 1, 0, 0xFF) == 7
    host.define()
    assert host.write(0x1A31, 1, 0, 1, 0, 0, 0) == 0
    assert host.device.pattern(0).all()


def test_flips_turn_the_mirrors(host):
    # The left half of the columns and the upper half of the rows are lit.
    row = bytes.fromhex("80 04 FFFFFF 80 04 000000")
    picture = row + bytes.fromhex("00 01 80 08") * 383
    picture += bytes.fromhex("80 08 000000") + bytes.fromhex("00 01 80 08") * 383 + b"\0\1\0"
    host.define()
    host.write(0x1A31, 1, 0, 1, 0, 0, 0)
    assert host.upload(0, image(picture)) == 0
    expected = np.zeros((768, 1024), bool)
    expected[:384, :512] = True
    np.testing.assert_array_equal(host.device.pattern(0), expected)
    assert host.write(0x1008, 1) == 0
    np.testing.assert_array_equal(host.device.pattern(0), expected[:, ::-1])
    assert host.write(0x1009, 1) == 0
    np.testing.assert_array_equal(host.device.pattern(0), expected[::-1, ::-1])


def test_halves_of_a_dual_dmd_come_from_their_controllers():
    host = Host("DLP9000")
    host.write(0x1A1B, 3)
    host.define(exposure_us=105)
    host.write(0x1A31, 1, 0, 1, 0, 0, 0)

    def half(colour):
        lines = bytes.fromhex("80 0A") + colour * 3 + bytes.fromhex("00 01 80 0A") * 1599
        return image(lines + b"\0\1\0", 1280, 1600)

    assert host.upload(0, half(b"\xff")) == 0
    assert host.write(0x1A24, 2) == 7
    assert host.upload(0, half(b"\x00"), init=0x1A2C) == 0
    mirrors = host.device.pattern(0)
    assert mirrors[:, :1280].all()
    assert not mirrors[:, 1280:].any()


def test_power_cycle_forgets(host):
    two_patterns(host)
    host.device.power_cycle()
    assert host.read(0x1A1B) == b"\x01"
    assert host.read(0x1A31) == bytes(6)
    host.write(0x1A1B, 3)
    assert host.write(0x1A24, 2) == 7


# -- what host programs do differently ---------------------------------------------------------


def test_reports_may_lack_padding_or_carry_the_report_id(host):
    """HID libraries are handed the report id 0 in front; some programs write what they have."""
    read_curtain = struct.pack("<BBHH", 0xC0, 7, 2, 0x1100)
    wanted = host.device.receive(read_curtain.ljust(64, b"\0"))
    assert wanted[0][:4] == bytes([0xC0, 7, 6, 0])
    assert host.device.receive(read_curtain) == wanted
    assert host.device.receive(b"\0" + read_curtain.ljust(64, b"\0")) == wanted
    # Image data has no flags at all: the id in front of it is told by the length alone.
    stream = image(WHITE)
    assert host.write(0x1A2A, *struct.pack("<HI", 0, len(stream))) == 0
    for at in range(0, len(stream), 504):
        part = stream[at : at + 504]
        packet = struct.pack("<BBHHH", 0, 1, len(part) + 4, 0x1A2B, len(part)) + part
        for start in range(0, len(packet), 64):
            assert host.device.receive(b"\0" + packet[start : start + 64].ljust(64, b"\0")) == []
    assert host.read(0x0100) == b"\0"
    assert host.define() == 0
    assert host.write(0x1A31, 1, 0, 1, 0, 0, 0) == 0
    assert host.device.pattern(0).all()


def test_a_message_of_no_length_is_refused_in_a_reply(host):
    (reply,) = host.device.receive(struct.pack("<BBH", 0xC0, 9, 0).ljust(64, b"\0"))
    assert reply[:4] == bytes([0xE0, 9, 0, 0])
    assert host.read(0x0100) == b"\x06"
    assert host.read(0x1A1B) == b"\x03"


@pytest.mark.parametrize("order", [(0, 2), (2,), (0, 0, 1, 2), (1, 2)])
def test_start_and_stop_in_any_order(host, order):
    assert host.upload(0, image(WHITE)) == 0
    assert host.define() == 0
    assert host.write(0x1A31, 1, 0, 1, 0, 0, 0) == 0
    for value in order:
        assert host.write(0x1A24, value) == 0
    host.finish()
    assert len(host.edges) == 1
    for command, value in ((0x0201, 1), (0x0201, 0), (0x0201, 1), (0x0201, 3), (0x0200, 1)):
        assert host.write(command, value) == 0
        assert host.read(command) == bytes([value & 1 if value < 3 else 0])
    assert host.write(0x0200, 0) == 0
    assert host.write(0x1A24, 2) == 0


def test_pause_of_a_stopped_sequence_does_not_skip_patterns(host):
    """Some hosts pause ("validate") before each start."""
    two_patterns(host)
    for count in (2, 4):
        for value in (0, 1, 2):
            assert host.write(0x1A24, value) == 0
        host.finish()
        assert len(host.edges) == count
