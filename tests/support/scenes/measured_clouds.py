"""Synthetic organised clouds whose heights and noise are known, for the tests of measurements."""

from collections.abc import Callable

import numpy as np

FIELDS = [(name, "f8") for name in ("x", "y", "z", "intensity", "sigma")]
SIGMA_M = 0.3e-6


def cloud(
    height: Callable[[np.ndarray, np.ndarray], np.ndarray],
    shape: tuple[int, int] = (50, 60),
    size_m: tuple[float, float] = (4e-3, 3e-3),
    sigma_m: float = SIGMA_M,
    seed: int = 0,
) -> np.ndarray:
    """Heights over a grid about the origin, with normal noise of the sigma that they state."""
    rng = np.random.default_rng(seed)
    points = np.zeros(shape, FIELDS)
    points["x"] = np.linspace(-size_m[0] / 2, size_m[0] / 2, shape[1])
    points["y"] = np.linspace(size_m[1] / 2, -size_m[1] / 2, shape[0])[:, None]
    points["sigma"] = sigma_m * (1.0 + 0.5 * rng.random(shape))
    points["z"] = height(points["x"], points["y"])
    points["z"] += points["sigma"] * rng.standard_normal(shape)
    points["intensity"] = 200.0
    return points
