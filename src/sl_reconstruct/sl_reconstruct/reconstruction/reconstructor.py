"""From a stack of images to a cloud: the one entry of the reconstruction."""

from __future__ import annotations

import functools
import threading
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_common.errors import StackError
from sl_projector.sequence.pattern_sequence import PatternSequence
from sl_reconstruct.cloud.cloud import CLOUD_DTYPE, Cloud, Figures, count_reasons, median
from sl_reconstruct.decode.decode_plan import AxisPlan, DecodePlan
from sl_reconstruct.decode.edge_filters import edge_filter, gaussian_taps, tap_variance
from sl_reconstruct.decode.edges import Filter, Tuning
from sl_reconstruct.decode.full_scale import saturation_of
from sl_reconstruct.decode.illumination_check import check_illumination
from sl_reconstruct.decode.row_decoder import decode_rows, row_scratch
from sl_reconstruct.decode.row_threads import share_rows
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.decode.stack_statistics import (
    NOISE_STEP,
    Noise,
    code_growth,
    edge_bound,
    fit_noise,
    sample_scatter,
    survey_rows,
)
from sl_reconstruct.decode.types import Layout, Lines
from sl_reconstruct.model.geometry import geometry, ray_tile
from sl_reconstruct.model.rig import Rig
from sl_reconstruct.reconstruction.four_equation import Crossed, cross_rows, map_rows
from sl_reconstruct.reconstruction.scan_quality import check_identity, check_order, check_phase
from sl_reconstruct.reconstruction.triangulate import Output, Screen, around_row, triangulate_rows

#: Blur assumed until it is measured, camera pixels.
FIRST_BLUR_PX = 1.0
#: An edge's blur does not matter beyond so many standard deviations.
REACH_SD = 2.5
#: A jump counts from so many standard deviations on.
JUMP_SD = 6.0
#: Every so many surveyed rows the order of the boundaries is checked.
ORDER_STEP = 3
#: Distance to both neighbours together, over twice the least distance to one.
WIDE_SPACING = 1.35
#: A usable BR8 needs this slope at a stripe's centre, per pixel of a unit stripe.
MIN_BAR_SLOPE = 0.05


class AxisState(NamedTuple):
    """What one axis of one stack is decoded with."""

    tuning: Tuning
    edge_filter: Filter
    bars: bool
    blur_px: float
    noise: Noise
    bound_px: float


