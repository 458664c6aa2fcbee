"""Roughness, exchange formats and foreign libraries: analytic surfaces and a measured coin."""

import numpy as np
import pytest

from sl_common.errors import StackError
from sl_reconstruct.cloud.height_map import HeightMap
from sl_reconstruct.cloud.x3p_writer import save_x3p
from sl_reconstruct.measure.plane_angle import measure_plane
from sl_reconstruct.measure.region import Region, Selection, select
from sl_reconstruct.measure.roughness import areal_parameters, measure_roughness
from sl_reconstruct.measure.sphere_cylinder import measure_sphere
from support.paths import DATA
from support.scenes.measured_clouds import cloud

surfalize = pytest.importorskip("surfalize", reason="pip install surfalize")

COIN = DATA / "surfaces" / "coin_us_dime.tmd"
STEP_M, WAVE_M, AMPLITUDE_M = 1e-6, 100e-6, 0.8e-6


def cosine(waves: int = 4) -> np.ndarray:
    """Whole waves along x, sampled at the middle of 100 intervals each; 20 rows."""
    x_m = (np.arange(100 * waves) + 0.5) * STEP_M
    return AMPLITUDE_M * np.cos(2 * np.pi * x_m / WAVE_M) + np.zeros((20, 1))


def test_a_cosine_has_the_roughness_of_its_closed_form() -> None:
    """Sampling: Sq and Ssk are exact, Sa is off by (pi / 100)^2 / 6, Sz by (pi / 100)^2 / 2.

    The slope is taken from differences over a step: sin(pi / 100) / (pi / 100) too small, and
    Sdr is half its square to first order in the slope's square (0.0013).
    """
    found = areal_parameters(cosine(), STEP_M)
    assert found["Sq"] == pytest.approx(AMPLITUDE_M / np.sqrt(2.0), rel=1e-9)
    assert found["Sa"] == pytest.approx(AMPLITUDE_M * 2.0 / np.pi, rel=2e-4)
    assert found["Sz"] == pytest.approx(2.0 * AMPLITUDE_M, rel=6e-4)
    assert found["Ssk"] == pytest.approx(0.0, abs=1e-9)
    assert found["Sku"] == pytest.approx(1.5, rel=1e-9)
    steep = 2 * np.pi * AMPLITUDE_M / WAVE_M / np.sqrt(2.0) * np.sinc(1.0 / 100.0)
    # The last interval of the last wave is missing from the mean: one part in 400.
    assert found["Sdq"] == pytest.approx(steep, rel=1 / 400)
    assert found["Sdr"] == pytest.approx(0.5 * steep**2, rel=1 / 200 + 0.0013)


def test_a_tilted_plane_has_no_roughness() -> None:
    tilted = 0.1 * STEP_M * np.arange(50) + 0.2 * STEP_M * np.arange(40)[:, None]
    found = areal_parameters(tilted, STEP_M)
    assert found["Sz"] < 1e-18 + 1e-15 * 50 * STEP_M * 1e6


def test_missing_borders_are_cut_and_single_holes_filled() -> None:
    whole, torn = cosine(), np.full((26, 420), np.nan)
    torn[3:23, 10:410] = whole
    torn[8, 57] = np.nan  # filled from its neighbour, 1 of 8000 nodes
    a, b = areal_parameters(whole, STEP_M), areal_parameters(torn, STEP_M)
    assert b["Sq"] == pytest.approx(a["Sq"], rel=1e-3)
    with pytest.raises(StackError, match="too few heights"):
        areal_parameters(np.full((10, 10), np.nan), STEP_M)


def test_noise_is_taken_off_the_roughness() -> None:
    """Coverage: `test_measure.py`. Of points that state no noise nothing can be taken off."""
    wave = lambda x, y: 0.5e-6 * np.cos(2 * np.pi * x / 0.2e-3)  # noqa: E731
    size, shape = (1.2e-3, 0.9e-3), (46, 61)
    exact = measure_roughness(cloud(wave, shape, size, 0.0), step_m=2e-5)
    assert np.isnan(exact.uncertainty)
    assert exact.corrected == exact.raw
    m = measure_roughness(cloud(wave, shape, size, 0.08e-6, 1), step_m=2e-5)
    for name in ("Sz", "Sdq", "Sdr"):
        assert m.raw[name] > exact.raw[name]
        assert abs(m.corrected[name] - exact.raw[name]) < 4.0 * m.uncertainties[name]
    assert [q.name for q in m.quantities()][:2] == ["Sq", "Sa"]


