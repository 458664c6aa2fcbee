"""Planes through points: closed forms, noise, outliers, and what is no plane."""

from __future__ import annotations

import numpy as np
import pytest

from sl_reconstruct.cloud.plane_fit import fit_plane

NORMAL = np.array([-0.3, 0.2, 1.0]) / np.linalg.norm([-0.3, 0.2, 1.0])


def points_on_plane(n: int, seed: int = 3) -> np.ndarray:
    """Points on z = 0.1 + 0.3 x - 0.2 y, whose normal is (-0.3, 0.2, 1)."""
    xy = np.random.default_rng(seed).uniform(-5e-3, 5e-3, (n, 2))
    return np.column_stack([xy, 0.1 + 0.3 * xy[:, 0] - 0.2 * xy[:, 1]])


def test_exact_plane() -> None:
    plane = fit_plane(points_on_plane(100))
    assert plane is not None
    np.testing.assert_allclose(plane.normal, NORMAL, atol=1e-12)
    # Coordinates are about 0.1 m in double precision: 0.1 * 2^-52 = 2e-17 each, a few of them.
    assert plane.rms_m < 1e-15
    assert (plane.used, plane.set_aside) == (100, 0)


def test_noise_is_the_residual() -> None:
    sigma = 2e-7
    noise = np.random.default_rng(4).normal(0, sigma, 20_000)
    points = points_on_plane(20_000) + noise[:, np.newaxis] * NORMAL
    plane = fit_plane(points)
    assert plane is not None
    # The estimate of a standard deviation from n points scatters by sigma / sqrt(2 n).
    assert plane.rms_m == pytest.approx(sigma, abs=4 * sigma / np.sqrt(40_000))
    np.testing.assert_allclose(plane.distances_m(points), noise, atol=0.05 * sigma)
    # Tilt: sigma / (sqrt(n) * standard deviation of x) = 2e-7 / (141 * 2.9e-3) = 5e-7 rad.
    assert np.linalg.norm(np.cross(plane.normal, NORMAL)) < 5 * 5e-7


def test_outliers_are_set_aside() -> None:
    rng = np.random.default_rng(5)
    points = points_on_plane(10_000)
    points += rng.normal(0, 1e-7, 10_000)[:, np.newaxis] * NORMAL
    points[:300] += rng.uniform(5e-5, 1e-3, 300)[:, np.newaxis] * NORMAL
    plane = fit_plane(points)
    assert plane is not None
    # 300 outliers, and of 9700 normal deviates beyond 5 sigma none is expected (6e-7 each).
    assert plane.set_aside == pytest.approx(300, abs=2)
    assert plane.rms_m == pytest.approx(1e-7, rel=0.05)


def test_missing_points_do_not_matter() -> None:
    points = points_on_plane(50)
    points[::3, 2] = np.nan
    plane = fit_plane(points)
    assert plane is not None
    assert plane.used == np.isfinite(points[:, 2]).sum()


def test_the_normal_points_up() -> None:
    plane = fit_plane(points_on_plane(10) * [1, 1, -1])
    assert plane is not None
    assert plane.normal[2] > 0


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.zeros((2, 3)),
        np.full((9, 3), np.nan),
        np.outer(np.arange(9.0), [1.0, 2.0, 3.0]),
        np.ones((9, 3)),
    ],
    ids=["none", "two", "nan", "line", "one place"],
)
def test_what_spans_no_plane_gives_none(points: np.ndarray) -> None:
    assert fit_plane(points) is None
