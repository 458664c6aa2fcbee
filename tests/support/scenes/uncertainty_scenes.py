"""Surfaces of every measurement with known truth: z-scores of all stated quantities by seed.

A z-score is (measured - true) / stated uncertainty. Shapes and places change with the seed where
a fixed one would hide a bias; truths are closed forms, but for roughness: there it is what the
same map shows of the surface without noise.
"""

from collections.abc import Callable

import numpy as np
from scipy.special import erf

from sl_reconstruct.measure.deviation import measure_deviation
from sl_reconstruct.measure.hole import measure_hole
from sl_reconstruct.measure.plane_angle import measure_angle, measure_plane
from sl_reconstruct.measure.profile import measure_profile
from sl_reconstruct.measure.region import Region, select
from sl_reconstruct.measure.roughness import measure_roughness
from sl_reconstruct.measure.sphere_cylinder import measure_cylinder, measure_sphere
from sl_reconstruct.measure.step import measure_step
from support.scenes.measured_clouds import SIGMA_M, cloud

Scores = dict[str, float]


def plane(seed: int) -> Scores:
    points = select(cloud(lambda x, y: 0.1 * x - 0.03 * y + 1e-3, seed=seed))
    m = measure_plane(points, flatness=False)
    x, y, z = m.point_m
    above = z - (0.1 * x - 0.03 * y + 1e-3)
    return {"a": (m.a - 0.1) / m.u_a, "b": (m.b + 0.03) / m.u_b, "c": above / m.u_c_m}


def flat(seed: int) -> Scores:
    """No form at all: the flatness is nothing but noise."""
    m = measure_plane(select(cloud(lambda x, y: 0.1 * x, (120, 160), seed=seed)))
    return {"flatness": m.value / m.uncertainty}


def cells(height: Callable, rows: int, columns: int) -> np.ndarray:
    """Means of a surface over the 40 x 40 cells of a `cloud` of so many points."""
    x = np.linspace(-2e-3, 2e-3, columns)
    y = np.linspace(1.5e-3, -1.5e-3, rows)[:, None]
    z = height(x, y)
    at_x = np.minimum((40 * np.arange(columns) / (columns - 1)).astype(int), 39)
    at_y = np.minimum((40 * np.arange(rows) / (rows - 1)).astype(int), 39)
    number = (at_y[:, None] * 40 + at_x).ravel()
    design = np.column_stack([np.ones(z.size), (x + 0 * y).ravel(), (y + 0 * x).ravel()])
    level = z.ravel() - design @ np.linalg.lstsq(design, z.ravel(), rcond=None)[0]
    return np.bincount(number, level) / np.bincount(number)


def bow(seed: int) -> Scores:
    """A bow and a wave of random size: 1 to 10 um where a cell's noise is 0.1 um."""
    rng = np.random.default_rng(30_000 + seed)
    a, b, c, phase = *(rng.uniform(0.2, 1.5, 2) * rng.choice([-1, 1], 2)), *rng.random(2)
    form = lambda x, y: (  # noqa: E731
        a * x * x + b * y * y + 1e-6 * c * np.sin(3e3 * x + 6 * phase)
    )
    m = measure_plane(select(cloud(form, (120, 160), seed=seed)))
    return {"flatness": (m.value - np.ptp(cells(form, 120, 160))) / m.uncertainty}


def rough_plane(seed: int) -> Scores:
    """Form that differs from cell to cell, five times their noise."""
    steps = 0.5e-6 * np.random.default_rng(40_000 + seed).standard_normal((40, 40))
    form = lambda x, y: steps[  # noqa: E731
        np.minimum(((1.5e-3 - y) / 3e-3 * 40).astype(int), 39),
        np.minimum(((x + 2e-3) / 4e-3 * 40).astype(int), 39),
    ]
    m = measure_plane(select(cloud(form, (120, 160), seed=seed)))
    return {"flatness": (m.value - np.ptp(cells(form, 120, 160))) / m.uncertainty}


SLOPE = 0.2131


def angle(seed: int) -> Scores:
    points = cloud(lambda x, y: SLOPE * np.abs(x), (40, 100), seed=seed)
    flanks = [select(points, mask=points["x"] * side > 1e-4) for side in (-1, 1)]
    m = measure_angle(*flanks)
    return {"angle": (m.value - 180.0 + 2.0 * np.degrees(np.arctan(SLOPE))) / m.uncertainty}


def step(seed: int) -> Scores:
    points = cloud(lambda x, y: 0.01 * x + 5e-5 * (np.abs(x) < 0.6e-3), (30, 150), seed=seed)
    m = measure_step(select(points))
    return {"height": (m.value - 5e-5) / m.uncertainty}


