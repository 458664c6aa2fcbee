"""Sub-pixel holes: a blurred elliptic step is fitted to the pixels around each hole's edge.

Model of a pixel at x: ``L (D + (P0 - D) Phi(d / s)) + s (grad P . n) phi(d / s)`` with
``q = M (x - c)``, which maps the ellipse on the unit circle, and ``d = (|q| - 1) / |grad |q||`` the
distance from the edge (to first order; exact for a circle) along its normal n. c centre,
M symmetric (3 numbers), s blur, D level in the hole, P0 level of the plate, and the light
``L = 1 + (P1 q1 + P2 q2) / P0``: uneven light does not move the centre. Least
squares over the pixels, weighted by the noise found on each side, is the matched filter of every
edge point and the ellipse fit in one, and its normal equations give the covariance.

A chamfer adds a second step: its outer rim is the same ellipse, larger by the known ratio of the
diameters and shifted by a parallax that is fitted, with a level between the two that varies
around the hole as a cone's light does.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_calibration.target.blobs import Blobs, inverse_roots
from sl_common.kernel_cache import kernel
from sl_common.row_threads import share_rows

Array = NDArray[np.float64]
Image = NDArray[np.float32]

#: c (2), M (uu, uv, vv), s, D, P0, P1, P2; with a chamfer its level (3, as P) and its shift (2).
PARAMETERS = 15
PLAIN = 10
CENTRE, SHAPE, BLUR, DARK, BRIGHT, CHAMFER, SHIFT = 0, 2, 5, 6, 7, 10, 13

#: Pixels are used to this many blurs on both sides of the edge: the step's tails end there.
REACH_BLURS = 4.0
#: Reach of the first pass, before the blur is known, px.
FIRST_REACH_PX = 5.0
MIN_REACH_PX = 2.0
#: The far side of a chamfer looks this much wider than its width square on (28 degrees: 1.53).
CHAMFER_STRETCH = 1.6
#: Share of the way to the next hole's edge, and of the smaller semi-axis, that pixels may take.
REACH_SHARE = 0.45
#: Residuals beyond this many sigmas lose weight (Huber).
HUBER = 2.5
PASSES = 2
CHAMFER_PASSES = 3
ITERATIONS = 12
#: A step that changes the cost by less than this share of it is the last: with some 1500 pixels
#: (cost 750) that is a tenth of a sigma of one parameter.
DONE = 1e-5
#: Largest part of a semi-axis that a centre may move from where the spot was.
MAX_SHIFT = 0.5
SQRT_HALF = math.sqrt(0.5)
INV_SQRT_2PI = 1.0 / math.sqrt(2.0 * math.pi)
#: Least noise variance: that of rounding to whole numbers.
MIN_VARIANCE = 1.0 / 12.0


class HoleFits(NamedTuple):
    """N fits, NaN where one failed.

    ``centres_px`` (N, 2) of the ellipses, ``shapes_px2`` (N, 2, 2) as in `Blobs`,
    ``covariance_px2`` (N, 2, 2) of the centres, ``blur_px`` (N,), ``contrast`` (N,) DN,
    ``misfit`` (N,): rms residual over contrast, ``saturated`` (N,): share of the plate beside the
    hole that is at the top of the scale.
    """

    centres_px: Array
    shapes_px2: Array
    covariance_px2: Array
    blur_px: Array
    contrast: Array
    misfit: Array
    saturated: Array


class _Starts(NamedTuple):
    """Parameters (N, 15), largest reach (N,) px on either side of the edge, ratio of rims (N,)."""

    parameters: Array
    reach: Array
    rim: Array


class _Results(NamedTuple):
    """Parameters (N, 15), covariances of the centres (N, 2, 2), misfit and saturation (N, 2)."""

    parameters: Array
    covariance: Array
    quality: Array


class _Hole(NamedTuple):
    """Of one hole: parameters (15,) to start from; covariance (2, 2) and quality (2,) to fill."""

    start: Array
    covariance: Array
    quality: Array


class _Edge(NamedTuple):
    """Pixels (K, 3) = (u, v, level) about an edge, ratio of rims, variances (hole, plate)."""

    pixels: Array
    ratio: float
    noise: tuple[float, float]


class _Equations(NamedTuple):
    """Derivatives of a pixel's level (15,), normal matrix (P, P) and right side (P,)."""

    row: Array
    matrix: Array
    right: Array


