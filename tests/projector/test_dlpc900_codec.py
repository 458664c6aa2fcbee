"""DLPC900 images: packing, compressions and the emulator's decoder.

The decoder in `sl_bench` was written from the guide and shares no code with the encoder; the
vectors come from the guide.
"""

import struct

import numpy as np
import pytest

from sl_bench.dlpc.dlpc900_images import decode_image
from sl_bench.dlpc.dlpc_emulator import Refusal
from sl_common.errors import SequenceError
from sl_projector.dlpc import dlpc900_codec as codec
from sl_projector.dlpc.dmd import dmd_model
from sl_projector.sequence.pattern_sequence import NAMED, Pattern, PatternSequence, named

COMPRESSIONS = {
    codec.UNCOMPRESSED: codec.encode_uncompressed,
    codec.RLE: codec.encode_rle,
    codec.ENHANCED_RLE: codec.encode_enhanced_rle,
}

# DLPU018, RLE: two lines of 13 pixels. The guide's bytes end with the end mark; TI's encoder adds
# zeros to a multiple of 16.
RLE_EXAMPLE = bytes.fromhex(
    "03 040506  05 777777  00 03 040506 070809 0A0B0C  02 789ABC  00 00  00 00 00"
    "07 1D1E1F  06 212223  00 01"
)
RLE_EXAMPLE_PIXELS = [
    [0x040506] * 3 + [0x777777] * 5 + [0x040506, 0x070809, 0x0A0B0C] + [0x789ABC] * 2,
    [0x1D1E1F] * 7 + [0x212223] * 6,
]


def stream(words, compression):
    data = COMPRESSIONS[compression](words)
    rows, columns = words.shape
    return codec.image_header(columns, rows, len(data), compression) + data


def joined(planes):
    """Bit planes as words: plane k is bit k."""
    return planes[0].astype(np.uint32) | planes[1] * np.uint32(256) | planes[2] * np.uint32(65536)


def decoded(data, columns, rows):
    return joined(decode_image(data, columns, rows))


def test_rle_encodes_tis_example():
    encoded = codec.encode_rle(np.array(RLE_EXAMPLE_PIXELS, np.uint32))
    assert encoded == RLE_EXAMPLE.ljust(48, b"\0")


def test_decoder_reads_tis_example():
    header = codec.image_header(13, 2, len(RLE_EXAMPLE), codec.RLE)
    assert decoded(header + RLE_EXAMPLE, 13, 2).tolist() == RLE_EXAMPLE_PIXELS


def test_enhanced_rle_of_a_known_image():
    # By hand from the guide's table: N P; 00 N pixels; 00 01 N; counts from 128 in two bytes,
    # (N & 0x7F) | 0x80 then N >> 7; end of image 00 01 00.
    line = np.repeat(np.array([0xAABBCC, 0x010203], np.uint32), [200, 1])
    words = np.vstack([line, line, np.full(201, 0x040506, np.uint32)])
    assert codec.encode_enhanced_rle(words) == bytes.fromhex(
        "C8 01 AABBCC  01 010203  00 01 C9 01  C9 01 040506  00 01 00"
    )


def test_enhanced_rle_literals():
    words = np.array([[1, 2, 3, 3, 4]], np.uint32)
    assert codec.encode_enhanced_rle(words) == bytes.fromhex(
        "00 02 000001 000002  02 000003  01 000004  00 01 00"
    )


def test_header_is_what_tis_software_writes():
    header = codec.image_header(1920, 1080, 0x01020304, codec.ENHANCED_RLE)
    assert header == bytes.fromhex(
        "53706C64 8007 3804 04030201 FFFFFFFFFFFFFFFF 00000000 01 02 01 0000 01"
    ) + bytes(18)


