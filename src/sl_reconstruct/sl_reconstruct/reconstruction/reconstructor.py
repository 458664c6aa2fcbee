"""From a stack of images to a cloud: the one entry of the reconstruction."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import StackError
from sl_common.row_threads import share_rows
from sl_projector.sequence.pattern_sequence import PatternSequence
from sl_reconstruct.cloud.cloud import CLOUD_DTYPE, Cloud, Figures, count_reasons, median
from sl_reconstruct.decode.axis_decoder import AxisDecoder, Decoded
from sl_reconstruct.decode.decode_plan import DecodePlan
from sl_reconstruct.decode.illumination_check import check_illumination
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.decode.stack_statistics import saturation_of
from sl_reconstruct.decode.types import Pixels, contiguous
from sl_reconstruct.model.geometry import geometry
from sl_reconstruct.model.rig import Rig
from sl_reconstruct.reconstruction.four_equation import Crossed, RowMap, cross_rows, map_rows
from sl_reconstruct.reconstruction.scan_quality import check_identity, check_order, check_phase
from sl_reconstruct.reconstruction.triangulate import (
    Output,
    Screen,
    Triangulation,
    around_row,
    triangulate_rows,
    triangulation_scratch,
)

#: A jump counts from this many standard deviations on.
JUMP_SD = 6.0
#: The order of the boundaries is checked in every third of the rows that are looked at first.
ORDER_STEP = 3
#: Distance to both neighbours together, over twice the least distance to one.
WIDE_SPACING = 1.35


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
        self._column = AxisDecoder(self.plan.column, self.settings)
        self._row = AxisDecoder(self.plan.row, self.settings) if self.plan.row else None

    def __call__(self, stack: Pixels, saturation_dn: int | None = None) -> Cloud:
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
            return self._reconstruct(contiguous(stack), saturation)

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

    def _reconstruct(self, stack: Pixels, saturation_dn: int) -> Cloud:
        decoded, figures = _decode(self._column, stack, saturation_dn)
        light = check_illumination(
            stack, self.sequence, self.settings, saturation_dn, figures.edge_blur_px,
            figures.scale_px,
        )  # fmt: skip
        figures = replace(figures, light_change=light)
        columns = np.arange(self.plan.column.size_px, dtype=np.float64) - 0.5
        screen = _screen(self.settings, figures)
        job = Triangulation(self._geometry, columns, decoded.lines, screen, decoded.decoding.tuning)
        rows = self._map_rows(stack, saturation_dn)
        out, extra = _triangulate(job, rows)
        refused, lit = count_reasons(out.reason)
        points = out.values.view(CLOUD_DTYPE)[..., 0]
        return Cloud(points, out.u_px, out.reason, refused, lit, figures, *extra)

    def _map_rows(self, stack: Pixels, saturation_dn: int) -> RowMap | None:
        """Decode the row patterns, and give every pixel its DMD row; None where there are none."""
        if self._row is None:
            return None
        decoded, figures = _decode(self._row, stack, saturation_dn)
        lines, screen = decoded.lines, _screen(self.settings, figures)
        sigma_v = float(np.nanmedian(lines.sigma_px)) / decoded.decoding.tuning.scale
        v_map = np.empty((stack.shape[2], stack.shape[1]), np.float32)

        def work(first: int, last: int) -> None:
            map_rows(first, last, lines, screen, v_map, around_row(lines.u_px.shape[1]))

        share_rows(work, len(v_map))
        return RowMap(v_map, sigma_v, self.settings.max_gap_px or np.inf)


def _decode(decoder: AxisDecoder, stack: Pixels, saturation_dn: int) -> tuple[Decoded, Figures]:
    """Decode an axis; a stack that contradicts its sequence is refused."""
    decoded = decoder(stack, saturation_dn)
    lines, ys, sources = decoded.lines, decoded.ys, decoder.plan.sources
    images = [s.image for s in sources]
    check_identity(lines.tally, images)
    check_phase(lines.u_px[ys], decoded.decoding.plan.edge_owner, images)
    order = check_order(lines.u_px[ys[::ORDER_STEP]])
    return decoded, _figures(decoded, order)


def _triangulate(job: Triangulation, rows: RowMap | None) -> tuple[Output, Crossed | tuple[()]]:
    """Make the cloud, and what row patterns add to it."""
    shape = job.lines.u_px.shape
    out = Output(
        np.empty((*shape, 5), np.float32), np.empty(shape, np.float32), np.empty(shape, np.uint8)
    )
    extra = Crossed(*(np.empty(shape, np.float32) for _ in range(3))) if rows else ()

    def work(first: int, last: int) -> None:
        scratch = triangulation_scratch(shape[1])
        if rows and extra:
            cross_rows(job, rows, first, last, out, extra, scratch)
        else:
            triangulate_rows(job, first, last, out, scratch)

    share_rows(work, shape[0])
    return out, extra


def _screen(settings: Settings, figures: Figures) -> Screen:
    """Limits for neighbours; a second difference has sqrt(6) times the noise of its edges."""
    noise_px = JUMP_SD * np.sqrt(6) * figures.edge_sigma_px
    jump_px = max(settings.max_jump_px, noise_px) if noise_px > 0 else settings.max_jump_px
    near_px = settings.min_spacing * figures.scale_px
    return Screen(float(jump_px), near_px, 2 * WIDE_SPACING * near_px)


def _figures(decoded: Decoded, order: float) -> Figures:
    """Quality figures from the rows that were looked at first."""
    d, lines, ys = decoded.decoding, decoded.lines, decoded.ys
    edges = d.plan.edge_owner >= 0
    sigma = lines.sigma_px[ys][:, edges][lines.reason[ys][:, edges] == 0]
    pairs = 1.0 if d.plan.dynamic else np.sqrt(2.0)
    return Figures(
        edge_blur_px=d.tuning.blur_px,
        scale_px=d.tuning.scale * d.tuning.direction,
        noise_read_dn2=d.tuning.noise.read_dn2,
        noise_shot_dn=d.tuning.noise.shot_dn,
        edge_sigma_px=median(sigma),
        edge_bound_px=float(decoded.bound_px / pairs),
        order=order,
    )
