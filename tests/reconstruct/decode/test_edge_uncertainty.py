"""What bends and uneven light do to edges and centres, and that the stated sigma covers it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from sl_bench.world.optics import Optics
from sl_bench.world.surfaces import make_surface
from sl_bench.world.world import World
from sl_projector.sequence.pattern_sequence import PatternSequence, named
from sl_reconstruct.decode.axis_decoder import first_tuning
from sl_reconstruct.decode.decode_plan import DecodePlan, make_layout
from sl_reconstruct.decode.edge_uncertainty import find_centres, widen_edges
from sl_reconstruct.decode.edges import Tuning
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.decode.types import Lines, Noise, line_at
from sl_reconstruct.reconstruction.correspondence import decode_columns
from sl_reconstruct.reconstruction.reconstructor import Reconstructor
from support.scenes.bench_scenes import NOMINAL_S, tilt
from support.scenes.rigs import small_rig

Array = NDArray[np.float64]

PAPER = DecodePlan.of(named("paper"))
LAYOUT = make_layout(PAPER.column)
K = np.arange(PAPER.column.size_px, dtype=np.float64)
IS_EDGE, IS_CENTRE = LAYOUT.edge_owner >= 0, LAYOUT.centre_owner >= 0
OWN_PX = 1e-3


def tuning() -> Tuning:
    """1.3 pixels a boundary, a blur of 1.1 pixels, images without noise."""
    first = first_tuning(PAPER.column, Settings(), 255)
    return first._replace(scale=1.3, blur_px=1.1, jump_px=np.inf)


def row_of(u_px: Array, level_dn: Array | float = 200.0) -> Lines:
    """A row whose boundaries are all found, each with the same noise."""
    n = u_px.size
    return Lines(
        u_px.astype(np.float32), np.full(n, OWN_PX, np.float32), np.ones(n, np.float32),
        np.broadcast_to(np.float32(level_dn), n).copy(), np.zeros(n, np.uint8),
        np.zeros((len(PAPER.column.sources), 2), np.int32),
    )  # fmt: skip


def widened(t: Tuning, row: Lines) -> NDArray[np.float32]:
    """Sigma with bends and uneven light; that of noise alone stays as it is."""
    wide_px, noise_px = np.empty_like(row.sigma_px), row.sigma_px.copy()
    widen_edges(t, row.u_px, row.level_dn, row.sigma_px, wide_px)
    np.testing.assert_array_equal(row.sigma_px, noise_px)
    return wide_px


def centres_of(u_px: Array) -> tuple[Array, Array]:
    """Errors of all centres of a row whose edges are where they should be, and their sigma."""
    row = row_of(np.where(IS_EDGE, u_px, np.nan))
    row.reason[~IS_EDGE] = 1
    find_centres(LAYOUT, False, tuning(), row)
    got = IS_CENTRE & (row.reason == 0)
    assert got.sum() >= IS_CENTRE.sum() - 8  # some lack an edge at the DMD's borders
    return (row.u_px - u_px)[got], row.sigma_px[got].astype(np.float64)


def test_a_straight_row_keeps_its_sigma() -> None:
    """A centre is the mean of two edges: it has 1 / sqrt(2) of their noise, and no more."""
    error, sigma_px = centres_of(40.0 + 1.3 * K)
    assert np.abs(error).max() < 2e-4  # float32 at 1300 px
    assert sigma_px == pytest.approx(OWN_PX / np.sqrt(2), rel=1e-6)
    row = row_of(40.0 + 1.3 * K)
    assert widened(tuning(), row) == pytest.approx(OWN_PX, rel=1e-6)


def test_a_centre_on_a_parabola_states_its_error() -> None:
    """The mean of edges 4 boundaries away errs by 8 u''; float32 leaves 1e-4 px."""
    bend = 0.004
    error, sigma_px = centres_of(40.0 + 1.3 * K + bend * (K - 512) ** 2 / 2)
    assert error == pytest.approx(8 * bend, abs=5e-4)
    # At the DMD's borders some edges are missing.
    assert (sigma_px > 0.98 * np.abs(error))[8:-8].all()
    # Half a lead's miss, 11 u'', is the other measure: sigma is no more than the larger one.
    assert (sigma_px < 1.05 * 11 * bend)[8:-8].all()


@pytest.mark.parametrize("step_px", [0.0, 0.3])
def test_a_centre_over_a_kink_or_a_step_states_its_error(step_px: float) -> None:
    """Wherever the kink lies: a centre k errs by change / 2 (4 - |k - kink|), at most 2 changes."""
    worst = []
    for kink in np.arange(507.1, 517.0, 0.25):
        beyond = kink < K
        turned = 40.0 + 1.3 * K + beyond * (step_px + 0.05 * (K - kink))
        error, sigma_px = centres_of(turned)
        worst.append(np.nanmax(np.abs(error / np.hypot(sigma_px, 0.002))))
        assert sigma_px[:100] == pytest.approx(OWN_PX / np.sqrt(2), rel=0.01)
    # At the worst places the error is two sigma, never many.
    assert max(worst) < 2.2


def test_light_and_bend_widen_an_edge_by_what_they_may_do() -> None:
    """Light exp(g u): g s^2. Second difference d: d s^2 / (4 scale^2), less what is noise."""
    t, slope, bend = tuning(), 0.01, 0.03
    straight = 40.05 + 1.3 * np.arange(64.0)
    lit = row_of(straight, 100.0 * np.exp(slope * np.round(straight)))
    # Towards the lighter side over one or two pixels the slope is (exp(2 g) - 1) / 2, 1 % more.
    expected = np.hypot(OWN_PX, slope * 1.1**2)
    assert widened(t, lit)[2:-2] == pytest.approx(expected, rel=0.015)
    bent = row_of(straight + bend * (np.arange(64) - 32.0) ** 2 / 2)
    expected = np.hypot(OWN_PX, bend * 1.1**2 / (4 * 1.3**2))
    assert widened(t, bent)[2:-2] == pytest.approx(expected, rel=0.02)


def test_neighbours_on_one_side_are_enough() -> None:
    t = tuning()
    u = 40.0 + 1.3 * np.arange(64.0) + 0.03 * (np.arange(64) - 32.0) ** 2 / 2
    whole, half = (row_of(u, 300.0 + 2.0 * np.round(u)) for _ in range(2))
    half.u_px[:31] = np.nan
    half.level_dn[:31] = 1e6  # what was left there by another row
    assert widened(t, half)[31:] == pytest.approx(widened(t, whole)[31:], rel=0.1)
    lonely = row_of(np.where(np.arange(64) == 32, 50.0, np.nan))
    assert widened(t, lonely)[32] == np.float32(OWN_PX)


LENS_PX, PITCH_PX, START_PX, COLUMNS, DMD_PX = 0.9, 1.4, 20.3, 760, 512
RAMP_PX, SLOPE = 95, 0.012
_FINE = 15  # odd: one sample lies in the middle of each pixel


def _ramps(u: Array) -> Array:
    """Log of the light: up and down with a constant slope."""
    return SLOPE * np.abs((u + RAMP_PX) % (2 * RAMP_PX) - RAMP_PX)


def _seen_in_ramps(sequence: PatternSequence) -> Lines:
    """What is decoded of stripes in such light, seen by a lens whose blur is all there is."""
    u = (np.arange(COLUMNS * _FINE) + 0.5) / _FINE - 0.5
    light = np.exp(_ramps(u))
    rng = np.random.default_rng(8)
    frames = []
    for pattern in sequence.patterns:
        column = np.floor((u - START_PX) / PITCH_PX).astype(int)
        inside = (column >= 0) & (column < DMD_PX)
        lit = inside & pattern.profile(DMD_PX)[np.clip(column, 0, DMD_PX - 1)]
        seen = gaussian_filter1d(light * lit, LENS_PX * _FINE)
        line = 60.0 + 1000.0 * seen[_FINE // 2 :: _FINE]
        noisy = line + rng.normal(0, 1.0, (16, COLUMNS))
        frames.append(np.clip(np.rint(noisy), 0, 4095).astype(np.uint16))
    return decode_columns(np.array(frames), sequence, Settings())


def test_light_that_grows_moves_an_edge_and_sigma_says_so() -> None:
    """A step in light exp(g u), blurred to s by the lens, is seen g s^2 before its place.

    exp(g u) convolved with a Gaussian is itself, times a constant, about a mean g s^2 away: exact.
    """
    sequence = named("precise", (DMD_PX, 8))
    lines = _seen_in_ramps(sequence)
    k = np.arange(DMD_PX)
    truth = START_PX + k * PITCH_PX
    from_corner = np.abs((truth + RAMP_PX / 2) % RAMP_PX - RAMP_PX / 2)
    inside = (k > 3) & (k < DMD_PX - 3) & (from_corner > 8)
    sign = np.where((truth + RAMP_PX) % (2 * RAMP_PX) > RAMP_PX, 1.0, -1.0)
    error = (lines.u_px - truth)[:, inside].mean(axis=0)
    shift = -(sign * SLOPE * LENS_PX**2)[inside]
    # 16 rows of 5e-4 px leave 1e-4. Point samples of so narrow a blur add 3e-3 by their phase.
    assert error == pytest.approx(shift, abs=4e-3)
    assert np.mean(error / shift) == pytest.approx(1.0, abs=0.1)
    t = tuning()._replace(scale=PITCH_PX, blur_px=LENS_PX, noise=Noise(1.1, 0.0))
    sigma_px = np.array([widened(t, line_at(lines, row)) for row in range(len(lines.u_px))])
    score = error / sigma_px[:, inside].mean(axis=0)
    # All of the blur is the lens's here, so the error is the most that sigma allows for.
    assert np.median(np.abs(score)) == pytest.approx(1.0, abs=0.15)
    assert np.abs(score).max() < 1.6


C, S = np.cos(np.deg2rad(20.0)), np.sin(np.deg2rad(20.0))
#: About z, so that walls cross columns instead of standing on one.
TURNED = np.array([[C, -S, 0.0], [S, C, 0.0], [0.0, 0.0, 1.0]])
SCENES = {
    "coin": ("coin", np.eye(3), (480, 330, 400, 130)),
    "coin_tilted": ("coin", tilt(3.0, -2.0), (800, 600, 300, 130)),
    "groove": ("groove", np.eye(3), (300, 400, 1000, 24)),
    "cap": ("sphere_cap", np.eye(3), (300, 430, 900, 40)),
    "steps": ("steps", TURNED, (300, 400, 1000, 40)),
}


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("sequence", ["paper", "precise"])
def test_stated_sigma_covers_the_bench_where_it_bends(sequence: str, name: str) -> None:
    """Column errors against the truth, in sigmas: 1 on average, and no tail beyond 5."""
    surface, rotation, window = SCENES[name]
    world = World(small_rig(window), make_surface(surface), Optics(seed=21))
    world.move(rotation, np.zeros(3))
    patterns = named(sequence)
    frames = [
        world.expose([(patterns.frame(i), NOMINAL_S)], NOMINAL_S, i) for i in range(len(patterns))
    ]
    reconstruct = Reconstructor(world.rig, patterns)
    cloud = reconstruct(np.stack(frames))
    there = np.isfinite(cloud.u_px)
    rows = np.broadcast_to(np.arange(there.shape[0], dtype=float)[:, None], there.shape)
    truth = world.truth_points(np.stack([cloud.u_px[there], rows[there]], axis=-1))
    score = (cloud.points["z"][there] - truth[:, 2]) / cloud.points["sigma"][there]
    print(f"{score.size} points, sd {score.std():.3f}, beyond 5: {(np.abs(score) > 5).mean():.2e}")
    assert score.size > 15000
    assert 0.85 < score.std() < 1.15
    assert (np.abs(score) > 5).mean() < 1e-3
    assert np.abs(score).max() < 20
