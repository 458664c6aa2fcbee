"""Documents that people and programs write: read strictly and within limits, written atomically.

PyYAML alone takes the last of two equal keys and reads ``1e-8`` as a string; here the first is
refused and the second is a number. Every complaint names the place, what was found there and
what was expected. Documents come from files and from topics, so nothing that one of them holds
may take long or much memory: bytes, depth, nodes and digits are limited before anything is
built, and aliases, which multiply what a document holds, are refused.
"""

from __future__ import annotations

import json
import math
import os
import re
import stat
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from sl_common.errors import SlError

#: The largest text file that is read: OpenCV keeps all image points beside a calibration.
MAX_FILE_BYTES = 8 << 20
#: Limits of one YAML or JSON document; a calibration of ours has 25 kB, depth 6 and 1,500 nodes.
MAX_CHARACTERS, MAX_DEPTH, MAX_NODES, MAX_DIGITS = 1 << 20, 32, 100_000, 100
_NUMBER = re.compile(r"[-+.]?\d[\w.:]*")
#: libyaml's parser where PyYAML has it: 20 times faster.
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_SafeLoader):  # type: ignore[misc]
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
        found: dict[Any, Any] = super().construct_mapping(node, deep)
        return found


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
        What is raised when the text is not one well-formed YAML document within the limits.
    """
    _check_length(text, source, error)
    try:
        _check_limits(text, source, error)
        return yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as exc:
        raise error(f"{source} is not a well-formed YAML document: {_one_line(exc)}") from None


def parse_json(text: str, source: str, error: type[SlError]) -> Any:
    """Return the JSON value in ``text``.

    Parameters
    ----------
    text, source : str
        The value; what it is, for the message.
    error : type
        What is raised when it is not JSON, or is too large.
    """
    _check_length(text, source, error)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as exc:
        raise error(f"{source} is not JSON: {_one_line(exc)}") from None


def _check_length(text: str, source: str, error: type[SlError]) -> None:
    if len(text) > MAX_CHARACTERS:
        raise error(f"{source} has {len(text)} characters; expected at most {MAX_CHARACTERS}")


def _check_limits(text: str, source: str, error: type[SlError]) -> None:
    """Refuse what would grow beyond bounds, from the parser's events alone."""
    depth = nodes = 0
    for event in yaml.parse(text, Loader=_SafeLoader):
        nodes += isinstance(event, yaml.NodeEvent)
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.AliasEvent):
            raise error(f"{source} has an alias (*{event.anchor}); expected none")
        if nodes > MAX_NODES or depth > MAX_DEPTH:
            raise error(
                f"{source} has more than {MAX_NODES} values or is nested more than {MAX_DEPTH} deep"
            )
        number = _NUMBER.match(event.value) if isinstance(event, yaml.ScalarEvent) else None
        if number and len(number[0]) > MAX_DIGITS:
            raise error(f"{source} has a number of more than {MAX_DIGITS} digits")


def read_bytes(path: Path, error: type[SlError], most: int = MAX_FILE_BYTES) -> bytes:
    """Return what a regular file holds; a device, pipe or folder is refused without a wait.

    Parameters
    ----------
    path : Path
        The file.
    error : type
        What is raised when there is none, it is no regular file, or it is too large.
    most : int
        Largest number of bytes, counted while reading.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
        with os.fdopen(handle, "rb") as file:
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                raise error(f"{path} is no regular file; expected a file of at most {most} bytes")
            data = file.read(most + 1)
    except (OSError, ValueError) as exc:
        raise error(f"cannot read {path}: {getattr(exc, 'strerror', None) or exc}") from None
    if len(data) > most:
        raise error(f"{path} has more than {most} bytes; expected a smaller file")
    return data


def read_text(path: Path, error: type[SlError]) -> str:
    """Return the text of a file; ``error`` when there is none or it is not UTF-8 text.

    Parameters
    ----------
    path : Path
        A regular file of at most `MAX_FILE_BYTES`; a byte order mark is skipped.
    error : type
        What is raised.
    """
    try:
        return read_bytes(path, error).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise error(f"{path} is not UTF-8 text; expected a text document") from None


def read_document(path: Path, error: type[SlError]) -> Any:
    """Return the YAML document in a file; see `parse_document`.

    Parameters
    ----------
    path : Path
        A regular file.
    error : type
        What is raised.
    """
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
    """Write a text file in one step: either the whole text is there or the old file is.

    Parameters
    ----------
    path : Path
        The file; its folder is made.
    text : str
        All of its text.
    """
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
        """Value of a key, checked by ``read``; the default, or an error when there is none.

        Parameters
        ----------
        key : str
            The key.
        read : callable
            Checks and returns its value, as `a_number` does.
        *default : object
            Returned when the key is missing.
        """
        if key in self._value:
            return read(self._value[key], f"{self._where}.{key}", self._error)
        if default:
            return default[0]
        raise self._error(f"{self._where} lacks the key {key}; is the file complete?")


def describe(value: Any) -> str:
    """Say what a value is, short enough for a message."""
    try:
        text = repr(value)
    except ValueError:  # an integer of thousands of digits
        text = "a number of very many digits"
    return f"{text if len(text) <= 60 else text[:57] + '...'} ({type(value).__name__})"


def a_string(value: Any, where: str, error: type[SlError]) -> str:
    """Check that a value is a non-empty string.

    Parameters
    ----------
    value : object
        What the document has.
    where : str
        Its place, for the message.
    error : type
        What is raised.
    """
    if not isinstance(value, str) or not value:
        raise error(f"{where} is {describe(value)}; expected a word")
    return value


def a_flag(value: Any, where: str, error: type[SlError]) -> bool:
    """Check that a value is true or false.

    Parameters
    ----------
    value, where, error
        As in `a_string`.
    """
    if not isinstance(value, bool):
        raise error(f"{where} is {describe(value)}; expected true or false")
    return value


def a_whole_number(value: Any, where: str, error: type[SlError]) -> int:
    """Check that a value is an integer (not a flag, not 3.0).

    Parameters
    ----------
    value, where, error
        As in `a_string`.
    """
    if isinstance(value, bool) or not isinstance(value, int):
        raise error(f"{where} is {describe(value)}; expected a whole number")
    return value


def a_number(value: Any, where: str, error: type[SlError]) -> float:
    """Check that a value is a finite number.

    Parameters
    ----------
    value, where, error
        As in `a_string`.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise error(f"{where} is {describe(value)}; expected a finite number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise error(f"{where} is {describe(value)}; expected a finite number")
    return number


def a_list(value: Any, where: str, error: type[SlError]) -> list[Any]:
    """Check that a value is a list.

    Parameters
    ----------
    value, where, error
        As in `a_string`.
    """
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
    """Check that a value is [width, height], two whole numbers of at least 1.

    Parameters
    ----------
    value, where, error
        As in `a_string`.
    """
    items = a_list(value, where, error)
    if len(items) != 2:
        raise error(f"{where} has {len(items)} entries; expected [width, height]")
    width, height = (a_whole_number(item, f"{where}[{i}]", error) for i, item in enumerate(items))
    if min(width, height) < 1:
        raise error(f"{where} is [{width}, {height}]; expected at least 1 x 1 pixels")
    return width, height
