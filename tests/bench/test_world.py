"""The world's images against closed forms: light, blur, edges, shadows, holes, noise."""

import numpy as np
import pytest
from scipy.optimize import curve_fit
from scipy.special import erf

from sl_bench.world.optics import Finish, Optics, make_finish
from sl_bench.world.surfaces import make_surface
from sl_bench.world.world import CACHED_FRAMES, World
from sl_common.errors import ConfigError
from sl_projector.sequence.pattern_sequence import Pattern, precise
from support.scenes.bench_scenes import NOMINAL_S, PLAIN, pixel_grid, small_world
from support.scenes.rigs import small_rig

DMD = (1024, 768)
WHITE = Pattern("white").frame(DMD)
FINE = Pattern("gray", "column", 7, 8, 4, 2)
FINE_ROWS = Pattern("gray", "row", 7, 8, 4, 2)
DN_E = 20_000 / 255


def to_dn(e_per_s: np.ndarray) -> np.ndarray:
    """8-bit DN after the nominal exposure."""
    return e_per_s.astype(float) * NOMINAL_S / DN_E


def at(image: np.ndarray, q: np.ndarray) -> np.ndarray:
    return image[q[:, 1].astype(int), q[:, 0].astype(int)]


# -- light ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flat():
    return small_world()


def test_white_is_190_at_the_origin(flat):
    u, v = np.rint(flat.rig.camera.project(np.zeros((1, 3)))[0]).astype(int)
    # Half a pixel from the origin, the light falls off by less than 1e-4.
    assert to_dn(flat.electrons_per_second(WHITE))[v, u] == pytest.approx(190.0, rel=1e-4)


def test_matt_plate_is_lambertian_under_a_point_source(flat):
    q = np.floor(pixel_grid(flat, 40))
    o, d = flat.rig.camera.position_m, flat.rig.camera.rays(q)
    plate = o - d * (o[2] / d[:, 2])[:, None]
    lamp = flat.rig.projector.position_m
    share = (lamp[2] / np.linalg.norm(lamp - plate, axis=1) ** 3) * (lamp @ lamp) ** 1.5 / lamp[2]
    # float32 through 28 filter taps: 1e-6.
    white = to_dn(flat.electrons_per_second(WHITE))
    assert at(white, q) == pytest.approx(190.0 * share, rel=5e-6)


def test_uneven_light_and_vignetting_take_their_share_at_the_corner():
    optics = Optics(uneven_light=0.2, vignetting=0.1, ambient=0.5)
    full, even = (small_world("flat", o, (0, 0, 1600, 1200)) for o in (optics, PLAIN))
    ambient = to_dn(full.ambient_e_per_s())
    assert ambient[599, 799] == pytest.approx(95.0, rel=1e-4)
    assert ambient[3, 3] == pytest.approx(95.0 * 0.9, rel=2e-3)
    corner = np.rint(full.rig.camera.project(full.truth_points(np.zeros((1, 2)))))
    assert corner == pytest.approx(np.zeros((1, 2)), abs=1e-6)
    ratio = full.electrons_per_second(WHITE)[600] / np.maximum(
        even.electrons_per_second(WHITE)[600], 1
    )
    u = np.array([200, 800, 1300])
    uv = full.rig.projector.project(
        full.truth_points(np.stack([u, np.full(3, 600)], axis=1).astype(float))
    )
    r2 = np.sum((uv - [511.5, 383.5]) ** 2, axis=1) / (512**2 + 384**2)
    s2 = ((u - 799.5) ** 2 + 0.25) / (800**2 + 600**2)
    assert ratio[u] == pytest.approx((1 - 0.2 * r2) * (1 - 0.1 * s2), rel=1e-4)


def test_light_adds_up(flat):
    fine, inverse = FINE.frame(DMD), FINE.inverse().frame(DMD)
    both = flat.electrons_per_second(fine) + flat.electrons_per_second(inverse)
    white = flat.electrons_per_second(WHITE)
    assert np.abs(both - white).max() < 1e-5 * white.max()
    assert not flat.electrons_per_second(np.zeros((768, 1024), dtype=bool)).any()


