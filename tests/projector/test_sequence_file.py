"""Sequence files: what people write by hand, round trips, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from sl_common.errors import SequenceError
from sl_projector.sequence.pattern_sequence import NAMED, Pattern, PatternSequence, named
from sl_projector.sequence.sequence_file import (
    dump_sequence,
    find_sequence,
    load_sequence,
    load_sequence_file,
    parse_sequence,
    save_sequence,
)
from support.paths import EXAMPLES


def read(text: str) -> PatternSequence:
    return parse_sequence(text, "seq.yaml", "seq").sequence


@pytest.mark.parametrize("name", sorted(NAMED))
@pytest.mark.parametrize("dmd_size", [(1024, 768), (1920, 1080), (912, 1140)])
def test_named_sequences_survive_a_file(
    tmp_path: Path, name: str, dmd_size: tuple[int, int]
) -> None:
    sequence = named(name, dmd_size)
    save_sequence(tmp_path / "seq.yaml", sequence)
    assert load_sequence(tmp_path / "seq.yaml") == sequence


def test_file_names_survive(tmp_path: Path) -> None:
    sequence = named("paper")
    names = [f"{i}.png" for i in range(11)]
    save_sequence(tmp_path / "seq.yaml", sequence, names)
    assert load_sequence_file(tmp_path / "seq.yaml").files == tuple(names)


def test_example_is_the_board_data_sequence() -> None:
    """shared/data/README: 00-19 columns in (positive, inverse) pairs, 20-39 rows, white, black."""
    sequence = load_sequence(EXAMPLES / "procam_board.yaml")
    expected = [
        Pattern("gray", axis, bit, 10, 1, 0, inverted)
        for axis in ("column", "row")
        for bit in range(10)
        for inverted in (False, True)
    ]
    assert sequence.patterns == (*expected, Pattern("white"), Pattern("black"))
    assert sequence.dmd_size == (1024, 768)


def test_a_bare_list_gets_the_defaults() -> None:
    sequence = read("[{kind: gray, axis: column, bit: 0}, {kind: gray, bit: 7}, {kind: black}]")
    # 8 bits on 1024 columns: 4 columns a division, since 2 << 8 = 512 would not span the DMD.
    assert sequence.patterns[:2] == (
        Pattern("gray", "column", 0, 8, 4),
        Pattern("gray", "column", 7, 8, 4),
    )
    assert (sequence.name, sequence.dmd_size) == ("seq", (1024, 768))


def test_bits_are_counted_on_each_axis_alone() -> None:
    sequence = read("[{kind: gray, bit: 3}, {kind: gray, axis: row, bit: 1}]")
    assert [p.bits for p in sequence.patterns] == [4, 2]
    # 1024 columns / 2^4 = 64; 768 rows need 192 of 2^2, the next power of two is 256.
    assert [p.division_px for p in sequence.patterns] == [64, 256]


def test_paper_by_hand_is_the_named_one() -> None:
    text = """
format: 1
name: paper
patterns:
- {kind: gray, axis: column, bits: 8}
- {kind: gray, axis: column, bit: 7, shift: [1, 2, 3]}
"""
    assert read(text) == named("paper")


def test_shorthand_order_is_bit_then_shift_then_inverse() -> None:
    patterns = read("[{kind: gray, bit: [0, 1], shift: [0, 2], paired: true}]").patterns
    told = [(p.bit, p.shift_px, p.inverted) for p in patterns]
    assert told == [
        (0, 0, False), (0, 0, True), (0, 2, False), (0, 2, True),
        (1, 0, False), (1, 0, True), (1, 2, False), (1, 2, True),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "expected a mapping"),
        ("just words", "expected a mapping"),
        ("[", "well-formed"),
        ("[]", "no patterns"),
        ("{patterns: [{kind: white}]}", "lacks the key format"),
        ("{format: 2, patterns: [{kind: white}]}", "format 2"),
        ("{format: 1, patterns: [{kind: white}], dmd: [9, 9]}", "unknown key dmd"),
        ("{format: 1, patterns: {kind: white}}", "expected a list"),
        ("{format: 1, dmd_size: [1024], patterns: [{kind: white}]}", "width, height"),
        ("{format: 1, dmd_size: [1024, 4], patterns: [{kind: white}]}", "between 8 and"),
        ("[{kind: sine}]", "gray, white or black"),
        ("[{axis: column, bit: 1}]", "lacks the key kind"),
        ("[gray]", "expected a mapping"),
        ("[{kind: white, bit: 1}]", "unknown key bit"),
        ("[{kind: gray, bit: 1, phase: 2}]", "unknown key phase"),
        ("[{kind: gray, axis: diagonal, bit: 1}]", "column or row"),
        ("[{kind: gray}]", "neither bit nor bits"),
        ("[{kind: gray, bit: -1}]", "0 <= bit"),
        ("[{kind: gray, bit: 3, bits: 3}]", "bit < bits"),
        ("[{kind: gray, bit: 40}]", "bits <= 16"),
        ("[{kind: gray, bit: 1.5}]", "whole number"),
        ("[{kind: gray, bit: []}]", "empty list"),
        ("[{kind: gray, bit: 0, shift: 100000}]", "shift_px"),
        ("[{kind: gray, bit: 0, inverted: 1}]", "true or false"),
        ("[{kind: gray, bit: 0, division_px: -4}]", "division_px"),
        ("[{kind: gray, bits: 2, file: a.png}]", "several patterns"),
        ("[{kind: white, kind: black}]", "twice"),
        ("[{kind: gray, bits: 16, shift: [" + "0, " * 99 + "0]}]", "1600 patterns"),
        ("!!python/object/apply:os.getcwd []", "well-formed"),
    ],
)
def test_nonsense_is_refused(text: str, told: str) -> None:
    with pytest.raises(SequenceError) as caught:
        read(text)
    assert told in str(caught.value)
    assert "seq" in str(caught.value)


def test_finding_by_name_or_file(tmp_path: Path) -> None:
    assert find_sequence("paper", (1920, 1080)).sequence == named("paper", (1920, 1080))
    save_sequence(tmp_path / "mine.yaml", named("precise"))
    assert find_sequence(str(tmp_path / "mine.yaml")).sequence == named("precise")
    with pytest.raises(SequenceError, match="neither a built-in sequence"):
        find_sequence("papper")
    with pytest.raises(SequenceError, match="made for a DMD"):
        find_sequence(str(tmp_path / "mine.yaml"), (1920, 1080))


def test_text_is_one_line_a_pattern() -> None:
    lines = dump_sequence(named("precise")).splitlines()
    assert sum(line.startswith("- {kind: ") for line in lines) == 25
    assert len(lines) == 25 + 4