def sphere(seed: int) -> Scores:
    m = measure_sphere(select(cloud(lambda x, y: np.sqrt(0.05**2 - x * x - y * y), seed=seed)))
    scores = {"radius": (m.value - 0.05) / m.uncertainty}
    return scores | {
        f"centre {n}": c / u for n, c, u in zip("xyz", m.centre_m, m.u_centre_m, strict=True)
    }


def cylinder(seed: int) -> Scores:
    points = cloud(lambda x, y: np.sqrt(5e-3**2 - (0.8 * x + 0.6 * y) ** 2), (30, 40), seed=seed)
    m = measure_cylinder(select(points))
    return {"radius": (m.value - 5e-3) / m.uncertainty}


def disc(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A dark disc of 0.4 mm and its centre, anywhere between the points.

    Its own light is anything that `HOLE_LIGHT` allows.
    """
    points = cloud(lambda x, y: 0.0 * x, (90, 100), (0.8e-3, 0.72e-3), seed=seed)
    rng = np.random.default_rng(10_000 + seed)
    own, centre = 0.04 * rng.random(), 1e-5 * rng.random(2)
    outside_m = np.hypot(points["x"] - centre[0], points["y"] - centre[1]) - 0.2e-3
    light = own + (1.0 - own) * 0.5 * (1.0 + erf(outside_m / (9e-6 * np.sqrt(2.0))))
    points["intensity"] = 200.0 * light + 1.5 * rng.standard_normal(points.shape)
    for name in "xyz":
        points[name][points["intensity"] < 20.0] = np.nan
    return points, centre


AROUND = Region.rectangle(-0.39e-3, -0.35e-3, 0.39e-3, 0.35e-3)


def hole(seed: int) -> Scores:
    points, centre = disc(seed)
    m = measure_hole(points, AROUND)
    assert m.method == "intensity"
    return {
        "diameter": (m.value - 0.4e-3) / m.uncertainty,
        "centre x": (m.centre_m[0] - centre[0]) / m.u_centre_m[0],
        "centre y": (m.centre_m[1] - centre[1]) / m.u_centre_m[1],
    }


def profile(seed: int) -> Scores:
    """A step on a part that is tilted across the section."""
    form = lambda x, y: 5e-5 * (np.abs(x) < 0.6e-3) - 0.08 * y  # noqa: E731
    points = cloud(form, (60, 100), seed=seed)
    m = measure_profile(points, (-1.9e-3, 0.0), (1.9e-3, 0.0), 0.4e-3, 5e-5)
    top = int(np.argmin(np.abs(m.along_m - 1.9e-3)))
    return {
        "height": (m.value - 5e-5) / m.uncertainty,
        "z of a bin": m.z_m[10] / m.u_z_m[10],
        "z on top": (m.z_m[top] - 5e-5) / m.u_z_m[top],
    }


def deviation(seed: int) -> Scores:
    m = measure_deviation(cloud(lambda x, y: 1e-3 * x + 5e-8, seed=seed), lambda x, y: 1e-3 * x)
    return {"mean": (m.value - 5e-8) / m.uncertainty}


def _roughness(height: Callable, seed: int, noise_m: float) -> Scores:
    size, shape = (1.2e-3, 0.9e-3), (46, 61)
    exact = measure_roughness(cloud(height, shape, size, 0.0), step_m=2e-5).raw
    m = measure_roughness(cloud(height, shape, size, noise_m, seed), step_m=2e-5)
    return {name: (m.corrected[name] - exact[name]) / m.uncertainties[name] for name in exact}


def wave(seed: int) -> Scores:
    """A cosine of 0.5 um under a noise of 0.1: hundreds of near ties along its ridges."""
    return _roughness(lambda x, y: 0.5e-6 * np.cos(2 * np.pi * x / 0.2e-3), seed, 0.08e-6)


def ground(seed: int) -> Scores:
    """A random surface of 0.3 um and 40 um correlation length under a noise of 0.1 um."""
    from scipy.ndimage import gaussian_filter

    rough = gaussian_filter(np.random.default_rng(50_000 + seed).standard_normal((46, 61)), 2.0)
    rough *= 0.3e-6 / rough.std()
    return _roughness(lambda x, y: rough, seed, 0.08e-6)


#: What is measured: a function of the seed.
SCENES: dict[str, Callable[[int], Scores]] = {
    "plane": plane, "flatness of a flat": flat, "flatness of a bow": bow,
    "flatness, rough": rough_plane, "angle": angle, "step": step, "sphere": sphere,
    "cylinder": cylinder, "hole": hole, "profile": profile, "deviation": deviation,
    "roughness, wave": wave, "roughness, ground": ground,
}  # fmt: skip


def z_scores(name: str, seeds: range) -> dict[str, np.ndarray]:
    """Scores of a scene over seeds, by quantity."""
    rows = [SCENES[name](seed) for seed in seeds]
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


__all__ = ["AROUND", "SCENES", "SIGMA_M", "disc", "z_scores"]
