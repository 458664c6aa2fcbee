"""Whether a stack and its cloud can be trusted, and why not."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import StackError
from sl_reconstruct.cloud.cloud import Cloud, median

#: A good scan has this part of its lit positions; where the finest stripes drown in moire, half
#: of the boundaries may be missing.
MIN_PRESENT = 0.25
#: Rays of a calibrated rig meet within a pixel; calibrations from elsewhere reach two.
MAX_GAP_PX = 3.0
#: This part of the lit positions may fail the geometry.
MAX_GEOMETRY = 0.05
#: Edges of one image whose identity disagrees: more than this part means foreign images.
MAX_CONFUSED = 0.4
#: Boundaries of a row that lie in order, median over rows: fewer means exchanged images.
MIN_ORDER = 0.8
#: An image's edges may lie off the middle of their neighbours by this many DMD pixels, median.
MAX_PHASE = 0.35

Array = NDArray[np.float64]


def verdict(cloud: Cloud) -> tuple[bool, list[str]]:
    """Whether a cloud may be called good, and every reason why not.

    Examples
    --------
    A scan in which the rays of camera and projector miss each other is not good, whatever its
    points look like: the calibration is another rig's.
    """
    if cloud.present == 0 and not cloud.refused["geometry"]:
        worst = max(cloud.refused, key=lambda name: cloud.refused[name])
        found = f"of {cloud.lit} lit positions, mostly refused for {worst}" if cloud.lit else ""
        return False, [f"there are no points {found or 'and no light'}".strip()]
    reasons = []
    if cloud.present < MIN_PRESENT * cloud.lit:
        reasons.append(
            f"only {cloud.present / cloud.lit:.1%} of the lit positions hold a point; expected "
            f"at least {MIN_PRESENT:.0%}"
        )
    if cloud.refused["geometry"] > MAX_GEOMETRY * cloud.lit:
        reasons.append(
            f"at {cloud.refused['geometry'] / cloud.lit:.1%} of the lit positions camera and "
            f"projector ray do not meet; expected at most {MAX_GEOMETRY:.0%}"
        )
    return not (reasons := reasons + _missing_rays(cloud)), reasons


def _missing_rays(cloud: Cloud) -> list[str]:
    if cloud.gap_px is None or cloud.gap_m is None or not np.isfinite(cloud.gap_m).any():
        return []
    gap_px, gap_m = median(cloud.gap_px), median(cloud.gap_m)
    if gap_px <= MAX_GAP_PX:
        return []
    return [
        f"camera and projector rays miss each other by {gap_m * 1e3:.3g} mm ({gap_px:.3g} px, "
        f"median); expected at most {MAX_GAP_PX:g} px: the calibration does not fit the images"
    ]


def check_identity(tally: NDArray[np.int32], images: list[int]) -> None:
    """Refuse a stack in which an image's edges are not where the Gray code says.

    Parameters
    ----------
    tally : ndarray, (rows, sources, 2)
        Edges accepted, and edges whose identity disagreed.
    images : list of int
        Index of each source's image in the stack.

    Raises
    ------
    StackError
        Naming the image and what was found.
    """
    accepted, confused = tally.sum(axis=0, dtype=np.int64).T
    for image, good, bad in zip(images, accepted, confused, strict=True):
        if bad > MAX_CONFUSED * (good + bad) and bad > tally.shape[0]:
            raise StackError(
                f"image {image}: {bad} of {good + bad} edges disagree with the Gray code; expected "
                f"at most {MAX_CONFUSED:.0%}: images are exchanged, repeated or of another sequence"
            )


def in_order(u_px: NDArray[np.float32]) -> float:
    """Part of a row's boundaries that lie in order along the row, whichever the direction.

    The longest rising chain of columns among the boundaries by number; 1 where all are in order,
    NaN where fewer than 16 are known.
    """
    u = u_px[np.isfinite(u_px)]
    if u.size < 16:
        return float("nan")
    steps = np.diff(u)
    if (steps > 0).all() or (steps < 0).all():
        return 1.0
    return max(_longest_rise(u), _longest_rise(u[::-1])) / u.size


def _longest_rise(values: NDArray[np.float32]) -> int:
    ends: list[float] = []
    for v in values.tolist():
        i = bisect_right(ends, v)
        ends[i : i + 1] = [v]
    return len(ends)


def check_order(u_px: NDArray[np.float32]) -> float:
    """Median part of boundaries in order over rows of (rows, boundaries) columns.

    Raises
    ------
    StackError
        When too few are: an exchanged code image moves whole blocks of columns.
    """
    parts = np.array([in_order(row) for row in u_px])
    if not np.isfinite(parts).any():
        return float("nan")
    order = float(np.nanmedian(parts))
    if order < MIN_ORDER:
        raise StackError(
            f"only {order:.0%} of the boundaries lie in order along the rows; expected at least "
            f"{MIN_ORDER:.0%}: images are exchanged, repeated or of another sequence"
        )
    return order


def check_phase(u_px: NDArray[np.float32], owner: NDArray[np.int64], images: list[int]) -> None:
    """Refuse a stack in which an image's edges lie off the middle of their neighbours.

    Parameters
    ----------
    u_px : ndarray, (rows, boundaries)
        Columns of some rows, NaN where unknown.
    owner : ndarray, (boundaries,)
        Which source gave each boundary by an edge, -1 for none.
    images : list of int
        Index of each source's image in the stack.

    Raises
    ------
    StackError
        Naming the image: it was exchanged for another of the same stripes, or shown twice.
    """
    span = u_px[:, 2:] - u_px[:, :-2]
    span = np.where(span == 0, np.float32(np.nan), span)
    off = (u_px[:, 1:-1] - (u_px[:, 2:] + u_px[:, :-2]) / 2) / span * 2
    for i, image in enumerate(images):
        mine = off[:, owner[1:-1] == i]
        middle = median(mine) if np.count_nonzero(np.isfinite(mine)) >= 32 else 0.0
        if abs(middle) > MAX_PHASE:
            raise StackError(
                f"image {image}: its edges lie {middle:+.2f} DMD pixels off the middle of their "
                f"neighbours; expected at most {MAX_PHASE}: images are exchanged or repeated"
            )
