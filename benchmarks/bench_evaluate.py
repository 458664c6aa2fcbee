"""How many `precise` scans a second `slrig evaluate` gets through, without pictures.

Run as ``python benchmarks/bench_evaluate.py`` with the packages on the path; needs 1.1 GB in the
temporary directory. The bag is evaluated once from uncompressed chunks and once from zstd, as
``slrig record --compress`` writes them. CPU time counts on a machine that others load.
"""

from __future__ import annotations

import os
import resource
import tempfile
import time
from pathlib import Path

from sl_bench.world.optics import Optics
from sl_bench.world.reference_rig import reference_rig
from sl_bench.world.surfaces import make_surface
from sl_bench.world.world import World
from sl_bringup.bag.bag_writer import new_bag
from sl_bringup.bag.bags import open_bag, typestore
from sl_bringup.bag.mcap_writer import McapWriter
from sl_bringup.evaluation.evaluate_bag import Choices, Crew, evaluate_bag
from sl_common.topics import EVALUATED_TOPICS
from sl_projector.sequence.pattern_sequence import named
from sl_reconstruct.model.calibration_file import Calibration

SCANS = 12
START_NS, FRAME_NS, SCAN_NS = 1_700_000_000_000_000_000, 20_000_000, 2_000_000_000
EXPOSURE_S = 0.01


def write_bag(path: Path) -> None:
    """The same scan of a flat plate, so many times."""
    world, sequence = World(reference_rig(), make_surface("flat"), Optics()), named("precise")
    stack = [
        world.expose([(sequence.frame(i), EXPOSURE_S)], EXPOSURE_S, i) for i in range(len(sequence))
    ]
    with new_bag(path) as bag:
        bag.calibration(Calibration(world.rig), "true", START_NS)
        for scan in range(1, SCANS + 1):
            start_ns = START_NS + scan * SCAN_NS
            bag.pose((0.0, 0.0, 0.0), start_ns - FRAME_NS)
            for i, image in enumerate(stack):
                stamp_ns = start_ns + i * FRAME_NS
                bag.trigger(sequence, i, scan, stamp_ns, EXPOSURE_S)
                bag.image(image, stamp_ns, stamp_ns + FRAME_NS // 2)
            bag.pose((0.0, 0.0, 0.0), start_ns + len(stack) * FRAME_NS)


def compress(source: Path, target: Path) -> None:
    """Write the same messages as `slrig record` does when it compresses."""
    with open_bag(source) as bag:
        writer, channels = McapWriter(target, True, {}), {}
        for raw in bag.raw(*EVALUATED_TOPICS):
            kind = raw.topic.msgtype
            if raw.topic not in channels:
                definition, _ = typestore().generate_msgdef(kind, ros_version=2)
                channels[raw.topic] = writer.add_channel(
                    f"/sl/{raw.topic.name}", kind, definition, typestore().hash_rihs01(kind), ""
                )
            stamp_ns = raw.received_ns
            writer.write(channels[raw.topic], stamp_ns, stamp_ns, bytes(raw.data))
        writer.close()


def bench(name: str, bag: Path, output: Path) -> None:
    """Evaluate; the first three scans warm up."""
    marks: list[tuple[float, float]] = []

    def step() -> None:
        marks.append((time.perf_counter(), time.process_time()))

    jobs = len(os.sched_getaffinity(0))
    with Crew(jobs, step) as crew:
        result = evaluate_bag(bag, output, Choices(pictures="none"), crew)
    assert all(report["good"] for report in result.reports)
    (wall, cpu), (wall_end, cpu_end) = marks[2], marks[-1]
    scans = len(marks) - 3
    print(
        f"{name}: {scans / (wall_end - wall):.1f} scans/s on {jobs} cores; "
        f"CPU {(cpu_end - cpu) / scans:.3f} s a scan, so at most "
        f"{jobs * scans / (cpu_end - cpu):.1f} scans/s on {jobs} idle cores"
    )


def main() -> None:
    print(f"load before {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as folder:
        plain, packed = Path(folder, "plain"), Path(folder, "zstd.mcap")
        write_bag(plain)
        compress(plain, packed)
        bench("plain", plain, Path(folder, "a"))
        bench("zstd", packed, Path(folder, "b"))
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak resident memory {peak_mb:.0f} MB, world included")


if __name__ == "__main__":
    main()