def test_noise_that_differs_from_place_to_place_is_taken_off_the_kurtosis() -> None:
    """A cosine has Sku 1.5. Noise of 0.1 um on one half and 0.3 on the other has a fourth cumulant
    of 3 (0.08 / 2)^2 um^4 and adds 0.31 to that: 3 * 0.0016 / 0.125^2.
    """
    wave = lambda x, y: 0.5e-6 * np.cos(2 * np.pi * x / 0.2e-3)  # noqa: E731
    points = cloud(wave, (46, 61), (1.2e-3, 0.9e-3), 0.0)
    points["sigma"] = np.where(points["y"] > 0.0, 0.1e-6, 0.3e-6)
    points["z"] += points["sigma"] * np.random.default_rng(3).standard_normal(points.shape)
    m = measure_roughness(points, step_m=2e-5)
    assert m.uncertainties["Sku"] < 0.31 / 4.0
    # 61 nodes are 6 waves and one more crest, of power two: Sku is 1.51.
    assert m.corrected["Sku"] == pytest.approx(1.51, abs=3.0 * m.uncertainties["Sku"])


def test_a_flat_has_no_shape_of_heights() -> None:
    """Ssk and Sku divide by Sq, which is nothing but noise here."""
    flat = cloud(lambda x, y: 0.0 * x, (46, 61), (1.2e-3, 0.9e-3), 0.08e-6)
    m = measure_roughness(flat, step_m=2e-5)
    assert m.corrected["Sq"] < 3.0 * m.uncertainty
    assert np.isnan([m.corrected["Ssk"], m.corrected["Sku"]]).all()


# -- X3P -------------------------------------------------------------------------------------------


def a_map() -> HeightMap:
    z = cosine(1).astype(np.float32)
    z[0, 0] = np.nan
    z[-1] += np.float32(1e-6)
    return HeightMap(z, -5e-5, 1e-5, STEP_M)


def test_a_foreign_reader_finds_the_heights_in_x3p(tmp_path) -> None:
    height = a_map()
    save_x3p(tmp_path / "map.x3p", height)
    back = surfalize.Surface.load(tmp_path / "map.x3p")
    assert back.step_x == pytest.approx(1e6 * STEP_M)
    assert back.step_y == pytest.approx(1e6 * STEP_M)
    # Micrometres in it; rows of X3P go upwards.
    np.testing.assert_array_equal(np.float32(back.data * 1e-6), height.z_m[::-1])


def test_another_foreign_reader_finds_them_too(tmp_path) -> None:
    topography = pytest.importorskip("SurfaceTopography")
    height = a_map()
    save_x3p(tmp_path / "map.x3p", height)
    back = topography.read_topography(str(tmp_path / "map.x3p"))
    assert back.nb_grid_pts == (100, 20)
    scale = {"m": 1.0, "mm": 1e-3, "µm": 1e-6}[back.unit]
    assert scale * back.physical_sizes[0] == pytest.approx(100 * STEP_M)
    found = np.ma.filled(back.heights(), np.nan) * scale
    # Its arrays are (x, y); whichever way y runs, the rows are ours.
    rows = found.T if np.isnan(found.T[-1, 0]) else found.T[::-1]
    np.testing.assert_allclose(rows, height.z_m[::-1], rtol=1e-6)


# -- a measured coin ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def coin() -> tuple[np.ndarray, float]:
    """Heights (rows, columns) and step of the measured dime, metres, read by a foreign reader."""
    if not COIN.is_file():
        pytest.skip(f"no {COIN.name} in ../shared/data/surfaces")
    surface = surfalize.Surface.load(COIN)
    return surface.data * 1e-6, surface.step_x * 1e-6


