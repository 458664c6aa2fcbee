"""Compiled kernels must never outlive the sources that they were made of."""

import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from sl_common import kernel_cache

CALLEE = """
from sl_common.kernel_cache import kernel

@kernel()
def number():
    return {value}
"""
CALLER = """
from sl_common.kernel_cache import kernel
from sl_inner.callee import number

@kernel()
def twice():
    return 2 * number()

print(twice())
"""


def run(folder, cache):
    """Run the caller in a process of its own, on a package set that lies in ``folder``."""
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    environment |= {"PYTHONPATH": str(folder), "XDG_CACHE_HOME": str(cache)}
    done = subprocess.run(
        [sys.executable, "-c", "import sl_outer.caller"],
        env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return int(done.stdout)


@pytest.fixture
def packages(tmp_path):
    """A package with a kernel, and another whose kernel calls it."""
    for name in ("sl_common", "sl_inner", "sl_outer"):
        (tmp_path / "src" / name).mkdir(parents=True)
        (tmp_path / "src" / name / "__init__.py").touch()
    source = Path(kernel_cache.__file__).read_text()
    (tmp_path / "src" / "sl_common" / "kernel_cache.py").write_text(source)
    (tmp_path / "src" / "sl_outer" / "caller.py").write_text(CALLER)
    return tmp_path / "src"


def test_a_caller_follows_an_edit_of_the_kernel_it_calls(packages, tmp_path):
    (packages / "sl_inner" / "callee.py").write_text(CALLEE.format(value=21))
    assert run(packages, tmp_path / "cache") == 42
    (packages / "sl_inner" / "callee.py").write_text(CALLEE.format(value=50))
    # numba's own cache would still say 42: caller.py did not change
    assert run(packages, tmp_path / "cache") == 100


def test_a_kernel_follows_an_edit_of_a_constant_elsewhere(packages, tmp_path):
    callee = CALLEE.replace("{value}", "VALUE").replace(
        "\n@", "from sl_inner.values import VALUE\n\n@"
    )
    (packages / "sl_inner" / "callee.py").write_text(callee)
    (packages / "sl_inner" / "values.py").write_text("VALUE = 21\n")
    assert run(packages, tmp_path / "cache") == 42
    (packages / "sl_inner" / "values.py").write_text("VALUE = 50\n")
    assert run(packages, tmp_path / "cache") == 100


def test_a_package_keeps_its_kernels_when_only_its_users_change(packages, tmp_path):
    (packages / "sl_inner" / "callee.py").write_text(CALLEE.format(value=21))
    run(packages, tmp_path / "cache")
    before = set((tmp_path / "cache/slrig/kernels").iterdir())
    (packages / "sl_outer" / "caller.py").write_text(CALLER + "\n# another line\n")
    run(packages, tmp_path / "cache")
    after = set((tmp_path / "cache/slrig/kernels").iterdir())
    assert len(before) == 2  # one folder a package
    assert before < after
    assert len(after) == 3


def test_a_users_own_cache_directory_and_kernels_stay(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernel_cache.directory.cache_clear()
    before = numba.config.CACHE_DIR
    try:
        assert kernel_cache.directory("sl_reconstruct").parent == tmp_path
        assert before == numba.config.CACHE_DIR
    finally:
        kernel_cache.directory.cache_clear()
