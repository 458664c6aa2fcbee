"""Hold the wheels to the source tree: every file of every package, types, data, licence."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DATA = ("config/*.yaml",)


def expected() -> set[str]:
    """Paths in the wheel of all that git has in the Python packages of src/."""
    wanted = set()
    for setup in sorted(ROOT.glob("src/*/setup.py")):
        package = setup.parent.name
        command = ["git", "-C", setup.parent, "ls-files", package]
        wanted |= set(subprocess.check_output(command, text=True).split())
        wanted.add(f"{package}/py.typed")
        wanted |= {
            f"share/{package}/{file.relative_to(setup.parent).as_posix()}"
            for pattern in DATA for file in setup.parent.glob(pattern)
        }  # fmt: skip
    return wanted


def contents(wheel: Path) -> set[str]:
    """Paths as they are installed: without the metadata, data below the prefix."""
    with zipfile.ZipFile(wheel) as file:
        names = set(file.namelist())
    assert any(n.endswith(".dist-info/licenses/LICENSE") for n in names), (
        f"{wheel.name}: no licence"
    )
    return {n.partition(".data/data/")[2] or n for n in names if ".dist-info/" not in n}


def main() -> None:
    """Fail when a wheel lacks its licence, or slrig's has too few or too many files."""
    found = {Path(name).name.partition("-")[0]: contents(Path(name)) for name in sys.argv[1:]}
    assert found.keys() == {"slrig", "sl_interfaces"}, sorted(found)
    wanted = expected()
    assert wanted == found["slrig"], (
        f"missing {sorted(wanted - found['slrig'])}, not in git {sorted(found['slrig'] - wanted)}"
    )


if __name__ == "__main__":
    main()
