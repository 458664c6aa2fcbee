"""Recordings of two small scans, and damage done to them at random.

As a script it does more of what the test does: ``python -m support.bag_damage 200`` in ``tests``
(seeds 0 to 199).
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sl_bringup.bag.bag_recorder import BagRecorder
from sl_bringup.bag.bag_writer import new_bag, topic_qos
from sl_bringup.bag.bags import open_bag
from sl_bringup.evaluation.evaluate_bag import Choices, Crew, evaluate_bag
from sl_common.errors import SlError
from sl_common.topics import CALIBRATION, EVALUATED_TOPICS
from sl_reconstruct.cloud.cloud_reader import read_cloud
from sl_reconstruct.model.calibration_file import Calibration
from support.scenes.rigs import tiny_rig
from support.scenes.tiny_bags import START_NS, write_scans
from support.scenes.tiny_scans import HEIGHT_M, SLOPE, render, tiny_sequence

#: Kinds of bags; only the recorder's own have checksums.
KINDS = ("recorder", "compressed", "split", "rosbags", "sqlite3")
CHECKED = KINDS[:3]
SCANS = 2


def make(kind: str, path: Path) -> Path:
    """Make a bag of two scans."""
    stacks = [render(tiny_sequence("precise"), seed) for seed in range(1, SCANS + 1)]
    plain = path if kind not in CHECKED else path.with_name(f"{path.name}_plain")
    with new_bag(plain, "sqlite3" if kind == "sqlite3" else "mcap") as bag:
        bag.calibration(Calibration(tiny_rig()), "true", START_NS)
        write_scans(bag, stacks)
    if plain != path:
        split = 600_000 if kind == "split" else 0
        with open_bag(plain) as old, BagRecorder(path, {}, split, kind == "compressed") as new:
            for topic in EVALUATED_TOPICS:
                new.add_topic(f"/sl/{topic.name}", topic.msgtype, topic_qos(topic))
            for raw in old.raw(CALIBRATION, *EVALUATED_TOPICS[:3]):
                name = f"/sl/{raw.topic.name}"
                new.write(name, raw.received_ns, raw.received_ns, bytes(raw.data))
    return path


def damage(path: Path, seed: int) -> str:
    """Cut, flip bits of, overwrite or take bytes out of one file of a bag; say what was done."""
    rng = np.random.default_rng(seed)
    files = sorted(p for p in path.iterdir() if p.is_file())
    large = [p for p in files if p.suffix in (".mcap", ".db3")]
    file = (
        files[rng.integers(len(files))] if rng.random() < 0.2 else large[rng.integers(len(large))]
    )
    content = bytearray(file.read_bytes())
    at = int(rng.integers(len(content)))
    how = ("cut", "flip", "flips", "zeros", "noise", "gap", "gone")[
        rng.choice(7, p=[0.3, 0.2, 0.15, 0.12, 0.1, 0.1, 0.03])
    ]
    length = int(rng.integers(1, 4000))
    if how == "cut":
        del content[at:]
    elif how in ("flip", "flips"):
        for place in rng.integers(len(content), size=1 if how == "flip" else 64):
            content[place] ^= 1 << int(rng.integers(8))
    elif how == "zeros":
        content[at : at + length] = bytes(min(length, len(content) - at))
    elif how == "noise":
        length = min(length, len(content) - at)
        content[at : at + length] = rng.bytes(length)
    elif how == "gap":
        del content[at : at + length]
    file.write_bytes(content)
    if how == "gone":
        file.unlink()
    if rng.random() < 0.3:  # as a killed recorder of another kind leaves it
        (path / "metadata.yaml").unlink(missing_ok=True)
    return f"{file.name}: {how} at byte {at} of {len(content)}"


@dataclass
class Found:
    """What an evaluation said of a bag: scans by verdict, hashes and errors of the good ones."""

    refused: str = ""
    good: int = 0
    hashes: tuple[str, ...] = ()
    worst_m: float = 0.0
    told: bool = False


def look(bag: Path, output: Path) -> Found:
    """Evaluate a bag; a SlError is a refusal, anything else is a fault and raised."""
    try:
        with Crew(1) as crew:
            result = evaluate_bag(bag, output, Choices(pictures="none"), crew)
    except SlError as error:
        return Found(refused=str(error))
    good = [r for r in result.reports if r["good"]]
    worst = [deviation_m(output / r["folder"] / "cloud.pcd") for r in good]
    told = bool(result.lost or any(r["reasons"] for r in result.reports))
    hashes = tuple(r["cloud_hash"] for r in good)
    return Found("", len(good), hashes, max(worst, default=0.0), told)


def deviation_m(cloud: Path) -> float:
    """Largest distance of 99 % of the points from the plane that was rendered, metres."""
    points = read_cloud(cloud)
    error = points["z"] - HEIGHT_M - SLOPE * points["x"]
    return float(np.nanquantile(np.abs(error), 0.99))


def main() -> None:
    """Damage bags of every kind and count what is said of them."""
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        whole = {kind: make(kind, base / kind) for kind in KINDS}
        clean = {kind: look(bag, base / "out") for kind, bag in whole.items()}
        for seed in range(int(sys.argv[1])):
            kind = KINDS[seed % len(KINDS)]
            shutil.rmtree(base / "hurt", ignore_errors=True)
            shutil.copytree(whole[kind], base / "hurt")
            done = damage(base / "hurt", seed)
            began_s = time.monotonic()
            found = look(base / "hurt", base / "out")
            lasted_s = time.monotonic() - began_s
            same = all(h in clean[kind].hashes for h in found.hashes)
            word = "refused" if found.refused else f"{found.good} good"
            word += "" if same else f", other bits ({found.worst_m * 1e6:.3f} um)"
            silent = not found.refused and found.good < SCANS and not found.told
            counts[kind + ": " + word.split(" (")[0] + (" SILENT" if silent else "")] += 1
            line = f"{seed:4} {kind:10} {done:50} {word} {lasted_s:.2f} s {found.refused[:120]}"
            sys.stdout.write(line + (" SILENT" if silent else "") + "\n")
    sys.stdout.write("\n".join(f"{n:5} {what}" for what, n in sorted(counts.items())) + "\n")


if __name__ == "__main__":
    main()
