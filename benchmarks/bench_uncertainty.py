"""Whether stated uncertainties cover the truth: z-scores of every measurement over seeds.

Run as ``python benchmarks/bench_uncertainty.py [SEEDS]`` with the packages on the path. A standard
deviation of 1 says that the uncertainty is right, above that it is too small. The last lines scan
the simulated bench, where errors are not those of a formula: groove, sphere and steps at poses.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from sl_bench.world.optics import Optics
from sl_bench.world.reference_rig import reference_rig
from sl_bench.world.surfaces import make_surface
from sl_bench.world.world import World
from sl_projector.sequence.pattern_sequence import named
from sl_reconstruct.measure.groove import measure_groove
from sl_reconstruct.measure.region import Region, Selection, select
from sl_reconstruct.measure.sphere_cylinder import measure_sphere
from sl_reconstruct.measure.step import measure_step
from sl_reconstruct.reconstruction.reconstructor import Reconstructor
from support.scenes.uncertainty_scenes import SCENES, z_scores

EXPOSURE_S = 1.0 / 30.0
POSES = 10
STEPS_M, STEP_WIDTH_M = (10e-6, 50e-6, 200e-6), 1.6e-3


def tell(name: str, quantity: str, z: np.ndarray) -> None:
    print(f"{name:<22}{quantity:<14}{len(z):4d}{z.mean():+8.2f}{z.std(ddof=1):8.2f}", flush=True)


def pose(world: World, seed: int) -> None:
    """Turn the part by up to 4 degrees about each axis, shift it by up to half a millimetre."""
    rng = np.random.default_rng(seed)
    turned = np.eye(3)
    for axis, angle in enumerate(np.deg2rad(rng.uniform(-4.0, 4.0, 3))):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        one = np.eye(3)
        one[i, i] = one[j, j] = np.cos(angle)
        one[i, j], one[j, i] = -np.sin(angle), np.sin(angle)
        turned = one @ turned
    world.move(turned, rng.uniform(-0.5e-3, 0.5e-3, 3))


def clouds(surface: str) -> Iterator[tuple[World, np.ndarray]]:
    """Scans of a surface of the bench at poses, each with noise of its own."""
    sequence, world = named("precise"), World(reference_rig(), make_surface(surface))
    for seed in range(POSES):
        world.optics = Optics(seed=seed)
        pose(world, seed)
        frames = (
            world.expose([(sequence.frame(i), EXPOSURE_S)], EXPOSURE_S, i)
            for i in range(len(sequence))
        )
        yield world, Reconstructor(world.rig, sequence)(np.stack(list(frames))).points


def groove() -> np.ndarray:
    found = [measure_groove(points) for _, points in clouds("groove")]
    return np.array([(m.value - 155.92) / m.uncertainty for m in found])


def sphere() -> np.ndarray:
    scores = []
    for world, points in clouds("sphere_cap"):
        x, y = world.pose[1][:2]
        cap = Region.rectangle(x - 2.5e-3, y - 2.5e-3, x + 2.5e-3, y + 2.5e-3)
        m = measure_sphere(select(points, cap))
        scores.append((m.value - 50e-3) / m.uncertainty)
    return np.array(scores)


def steps() -> np.ndarray:
    """Heights across the part's own faces: the cloud is turned back first."""
    scores = []
    for world, points in clouds("steps"):
        rotation, shift = world.pose
        chosen = select(points)
        part = (chosen.xyz_m - shift) @ rotation
        for k, height in enumerate(STEPS_M):
            left = (2 * k - len(STEPS_M) + 0.5) * STEP_WIDTH_M
            walls = (left, left + STEP_WIDTH_M)
            near = (np.abs(part[:, 0] - np.mean(walls)) < 1.45 * STEP_WIDTH_M) & (
                np.abs(part[:, 1]) < 3e-3
            )
            m = measure_step(Selection(part[near], chosen.sigma_m[near]), walls_m=walls)
            scores.append((m.value - height) / m.uncertainty)
    return np.array(scores)


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    print(f"{'measurement':<22}{'quantity':<14}{'n':>4}{'mean z':>8}{'sd of z':>8}")
    for name in SCENES:
        for quantity, z in z_scores(name, range(seeds)).items():
            tell(name, quantity, z)
    for name, scan in (("groove", groove), ("sphere", sphere), ("steps", steps)):
        tell(f"bench, {name}", f"{POSES} poses", scan())


if __name__ == "__main__":
    main()
