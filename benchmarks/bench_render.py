"""How long the bench takes for a frame, in milliseconds and as ratios within one run.

Run as ``python benchmarks/bench_render.py`` with the packages on the path; prints one line per
step. Times are medians; the copy of a frame in memory is the unit of the ratios.
"""

from __future__ import annotations

import os
import resource
import statistics
import time
from collections.abc import Callable

import numpy as np

from sl_bench.world.optics import Optics
from sl_bench.world.reference_rig import reference_rig
from sl_bench.world.surfaces import make_surface
from sl_bench.world.world import World
from sl_projector.sequence.pattern_sequence import Pattern, precise

EXPOSURE_S = 1.0 / 30.0
DMD = (1024, 768)


def median_ms(work: Callable[[int], object], repeats: int = 7) -> float:
    """Median duration of ``work(i)``, one call to warm up."""
    work(-1)
    times = []
    for i in range(repeats):
        start = time.perf_counter()
        work(i)
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def shifted(i: int, axis: str = "column") -> np.ndarray:
    """A fine pattern that no call before has shown."""
    return Pattern("gray", axis, 6, 8, 4, (i + 1) % 32).frame(DMD)


def bench_surface(name: str, unit_ms: float) -> None:
    world = World(reference_rig(), make_surface(name), Optics())

    def geometry(i: int) -> None:
        world.move(np.eye(3), np.array([0.0, 0.0, 1e-6 * (i + 2)]))
        world.ambient_e_per_s()

    rows = [
        ("geometry of a new pose", median_ms(geometry, 3)),
        ("light of a column pattern", median_ms(lambda i: world.electrons_per_second(shifted(i)))),
        (
            "light of a row pattern",
            median_ms(lambda i: world.electrons_per_second(shifted(i, "row"))),
        ),
        ("noise and DN, light cached", median_ms(expose_cached(world))),
        ("frame, all of it", median_ms(expose_new(world))),
    ]
    for what, ms in rows:
        print(f"{name:12} {what:28} {ms:8.1f} ms  {ms / unit_ms:8.0f} x the copy of a frame")


def expose_cached(world: World) -> Callable[[int], object]:
    mirrors = precise().frame(0)
    return lambda i: world.expose([(mirrors, EXPOSURE_S)], EXPOSURE_S, i + 1)


def expose_new(world: World) -> Callable[[int], object]:
    # Offset: shifts that the pattern benchmark has not left in the cache.
    return lambda i: world.expose([(shifted(i + 16), EXPOSURE_S)], EXPOSURE_S, i + 1)


def main() -> None:
    frame = np.zeros((1200, 1600), dtype=np.uint8)
    unit_ms = median_ms(lambda _: frame.copy(), 50)
    load = os.getloadavg()[0]
    print(f"{os.cpu_count()} cores, load {load:.1f}; copy of a 1600x1200 frame {unit_ms:.3f} ms")
    for name in ("flat", "groove", "steps", "coin"):
        bench_surface(name, unit_ms)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak resident memory {peak:.0f} MB")


if __name__ == "__main__":
    main()
