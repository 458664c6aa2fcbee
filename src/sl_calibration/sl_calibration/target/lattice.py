"""Which spots form a square lattice: seeded where four neighbours agree, grown, verified.

A spot's own ellipse says how its neighbourhood is tilted: seen in the frame where it is a circle,
the neighbours stand at right angles and at a known multiple of its radius, whatever the pose.
"""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from sl_calibration.target.blobs import Blobs, inverse_roots

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Neighbours looked at around each spot: foreshortening brings far ones near.
NEIGHBOURS = 16
#: Range of a neighbour's distance over that expected from pitch and diameter.
DISTANCE_RANGE = (0.6, 1.35)
#: |mean of exp(4 i angle)| of a cross's arms: 1 at right angles, 0.8 with 10 degrees of scatter.
MIN_CROSS = 0.8
#: Two holes of a size differ by at most this factor, in the image.
SIZE_RATIO = 1.6
#: A hole is within this fraction of a step of where its neighbours predict it.
GROW_TOLERANCE = 0.25
#: Seeds tried before the largest lattice so far is taken.
MAX_SEEDS = 12

STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))
Lattice = dict[tuple[int, int], int]


def find_lattice(blobs: Blobs, pitch_in_radii: float, mark_ratio: float, enough: int) -> Lattice:
    """Find the largest lattice of spots: {(i, j): index of the spot}, any origin, any rotation.

    Parameters
    ----------
    blobs : Blobs
        Candidates, with clutter among them.
    pitch_in_radii : float
        Distance of neighbours over a hole's radius, on the plate.
    mark_ratio : float
        Diameter of the origin mark over that of a hole, 1 without a mark.
    enough : int
        Number of holes with which no further seed is tried.
    """
    if len(blobs.centres_px) < 5:
        return {}
    tree = KDTree(blobs.centres_px)
    best: Lattice = {}
    for seed, basis in _seeds(blobs, tree, pitch_in_radii)[:MAX_SEEDS]:
        if seed not in best.values():
            grown = _verified(blobs, _grow(blobs, tree, seed, basis, mark_ratio))
            best = grown if len(grown) > len(best) else best
            if len(best) >= enough:
                break
    return best


def _seeds(blobs: Blobs, tree: KDTree, pitch_in_radii: float) -> list[tuple[int, Array]]:
    """Return spots with neighbours on a square cross, best first, and their bases (2, 2) px."""
    count = min(NEIGHBOURS + 1, len(blobs.centres_px))
    _, near = tree.query(blobs.centres_px, k=count)
    near = near[:, 1:]
    offsets = blobs.centres_px[near] - blobs.centres_px[:, None]
    round_ = np.einsum("nij,nkj->nki", inverse_roots(blobs.shapes_px2), offsets)
    ratio = np.linalg.norm(round_, axis=2) / pitch_in_radii
    alike = np.abs(np.log(blobs.sizes_px[near] / blobs.sizes_px[:, None])) < np.log(SIZE_RATIO)
    ratio = np.where(alike & (ratio > DISTANCE_RANGE[0]), ratio, np.inf)
    on_cross = (ratio <= np.sort(ratio, axis=1)[:, [3]]) & (ratio < DISTANCE_RANGE[1])
    angle = np.arctan2(round_[..., 1], round_[..., 0])
    fourfold = np.where(on_cross, np.exp(4j * angle), 0).sum(axis=1) / 4
    quality = np.where(on_cross.sum(axis=1) == 4, np.abs(fourfold), 0.0)
    order = [int(i) for i in np.argsort(-quality, kind="stable") if quality[i] > MIN_CROSS]
    seeds = ((i, _basis(offsets[i], on_cross[i], angle[i], fourfold[i])) for i in order)
    return [(i, basis) for i, basis in seeds if basis is not None]


def _basis(offsets: Array, chosen: Array, angle: Array, fourfold: complex) -> Array | None:
    """Mean steps along both axes of a cross, columns of (2, 2); None without both."""
    quadrant = np.rint((angle - np.angle(fourfold) / 4) / (np.pi / 2)).astype(int) % 4
    members = [offsets[chosen & (quadrant == q)] for q in range(4)]
    if not all(len(arm) for arm in members):
        return None
    arms = [arm.mean(axis=0) for arm in members]
    return np.stack([(arms[0] - arms[2]) / 2, (arms[1] - arms[3]) / 2], axis=1)


def _grow(blobs: Blobs, tree: KDTree, seed: int, basis: Array, mark_ratio: float) -> Lattice:
    """Add neighbours of neighbours, each where the nearest steps predict it."""
    found: Lattice = {(0, 0): seed}
    bases = {(0, 0): basis}
    taken = {seed}
    queue = deque([(0, 0)])
    while queue:
        here = queue.popleft()
        for axis, step in enumerate(STEPS):
            there = (here[0] + step[0], here[1] + step[1])
            if there in found:
                continue
            spot = _spot_at(blobs, tree, found[here], bases[here] @ step, mark_ratio)
            if spot is None or spot in taken:
                continue
            found[there] = spot
            taken.add(spot)
            bases[there] = bases[here].copy()
            moved = blobs.centres_px[spot] - blobs.centres_px[found[here]]
            bases[there][:, axis % 2] = moved * (1 if axis < 2 else -1)
            queue.append(there)
    return found


def _spot_at(blobs: Blobs, tree: KDTree, start: int, step_px: Array, mark: float) -> int | None:
    """Return the spot one step from another, where there is one of its size."""
    distance, spot = tree.query(blobs.centres_px[start] + step_px)
    ratio = abs(np.log(blobs.sizes_px[spot] / blobs.sizes_px[start]))
    allowed = np.log(SIZE_RATIO) + abs(np.log(mark))
    near = distance < GROW_TOLERANCE * np.linalg.norm(step_px)
    return int(spot) if near and ratio < allowed else None


def _verified(blobs: Blobs, lattice: Lattice) -> Lattice:
    """Drop what a homography through all does not carry; add what it does (islands)."""
    if len(lattice) < 6:
        return lattice
    ids = np.array(list(lattice), dtype=np.float64)
    spots = np.array(list(lattice.values()))
    h, _ = cv2.findHomography(blobs.centres_px[spots], ids, cv2.LMEDS)
    if h is None:
        return {}
    at = cv2.perspectiveTransform(blobs.centres_px[None], h)[0]
    near = np.abs(at - np.rint(at)).max(axis=1) < GROW_TOLERANCE
    low, high = ids.min(axis=0) - 1.5, ids.max(axis=0) + 1.5
    near &= np.all((at > low) & (at < high), axis=1)
    size = np.median(blobs.sizes_px[spots])
    near &= np.abs(np.log(blobs.sizes_px / size)) < np.log(SIZE_RATIO)
    near[spots] &= np.abs(at[spots] - ids).max(axis=1) < GROW_TOLERANCE
    kept = {k: s for k, s in lattice.items() if np.abs(at[s] - k).max() < GROW_TOLERANCE}
    for spot in np.flatnonzero(near):
        kept.setdefault((int(np.rint(at[spot, 0])), int(np.rint(at[spot, 1]))), int(spot))
    return kept
