"""Decode one axis of a stack: look at a few rows, choose the filters, then decode all rows."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_common.row_threads import share_rows
from sl_reconstruct.decode.decode_plan import AxisPlan, make_layout
from sl_reconstruct.decode.edge_filters import edge_filter, gaussian_taps, tap_variance
from sl_reconstruct.decode.edges import NO_FILTER, Tuning
from sl_reconstruct.decode.row_decoder import Decoding, decode_rows, row_scratch
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.decode.stack_statistics import (
    code_growth,
    edge_bound,
    fit_noise,
    sample_scatter,
    survey_rows,
)
from sl_reconstruct.decode.types import Integers, Lines, Noise, Pixels

#: Blur assumed until it is measured, camera pixels.
FIRST_BLUR_PX = 1.0
#: An edge's blur does not matter beyond this many standard deviations.
REACH_SD = 2.5
#: A usable BR8 needs this slope at a stripe's centre, per pixel of a unit stripe.
MIN_BAR_SLOPE = 0.05
#: Noise is measured in every fifth of the rows that are looked at.
NOISE_STEP = 5


class Decoded(NamedTuple):
    """Boundaries of an axis.

    Parameters
    ----------
    lines : Lines
        Along every camera row (or camera column); overwritten when the next stack is decoded.
    ys : ndarray
        Rows that were looked at first.
    decoding : Decoding
        What was found there, and what all rows were decoded with.
    bound_px : float
        Least standard deviation of an edge's position from one image; see `edge_bound`.
    """

    lines: Lines
    ys: Integers
    decoding: Decoding
    bound_px: float


class AxisDecoder:
    """Decodes one axis of stacks of a sequence; keeps its memory from stack to stack.

    Parameters
    ----------
    plan : AxisPlan
        The axis. Row boundaries are found along camera columns, column boundaries along rows.
    settings : Settings
        Choices of the user.
    """

    def __init__(self, plan: AxisPlan, settings: Settings) -> None:
        self._across = plan.images if plan.axis == "row" else ()
        self.plan = plan.alone() if self._across else plan
        self.settings = settings
        self._scratch: dict[int, Lines] = {}

    def __call__(self, stack: Pixels, saturation_dn: int) -> Decoded:
        """Decode a stack.

        Parameters
        ----------
        stack : ndarray, (N, H, W)
            Images in pattern order.
        saturation_dn : int
            Pixels are saturated from here on; see `saturation_of`.
        """
        count = stack.shape[2] if self._across else stack.shape[1]
        ys = survey_rows(count)
        few = turned(stack, self._across, ys) if self._across else stack
        looked_at = np.arange(ys.size) if self._across else ys
        decoding, bound_px = self._survey(few, looked_at, saturation_dn)
        lines = self._lines(count)
        if self._across:
            lines.sigma_px.fill(np.nan)  # of row boundaries all sigmas are looked at

        def work(first: int, last: int) -> None:
            part, at = stack, np.arange(first, last)
            if self._across:
                part, at = turned(stack, self._across, slice(first, last)), at - first
            mine = decoding._replace(stack=part)
            decode_rows(mine, at, lines.part(first, last), row_scratch(mine))

        share_rows(work, count)
        return Decoded(lines, ys, decoding, bound_px)

    def _survey(self, stack: Pixels, ys: Integers, saturation_dn: int) -> tuple[Decoding, float]:
        """Measure direction, scale, noise and blur on a few rows, and choose the filters."""
        plan, settings = self.plan, self.settings
        tuning = first_tuning(plan, settings, saturation_dn)
        d = Decoding(stack, make_layout(plan), tuning, NO_FILTER, False)
        scratch = row_scratch(d)
        growth = code_growth(d, ys, scratch.pixels)
        growth = growth if abs(growth) > 0 else 1.0
        scatter = sample_scatter(d, ys[::NOISE_STEP], scratch.pixels)
        noise = fit_noise(scatter)
        tuning = tuning._replace(
            direction=1 if growth > 0 else -1, scale=1 / abs(growth), noise=noise
        )
        first = edge_filter(plan, True, FIRST_BLUR_PX, tuning.scale)
        few = self._lines(ys.size)
        decode_rows(d._replace(tuning=tuning, filters=first), ys, few, scratch)
        tuning = self._measured(tuning, few)
        matched = settings.estimator == "matched"
        filters = edge_filter(plan, matched, tuning.blur_px, tuning.scale)
        bars = not matched and bool(filters.slope[-1] > MIN_BAR_SLOPE)
        d = d._replace(tuning=tuning, filters=filters, bars=bars)
        return d, edge_bound(scatter, noise, tuning.blur_px)

    def _measured(self, tuning: Tuning, few: Lines) -> Tuning:
        """Tuning with scale and blur of the edges that were found in a few rows."""
        plan, settings = self.plan, self.settings
        scale = _measure_scale(few, tuning.scale)
        stripe_px = min(s.half_period_px for s in plan.sources) * scale
        blur_px = settings.edge_blur_px or _measure_blur(few, plan, scale)
        return tuning._replace(
            scale=scale,
            around_px=max(3, int(np.ceil(stripe_px)) + 3),
            reach_px=max(2, int(np.ceil(REACH_SD * blur_px))),
            blur_px=blur_px,
            least_width=1 / settings.max_slope,
            most_width=1 / max(settings.min_slope, 1e-9),
        )

    def _lines(self, rows: int) -> Lines:
        """Memory for a number of rows, made once."""
        if rows not in self._scratch:
            shape = rows, self.plan.size_px
            u_px, sigma_px, width_px, level_dn = np.full((4, *shape), np.nan, np.float32)
            tally = np.zeros((rows, len(self.plan.sources), 2), np.int32)
            numbers = u_px, sigma_px, width_px, level_dn
            self._scratch[rows] = Lines(*numbers, np.ones(shape, np.uint8), tally)
        return self._scratch[rows]


def turned(stack: Pixels, images: tuple[int, ...], columns: slice | Integers) -> Pixels:
    """Camera columns of some images as rows: a few at a time, a whole stack would fill memory.

    Parameters
    ----------
    stack : ndarray, (N, H, W)
        The images.
    images : tuple of int
        Which of them.
    columns : slice or ndarray
        Which columns.

    Returns
    -------
    ndarray, (images, columns, H)
        A copy.
    """
    parts = [stack[image][:, columns] for image in images]
    rows = np.empty((len(images), parts[0].shape[1], stack.shape[1]), stack.dtype)
    for part, row in zip(parts, rows, strict=True):
        cv2.transpose(part, row)
    return rows


def first_tuning(plan: AxisPlan, settings: Settings, saturation_dn: int) -> Tuning:
    """What is known before a look at the images.

    Parameters
    ----------
    plan : AxisPlan
        The axis.
    settings : Settings
        Choices of the user.
    saturation_dn : int
        Full scale of the images, DN.
    """
    contrast_dn = settings.min_contrast_dn or 0.03 * saturation_dn
    return Tuning(
        direction=1,
        reach_px=int(np.ceil(REACH_SD * FIRST_BLUR_PX)),
        around_px=4 * plan.division_px,
        scale=1.0,
        division_px=plan.division_px,
        size_px=plan.size_px,
        floor_dn=0.002 * saturation_dn,
        lit_dn=0.5 * contrast_dn,
        contrast_dn=contrast_dn,
        saturation=saturation_dn,
        least_width=0.0,
        most_width=np.inf,
        min_light=settings.min_light,
        noise=Noise(0.0, 0.0),
        jump_px=settings.max_jump_px,
        blur_px=FIRST_BLUR_PX,
    )


def _measure_scale(lines: Lines, guess: float) -> float:
    """Camera pixels per DMD pixel: median distance of boundaries that are 8 apart."""
    steps = np.abs(lines.u_px[:, 8:] - lines.u_px[:, :-8]) / 8
    steps = steps[np.isfinite(steps)]
    return float(np.median(steps)) if steps.size else guess


def _measure_blur(lines: Lines, plan: AxisPlan, scale: float) -> float:
    """Blur of the edges: median over those whose neighbours do not flatten them, pixels."""
    taps = gaussian_taps(FIRST_BLUR_PX, int(np.ceil(3 * FIRST_BLUR_PX)))
    seen_px = np.hypot(FIRST_BLUR_PX, np.sqrt(tap_variance(taps)))
    wide = [i for i, s in enumerate(plan.sources) if 2 * s.half_period_px * scale > 6 * seen_px]
    mine: NDArray[np.bool_] = np.isin(make_layout(plan).edge_owner, wide)
    good = lines.width_px[:, mine][lines.reason[:, mine] == 0]
    if good.size == 0:
        return FIRST_BLUR_PX
    variance = (float(np.median(good)) * seen_px) ** 2 - tap_variance(taps)
    return float(np.sqrt(np.clip(variance, 0.3**2, 4.0**2)))
