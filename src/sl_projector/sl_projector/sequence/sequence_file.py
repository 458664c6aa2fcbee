"""The sequence file: a pattern sequence as YAML, short enough to write by hand.

Full form::

    format: 1
    name: mine
    dmd_size: [1024, 768]
    patterns:
    - {kind: gray, axis: column, bits: 10, division_px: 1, paired: true}
    - {kind: white}

A bare list of patterns is read too. One entry of kind ``gray`` stands for several patterns when
``bit`` or ``shift`` is a list, when ``bit`` is left out (all bits, coarsest first), or when
``paired`` is true (each pattern is followed by its inverse).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sl_common.documents import (
    Fields,
    FlowMapping,
    a_flag,
    a_list,
    a_size,
    a_string,
    a_whole_number,
    describe,
    dump_document,
    parse_document,
    read_text,
    write_text,
)
from sl_common.errors import SequenceError, SlError
from sl_projector.sequence.pattern_sequence import (
    DEFAULT_DMD_SIZE,
    NAMED,
    Axis,
    Pattern,
    PatternSequence,
    named,
)

FORMAT = 1
#: More patterns than this are a slip of the pen (24 bits x 2 axes x 8 shifts stay below it).
MAX_PATTERNS = 1024

_TOP_KEYS = ("format", "name", "dmd_size", "patterns")
_GRAY_KEYS = (
    "kind", "axis", "bit", "bits", "division_px", "shift", "inverted", "paired", "file",
)  # fmt: skip
_PLAIN_KEYS = ("kind", "file")


@dataclass(frozen=True)
class SequenceFile:
    """A sequence and, where its file names them, the image file of each pattern.

    Parameters
    ----------
    sequence : PatternSequence
        The patterns.
    files : tuple of str or None
        One per pattern; None where the file does not say.
    """

    sequence: PatternSequence
    files: tuple[str | None, ...]


def load_sequence(path: str | Path) -> PatternSequence:
    """Return the pattern sequence in a YAML file; see `load_sequence_file`."""
    return load_sequence_file(path).sequence


def load_sequence_file(path: str | Path) -> SequenceFile:
    """Read a sequence file.

    Raises
    ------
    SequenceError
        When the file cannot be read, has unknown keys, or describes no usable sequence.
    """
    path = Path(path)
    return parse_sequence(read_text(path, SequenceError), str(path), path.stem)


def find_sequence(name_or_path: str, dmd_size: tuple[int, int] | None = None) -> SequenceFile:
    """Return a built-in sequence by its name, or the sequence in a file.

    Parameters
    ----------
    name_or_path : str
        A built-in name wins over a file of the same name.
    dmd_size : tuple of int, optional
        (columns, rows) for a built-in one; a file says its own.
    """
    if name_or_path in NAMED:
        sequence = named(name_or_path, dmd_size or DEFAULT_DMD_SIZE)
        return SequenceFile(sequence, (None,) * len(sequence))
    if not Path(name_or_path).exists():
        raise SequenceError(
            f"{name_or_path!r} is neither a built-in sequence ({', '.join(sorted(NAMED))}) "
            "nor a file"
        )
    found = load_sequence_file(name_or_path)
    if dmd_size and found.sequence.dmd_size != dmd_size:
        raise SequenceError(
            f"{name_or_path} is made for a DMD of {found.sequence.dmd_size}; expected {dmd_size}"
        )
    return found


def parse_sequence(text: str, source: str, name: str) -> SequenceFile:
    """Read a sequence from YAML text.

    Parameters
    ----------
    text : str
        The document.
    source : str
        What it is, for messages.
    name : str
        Name of the sequence where the document gives none.
    """
    document = parse_document(text, source, SequenceError)
    if isinstance(document, list):
        document = {"format": FORMAT, "patterns": document}
    fields = Fields(document, source, SequenceError, _TOP_KEYS)
    version = fields.get("format", a_whole_number)
    if version != FORMAT:
        raise SequenceError(f"{source} is of format {version}; expected format {FORMAT}")
    dmd_size = fields.get("dmd_size", a_size, DEFAULT_DMD_SIZE)
    entries = fields.get("patterns", a_list)
    pairs = _expand(entries, dmd_size, f"{source}: patterns")
    sequence = PatternSequence(
        fields.get("name", a_string, name), dmd_size, tuple(pattern for pattern, _ in pairs)
    )
    return SequenceFile(sequence, tuple(file for _, file in pairs))


def _expand(
    entries: Sequence[Any], dmd_size: tuple[int, int], where: str
) -> list[tuple[Pattern, str | None]]:
    """All patterns of all entries, in order, with their image files."""
    read = [_Entry.read(entry, f"{where}[{i}]") for i, entry in enumerate(entries)]
    coarsest = {axis: _bits_of_axis(read, axis) for axis in ("column", "row")}
    pairs = [
        (pattern, entry.file)
        for entry in read
        for pattern in entry.patterns(coarsest[entry.axis], dmd_size)
    ]
    if len(pairs) > MAX_PATTERNS:
        raise SequenceError(f"{where} stands for {len(pairs)} patterns; expected <= {MAX_PATTERNS}")
    return pairs


def _bits_of_axis(entries: Sequence[_Entry], axis: str) -> int:
    """Bits of the code on an axis where an entry does not say: one more than the largest bit."""
    seen = [b for e in entries if e.kind == "gray" and e.axis == axis for b in e.bit or ()]
    given = [e.bits for e in entries if e.kind == "gray" and e.axis == axis and e.bits]
    return max([1, *(b + 1 for b in seen), *given])


@dataclass(frozen=True)
class _Entry:
    """One item of the file's list."""

    kind: str
    where: str
    axis: Axis = "column"
    bit: tuple[int, ...] | None = None
    bits: int | None = None
    division_px: int | None = None
    shift: tuple[int, ...] = (0,)
    inverted: bool = False
    paired: bool = False
    file: str | None = None

    @classmethod
    def read(cls, value: Any, where: str) -> _Entry:
        kind = value.get("kind") if isinstance(value, Mapping) else None
        if kind in ("white", "black"):
            fields = Fields(value, where, SequenceError, _PLAIN_KEYS)
            return cls(kind, where, file=fields.get("file", a_string, None))
        fields = Fields(value, where, SequenceError, _GRAY_KEYS)
        if fields.get("kind", a_string) != "gray":
            raise SequenceError(f"{where}.kind is {describe(kind)}; expected gray, white or black")
        return cls._read_gray(fields, where)

    @classmethod
    def _read_gray(cls, fields: Fields, where: str) -> _Entry:
        if "bit" not in fields and "bits" not in fields:
            raise SequenceError(f"{where} has neither bit nor bits; expected at least one of them")
        entry = cls(
            "gray",
            where,
            fields.get("axis", _an_axis, "column"),
            fields.get("bit", _whole_numbers, None),
            fields.get("bits", a_whole_number, None),
            fields.get("division_px", a_whole_number, None),
            fields.get("shift", _whole_numbers, (0,)),
            fields.get("inverted", a_flag, False),
            fields.get("paired", a_flag, False),
            fields.get("file", a_string, None),
        )
        if entry.file and (entry.paired or len(entry.bit or ()) != 1 or len(entry.shift) != 1):
            raise SequenceError(f"{where}.file names one image but the entry is several patterns")
        return entry

    def patterns(self, bits_of_axis: int, dmd_size: tuple[int, int]) -> list[Pattern]:
        """Patterns that the entry stands for, in order of projection."""
        if self.kind != "gray":
            return [Pattern("white" if self.kind == "white" else "black")]
        bits = self.bits if self.bits is not None else bits_of_axis
        division = self.division_px or _division(dmd_size[self.axis == "row"], bits)
        try:
            plain = [
                Pattern("gray", self.axis, bit, bits, division, shift, self.inverted)
                for bit in (range(bits) if self.bit is None else self.bit)
                for shift in self.shift
            ]
        except SequenceError as exc:
            raise SequenceError(f"{self.where}: {exc}") from None
        return [p for q in plain for p in ((q, q.inverse()) if self.paired else (q,))]