def test_dark_frame_is_ambient_only():
    world = small_world(optics=Optics(vignetting=0.0))
    dn = world.expose([], NOMINAL_S, 0).astype(float)
    variance = 5.7 / DN_E + 0.25 + 1 / 12  # DN^2: shot noise of 3 % of 190 DN, read noise, rounding
    assert dn.mean() == pytest.approx(5.7, abs=4 * np.sqrt(variance / dn.size))
    assert dn.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / dn.size))


def test_exposure_integrates_over_all_that_the_dmd_shows(flat):
    fine, inverse = FINE.frame(DMD), FINE.inverse().frame(DMD)
    mixed = flat.expose([(fine, NOMINAL_S / 2), (inverse, NOMINAL_S / 2)], NOMINAL_S, 5)
    halved = flat.expose([(WHITE, NOMINAL_S / 2)], NOMINAL_S, 6)
    expected = to_dn(flat.electrons_per_second(WHITE)) / 2
    sigma = np.sqrt(expected.mean() / DN_E + 0.25 + 1 / 12)
    for dn in (mixed, halved):
        assert (dn - expected).mean() == pytest.approx(0.0, abs=4 * sigma / np.sqrt(dn.size))
        assert (dn - expected).std() == pytest.approx(sigma, rel=0.02)
    whole = flat.expose([(fine, NOMINAL_S)], NOMINAL_S, 5)
    parts = flat.expose([(fine, NOMINAL_S / 4), (fine, 0.75 * NOMINAL_S)], NOMINAL_S, 5)
    # The same light but for the last bit of float32, which may tip a rounding here and there.
    assert np.mean(whole != parts) < 1e-3


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (10, np.uint16), (12, np.uint16)])
def test_scale_follows_the_bits(bits, dtype):
    world = small_world(optics=Optics(bits=bits, uneven_light=0, vignetting=0, ambient=0))
    top = (1 << bits) - 1
    dn = world.expose([(WHITE, NOMINAL_S)], NOMINAL_S, 0)
    light = to_dn(world.electrons_per_second(WHITE)).mean()
    assert dn.dtype == dtype
    assert dn.mean() == pytest.approx(light / 255 * top, rel=1e-4)
    assert (world.expose([(WHITE, 2 * NOMINAL_S)], NOMINAL_S, 0) == top).all()


def test_bare_metal_saturates_in_part_and_paint_does_not():
    dn = {
        f: World(small_rig((300, 500, 1000, 40)), make_surface("flat"), Optics(), f).expose(
            [(WHITE, NOMINAL_S)], NOMINAL_S, 1
        )
        for f in ("metal", "painted")
    }
    assert 0.05 < np.mean(dn["metal"] == 255) < 0.8
    assert dn["painted"].max() < 255
    assert np.std(dn["painted"]) > 1.5 * np.sqrt(190 / DN_E + 0.25)


def test_lobe_is_brightest_in_the_mirror_direction():
    finish = Finish(diffuse=0.0, specular=2.0, lobe_deg=3.0)
    world = small_world(finish=finish)
    lamp, eye = world.rig.projector.position_m, world.rig.camera.position_m
    half = (lamp / np.linalg.norm(lamp) + eye / np.linalg.norm(eye)) / 2
    half /= np.linalg.norm(half)
    # Turn the part about y until its normal is the half vector at the origin.
    z = half
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    world.move(np.stack([x, np.cross(z, x), z], axis=1), np.zeros(3))
    u, v = world.rig.camera.project(np.zeros((1, 3)))[0]
    white = to_dn(world.electrons_per_second(WHITE))
    cos_in = half @ lamp / np.linalg.norm(lamp)
    flat_cos = lamp[2] / np.linalg.norm(lamp)
    expected = 190.0 * 2.0 * cos_in / flat_cos
    assert white[round(v), round(u)] == pytest.approx(expected, rel=1e-3)
    _, peak_u = np.unravel_index(white.argmax(), white.shape)
    # A lobe 3 degrees wide on a field where the half vector turns 0.3 degrees per mm.
    assert abs(peak_u - u) < 120
    assert white[100, 0] < 0.99 * white[100, round(u)]
    assert make_finish("metal").specular > 0


