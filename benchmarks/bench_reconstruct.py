"""How long a stack takes from images to cloud, against copying it in memory; noise and memory.

Run as ``python benchmarks/bench_reconstruct.py`` with the packages on the path. Times are medians
of one run; "copy" is numpy's copy of the stack into memory that is already there, "fresh copy"
one into new memory, as the cloud's own is.
"""

from __future__ import annotations

import resource
import statistics
import time
from collections.abc import Callable

import numpy as np

from sl_bench.optics import Optics
from sl_bench.reference import reference_rig
from sl_bench.surfaces import make_surface
from sl_bench.world import World
from sl_projector.sequence import named
from sl_reconstruct.reconstruct import Reconstructor
from sl_reconstruct.settings import Settings

EXPOSURE_S = 1.0 / 30.0


def median_ms(work: Callable[[], object], repeats: int = 15) -> float:
    """Median duration, two calls to warm up."""
    times = []
    for i in range(repeats + 2):
        start = time.perf_counter()
        work()
        if i > 1:
            times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def bench(name: str, estimator: str, stack: np.ndarray, world: World) -> None:
    reconstruct = Reconstructor(world.rig, named(name), Settings(estimator=estimator))
    cloud = reconstruct(stack)
    target = np.empty_like(stack)
    copy_ms = median_ms(lambda: np.copyto(target, stack))
    fresh_ms = median_ms(stack.copy)
    ms = median_ms(lambda: reconstruct(stack))
    rate = cloud.present / ms / 1e3
    z = cloud.points["z"][np.isfinite(cloud.points["z"])]
    print(
        f"{name} {estimator}: {ms:.1f} ms = {ms / copy_ms:.1f} x copy ({copy_ms:.1f} ms) = "
        f"{ms / fresh_ms:.1f} x fresh copy ({fresh_ms:.1f} ms); {rate:.1f} million points/s; "
        f"z 1-sigma {z.std() * 1e6:.3f} um; edge noise {cloud.figures.bound_ratio:.3f} x bound"
    )


def main() -> None:
    world = World(reference_rig(), make_surface("flat"), Optics())
    for name in ("paper", "precise"):
        sequence = named(name)
        stack = np.stack(
            [
                world.expose([(sequence.frame(i), EXPOSURE_S)], EXPOSURE_S, i)
                for i in range(len(sequence))
            ]
        )
        for estimator in ("matched", "cubic"):
            bench(name, estimator, stack, world)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak resident memory {peak_mb:.0f} MB, world and stacks included")


if __name__ == "__main__":
    main()
