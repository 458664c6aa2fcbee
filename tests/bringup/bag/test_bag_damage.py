"""Damaged recordings give what is readable, say what is lost, and never a cloud that is wrong."""

from __future__ import annotations

import shutil
from functools import cache
from pathlib import Path

import pytest

from sl_bringup.bag.bags import open_bag
from sl_common.topics import IMAGE
from support.bag_damage import CHECKED, KINDS, SCANS, Found, damage, look, make

#: The worst 1 % of the points left out; whole bags have 1.35 um, an exchanged image a thousand.
WRONG_M = 5e-6


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("bags")
    return {kind: make(kind, folder / kind) for kind in KINDS}


@cache
def whole(bag: Path) -> Found:
    return look(bag, bag.with_name(f"{bag.name}_out"))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("kind", KINDS)
def test_damage(bags: dict[str, Path], tmp_path: Path, kind: str, seed: int) -> None:
    clean = whole(bags[kind])
    assert clean.good == SCANS and not clean.told
    shutil.copytree(bags[kind], tmp_path / "hurt")
    damage(tmp_path / "hurt", 1000 * KINDS.index(kind) + seed)
    found = look(tmp_path / "hurt", tmp_path / "out")
    if found.refused:
        return  # in words, as an error of ours
    assert found.good == SCANS or found.told
    assert found.worst_m < WRONG_M
    if kind in CHECKED:
        assert set(found.hashes) <= set(clean.hashes)


@pytest.mark.parametrize("part", [0.3, 0.6, 0.9])
def test_a_cut_sqlite_file_gives_the_messages_before_the_cut(
    bags: dict[str, Path], tmp_path: Path, part: float
) -> None:
    """All but those whose pages, or whose way to them, lay behind: the last ones."""
    shutil.copytree(bags["sqlite3"], tmp_path / "a")
    (file,) = (tmp_path / "a").glob("*.db3")
    with open_bag(tmp_path / "a") as bag:
        everything = [raw.received_ns for raw in bag.raw(IMAGE)]
    file.write_bytes(file.read_bytes()[: int(part * file.stat().st_size)])
    with open_bag(tmp_path / "a") as bag:
        found = [raw.received_ns for raw in bag.raw(IMAGE)]
        assert any("unreadable" in line for line in bag.lost)
    assert found == everything[: len(found)]
    assert len(found) > 0.8 * part * len(everything)
