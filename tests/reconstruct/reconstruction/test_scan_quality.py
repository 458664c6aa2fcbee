"""What is said about a stack or a cloud as a whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sl_common.errors import StackError
from sl_reconstruct.cloud.cloud import CLOUD_DTYPE, Cloud
from sl_reconstruct.reconstruction.scan_quality import (
    check_identity,
    check_order,
    check_phase,
    in_order,
    verdict,
)


def cloud(present: int = 90, **refused: int) -> Cloud:
    counts = dict.fromkeys(("contrast", "geometry", "step"), 0) | refused
    nothing = np.zeros((1, 1), np.float32)
    return Cloud(
        np.zeros((1, 1), CLOUD_DTYPE), nothing, nothing.astype(np.uint8), counts,
        present + sum(counts.values()),
    )  # fmt: skip


def test_a_full_cloud_is_good() -> None:
    assert verdict(cloud(95, contrast=5)) == (True, [])


def test_rays_that_miss_each_other_are_said() -> None:
    gap = np.full((2, 2), 0.25, np.float32)
    good, reasons = verdict(replace(cloud(), gap_m=gap, gap_px=gap * 40))
    assert not good
    assert "miss each other by 250 mm (10 px" in reasons[0]


@pytest.mark.parametrize(
    ("bad", "word"),
    [
        (cloud(0), "no light"), (cloud(0, contrast=8), "contrast"), (cloud(10, step=90), "10.0%"),
        (cloud(80, geometry=20), "do not meet"),
    ],
)  # fmt: skip
def test_what_is_missing_is_said(bad: Cloud, word: str) -> None:
    good, reasons = verdict(bad)
    assert not good and any(word in r for r in reasons)


def test_order_of_a_row() -> None:
    straight = np.arange(100, dtype=np.float32)
    blocks = np.concatenate([straight[:25], straight[75:], straight[50:75], straight[25:50]])
    assert in_order(straight) == 1.0 == in_order(straight[::-1])
    assert in_order(blocks) == 0.5  # two of the four blocks can stay
    assert np.isnan(in_order(straight[:3]))
    with pytest.raises(StackError, match="50% of the boundaries lie in order"):
        check_order(np.stack([blocks, blocks]))


def test_an_image_that_was_exchanged_is_named() -> None:
    u = np.tile(np.arange(64, dtype=np.float32), (4, 1))
    owner = np.arange(64) % 4
    check_phase(u, owner, [7, 8, 9, 10])
    u[:, 2::4] += 1
    with pytest.raises(StackError, match="image 9: its edges lie"):
        check_phase(u, owner, [7, 8, 9, 10])


def test_edges_that_contradict_the_code_are_counted_per_image() -> None:
    tally = np.zeros((10, 2, 2), np.int32)
    tally[:, :, 0] = 100
    check_identity(tally, [7, 8])
    tally[:, 1, 1] = 90
    with pytest.raises(StackError, match="image 8: 900 of 1900 edges"):
        check_identity(tally, [7, 8])