# -- blur and edges ------------------------------------------------------------------------


def edge_model(x, x0, height, s, slope):
    return (height + slope * (x - x0)) * erf((x - x0) / s / np.sqrt(2.0))


def fitted_edges(difference: np.ndarray, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position and standard deviation of blurred steps along one line."""
    found = []
    for x in guess:
        n = np.arange(round(x) - 4, round(x) + 5)
        y = difference[n].astype(float) / np.abs(difference[n]).max()
        start = (x, np.sign(y[-1] - y[0]), 1.1, 0.0)
        found.append(curve_fit(edge_model, n, y, p0=start)[0])
    found = np.array(found)
    return found[:, 0], found[:, 2]


def edges_of(pattern: Pattern) -> np.ndarray:
    profile = pattern.profile(DMD[0 if pattern.axis == "column" else 1])
    return np.flatnonzero(profile[1:] != profile[:-1]) + 1


@pytest.mark.parametrize("name", ["flat", "sphere_cap", "groove"])
@pytest.mark.parametrize("pattern", [FINE, FINE_ROWS])
def test_rendered_edges_are_where_the_truth_is_and_as_wide_as_stated(name, pattern):
    world = small_world(name, **({"width_m": 11e-3} if name == "groove" else {}))
    world.move(np.eye(3), np.array([2e-3, 0.0, 1e-3]))  # off focus, groove's kink out of view
    frames = [world.electrons_per_second(p.frame(DMD)) for p in (pattern, pattern.inverse())]
    line, column = 60, pattern.axis == "column"
    difference = frames[0] - frames[1]
    difference = difference[line] if column else difference[:, line]
    truth = world.truth_edges(edges_of(pattern), line, pattern.axis)
    truth = truth[(truth > 6) & (truth < difference.size - 7)]
    assert truth.size > 10
    position, width = fitted_edges(difference, truth)
    assert np.abs(position - truth).max() < 0.002
    q = np.stack([truth, np.full(truth.size, float(line))], axis=1)
    # A pixel's box is not a Gaussian, and the filter ends at 3.25 px: 1e-3 of the width.
    blur = world.edge_blur_px(q if column else q[:, ::-1], pattern.axis)
    assert width == pytest.approx(blur, rel=3e-3)


def test_edge_blur_on_the_flat_plate_is_the_sum_of_its_parts(flat):
    q = np.array([[200.0, 100.0]])
    u, u1 = (
        flat.rig.projector.project(flat.truth_points(q + np.array([s, 0.0])))[0, 0]
        for s in (-0.5, 0.5)
    )
    w, w1 = (
        flat.rig.projector.project(flat.truth_points(q + np.array([0.0, s])))[0, 0]
        for s in (-0.5, 0.5)
    )
    along, across = u1 - u, w1 - w
    steep = np.hypot(along, across)
    origin = flat.rig.camera.project(np.zeros((1, 3)))
    assert np.abs(q - origin).max() < 15  # in focus there
    expected = np.sqrt(0.8**2 + (0.55 / steep) ** 2 + 1 / 12) * steep / along
    assert flat.edge_blur_px(q)[0] == pytest.approx(expected, rel=1e-4)


def test_defocus_widens_edges():
    optics = Optics(lens_defocus_px_per_m=500.0, projector_defocus_px_per_m=500.0)
    world = small_world(optics=optics)
    world.move(np.eye(3), np.array([0.0, 0.0, 2e-3]))
    difference = (
        world.electrons_per_second(FINE.frame(DMD))[60]
        - world.electrons_per_second(FINE.inverse().frame(DMD))[60]
    )
    truth = world.truth_edges(edges_of(FINE), 60.0)
    truth = truth[(truth > 6) & (truth < 390)]
    position, width = fitted_edges(difference, truth)
    blur = world.edge_blur_px(np.stack([truth, np.full(truth.size, 60.0)], axis=1))
    assert blur.min() > 1.5
    # The window of the fit is two widths to each side, and the blur changes within it.
    assert width == pytest.approx(blur, rel=1e-2)
    assert np.abs(position - truth).max() < 0.005


def test_any_mirror_image_takes_the_general_path_to_the_same_light(flat):
    # Of each pair of inverses one is rendered, and the other taken from white.
    for pattern in (FINE, FINE.inverse(), FINE_ROWS, FINE_ROWS.inverse()):
        mirrors = pattern.frame(DMD)
        expected = flat.electrons_per_second(mirrors)
        u, v = np.rint(
            flat.rig.projector.project(flat.truth_points(np.array([[350.0, 40.0]])))[0]
        ).astype(int)
        mirrors[v, u] ^= 255
        found = flat.electrons_per_second(mirrors)
        off = np.abs(found - expected) / expected.max()
        assert off[37:44, 347:354].max() > 0.1
        off[30:51, 340:361] = 0.0
        assert off.max() < 1e-4


def test_one_mirror_sends_its_share_of_white(flat):
    mirrors = np.zeros((768, 1024), dtype=np.uint8)
    u, v = np.rint(
        flat.rig.projector.project(flat.truth_points(np.array([[200.0, 100.0]])))[0]
    ).astype(int)
    mirrors[v, u] = 1
    spot = to_dn(flat.electrons_per_second(mirrors))
    q = np.array([[200.0, 100.0]])
    step = 0.5 * np.eye(2)
    ahead, behind = (flat.rig.projector.project(flat.truth_points(q + s * step)) for s in (1, -1))
    area = 1.0 / abs(np.linalg.det(ahead - behind))  # camera pixels of one mirror
    white = to_dn(flat.electrons_per_second(WHITE))[100, 200]
    assert spot.sum() == pytest.approx(white * area, rel=1e-3)


# -- shadows and holes ---------------------------------------------------------------------


def test_shadow_of_a_step_is_dark_in_the_image():
    world = small_world("steps", window=(700, 500, 400, 60), heights_m=(600e-6,), width_m=1.6e-3)
    white = to_dn(world.electrons_per_second(WHITE))
    q = np.stack([np.arange(400.0), np.full(400, 30.0)], axis=1)
    lit = world.truth_lit(q)
    inner = np.convolve(~lit, np.ones(9), "same") == 9  # 4 px from any lit pixel
    outer = np.convolve(lit, np.ones(9), "same") == 9
    assert inner.sum() > 10
    assert white[30, inner].max() < 0.01
    assert white[30, outer][:-1].min() > 150


def outline(rig, x: float, y: float, radius: float) -> tuple[float, np.ndarray]:
    """Area and centroid, px, of the image of a circle on the plate, by Green's theorem."""
    a = np.linspace(0, 2 * np.pi, 20_001)[:-1]
    ring = np.stack([x + radius * np.cos(a), y + radius * np.sin(a), 0 * a], axis=1)
    p = rig.camera.project(ring)
    n = np.roll(p, -1, axis=0)
    cross = p[:, 0] * n[:, 1] - n[:, 0] * p[:, 1]
    return abs(cross.sum()) / 2, ((p + n) * cross[:, None]).sum(axis=0) / (3 * cross.sum())


def test_holes_have_the_area_and_the_place_of_their_image():
    window = (500, 300, 360, 300)
    plate, bare = (small_world(n, window=window) for n in ("hole_plate", "flat"))
    share = 1.0 - plate.electrons_per_second(WHITE) / bare.electrons_per_second(WHITE).astype(float)
    share /= 0.98  # a hole still sends back 2 %
    v, u = np.mgrid[: share.shape[0], : share.shape[1]]
    compared = 0
    for x, y in plate.surface.centres_m.reshape(-1, 2):
        area, centre = outline(plate.rig, x, y, 0.225e-3)
        near = np.hypot(u - centre[0], v - centre[1]) < 40
        if np.all(np.abs(centre - [180, 150]) < [130, 100]):
            weight = share[near]
            assert weight.sum() == pytest.approx(area, rel=2e-3)
            found = np.array([(weight * u[near]).sum(), (weight * v[near]).sum()]) / weight.sum()
            # Samples hold the exact share of the hole in them; detection must reach 0.02 px.
            assert found == pytest.approx(centre, abs=1e-3)
            compared += 1
    assert compared >= 4


# -- state ---------------------------------------------------------------------------------


def test_frames_repeat_by_seed_and_number():
    first, again = (small_world(optics=Optics(seed=4)) for _ in range(2))
    other = small_world(optics=Optics(seed=5))
    shown = [(FINE.frame(DMD), NOMINAL_S)]
    assert np.array_equal(first.expose(shown, NOMINAL_S, 9), again.expose(shown, NOMINAL_S, 9))
    assert not np.array_equal(first.expose(shown, NOMINAL_S, 9), first.expose(shown, NOMINAL_S, 10))
    assert not np.array_equal(first.expose(shown, NOMINAL_S, 9), other.expose(shown, NOMINAL_S, 9))


def test_moving_and_exchanging_the_part_changes_the_image_and_back(flat):
    fine = FINE.frame(DMD)
    world = small_world()
    before = world.electrons_per_second(fine).copy()
    world.move(np.eye(3), np.array([0.0, 0.0, 1e-4]))
    assert np.abs(world.electrons_per_second(fine) - before).max() > 0.1 * before.max()
    world.move(np.eye(3), np.zeros(3))
    assert np.array_equal(world.electrons_per_second(fine), before)
    world.put(make_surface("hole_plate"))
    assert np.abs(world.electrons_per_second(fine) - before).max() > 0.1 * before.max()
    world.put(make_surface("flat"))
    assert np.array_equal(world.electrons_per_second(fine), before)


def test_cached_frames_are_few_and_read_only():
    world = small_world(window=(700, 550, 64, 48))
    frame = world.electrons_per_second(WHITE)
    with pytest.raises(ValueError, match="read-only"):
        frame[0, 0] = 0.0
    assert world.electrons_per_second(WHITE) is frame
    assert len(precise().patterns) < CACHED_FRAMES
    mirrors = np.zeros((768, 1024), dtype=bool)
    for k in range(CACHED_FRAMES + 3):
        mirrors[:, k + 1] = True  # the first stays off: its inverse would be made from white
        world.electrons_per_second(mirrors)
    assert world.electrons_per_second(WHITE) is not frame


def test_part_out_of_sight_is_black(flat):
    world = small_world()
    world.move(np.eye(3), np.array([0.0, 0.0, 0.5]))  # over the devices
    assert not world.expose([(WHITE, NOMINAL_S)], NOMINAL_S, 0).max() > 4


@pytest.mark.parametrize("shape", [(1024, 768), (768,), (0, 0), (768, 1024, 1)])
def test_mirrors_of_the_wrong_shape_are_refused(flat, shape):
    with pytest.raises(ConfigError, match=r"mirrors\.shape"):
        flat.electrons_per_second(np.zeros(shape, dtype=np.uint8))


@pytest.mark.parametrize(
    "wrong", [{"bits": 9}, {"lens_blur_px": 0.0}, {"ambient": -1.0}, {"full_well_e": np.nan}]
)
def test_impossible_optics_are_refused(wrong):
    with pytest.raises(ConfigError, match="optics"):
        Optics(**wrong)


def test_unknown_finish_is_refused():
    with pytest.raises(ConfigError, match="finish"):
        small_world(finish="velvet")
