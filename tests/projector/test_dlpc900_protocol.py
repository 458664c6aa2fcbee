"""DLPC900 messages against the bytes printed in TI's programmer's guide (DLPU018)."""

import struct

import numpy as np
import pytest

from sl_bench.dlpc.dlpc900_emulator import Dlpc900Emulator
from sl_common.errors import DeviceError
from sl_projector.dlpc import dlpc900_protocol as protocol

CURTAIN_COLOUR = 0x1100


def test_write_message_is_tis_curtain_colour_example():
    data = struct.pack("<3H", 511, 511, 511)
    packet = protocol.message(CURTAIN_COLOUR, data, read=False, reply=False, sequence=0x12)
    assert packet == bytes.fromhex("00 12 08 00 00 11 FF 01 FF 01 FF 01")


def test_read_message_and_reply_are_tis_curtain_colour_example():
    packet = protocol.message(CURTAIN_COLOUR, read=True, reply=True, sequence=0x11)
    assert packet == bytes.fromhex("C0 11 02 00 00 11")
    reply = protocol.decode_reply(bytes.fromhex("C0 11 06 00 FF 01 FF 01 FF 01").ljust(64, b"\0"))
    assert reply == protocol.Reply(0x11, False, bytes.fromhex("FF 01 FF 01 FF 01"))


def test_emulator_answers_tis_curtain_colour_example():
    emulator = Dlpc900Emulator()
    assert emulator.receive(bytes.fromhex("00 12 08 00 00 11 FF 01 FF 01 FF 01")) == []
    (reply,) = emulator.receive(bytes.fromhex("C0 11 02 00 00 11"))
    assert reply == bytes.fromhex("C0 11 06 00 FF 01 FF 01 FF 01").ljust(64, b"\0")


def test_pattern_table_entries_are_tis_on_the_fly_example():
    first = protocol.lut_entry(0, 200, 0, image=0, bit=0, leds=1, clear=True)
    assert first == bytes.fromhex("00 00 C8 00 00 11 00 00 00 00 00 00")
    second = protocol.lut_entry(1, 400, 0, image=0, bit=1, depth=2, leds=2, clear=True)
    assert second == bytes.fromhex("01 00 90 01 00 23 00 00 00 00 00 08")
    assert protocol.lut_config(2, 0) == bytes.fromhex("02 00 00 00 00 00")


def test_pattern_table_entry_flags_lie_where_the_guide_puts_them():
    # DLPU018, 0x1A34: byte 5 bit 7 waits for the trigger, byte 9 bit 0 DISABLES trigger out 2,
    # bytes 10-11: image in bits 10:0, bit position in 15:11.
    entry = protocol.lut_entry(
        0x0102, 0x030405, 0x060708, 17, 23, leds=0, wait_trigger=True, trigger_out_2=False
    )
    assert entry == bytes.fromhex("02 01 05 04 03 80 08 07 06 01 11 B8")


def test_pattern_table_entries_are_those_of_tis_batch_file():
    """From the on-the-fly batch file that comes with TI's program: a gray image bit by bit."""
    tis = {
        (0, 0, 8, 0, 1): "00 00 A0 86 01 1F 00 00 00 00 00 00",
        (1, 1, 7, 0, 1): "01 00 A0 86 01 1D 00 00 00 00 00 08",
        (7, 7, 1, 150_000, 1): "07 00 A0 86 01 11 F0 49 02 00 00 38",
        (55, 7, 1, 150_000, 7): "37 00 A0 86 01 71 F0 49 02 00 00 38",
    }
    for (index, bit, depth, dark_us, leds), words in tis.items():
        entry = protocol.lut_entry(
            index, 100_000, dark_us, 0, bit, depth=depth, leds=leds, clear=True
        )
        assert entry == bytes.fromhex(words)
    assert protocol.lut_config(56, 0) == bytes.fromhex("38 00 00 00 00 00")


def test_image_load_is_tis_on_the_fly_example():
    stream = bytes(6057)
    assert protocol.image_init(0, len(stream)) == bytes.fromhex("00 00 A9 17 00 00")
    chunks = protocol.image_chunks(stream)
    assert [c[:2] for c in chunks] == [b"\xf8\x01"] * 12 + [b"\x09\x00"]
    assert [len(c) - 2 for c in chunks] == [504] * 12 + [9]


def test_image_data_message_fills_the_controllers_buffer():
    packet = protocol.message(0x1A2B, bytes(506), read=False, reply=False, sequence=1)
    assert len(packet) == 512
    assert [len(r) for r in protocol.reports(packet)] == [64] * 8
    with pytest.raises(DeviceError, match="507 bytes; expected at most 506"):
        protocol.message(0x1A2B, bytes(507), read=False, reply=False, sequence=1)


def test_trigger_settings():
    assert protocol.trigger_out(-20, 20000, inverted=False) == bytes.fromhex("00 EC FF 20 4E")
    assert protocol.trigger_in(105, falling_edge=True) == bytes.fromhex("69 00 01")


def test_reply_cut_short_is_no_reply():
    assert protocol.decode_reply(b"\xc0\x11\x06") is None
    assert protocol.decode_reply(b"\xc0\x11\x06\x00\xff\x01") is None


def test_refused_reply_carries_the_nack_bit():
    reply = protocol.decode_reply(bytes.fromhex("E0 07 00 00"))
    assert reply == protocol.Reply(7, True, b"")


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (0x00, "initialisation failed"),
        (0x03, "do not fit"),
        (0x05, "reset controller"),
        (0x09, "forced swap"),
        (0x41, "aborted"),
        (0x81, "sequencer error"),
    ],
)
def test_hardware_status_bits_become_words(status, words):
    (problem,) = protocol.hardware_problems(status)
    assert words in problem


def test_healthy_hardware_status_is_silent_with_one_and_two_controllers():
    assert protocol.hardware_problems(0x01) == protocol.hardware_problems(0x11) == ()


def test_refusal_names_command_and_reason():
    assert str(protocol.refusal(0x1A34, 14, "too short")) == (
        "DLPC900 refused 0x1A34 (pattern table entry): error 14, exposure out of range: too short"
    )


@pytest.mark.parametrize("seed", range(20))
def test_messages_of_any_length_survive_the_cut_into_reports(seed):
    # Reassembled as the guide says: the header's length counts command and data.
    rng = np.random.default_rng(seed)
    data = rng.bytes(int(rng.integers(0, 507)))
    command = int(rng.integers(0, 1 << 16))
    packet = protocol.message(command, data, read=False, reply=True, sequence=seed)
    joined = b"".join(protocol.reports(packet))
    length, found = struct.unpack_from("<HH", joined, 2)
    assert (joined[0], joined[1], found) == (0x40, seed, command)
    assert joined[6 : 4 + length] == data
    assert len(joined) % 64 == 0
    assert not any(joined[4 + length :])


@pytest.mark.parametrize("seed", range(20))
def test_emulator_survives_noise_and_answers_afterwards(seed):
    rng = np.random.default_rng(seed)
    emulator = Dlpc900Emulator()
    for _ in range(50):
        for reply in emulator.receive(rng.bytes(64)):
            assert len(reply) == 64
    emulator.forget_message()
    (reply,) = emulator.receive(bytes.fromhex("C0 55 02 00 06 02"))
    # 0x0206: byte 0 is the hardware code, 5 for the DLP5500; noise may have put an error first.
    assert reply[:5] == bytes.fromhex("C0 55 21 00 05")
