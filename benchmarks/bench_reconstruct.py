"""How long a stack takes from images to cloud, against copying it in memory; noise and memory.

Run as ``python benchmarks/bench_reconstruct.py`` with the packages on the path. Times are medians
of one run in which reconstruction and copies take turns. "warm copy" is numpy's copy of the stack
into memory that is already there; "stack.copy()" takes new memory, as the cloud's own is, and is
what a user of a copy gets. "CPU" is user and system time of all threads: what counts on a machine
that others load.
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
from sl_projector.sequence.pattern_sequence import named
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.reconstruction.reconstructor import Reconstructor

EXPOSURE_S = 1.0 / 30.0
REPEATS = 25


def timed_ms(*works: Callable[[], object]) -> list[tuple[float, float]]:
    """Median wall and CPU time of each, taking turns; two rounds to warm up."""
    rounds = []
    for _ in range(REPEATS + 2):
        taken = []
        for work in works:
            began, cpu = time.perf_counter(), time.process_time()
            work()
            taken.append((1e3 * (time.perf_counter() - began), 1e3 * (time.process_time() - cpu)))
        rounds.append(taken)
    return [
        (statistics.median(wall for wall, _ in times), statistics.median(cpu for _, cpu in times))
        for times in zip(*rounds[2:], strict=True)
    ]


def bench(name: str, estimator: str, stack: np.ndarray, world: World) -> None:
    reconstruct = Reconstructor(world.rig, named(name), Settings(estimator=estimator))
    cloud = reconstruct(stack)
    target = np.empty_like(stack)
    (ms, cpu_ms), (warm_ms, _), (fresh_ms, _) = timed_ms(
        lambda: reconstruct(stack), lambda: np.copyto(target, stack), stack.copy
    )
    rate = cloud.present / ms / 1e3
    z = cloud.points["z"][np.isfinite(cloud.points["z"])]
    print(
        f"{name} {estimator}: {ms:.1f} ms (CPU {cpu_ms:.1f} ms) = {ms / warm_ms:.1f} x warm copy "
        f"({warm_ms:.1f} ms) = {ms / fresh_ms:.1f} x stack.copy() ({fresh_ms:.1f} ms); "
        f"{rate:.1f} million points/s; z 1-sigma {z.std() * 1e6:.3f} um; "
        f"edge noise {cloud.figures.bound_ratio:.3f} x bound"
    )


def main() -> None:
    load, cores = os.getloadavg()[0], len(os.sched_getaffinity(0))
    print(f"{cores} cores, load before {load:.1f}")
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
