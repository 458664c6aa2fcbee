"""What a bend of the surface does to edges and centres: sigma grows, or a centre is refused.

An edge is blurred, and takes its place from light on both sides of it. Where that light is uneven,
or the surface bends there, the edge errs by what follows from both and the blur. A centre is
taken from edges D away; it errs where the surface bends between them, by far more. Both
errors show in the neighbours, so they are no secret: they belong into sigma. ``docs/measure.md``
has how true sigma is with them, and how false without.
"""

from __future__ import annotations

import numpy as np

from sl_common.kernel_cache import kernel
from sl_reconstruct.cloud.refusals import Reason
from sl_reconstruct.decode.edges import PRESENT, UNLIT, Tuning
from sl_reconstruct.decode.types import Floats, Layout, Lines, Real

STEP = int(Reason.STEP)

#: This much of a squared measure of a bend, in its own variances, may be noise.
NOISE = 4.0
#: A step of the light on one side, over a pixel or two, counts from twice as many deviations on:
#: the noise in it would move an edge by more than the edge's own noise does.
SIDE_NOISE = 4.0
#: Variance of half a lead's miss over that of the centre: three edges and their extrapolation.
LEAD_VARIANCE = 3.0


@kernel(forceinline=True)
def _average(plan: Layout, run: int, out: Lines) -> None:
    """The centre of a stripe lies midway between its two edges, which one image shows."""
    u_px, sigma_px, width_px, reason = out.u_px, out.sigma_px, out.width_px, out.reason
    first, stop, half = plan.centres[run, 0], plan.centres[run, 1], plan.centres[run, 2]
    edge_owner = plan.edge_owner
    for i in range(first, stop):
        k = np.uint64(i)
        a, b = k - np.uint64(half), k + np.uint64(half)
        if reason[a] == PRESENT and reason[b] == PRESENT and edge_owner[a] == edge_owner[b]:
            u_px[k] = np.float32(0.5) * (u_px[a] + u_px[b])
            sigma_px[k] = np.float32(0.5) * np.sqrt(sigma_px[a] ** 2 + sigma_px[b] ** 2)
            width_px[k] = width_px[a]
            reason[k] = PRESENT
        elif reason[a] > UNLIT or reason[b] > UNLIT:
            reason[k] = max(reason[a], reason[b])


@kernel(forceinline=True)
def _lead(plan: Layout, out: Lines, start: int, step: int, count: int) -> tuple[int, float, float]:
    """Nearest edge from ``start`` on, its column, and the pace from it to the farthest one.

    Looks at ``count`` boundaries; the pace is NaN where there are fewer than two edges.
    """
    u_px, reason, owner = out.u_px, out.reason, plan.edge_owner
    near = far = -1
    for i in range(count):
        k = start + step * i
        if 0 <= k < owner.size and owner[k] >= 0 and reason[k] == PRESENT:
            near, far = (near if near >= 0 else k), k
    if near < 0:
        return -1, 0.0, np.nan
    at = np.float64(u_px[near])
    return near, at, (u_px[far] - at) / (far - near) if far != near else np.nan


@kernel(forceinline=True)
def _bent(sigma_px: Real, curved: Real, miss: Real) -> Real:
    """Sigma of a centre with what a bend between its edges does to it.

    ``curved``: square of D / 4 times the change of pace, the error on a surface of even curvature.
    ``miss``: how far the centre lies from where the worse side leads; at a kink or a step
    between the edges the error is half of that on average, and never more than all of it.
    """
    own = sigma_px * sigma_px
    half = 0.25 * miss * miss
    beyond = max(curved - NOISE * own, half - NOISE * LEAD_VARIANCE * own)
    wider: Real = np.sqrt(own + max(0.0, beyond))
    return wider


@kernel(forceinline=True)
def _check(plan: Layout, run: int, jump_px: float, out: Lines) -> None:
    """Refuse centres to which the edges on both sides do not lead, and widen the others' sigma.

    A centre is taken from edges D away, so a depth step or a kink between them goes unseen.
    """
    u_px, sigma_px, reason = out.u_px, out.sigma_px, out.reason
    first, stop, half = plan.centres[run, 0], plan.centres[run, 1], plan.centres[run, 2]
    a, u_a, pace_a = _lead(plan, out, first - 1, -1, half)
    b, u_b, pace_b = _lead(plan, out, stop, 1, half)
    curved = (0.25 * half * (pace_b - pace_a)) ** 2
    for i in range(first, stop):
        k = np.uint64(i)
        if reason[k] != PRESENT:
            continue
        left = abs(u_px[k] - u_a - pace_a * (i - a))
        right = abs(u_px[k] - u_b - pace_b * (i - b))
        if left <= jump_px and right <= jump_px:
            sigma_px[k] = _bent(sigma_px[k], curved, max(left, right))
        else:
            reason[k] = STEP
            u_px[k] = np.nan