def fit_holes(
    image: Image, spots: Blobs, gap_px: Array, rim_ratio: Array, saturation: float
) -> HoleFits:
    """Fit the edges of dark holes.

    Parameters
    ----------
    image : ndarray, (H, W) float32
        Dark holes on a bright plate, DN.
    spots : Blobs
        N starts: to a quarter of a radius.
    gap_px : ndarray, (N,)
        Bright plate between a hole and its next neighbour.
    rim_ratio : ndarray, (N,)
        Diameter at the top of the chamfer over that at its bottom; 1 without a chamfer.
    saturation : float
        Level at which the sensor is full, in the units of the image; inf for none.
    """
    count = len(spots.centres_px)
    start = np.zeros((count, PARAMETERS))
    start[:, CENTRE : CENTRE + 2] = spots.centres_px
    start[:, SHAPE : SHAPE + 3] = inverse_roots(spots.shapes_px2)[:, [0, 0, 1], [0, 1, 1]]
    small = np.sqrt(np.linalg.eigvalsh(spots.shapes_px2)[:, 0])
    reach = np.clip(REACH_SHARE * np.minimum(gap_px, 2.0 * small), MIN_REACH_PX, None)
    starts = _Starts(start, reach, rim_ratio)
    shapes = (count, PARAMETERS), (count, 2, 2), (count, 2)
    out = _Results(*(np.full(shape, np.nan) for shape in shapes))

    def work(first: int, last: int) -> None:
        _fit_some(image, first, last, starts, float(saturation), out)

    share_rows(work, count)
    return _fits(out)


def _fits(out: _Results) -> HoleFits:
    p = out.parameters
    m = p[:, [SHAPE, SHAPE + 1, SHAPE + 1, SHAPE + 2]].reshape(-1, 2, 2)
    failed = ~np.isfinite(p[:, 0])
    m[failed] = np.eye(2)
    shapes = np.asarray(np.linalg.inv(m @ m), dtype=np.float64)
    shapes[failed] = np.nan
    contrast, quality = p[:, BRIGHT] - p[:, DARK], out.quality.T
    return HoleFits(p[:, :2], shapes, out.covariance, p[:, BLUR], contrast, *quality)


@kernel()
def _fit_some(
    image: Image, first: int, last: int, starts: _Starts, saturation: float, out: _Results
) -> None:
    for k in range(first, last):
        rim, most = starts.rim[k], starts.reach[k]
        hole = _Hole(starts.parameters[k], out.covariance[k], out.quality[k])
        p = hole.start.copy()
        inner = min(most, FIRST_REACH_PX if rim == 1.0 else MIN_REACH_PX)
        outer, good = inner, True
        for i in range(PASSES if rim == 1.0 else CHAMFER_PASSES):
            good = _fit(image, p, (inner, outer), rim if i > 0 else 1.0, hole)
            if not good:
                break
            inner = min(most, max(REACH_BLURS * p[BLUR], MIN_REACH_PX))
            outer = inner + CHAMFER_STRETCH * (rim - 1.0) / math.sqrt(_det(p))
        if good:
            out.parameters[k] = p
            out.quality[k, 1] = _saturated_share(image, p, (inner, outer), saturation)


@kernel()
def _det(p: Array) -> float:
    """Determinant of M: one over the product of the semi-axes."""
    det: float = p[2] * p[4] - p[3] * p[3]
    return det


@kernel()
def _distance(p: Array, x: float, y: float) -> tuple[float, float, float, float]:
    """Return (q1, q2, |q|, |grad |q||) of a pixel."""
    dx, dy = x - p[0], y - p[1]
    q1, q2 = p[2] * dx + p[3] * dy, p[3] * dx + p[4] * dy
    rho = max(math.sqrt(q1 * q1 + q2 * q2), 1e-9)
    g1, g2 = p[2] * q1 + p[3] * q2, p[3] * q1 + p[4] * q2
    return q1, q2, rho, max(math.sqrt(g1 * g1 + g2 * g2) / rho, 1e-9)


