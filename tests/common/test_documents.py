"""Documents: whatever they hold, reading them ends soon, and says what was wrong."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from sl_common.documents import (
    MAX_CHARACTERS,
    MAX_DEPTH,
    MAX_DIGITS,
    MAX_NODES,
    a_number,
    describe,
    dump_document,
    parse_document,
    parse_json,
    read_bytes,
    read_text,
)
from sl_common.errors import CalibrationError, SlError

ALIASES = "a0: &a0 [x, x]\n" + "".join(
    f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 40)
)

TOO_MUCH = {
    "alias bomb": (ALIASES, "alias"),
    "one alias": ("a: &a 1\nb: *a", "alias"),
    "merge": ("a: &a {b: 1}\nc: {<<: *a}", "alias"),
    "deep": ("[" * 500 + "]" * 500, f"{MAX_DEPTH} deep"),
    "long": ("a: " + "x" * MAX_CHARACTERS, "characters"),
    "many": ("[" + "1," * MAX_NODES + "1]", f"{MAX_NODES} values"),
    "digits": ("a: " + "9" * 400, f"{MAX_DIGITS} digits"),
    "digits with underscores": ("a: " + "9_" * 400, f"{MAX_DIGITS} digits"),
    "base 60": ("a: " + ":".join(["59"] * 4000), f"{MAX_DIGITS} digits"),
    "hexadecimal": ("a: 0x" + "f" * 9000, f"{MAX_DIGITS} digits"),
}


@pytest.mark.parametrize("name", TOO_MUCH)
def test_what_would_grow_is_refused_before_it_is_built(name: str) -> None:
    text, words = TOO_MUCH[name]
    began_s = time.process_time()
    with pytest.raises(CalibrationError, match=words):
        parse_document(text, "the file", CalibrationError)
    assert time.process_time() - began_s < 20.0  # the bomb took minutes, and grew


def test_a_document_within_the_limits_is_read_whole() -> None:
    document = {"format": 1, "numbers": [1e-8, 2.5, -3], "text": "word", "list": [[1, 2], [3, 4]]}
    assert parse_document(dump_document(document), "the file", SlError) == document


@pytest.mark.parametrize("text", ["[" * 100_000, "{", "1" * 5000, " " * (MAX_CHARACTERS + 1), ""])
def test_json_is_refused_in_words(text: str) -> None:
    with pytest.raises(SlError, match="the message"):
        parse_json(text, "the message", SlError)


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        with pytest.raises(SlError, match=r"no regular file|directory"):
            read_bytes(path, SlError)
    for path in (tmp_path / "none", Path("a\0b"), tmp_path / ("x" * 300)):
        with pytest.raises(SlError, match="cannot read"):
            read_bytes(path, SlError)


def test_bytes_are_counted_while_reading(tmp_path: Path) -> None:
    path = tmp_path / "large"
    path.write_bytes(b"x" * 11)
    assert read_bytes(path, SlError, most=11) == b"x" * 11
    with pytest.raises(SlError, match="more than 10 bytes"):
        read_bytes(path, SlError, most=10)


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    path = tmp_path / "bom.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1")
    assert parse_document(read_text(path, SlError), "the file", SlError) == {"a": 1}


@pytest.mark.parametrize(
    "value", [10**400, 10**5000, float("nan"), -(10**400), True, "1"], ids=range(6)
)
def test_what_is_no_finite_number_is_refused(value: object) -> None:
    with pytest.raises(SlError, match="expected a finite number"):
        a_number(value, "the key", SlError)
    assert len(describe(value)) < 100
