"""Where numba keeps this project's compiled kernels: one directory for each state of the sources.

numba's own cache looks only at the file that a kernel is written in. A kernel that calls one of
another file keeps the other's old code after an edit or an update, without a word. Every package
with kernels calls :func:`choose` before numba is imported, so kernels compiled from other sources
are never found.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import shutil
import sys
import time
from pathlib import Path

PACKAGES = ("sl_projector", "sl_reconstruct", "sl_calibration", "sl_bench")
UNUSED_AFTER_S = 30 * 24 * 3600


def choose() -> None:
    """Point numba to the cache of the sources as they are, below a user's NUMBA_CACHE_DIR if set.

    To be called before numba is imported; child processes find the choice in their environment.
    """
    directory = _directory()
    try:
        directory.mkdir(parents=True, exist_ok=True)
        os.utime(directory)
    except OSError:
        return  # numba then looks for a place of its own
    os.environ["NUMBA_CACHE_DIR"] = str(directory)
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(directory)
    _forget_unused(directory.parent)


def mark(name: str) -> Path:
    """Path of a file that tells, by being there, that ``name`` is compiled in this cache."""
    return _directory() / f"{name}.compiled"


@functools.cache
def _directory() -> Path:
    digest = _digest()
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        return Path(given) if Path(given).name == digest else Path(given) / digest
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "slrig" / "kernels" / digest


def _digest() -> str:
    """Digest of every source file with a kernel in it, and of where it lies."""
    digest = hashlib.sha256()
    for name in PACKAGES:
        spec = importlib.util.find_spec(name)
        for place in (spec.submodule_search_locations or ()) if spec else ():
            for file in sorted(Path(place).rglob("*.py")):
                text = file.read_bytes()
                if b"njit" in text:
                    digest.update(str(file).encode() + b"\0" + text)
    return digest.hexdigest()[:16]


def _forget_unused(root: Path) -> None:
    for old in root.glob("?" * 16):
        if time.time() - old.stat().st_mtime > UNUSED_AFTER_S:
            shutil.rmtree(old, ignore_errors=True)