@kernel()
def _window(p: Array, limit: float, shape: tuple[int, int]) -> tuple[int, int, int, int, bool]:
    """Rows and columns of pixels within reach; ok is False where they leave the image."""
    det = _det(p)
    if not det > 1e-12:
        return 0, 0, 0, 0, False
    # semi-extents of the ellipse along u and v: rows of M^-1
    wide = math.sqrt(p[4] * p[4] + p[3] * p[3]) / det + limit
    high = math.sqrt(p[2] * p[2] + p[3] * p[3]) / det + limit
    u0, u1 = math.floor(p[0] - wide), math.ceil(p[0] + wide)
    v0, v1 = math.floor(p[1] - high), math.ceil(p[1] + high)
    return u0, u1, v0, v1, u0 >= 0 and v0 >= 0 and u1 < shape[1] and v1 < shape[0]


@kernel()
def _gather(image: Image, p: Array, limits: tuple[float, float]) -> Array:
    """Pixels (K, 3) = (u, v, level) within reach of the edge; none where the image ends."""
    u0, u1, v0, v1, inside = _window(p, limits[1], image.shape)
    if not inside or (u1 - u0) * (v1 - v0) > 400000:
        return np.empty((0, 3))
    pixels = np.empty(((u1 - u0 + 1) * (v1 - v0 + 1), 3))
    count = 0
    for v in range(v0, v1 + 1):
        for u in range(u0, u1 + 1):
            _, _, rho, steep = _distance(p, u, v)
            if -limits[0] * steep <= rho - 1.0 <= limits[1] * steep:
                pixels[count, 0], pixels[count, 1], pixels[count, 2] = u, v, image[v, u]
                count += 1
    return pixels[:count]


@kernel()
def _start_levels(pixels: Array, p: Array, limits: tuple[float, float]) -> None:
    """Put the mean levels at the ends of the reach, and a blur of 1 px, into the parameters."""
    sums = np.zeros((2, 2))
    for k in range(pixels.shape[0]):
        _, _, rho, steep = _distance(p, pixels[k, 0], pixels[k, 1])
        d = (rho - 1.0) / steep
        if d > limits[1] - 0.5 * limits[0] or d < -0.5 * limits[0]:
            side = 1 if d > 0 else 0
            sums[side, 0] += pixels[k, 2]
            sums[side, 1] += 1.0
    if p[BLUR] == 0.0:
        p[BLUR] = 1.0
    p[DARK] = sums[0, 0] / max(sums[0, 1], 1.0)
    p[BRIGHT] = sums[1, 0] / max(sums[1, 1], 1.0)
    p[BRIGHT + 1], p[BRIGHT + 2] = 0.0, 0.0


@kernel()
def _rim_step(
    p: Array, q1: float, q2: float, ratio: float, step: float
) -> tuple[float, float, float, float]:
    """Phi of the chamfer's upper rim, its derivative over q (2), and over the blur."""
    r1, r2 = (q1 - p[SHIFT]) / ratio, (q2 - p[SHIFT + 1]) / ratio
    rho = max(math.sqrt(r1 * r1 + r2 * r2), 1e-9)
    g1, g2 = p[2] * r1 + p[3] * r2, p[3] * r1 + p[4] * r2
    steep = max(math.sqrt(g1 * g1 + g2 * g2) / (rho * ratio), 1e-9)
    t = (rho - 1.0) / (steep * p[BLUR])
    by_d = step * INV_SQRT_2PI * math.exp(-0.5 * t * t) / p[BLUR]
    by_q = by_d / (steep * rho * ratio)
    return 0.5 * math.erfc(-t * SQRT_HALF), by_q * r1, by_q * r2, -by_d * t


@kernel()
def _facing(p: Array, q1: float, q2: float, rho: float, ratio: float) -> tuple[float, float]:
    """Unit vector to where the chamfer faces: its light is the same from bottom to top."""
    up = min(max((rho - 1.0) / (ratio - 1.0), 0.0), 1.0)
    e1, e2 = q1 - up * p[SHIFT], q2 - up * p[SHIFT + 1]
    size = max(math.sqrt(e1 * e1 + e2 * e2), 1e-9)
    return e1 / size, e2 / size