@pytest.mark.parametrize("plane", range(24))
def test_plane_lies_in_its_byte_and_bit(plane):
    # Byte 0 of a pixel holds planes 16-23, byte 1 8-15, byte 2 0-7; bit k mod 8.
    frames = [np.zeros((1, 16), np.uint8)] * plane + [np.full((1, 16), 255, np.uint8)]
    pixels = np.frombuffer(codec.encode_uncompressed(codec.pack_planes(frames)), np.uint8)
    expected = [0, 0, 0]
    expected[2 - plane // 8] = 1 << plane % 8
    assert pixels.reshape(16, 3).tolist() == [expected] * 16


def images(rows, columns, seed):
    rng = np.random.default_rng(seed)
    across, down = np.arange(columns), np.arange(rows)
    striped = (across[None, :] // 4 * 0x010305 ^ down[:, None] // 3 * 0x100010) & 0xFFFFFF
    random = rng.integers(0, 1 << 24, (rows, columns))
    sparse = np.where(rng.random((rows, columns)) < 0.05, random, 0x00FF00)
    repeated = np.repeat(random[: rows // 2 + 1], 2, axis=0)[:rows]
    blank = np.full((rows, columns), seed % 2 * 0xFFFFFF)
    return {
        "random": random, "striped": striped, "sparse": sparse, "repeated": repeated,
        "blank": blank,
    }  # fmt: skip


@pytest.mark.parametrize("kind", ["random", "striped", "sparse", "repeated", "blank"])
@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize(("columns", "rows"), [(8, 8), (13, 7), (129, 3), (679, 40), (1024, 96)])
def test_compressions_round_trip(columns, rows, compression, kind):
    words = images(rows, columns, seed=columns)[kind].astype(np.uint32)
    got = decoded(stream(words, compression), columns, rows)
    np.testing.assert_array_equal(got, words)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 23, 24])
def test_packing_round_trips(count):
    rng = np.random.default_rng(count)
    frames = [np.where(rng.random((40, 56)) < 0.5, 255, 0).astype(np.uint8) for _ in range(count)]
    planes = decode_image(codec.encode_image(codec.pack_planes(frames)), 56, 40)
    for plane, frame in enumerate(frames):
        np.testing.assert_array_equal(planes[plane // 8] >> plane % 8 & 1, frame // 255)
    assert not (joined(planes) >> np.uint32(count)).any()


@pytest.mark.parametrize("kind", ["random", "striped", "sparse", "repeated", "blank"])
def test_smallest_compression_is_chosen(kind):
    words = images(48, 64, seed=3)[kind].astype(np.uint32)
    sizes = {c: len(encode(words)) for c, encode in COMPRESSIONS.items()}
    image = codec.encode_image(words)
    assert len(image) - 48 == min(sizes.values())
    assert sizes[image[25]] == min(sizes.values())


def test_random_image_is_sent_raw_and_blank_image_compressed():
    pictures = images(48, 64, seed=3)
    assert codec.encode_image(pictures["random"].astype(np.uint32))[25] == codec.UNCOMPRESSED
    assert codec.encode_image(pictures["blank"].astype(np.uint32))[25] == codec.ENHANCED_RLE


@pytest.mark.parametrize("model", ["DLP5500", "DLP6500", "DLP9000"])
@pytest.mark.parametrize("name", NAMED)
def test_line_shift_sets_compress_to_two_percent(name, model):
    dmd = dmd_model(model)
    sequence = named(name, dmd.size)
    sent = [codec.encode_patterns(p, dmd) for p in codec.map_planes(sequence).images]
    raw = 3 * dmd.columns * dmd.rows * len(sent)
    assert sum(len(half) for image in sent for half in image) <= 0.02 * raw


@pytest.mark.parametrize("name", NAMED)
def test_every_pattern_has_a_plane_that_shows_it(name):
    sequence = named(name, (64, 40))
    planes = codec.map_planes(sequence)
    for index, (image, bit) in enumerate(planes.places):
        shown = planes.images[image][bit].frame((64, 40))
        np.testing.assert_array_equal(shown, sequence.frame(index))


def test_equal_patterns_share_a_plane_and_axes_do_not_mix():
    stripes = [Pattern("gray", axis, b, 8) for axis in ("column", "row") for b in range(3)]
    blanks = [Pattern("white"), Pattern("black"), Pattern("black", inverted=True)]
    planes = codec.map_planes(PatternSequence("s", (64, 64), (*blanks, *stripes, *stripes)))
    assert planes.places[0] == planes.places[2]
    assert planes.places[3:9] == planes.places[9:15]
    for image in planes.images:
        assert len({p.axis for p in image if p.kind == "gray"}) == 1


def many(count):
    patterns = [Pattern("gray", "column", 0, 16, 1, shift) for shift in range(count)]
    return PatternSequence("many", (64, 64), tuple(patterns))


def test_eighteen_images_are_the_most():
    assert len(codec.map_planes(many(432)).images) == 18
    with pytest.raises(SequenceError, match=r"433 distinct patterns in 19 images.*at most 18"):
        codec.map_planes(many(433))


def enhanced(data, columns, rows, **changes):
    header = bytearray(codec.image_header(columns, rows, len(data), codec.ENHANCED_RLE))
    for offset, value in changes.items():
        header[int(offset[1:])] = value
    return bytes(header) + data


def test_decoder_takes_optional_ends_of_line_and_both_headers():
    # Pycrafter6500 ends every row, pads to four bytes, counts the header and leaves bytes 24 and
    # 29 zero; TI's software does neither. Both work in the field.
    data = bytes.fromhex("02 0000FF 00 00  00 01 02 00 00  00 01 00 00")
    ti = decoded(enhanced(bytes.fromhex("02 0000FF 00 01 02 00 01 00"), 2, 2), 2, 2)
    p65 = decoded(enhanced(data, 2, 2, b8=len(data) + 48, b24=0, b29=0), 2, 2)
    assert ti.tolist() == p65.tolist() == [[255, 255], [255, 255]]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ("02 0000FF 00 01 02", "end mark"),
        ("03 0000FF 00 01 00", "leave the line"),
        ("00 01 02 02 0000FF 00 01 00", "first line"),
        ("02 0000FF 00 01 00", "image ends after 2 of 4"),
        ("02 0000FF 00 02 0000FF", "ends within"),
    ],
)
def test_decoder_refuses_broken_enhanced_rle(data, words):
    with pytest.raises(Refusal, match=words):
        decode_image(enhanced(bytes.fromhex(data), 2, 2), 2, 2)


def test_decoder_refuses_broken_headers():
    good = codec.encode_image(np.zeros((2, 2), np.uint32))
    with pytest.raises(Refusal, match="begins with"):
        decode_image(b"Splc" + good[4:], 2, 2)
    with pytest.raises(Refusal, match="expected 4x2"):
        decode_image(good, 4, 2)
    with pytest.raises(Refusal, match="counts"):
        decode_image(good + b"\0", 2, 2)
    with pytest.raises(Refusal, match="compression 3") as fault:
        decode_image(good[:25] + b"\x03" + good[26:], 2, 2)
    assert fault.value.code == 9


def test_uncompressed_rows_may_come_without_padding():
    words = np.arange(6, dtype=np.uint32).reshape(2, 3)
    data = b"".join(struct.pack(">I", w)[1:] for w in range(6))
    header = codec.image_header(3, 2, len(data), codec.UNCOMPRESSED)
    np.testing.assert_array_equal(decoded(header + data, 3, 2), words)