def _division(size_px: int, bits: int) -> int:
    """Smallest power of two of DMD pixels with which so many bits span the axis."""
    division = 1
    while division << bits < size_px:
        division *= 2
    return division


def _an_axis(value: Any, where: str, error: type[SlError]) -> Axis:
    if value == "column":
        return "column"
    if value == "row":
        return "row"
    raise error(f"{where} is {describe(value)}; expected column or row")


def _whole_numbers(value: Any, where: str, error: type[SlError]) -> tuple[int, ...]:
    """One whole number, or a list of at least one."""
    items = value if isinstance(value, list) else [value]
    if not items:
        raise error(f"{where} is an empty list; expected whole numbers")
    return tuple(a_whole_number(item, where, error) for item in items)


def dump_sequence(sequence: PatternSequence, files: Sequence[str] | None = None) -> str:
    """YAML text of a sequence, one line per pattern, nothing left to defaults.

    Parameters
    ----------
    sequence : PatternSequence
        The patterns.
    files : sequence of str, optional
        Image file of each pattern, noted beside it.
    """
    entries = [_entry(pattern) for pattern in sequence.patterns]
    for entry, file in zip(entries, files or (), strict=bool(files)):
        entry["file"] = file
    return dump_document(
        {
            "format": FORMAT,
            "name": sequence.name,
            "dmd_size": list(sequence.dmd_size),
            "patterns": entries,
        }
    )


def _entry(pattern: Pattern) -> FlowMapping:
    if pattern.kind != "gray":
        lit = (pattern.kind == "white") != pattern.inverted
        return FlowMapping(kind="white" if lit else "black")
    return FlowMapping(
        kind="gray",
        axis=pattern.axis,
        bit=pattern.bit,
        bits=pattern.bits,
        division_px=pattern.division_px,
        shift=pattern.shift_px,
        inverted=pattern.inverted,
    )


def save_sequence(
    path: str | Path, sequence: PatternSequence, files: Sequence[str] | None = None
) -> None:
    """Write a sequence file; see `dump_sequence`.

    Parameters
    ----------
    path : str or Path
        The file.
    sequence : PatternSequence
        What it describes.
    files : sequence of str, optional
        Image files, one for each pattern.
    """
    write_text(Path(path), dump_sequence(sequence, files))