@kernel()
def _blurred_slope(p: Array, q1: float, q2: float, size: float, bell: float) -> float:
    """What blur adds at an edge between 0 and the plate's level: ``s (grad P . n)`` bell.

    A step whose level changes along its normal n is not blurred to a step times that level: in
    uneven light the centre would move by ``s^2`` times the relative slope.
    """
    n1, n2 = p[2] * q1 + p[3] * q2, p[3] * q1 + p[4] * q2
    g1 = p[2] * p[BRIGHT + 1] + p[3] * p[BRIGHT + 2]
    g2 = p[3] * p[BRIGHT + 1] + p[4] * p[BRIGHT + 2]
    added: float = p[BLUR] * bell * (n1 * g1 + n2 * g2) / size
    return added


@kernel()
def _model(p: Array, x: float, y: float, ratio: float, row: Array) -> tuple[float, float]:
    """Level of a pixel; its derivatives go to ``row``. Returns (level, Phi)."""
    q1, q2, rho, steep = _distance(p, x, y)
    dx, dy = x - p[0], y - p[1]
    t = (rho - 1.0) / (steep * p[BLUR])
    phi, bell = 0.5 * math.erfc(-t * SQRT_HALF), INV_SQRT_2PI * math.exp(-0.5 * t * t)
    light = 1.0 + (p[BRIGHT + 1] * q1 + p[BRIGHT + 2] * q2) / p[BRIGHT]
    bright, dark = p[BRIGHT] * light, p[DARK] * light
    by1, by2, rim, level = 0.0, 0.0, phi, bright
    if ratio > 1.0:
        c1, c2 = _facing(p, q1, q2, rho, ratio)
        level = light * (p[CHAMFER] + p[CHAMFER + 1] * c1 + p[CHAMFER + 2] * c2)
        rim, by1, by2, row[BLUR] = _rim_step(p, q1, q2, ratio, bright - level)
        row[SHIFT], row[SHIFT + 1] = -by1, -by2
        between = (phi - rim) * light
        row[CHAMFER], row[CHAMFER + 1], row[CHAMFER + 2] = between, between * c1, between * c2
    else:
        row[BLUR] = 0.0
    by_d = (level - dark) * bell / p[BLUR]
    by1, by2 = by1 + by_d / (steep * rho) * q1, by2 + by_d / (steep * rho) * q2
    row[0] = -(p[2] * by1 + p[3] * by2)
    row[1] = -(p[3] * by1 + p[4] * by2)
    row[2], row[3], row[4] = by1 * dx, by1 * dy + by2 * dx, by2 * dy
    row[BLUR] -= by_d * t
    row[DARK] = (1.0 - phi) * light
    row[BRIGHT], row[BRIGHT + 1], row[BRIGHT + 2] = rim, rim * q1, rim * q2
    tilted = _blurred_slope(p, q1, q2, rho * steep, bell) * (level - dark) / bright
    return dark + (level - dark) * phi + (bright - level) * rim + tilted, phi


@kernel()
def _noise(pixels: Array, p: Array, ratio: float, row: Array) -> tuple[float, float]:
    """Variances in the hole and on the plate, from the residuals beside the edge."""
    sums = np.zeros((2, 2))
    for k in range(pixels.shape[0]):
        level, phi = _model(p, pixels[k, 0], pixels[k, 1], ratio, row)
        if phi < 0.02 or phi > 0.98:
            side = 1 if phi > 0.5 else 0
            sums[side, 0] += (pixels[k, 2] - level) ** 2
            sums[side, 1] += 1.0
    whole = (sums[0, 0] + sums[1, 0] + 1e-3) / max(sums[0, 1] + sums[1, 1], 1.0)
    dark = sums[0, 0] / sums[0, 1] if sums[0, 1] >= 12.0 else whole
    bright = sums[1, 0] / sums[1, 1] if sums[1, 1] >= 12.0 else whole
    return max(dark, MIN_VARIANCE), max(bright, MIN_VARIANCE)