@kernel()
def find_centres(plan: Layout, bars: bool, t: Tuning, out: Lines) -> None:
    """Take a row's centres from its edges, and check them.

    Parameters
    ----------
    plan : Layout
        Says which boundaries are centres.
    bars : bool
        Whether BR8 has found them already, so that they are only checked.
    t : Tuning
        Has the farthest that a centre may lie from where its neighbours lead.
    out : Lines
        The row: its edges are read, its centres written.
    """
    for run in range(plan.centres.shape[0]):
        if not bars:
            _average(plan, run, out)
        _check(plan, run, t.jump_px, out)


@kernel(forceinline=True)
def _beyond(change: Real, noise: Real, apart: Real) -> Real:
    """Square of a slope less what is noise in it; 0 where that is more, or nothing is known."""
    none = np.float32(0)
    square = (change * change - noise) / (apart * apart)
    return square if square > none else none


@kernel()
def widen_edges(
    t: Tuning, u_px: Floats, level_dn: Floats, sigma_px: Floats, wide_px: Floats
) -> None:
    """Write a row's sigma, wider where light is uneven or the surface bends under an edge.

    Light that changes by the part g per pixel moves an edge by g times the square of the lens's
    blur; boundaries whose second difference is d by d / (2 scale^2) times V, where V = S^2 q^2 /
    (S^2 + q^2) of projector's blur q and that of lens and filter S. How the blur s that is seen
    is shared out is not known: g s^2 and d s^2 / (4 scale^2) are the most that they can be.

    g is taken over four boundaries, or from one side where it is far steeper: beside a wall. Where
    a neighbour is missing, those on the other side are used. The first and last two boundaries,
    with too few neighbours, keep their sigma.

    Parameters
    ----------
    t : Tuning
        Has blur, scale and pixel noise.
    u_px, level_dn, sigma_px : ndarray, (boundaries,)
        Of the row, as in `Lines`; this sigma is that of noise alone.
    wide_px : ndarray, (boundaries,)
        Written to, camera pixels.
    """
    n = u_px.size
    wide_px[:2], wide_px[n - 2 :] = sigma_px[:2], sigma_px[n - 2 :]
    f, one, half, side = np.float32, np.float32(1), np.float32(0.5), np.float32(SIDE_NOISE)
    light_px4, bent_px = f(t.blur_px**4), f((0.5 * t.blur_px / t.scale) ** 4)
    read, shot = f(2 * NOISE * t.noise.read_dn2), f(2 * NOISE * t.noise.shot_dn)
    free = f(6 * NOISE)
    for i in range(n - 4):
        # Every load comes before the choices: only so are eight boundaries worked on at once.
        a, b, u, c, d = u_px[i], u_px[i + 1], u_px[i + 2], u_px[i + 3], u_px[i + 4]
        far_low, low, here = level_dn[i], level_dn[i + 1], level_dn[i + 2]
        high, far_high = level_dn[i + 3], level_dn[i + 4]
        own, noise = sigma_px[i + 2] * sigma_px[i + 2], read + shot * here
        bend = (c - u) - (u - b)
        bend = bend if bend == bend else (d - c) - (c - u)
        bend = bend if bend == bend else (u - b) - (b - a)
        curved = bent_px * _beyond(bend, free * own, one)
        # A level is that of the pixel which the boundary lies in.
        x, x_low, x_high = np.floor(u + half), np.floor(b + half), np.floor(c + half)
        below = _beyond(here - low, side * noise, x - x_low)
        above = _beyond(high - here, side * noise, x_high - x)
        low, x_low = (low, x_low) if b == b else (here, x)
        high, x_high = (high, x_high) if c == c else (here, x)
        low, x_low = (far_low, np.floor(a + half)) if a == a else (low, x_low)
        high, x_high = (far_high, np.floor(d + half)) if d == d else (high, x_high)
        light = _beyond(high - low, noise, x_high - x_low)
        light = light if light > below else below
        light = light if light > above else above
        wide_px[i + 2] = np.sqrt(own + curved + light_px4 * light / (here * here))