class Reconstructor:
    """Reconstructs stacks of one sequence, seen by one rig.

    Parameters
    ----------
    rig : Rig
        Camera and projector.
    sequence : PatternSequence
        What was projected; images of a stack come in its order.
    settings : Settings
        Choices of the user.

    Notes
    -----
    Scratch memory is kept between calls; calls from several threads wait for each other.
    Results do not depend on the number of threads.
    """

    def __init__(
        self, rig: Rig, sequence: PatternSequence, settings: Settings | None = None
    ) -> None:
        self.rig = rig
        self.sequence = sequence
        self.settings = settings or Settings()
        self.plan = DecodePlan.of(sequence)
        if sequence.dmd_size != rig.projector.image_size:
            raise StackError(
                f"sequence {sequence.name!r} is made for a DMD of {sequence.dmd_size} pixels but "
                f"the rig's projector has {rig.projector.image_size}"
            )
        self._geometry = geometry(rig)
        self._lock = threading.Lock()
        self._scratch: dict[tuple[Any, ...], Lines] = {}

    def __call__(
        self, stack: NDArray[np.uint8] | NDArray[np.uint16], saturation_dn: int | None = None
    ) -> Cloud:
        """Reconstruct one stack.

        Parameters
        ----------
        stack : ndarray, (N, H, W) of uint8 or uint16
            Images in pattern order, DN.
        saturation_dn : int, optional
            What `saturation_of` says of them, where it was asked already: a pass over all pixels.

        Returns
        -------
        Cloud
            All NaN, with reasons, where nothing can be measured.

        Raises
        ------
        StackError
            When number, shape or type of the images do not fit sequence and rig, or the images
            contradict the sequence (exchanged, repeated or foreign frames) or were taken under
            different light.
        """
        self._check(stack)
        with self._lock:
            saturation = saturation_dn or saturation_of(stack, self.settings)
            return self._reconstruct(np.ascontiguousarray(stack), saturation)

    def _check(self, stack: NDArray[Any]) -> None:
        width, height = self.rig.camera.image_size
        expected = (self.plan.count, height, width)
        if not isinstance(stack, np.ndarray) or stack.dtype not in (np.uint8, np.uint16):
            found = getattr(stack, "dtype", type(stack).__name__)
            raise StackError(f"stack of {found}; expected an array of uint8 or uint16")
        if stack.shape != expected:
            raise StackError(
                f"stack.shape={stack.shape}; expected {expected}: {self.plan.count} images of "
                f"sequence {self.sequence.name!r} from the rig's {width}x{height} camera"
            )

    def _reconstruct(self, stack: NDArray[Any], saturation: int) -> Cloud:
        column = self.plan.column
        state, lines, figures = self._decode(
            stack, column, self.plan.white, self.plan.black, saturation
        )
        out = _output(*lines.u_px.shape)
        light = check_illumination(
            stack, self.sequence, self.settings, saturation, figures.edge_blur_px, figures.scale_px
        )
        figures = replace(figures, light_change=light)
        columns = np.arange(column.size_px, dtype=np.float64) - 0.5
        screen = _screen(self.settings, figures)
        arguments = self._geometry, columns, lines, screen, state.tuning, out

        def work(first: int, last: int) -> None:
            scratch = ray_tile(), around_row(column.size_px)
            triangulate_rows(first, last, *arguments, *scratch)

        share_rows(work, stack.shape[1])
        crossed = self._cross(stack, lines, columns, out, saturation) if self.plan.row else None
        refused, lit = count_reasons(out.reason)
        extra = crossed[1:] if crossed else ()
        points = out.values.view(CLOUD_DTYPE)[..., 0]
        return Cloud(points, out.u_px, out.reason, refused, lit, figures, *extra)

    def _cross(
        self, stack: NDArray[Any], lines: Lines, columns: NDArray[np.float64], out: Output,
        saturation: int,
    ) -> Crossed:  # fmt: skip
        """Decode the rows, and solve again with all four equations."""
        plan, white, black = turn(self.plan)
        images = self.plan.row.images if self.plan.row else ()
        state, across, figures = self._decode(stack, plan, white, black, saturation, images)
        t = state.tuning
        sigma_v = float(np.nanmedian(across.sigma_px)) / t.scale
        v_map = np.empty((stack.shape[2], stack.shape[1]), np.float32)
        add = Crossed(v_map, *(np.empty_like(out.u_px) for _ in range(3)))
        screen, gap_px = _screen(self.settings, figures), self.settings.max_gap_px or np.inf

        def work_rows(first: int, last: int) -> None:
            map_rows(first, last, across, screen, v_map, around_row(plan.size_px))

        def work(first: int, last: int) -> None:
            cross_rows(first, last, self._geometry, columns, lines, sigma_v, gap_px, out, add)

        share_rows(work_rows, stack.shape[2])
        share_rows(work, stack.shape[1])
        return add

    def _decode(
        self, stack: NDArray[Any], plan: AxisPlan, white: int, black: int, saturation: int,
        across: tuple[int, ...] = (),
    ) -> tuple[AxisState, Lines, Figures]:  # fmt: skip
        """Decode image rows, or the columns of the images ``across``."""
        layout = make_layout(plan, white, black)
        count = stack.shape[2] if across else stack.shape[1]
        ys, rows = survey_rows(count), np.arange(count)
        few = self._lines((ys.size, plan, "survey"))
        surveyed = (turned(stack, across, ys), rows[: ys.size]) if across else (stack, ys)
        state = survey(*surveyed, plan, layout, self.settings, few, saturation)
        lines = self._lines((count, plan, "all"))
        arguments = layout, state.edge_filter, state.tuning, state.bars, lines
        divisions = -(-plan.size_px // plan.division_px)

        def work(first: int, last: int) -> None:
            part, at = stack, rows
            if across:
                part, at = turned(stack, across, slice(first, last)), rows - first
            scratch = row_scratch(part.shape[2], stack.dtype, divisions)
            decode_rows(at, first, last, part, *arguments, scratch)

        share_rows(work, rows.size)
        images = [s.image for s in plan.sources]
        check_identity(lines.tally, images)
        check_phase(lines.u_px[ys], layout.edge_owner, images)
        order = check_order(lines.u_px[ys[::ORDER_STEP]])
        return state, lines, figures_of(state, layout, lines, ys, order)

    def _lines(self, key: tuple[Any, ...]) -> Lines:
        """Scratch for so many rows of an axis, made once."""
        if key not in self._scratch:
            self._scratch[key] = empty_lines(key[0], key[1])
        return self._scratch[key]


def empty_lines(rows: int, plan: AxisPlan) -> Lines:
    """Results of so many rows of an axis, nothing found yet."""
    u_px, sigma_px, width_px, level_dn = np.full((4, rows, plan.size_px), np.nan, np.float32)
    return Lines(
        u_px, sigma_px, width_px, level_dn, np.ones((rows, plan.size_px), np.uint8),
        np.zeros((rows, len(plan.sources), 2), np.int32),
    )  # fmt: skip


def _screen(settings: Settings, figures: Figures) -> Screen:
    """Limits for neighbours; a second difference has sqrt(6) times the noise of its edges."""
    noise_px = JUMP_SD * np.sqrt(6) * figures.edge_sigma_px
    jump_px = max(settings.max_jump_px, noise_px) if noise_px > 0 else settings.max_jump_px
    near_px = settings.min_spacing * figures.scale_px
    return Screen(float(jump_px), near_px, 2 * WIDE_SPACING * near_px)


def _output(height: int, boundaries: int) -> Output:
    shape = (height, boundaries)
    return Output(
        np.empty((*shape, 5), np.float32), np.empty(shape, np.float32), np.empty(shape, np.uint8)
    )


def turned(
    stack: NDArray[Any], images: tuple[int, ...], columns: slice | NDArray[np.int64]
) -> NDArray[Any]:
    """Camera columns of some images as rows: a few at a time, a whole stack would fill memory."""
    parts = [stack[image][:, columns] for image in images]
    rows = np.empty((len(images), parts[0].shape[1], stack.shape[1]), stack.dtype)
    for part, row in zip(parts, rows, strict=True):
        cv2.transpose(part, row)
    return rows


def turn(plan: DecodePlan) -> tuple[AxisPlan, int, int]:
    """The row plan, white and black as for a stack of the row plan's images alone."""
    assert plan.row is not None
    at = {image: i for i, image in enumerate(plan.row.images)} | {-1: -1}
    row = replace(
        plan.row, images=tuple(range(len(plan.row.images))),
        bits=tuple(replace(b, image=at[b.image], inverse=at[b.inverse]) for b in plan.row.bits),
        sources=tuple(
            replace(s, image=at[s.image], inverse=at[s.inverse]) for s in plan.row.sources
        ),
    )  # fmt: skip
    return row, at[plan.white], at[plan.black]


@functools.lru_cache(maxsize=8)
def make_layout(plan: AxisPlan, white: int, black: int) -> Layout:
    """Write an axis's plan as arrays for the kernels."""
    edge_owner, centre_owner = plan.owners()
    sources = [
        (s.image, s.inverse, s.half_period_px, s.rising_px, s.edges, s.centres)
        for s in plan.sources
    ]
    bits = [(b.image, b.inverse, b.flipped) for b in plan.bits]
    turns = np.flatnonzero(np.diff(centre_owner >= 0, prepend=False, append=False))
    centres = [
        (first, stop, plan.sources[centre_owner[first]].half_period_px)
        for first, stop in turns.reshape(-1, 2).tolist()
    ]
    return Layout(
        np.array(sources, np.int64), edge_owner, centre_owner, np.array(bits, np.int64),
        np.array(plan.images, np.int64), white, black, plan.dynamic,
        np.array(centres, np.int64).reshape(-1, 3),
    )  # fmt: skip


def first_tuning(plan: AxisPlan, settings: Settings, saturation: int) -> Tuning:
    """What is known before a look at the images; ``saturation`` is their full scale, DN."""
    contrast_dn = settings.min_contrast_dn or 0.03 * saturation
    return Tuning(
        direction=1, reach_px=int(np.ceil(REACH_SD * FIRST_BLUR_PX)),
        around_px=4 * plan.division_px, scale=1.0, division_px=plan.division_px,
        size_px=plan.size_px, floor_dn=0.002 * saturation, lit_dn=0.5 * contrast_dn,
        contrast_dn=contrast_dn, saturation=saturation,
        least_width=0.0, most_width=np.inf, min_light=settings.min_light,
        noise_dn2=0.0, noise_dn=0.0, jump_px=settings.max_jump_px, blur_px=FIRST_BLUR_PX,
    )  # fmt: skip


def survey(
    stack: NDArray[Any], ys: NDArray[np.int64], plan: AxisPlan, layout: Layout,
    settings: Settings, few: Lines, saturation: int | None = None,
) -> AxisState:  # fmt: skip
    """Measure direction, scale, noise and blur on a few rows, and choose the filters."""
    tuning = first_tuning(plan, settings, saturation or saturation_of(stack, settings))
    scratch = row_scratch(stack.shape[2], stack.dtype, -(-plan.size_px // plan.division_px))
    growth, _ = code_growth(stack, ys, layout, tuning, scratch.pixels)
    if not abs(growth) > 0:
        growth = 1.0
    scatter = sample_scatter(stack, ys[::NOISE_STEP], layout, tuning, scratch.pixels)
    noise = fit_noise(scatter)
    tuning = tuning._replace(
        direction=1 if growth > 0 else -1, scale=1 / abs(growth),
        noise_dn2=noise.read_dn2, noise_dn=noise.shot_dn,
    )  # fmt: skip
    first = edge_filter(plan, True, FIRST_BLUR_PX, tuning.scale)
    decode_rows(ys, 0, ys.size, stack, layout, first, tuning, False, few, scratch)
    scale = measure_scale(few, tuning.scale)
    stripe_px = min(s.half_period_px for s in plan.sources) * scale
    tuning = tuning._replace(scale=scale, around_px=max(3, int(np.ceil(stripe_px)) + 3))
    blur_px = settings.edge_blur_px or measure_blur(few, plan, layout, tuning.scale)
    tuning = tuning._replace(
        reach_px=max(2, int(np.ceil(REACH_SD * blur_px))), blur_px=blur_px,
        least_width=1 / settings.max_slope, most_width=1 / max(settings.min_slope, 1e-9),
    )  # fmt: skip
    matched = settings.estimator == "matched"
    filters = edge_filter(plan, matched, blur_px, tuning.scale)
    bars = not matched and bool(filters.slope[-1] > MIN_BAR_SLOPE)
    return AxisState(tuning, filters, bars, blur_px, noise, edge_bound(scatter, noise, blur_px))


def measure_scale(lines: Lines, guess: float) -> float:
    """Camera pixels per DMD pixel: median distance of boundaries that are 8 apart."""
    steps = np.abs(lines.u_px[:, 8:] - lines.u_px[:, :-8]) / 8
    steps = steps[np.isfinite(steps)]
    return float(np.median(steps)) if steps.size else guess


def measure_blur(lines: Lines, plan: AxisPlan, layout: Layout, scale: float) -> float:
    """Blur of the edges: median over those whose neighbours do not flatten them, pixels."""
    taps = gaussian_taps(FIRST_BLUR_PX, int(np.ceil(3 * FIRST_BLUR_PX)))
    seen_px = np.hypot(FIRST_BLUR_PX, np.sqrt(tap_variance(taps)))
    wide = [i for i, s in enumerate(plan.sources) if 2 * s.half_period_px * scale > 6 * seen_px]
    width = lines.width_px[:, np.isin(layout.edge_owner, wide)]
    good = width[(lines.reason[:, np.isin(layout.edge_owner, wide)] == 0)]
    if good.size == 0:
        return FIRST_BLUR_PX
    variance = (float(np.median(good)) * seen_px) ** 2 - tap_variance(taps)
    return float(np.sqrt(np.clip(variance, 0.3**2, 4.0**2)))


def figures_of(
    state: AxisState, layout: Layout, lines: Lines, ys: NDArray[np.int64], order: float
) -> Figures:
    """Quality figures from the surveyed rows."""
    t = state.tuning
    edges = layout.edge_owner >= 0
    sigma = lines.sigma_px[ys][:, edges][lines.reason[ys][:, edges] == 0]
    pairs = 1.0 if layout.dynamic else np.sqrt(2.0)
    return Figures(
        edge_blur_px=state.blur_px, scale_px=t.scale * t.direction,
        noise_read_dn2=state.noise.read_dn2, noise_shot_dn=state.noise.shot_dn,
        edge_sigma_px=median(sigma),
        edge_bound_px=float(state.bound_px / pairs), order=order,
    )  # fmt: skip
