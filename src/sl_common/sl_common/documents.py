"""YAML documents that people write by hand: read strictly, written atomically.

PyYAML alone takes the last of two equal keys and reads ``1e-8`` as a string; here the first is
refused and the second is a number. Every complaint names the place, what was found there and
what was expected.
"""

from __future__ import annotations

import math
import os
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from sl_common.errors import SlError

#: No document of ours comes near this; a larger file was named by mistake.
MAX_DOCUMENT_BYTES = 64 << 20


class _Loader(yaml.SafeLoader):
    """Safe loader with YAML 1.2 numbers and without repeated keys."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key_node, _ in node.value:
            key = str(key_node.value)
            if key in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"the key {key!r} is there twice", problem_mark=key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def parse_document(text: str, source: str, error: type[SlError]) -> Any:
    """Return the one YAML document in ``text``.

    Parameters
    ----------
    text : str
        The document.
    source : str
        What the text is, for the message.
    error : type
        What is raised when the text is not one well-formed YAML document.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as exc:
        raise error(f"{source} is not a well-formed YAML document: {_one_line(exc)}") from None


def read_text(path: Path, error: type[SlError]) -> str:
    """Return the file's text; ``error`` when there is none or it is not UTF-8 text."""
    try:
        if path.stat().st_size > MAX_DOCUMENT_BYTES:
            raise error(f"{path} has {path.stat().st_size} bytes; expected a text document")
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise error(f"{path} is not UTF-8 text; expected a YAML document") from None
    except OSError as exc:
        raise error(f"cannot read {path}: {exc.strerror or exc}") from None


def read_document(path: Path, error: type[SlError]) -> Any:
    """Return the YAML document in a file; see `parse_document`."""
    return parse_document(read_text(path, error), str(path), error)


def _one_line(exc: BaseException) -> str:
    return " ".join(str(exc).split())


@contextmanager
def written_atomically(path: Path) -> Iterator[Path]:
    """Give a temporary path beside ``path`` that takes its place only when the block succeeds.

    The temporary name keeps the suffix, for writers that go by it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    partial = Path(name)
    try:
        yield partial
        partial.chmod(0o644)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file in one step: either the whole text is there or the old file is."""
    with written_atomically(path) as partial:
        partial.write_text(text, encoding="utf-8")


class _Dumper(yaml.SafeDumper):
    """Block style outside, one line for every list of plain values."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_list(dumper: yaml.SafeDumper, data: Sequence[Any]) -> yaml.SequenceNode:
    flat = all(not isinstance(item, (list, tuple, dict)) for item in data)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=flat)


class FlowMapping(dict[str, Any]):
    """A mapping that is written on one line."""


def _represent_flow(dumper: yaml.SafeDumper, data: FlowMapping) -> yaml.MappingNode:
    return dumper.represent_mapping("tag:yaml.org,2002:map", dict(data), flow_style=True)


_Dumper.add_representer(list, _represent_list)
_Dumper.add_representer(FlowMapping, _represent_flow)


def dump_document(document: Mapping[str, Any]) -> str:
    """YAML text of a mapping; floats with all their digits, keys in the order given."""
    return yaml.dump(document, Dumper=_Dumper, sort_keys=False, width=10_000, allow_unicode=True)


class Fields:
    """The keys of one mapping in a document, each asked for once.

    Parameters
    ----------
    value : object
        What the document has; anything but a mapping is refused.
    where : str
        Its place in the document, for messages.
    error : type
        What is raised.
    known : sequence of str
        Keys that may be there; any other is refused.
    """

    def __init__(self, value: Any, where: str, error: type[SlError], known: Sequence[str]) -> None:
        if not isinstance(value, Mapping):
            raise error(f"{where} is {describe(value)}; expected a mapping of {', '.join(known)}")
        unknown = [str(key) for key in value if key not in known]
        if unknown:
            raise error(
                f"{where} has the unknown key {', '.join(unknown)}; expected {', '.join(known)}"
            )
        self._value, self._where, self._error = value, where, error

    def __contains__(self, key: str) -> bool:
        return key in self._value

    def get(self, key: str, read: Callable[[Any, str, type[SlError]], Any], *default: Any) -> Any:
        """Value of a key, checked by ``read``; the default, or an error when there is none."""
        if key in self._value:
            return read(self._value[key], f"{self._where}.{key}", self._error)
        if default:
            return default[0]
        raise self._error(f"{self._where} lacks the key {key}; is the file complete?")


def describe(value: Any) -> str:
    """Say what a value is, short enough for a message."""
    text = repr(value)
    return f"{text if len(text) <= 60 else text[:57] + '...'} ({type(value).__name__})"


def a_string(value: Any, where: str, error: type[SlError]) -> str:
    """Check that a value is a non-empty string."""
    if not isinstance(value, str) or not value:
        raise error(f"{where} is {describe(value)}; expected a word")
    return value


def a_flag(value: Any, where: str, error: type[SlError]) -> bool:
    """Check that a value is true or false."""
    if not isinstance(value, bool):
        raise error(f"{where} is {describe(value)}; expected true or false")
    return value


def a_whole_number(value: Any, where: str, error: type[SlError]) -> int:
    """Check that a value is an integer (not a flag, not 3.0)."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise error(f"{where} is {describe(value)}; expected a whole number")
    return value


def a_number(value: Any, where: str, error: type[SlError]) -> float:
    """Check that a value is a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise error(f"{where} is {describe(value)}; expected a finite number")
    return float(value)


def a_list(value: Any, where: str, error: type[SlError]) -> list[Any]:
    """Check that a value is a list."""
    if not isinstance(value, list):
        raise error(f"{where} is {describe(value)}; expected a list")
    return value


def numbers(*lengths: int) -> Callable[[Any, str, type[SlError]], list[float]]:
    """Return a check for a list of finite numbers of one of the given lengths."""

    def read(value: Any, where: str, error: type[SlError]) -> list[float]:
        items = a_list(value, where, error)
        if len(items) not in lengths:
            wanted = " or ".join(str(n) for n in lengths)
            raise error(f"{where} has {len(items)} entries; expected {wanted}")
        return [a_number(item, f"{where}[{i}]", error) for i, item in enumerate(items)]

    return read


def a_size(value: Any, where: str, error: type[SlError]) -> tuple[int, int]:
    """Check that a value is [width, height], two whole numbers of at least 1."""
    items = a_list(value, where, error)
    if len(items) != 2:
        raise error(f"{where} has {len(items)} entries; expected [width, height]")
    width, height = (a_whole_number(item, f"{where}[{i}]", error) for i, item in enumerate(items))
    if min(width, height) < 1:
        raise error(f"{where} is [{width}, {height}]; expected at least 1 x 1 pixels")
    return width, height
