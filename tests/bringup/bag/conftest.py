"""A small bag in each storage format."""

from __future__ import annotations

from pathlib import Path

import pytest

from sl_bringup.bag.bag_writer import Storage, new_bag
from support.scenes.made_bags import fill, frames


@pytest.fixture(params=["mcap", "sqlite3"])
def storage(request: pytest.FixtureRequest) -> Storage:
    return request.param


@pytest.fixture
def bag_path(tmp_path: Path, storage: Storage) -> Path:
    with new_bag(tmp_path / "a", storage) as bag:
        fill(bag, frames())
    return tmp_path / "a"
