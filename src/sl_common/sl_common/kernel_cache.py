"""Compiled kernels, kept in one directory for each state of the sources that they are made of.

numba's own cache looks only at the file that a kernel is written in. A kernel that calls one of
another file keeps the other's old code after an edit or an update, without a word. `kernel` keeps
the kernels of a package under a digest of all its sources with kernels and of those that it
imports, so that kernels compiled from other sources are never found.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

UNUSED_AFTER_S = 30 * 24 * 3600
_OURS = re.compile(rb"^(?:from|import) (sl_[\w.]+)", re.MULTILINE)

_FunctionT = TypeVar("_FunctionT", bound=Callable[..., Any])


def kernel(**options: Any) -> Callable[[_FunctionT], _FunctionT]:
    """Return numba's `njit` as this project uses it: cached, and without the interpreter's lock.

    Parameters
    ----------
    **options
        Further options of `numba.njit`; ``error_model`` is ``"numpy"`` unless given.

    Returns
    -------
    callable
        A decorator. Nothing is compiled before the first call of what it returns.
    """

    def decorate(function: _FunctionT) -> _FunctionT:
        from numba import config, njit

        before = config.CACHE_DIR
        config.CACHE_DIR = str(directory(function.__module__.partition(".")[0]))
        try:
            settings = {"cache": True, "nogil": True, "error_model": "numpy"} | options
            compiled: _FunctionT = njit(**settings)(function)
        finally:
            config.CACHE_DIR = before
        return compiled

    return decorate


def compiled_mark(package: str, name: str) -> Path:
    """Path of a file that tells, by being there, that a set of kernels is compiled.

    Parameters
    ----------
    package : str
        The package that the kernels belong to.
    name : str
        What the set is called.
    """
    return directory(package) / f"{name}.compiled"


@functools.cache
def directory(package: str) -> Path:
    """Directory of the kernels of a package, below NUMBA_CACHE_DIR if the user has set it."""
    found = _base() / _digest(package)
    try:
        found.mkdir(parents=True, exist_ok=True)
        os.utime(found)
    except OSError:
        return found  # numba then looks for a place of its own
    _forget_unused(found.parent)
    return found


def _base() -> Path:
    given, cache = os.environ.get("NUMBA_CACHE_DIR"), os.environ.get("XDG_CACHE_HOME")
    if given:
        return Path(given)
    return (Path(cache) if cache else Path.home() / ".cache") / "slrig" / "kernels"


def _file(module: str) -> Path | None:
    spec = importlib.util.find_spec(module)
    return Path(spec.origin) if spec and spec.origin else None


def _sources(package: str) -> set[Path]:
    """Files that the package's kernels are made of: their own, and those of ours they import.

    A constant of another module is compiled into a kernel, so it counts whether or not there are
    kernels beside it.
    """
    spec = importlib.util.find_spec(package)
    places = (spec.submodule_search_locations or ()) if spec else ()
    left = [f for p in places for f in Path(p).rglob("*.py") if b"@kernel(" in f.read_bytes()]
    found: set[Path] = set()
    while left:
        file = left.pop()
        if file not in found:
            found.add(file)
            names = {name.decode() for name in _OURS.findall(file.read_bytes())}
            left += [origin for name in names if (origin := _file(name))]
    return found


def _digest(package: str) -> str:
    """Digest of the sources of a package's kernels, and of where they lie."""
    digest = hashlib.sha256()
    for file in sorted(_sources(package)):
        digest.update(str(file).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def _forget_unused(root: Path) -> None:
    for old in root.glob("?" * 16):
        if time.time() - old.stat().st_mtime > UNUSED_AFTER_S:
            shutil.rmtree(old, ignore_errors=True)