def test_roughness_of_the_coin_is_that_of_the_definitions(coin) -> None:
    """ISO 25178-2, 4.1, written out, after levelling by numpy."""
    z_m, step_m = coin
    found, heights = areal_parameters(z_m, step_m), z_m - plane_of(z_m)
    heights = heights - heights.mean()
    root_mean_square = np.sqrt(np.mean(heights**2))
    assert found["Sq"] == pytest.approx(root_mean_square, rel=1e-9)
    assert found["Sa"] == pytest.approx(np.abs(heights).mean(), rel=1e-9)
    assert found["Sp"] == pytest.approx(heights.max(), rel=1e-9)
    assert found["Sv"] == pytest.approx(-heights.min(), rel=1e-9)
    assert found["Sz"] == pytest.approx(np.ptp(heights), rel=1e-9)
    assert found["Ssk"] == pytest.approx(np.mean(heights**3) / root_mean_square**3, rel=1e-9)
    assert found["Sku"] == pytest.approx(np.mean(heights**4) / root_mean_square**4, rel=1e-9)


@pytest.mark.filterwarnings("ignore:Function/property:DeprecationWarning")
def test_roughness_of_the_coin_agrees_with_another_library(coin) -> None:
    topography = pytest.importorskip("SurfaceTopography", reason="pip install SurfaceTopography")
    z_m, step_m = coin
    rows, columns = z_m.shape
    levelled = topography.Topography(
        (z_m - plane_of(z_m)).T.copy(), (columns * step_m, rows * step_m)
    )
    found = areal_parameters(z_m, step_m)
    assert found["Sq"] == pytest.approx(levelled.rms_height_from_area(), rel=1e-9)


def plane_of(z_m: np.ndarray) -> np.ndarray:
    """Least squares plane of heights on a grid, by numpy."""
    v, u = np.indices(z_m.shape)
    design = np.column_stack([u.ravel(), v.ravel(), np.ones(z_m.size)])
    found = np.linalg.lstsq(design, z_m.ravel(), rcond=None)[0]
    return (design @ found).reshape(z_m.shape)


def test_the_plane_of_the_coin_agrees_with_an_independent_fit(coin) -> None:
    """Total least squares by scipy's singular values."""
    from scipy.linalg import svd

    z_m, step_m = coin
    v, u = np.indices(z_m.shape)
    xyz = np.column_stack([u.ravel() * step_m, v.ravel() * step_m, z_m.ravel()])[::7]
    m = measure_plane(Selection(xyz, np.zeros(len(xyz))))
    assert m.set_aside == 0
    _, _, axes = svd(xyz - xyz.mean(axis=0), full_matrices=False)
    normal = axes[2] * np.sign(axes[2, 2])
    np.testing.assert_allclose(m.normal, normal, atol=1e-9)
    distance = (xyz - xyz.mean(axis=0)) @ normal
    assert m.rms_m == pytest.approx(np.sqrt(np.mean(distance**2)), rel=1e-9)


def test_a_sphere_agrees_with_scipy() -> None:
    """The same orthogonal distances, minimised by scipy's Levenberg-Marquardt."""
    from scipy.optimize import least_squares

    points = select(cloud(lambda x, y: np.sqrt(0.02**2 - x * x - y * y) + 1e-3, seed=4))
    m = measure_sphere(points)
    xyz = points.xyz_m * 1e3

    def distance(p: np.ndarray) -> np.ndarray:
        return np.linalg.norm(xyz - p[:3], axis=1) - p[3]

    fit = least_squares(distance, [0, 0, 0, 15], method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    # To the last stated digit: the uncertainty is 0.5 um, so far below a hundredth of that.
    assert m.value == pytest.approx(fit.x[3] * 1e-3, abs=0.01 * m.uncertainty)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * (2 * fit.cost / m.dof)
    assert m.uncertainty == pytest.approx(1e-3 * np.sqrt(covariance[3, 3]), rel=0.1)


def test_roughness_wants_an_organised_cloud() -> None:
    flat = cloud(lambda x, y: 0.0 * x)
    with pytest.raises(StackError, match="organised"):
        measure_roughness(flat.ravel())
    with pytest.raises(StackError, match="no points"):
        measure_roughness(flat, Region.of([1, 1, 2, 2]))
