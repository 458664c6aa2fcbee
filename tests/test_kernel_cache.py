"""Compiled kernels must never outlive the sources that they were made of."""

import os
import subprocess
import sys
import types
from pathlib import Path

CALLEE = """
from numba import njit

@njit(cache=True)
def number():
    return {value}
"""
CALLER = """
from numba import njit
from sl_bench.callee import number

@njit(cache=True)
def twice():
    return 2 * number()

print(twice())
"""


def run(folder, cache):
    """Run the caller in a process of its own, on a package set that lies in ``folder``."""
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    environment |= {"PYTHONPATH": str(folder), "XDG_CACHE_HOME": str(cache)}
    done = subprocess.run(
        [sys.executable, "-c", "import sl_bench.caller"],
        env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return int(done.stdout)


def test_a_caller_follows_an_edit_of_the_kernel_it_calls(tmp_path):
    import sl_projector.kernel_cache as module

    for name in ("sl_projector", "sl_bench"):
        package = tmp_path / "src" / name
        package.mkdir(parents=True)
        (package / "__init__.py").write_text(
            "from sl_projector import kernel_cache\nkernel_cache.choose()\n"
        )
    kernel_cache = tmp_path / "src" / "sl_projector" / "kernel_cache.py"
    kernel_cache.write_text(Path(module.__file__).read_text())
    bench = tmp_path / "src" / "sl_bench"
    (bench / "caller.py").write_text(CALLER)
    (bench / "callee.py").write_text(CALLEE.format(value=21))
    assert run(tmp_path / "src", tmp_path / "cache") == 42
    (bench / "callee.py").write_text(CALLEE.format(value=50))
    # numba's own cache would still say 42: caller.py did not change
    assert run(tmp_path / "src", tmp_path / "cache") == 100


def test_child_processes_keep_the_choice(monkeypatch, tmp_path):
    from sl_projector import kernel_cache

    stand_in = types.SimpleNamespace(config=types.SimpleNamespace(CACHE_DIR=""))
    monkeypatch.setitem(sys.modules, "numba", stand_in)  # the real one's cache stays as it is
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernel_cache._directory.cache_clear()
    kernel_cache.choose()
    first = os.environ["NUMBA_CACHE_DIR"]
    kernel_cache._directory.cache_clear()
    kernel_cache.choose()
    assert os.environ["NUMBA_CACHE_DIR"] == first
    assert first.startswith(str(tmp_path))
    kernel_cache._directory.cache_clear()
