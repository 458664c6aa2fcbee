"""A small recording of made-up images, with triggers, poses and a calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sl_bench.world.reference_rig import reference_rig
from sl_bringup.bag.bag_writer import BagWriter
from sl_bringup.bag.bags import open_bag
from sl_common.topics import IMAGE
from sl_projector.sequence.pattern_sequence import named
from sl_reconstruct.model.calibration_file import Calibration

START_NS = 1_700_000_000_000_000_000
COUNT = 11


def frames(dtype: type = np.uint8) -> np.ndarray:
    rng = np.random.default_rng(5)
    return rng.integers(0, np.iinfo(dtype).max, (COUNT, 48, 64), dtype)


def fill(bag: BagWriter, images: np.ndarray) -> None:
    sequence = named("paper")
    bag.calibration(Calibration(reference_rig()), "made up", START_NS)
    for i, image in enumerate(images):
        stamp_ns = START_NS + i * 10_000_001
        bag.trigger(sequence, i, 7, stamp_ns, 0.005)
        bag.pose((0.001, -0.002, 0.003), stamp_ns)
        bag.image(image, stamp_ns, stamp_ns + 5_000_000)


def count_images(path: Path) -> tuple[int, list[str], list[str]]:
    with open_bag(path) as bag:
        images = sum(1 for _ in bag.messages(IMAGE))
        return images, bag.lost, bag.notes