@kernel()
def _normal(edge: _Edge, p: Array, to: _Equations) -> tuple[float, float]:
    """Fill the weighted normal equations; returns the cost (Huber) and the plain sum of squares."""
    row, a, b = to.row, to.matrix, to.right
    a[:] = 0.0
    b[:] = 0.0
    cost, squares = 0.0, 0.0
    dark, bright = edge.noise
    for k in range(edge.pixels.shape[0]):
        level, phi = _model(p, edge.pixels[k, 0], edge.pixels[k, 1], edge.ratio, row)
        r = edge.pixels[k, 2] - level
        variance = dark + (bright - dark) * phi
        z = abs(r) / math.sqrt(variance)
        weight = (1.0 if z < HUBER else HUBER / z) / variance
        cost += 0.5 * z * z if z < HUBER else HUBER * (z - 0.5 * HUBER)
        squares += r * r
        for i in range(b.size):
            b[i] += weight * row[i] * r
            for j in range(i + 1):
                a[i, j] += weight * row[i] * row[j]
    for i in range(b.size):
        for j in range(i):
            a[j, i] = a[i, j]
    return cost, squares


@kernel()
def _sane(p: Array, start: Array) -> bool:
    """Whether parameters are still those of the hole that the fit was started on."""
    det, was = _det(p), _det(start)
    shift = math.hypot(p[0] - start[0], p[1] - start[1]) * math.sqrt(abs(was))
    shape = p[2] + p[4] > 0.0 and was / 4.0 < det < was * 4.0
    return shift < MAX_SHIFT and 0.1 < p[BLUR] < 20.0 and shape


@kernel()
def _descend(edge: _Edge, p: Array, at: _Equations, start: Array) -> float:
    """Levenberg-Marquardt on the parameters in place; returns the sum of squares; fills ``at``."""
    cost, squares = _normal(edge, p, at)
    a, b = at.matrix, at.right
    trial_at = _Equations(at.row, np.empty_like(a), np.empty_like(b))
    damping = 1e-4
    for _ in range(ITERATIONS):
        damped = a.copy()
        for i in range(b.size):
            damped[i, i] += damping * a[i, i] + 1e-12
        trial = p.copy()
        trial[: b.size] += np.linalg.solve(damped, b)
        if _sane(trial, start):
            trial_cost, trial_squares = _normal(edge, trial, trial_at)
            done = abs(cost - trial_cost) < DONE * cost
            better = trial_cost <= cost
            if better:
                p[:], a[:], b[:] = trial, trial_at.matrix, trial_at.right
                cost, squares = trial_cost, trial_squares
                damping *= 0.1
            if done:
                break
            if better:
                continue
        damping *= 10.0
        if damping > 1e6:
            break
    return squares


@kernel()
def _fit(image: Image, p: Array, reach: tuple[float, float], ratio: float, hole: _Hole) -> bool:
    """One pass: gather pixels within reach, find the noise, descend; False: there is no hole."""
    count = PLAIN if ratio == 1.0 else PARAMETERS
    pixels = _gather(image, p, reach)
    if pixels.shape[0] < 3 * count:
        return False
    if p[BLUR] == 0.0 or (ratio > 1.0 and p[CHAMFER] == 0.0):
        chamfer = p[BRIGHT]  # a narrow reach sees no further than the chamfer
        _start_levels(pixels, p, reach)
        p[CHAMFER] = chamfer
    at = _Equations(np.zeros(PARAMETERS), np.zeros((count, count)), np.zeros(count))
    edge = _Edge(pixels, ratio, _noise(pixels, p, ratio, at.row))
    squares = _descend(edge, p, at, hole.start)
    contrast = p[BRIGHT] - p[DARK]
    if not (contrast > 1.0 and _sane(p, hole.start)):
        return False
    for i in range(count):
        at.matrix[i, i] += 1e-12 * (1.0 + at.matrix[i, i])
    hole.covariance[:] = np.linalg.inv(at.matrix)[:2, :2]
    hole.quality[0] = math.sqrt(squares / pixels.shape[0]) / contrast
    return True


@kernel()
def _saturated_share(
    image: Image, p: Array, limits: tuple[float, float], saturation: float
) -> float:
    """Share of the plate's pixels beside the edge that are at the top of the scale."""
    pixels = _gather(image, p, limits)
    full, count = 0, 0
    for k in range(pixels.shape[0]):
        _, _, rho, steep = _distance(p, pixels[k, 0], pixels[k, 1])
        if rho - 1.0 > (limits[1] - 0.5 * limits[0]) * steep:
            count += 1
            if pixels[k, 2] >= saturation:
                full += 1
    return full / max(count, 1)
