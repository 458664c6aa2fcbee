"""From one stack to one view: the plate's holes in white light, and the projector's coordinates."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_calibration.data.observations import View
from sl_calibration.data.session import CalibrationRequest
from sl_calibration.target.hole_detection import find_plate
from sl_common.errors import CalibrationError
from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence
from sl_projector.sequence.stack import Stack
from sl_reconstruct.decode.stack_statistics import full_scale_dn
from sl_reconstruct.reconstruction.correspondence import Correspondences, correspondences

Array = NDArray[np.float64]

#: White must differ from black by this part of the full scale in some part of the image.
MIN_LIGHT = 0.05
#: The part of the image that must be lit so.
MIN_LIT_PART = 0.02
#: Fewer targets than this in a view do not carry a projector's calibration.
MIN_TARGETS = 30
#: Light with a relative slope g moves an edge blurred by s by about s^2 g, the same over whole
#: regions of the field. That does not average out, so each of the hundreds of targets has to count
#: for less to make up for it. 1.5 px^2, as measured on noise-free images, times the root of 50 a
#: region.
LIGHT_SLOPE_PX2 = 10.0
#: What the slant of the views does to edges in even light, DMD pixels: 6e-5, alike everywhere.
MODEL_SIGMA_PX = 0.0009
#: The light is averaged in cells of this many pixels, and smoothed over this many cells.
CELL_PX = 8
SMOOTH_CELLS = 6.0
_NO_TARGETS = Correspondences(*np.empty((3, 0, 2)))


def observe(stack: Stack, request: CalibrationRequest) -> View:
    """Measure the plate in one stack.

    Parameters
    ----------
    stack : Stack
        The stack, and where the stage stood.
    request : CalibrationRequest
        The plate; without ``patterns`` only its holes are looked for, and the view has no targets.

    Raises
    ------
    CalibrationError
        When the projector gives no light, the plate is not there or not as it should be, or the
        projector's patterns are not seen on it.
    """
    check_target_light(stack.images)
    full_dn = full_scale_dn(stack.images)
    white = white_image(stack.images, stack.sequence)
    holes = find_plate(white, request.plate, full_dn)
    targets = _targets(stack, white) if request.patterns else _NO_TARGETS
    good = holes.good
    return View(
        stack.place[2],
        hole_ids=holes.ids[good],
        plate_xy_m=holes.plate_xy_m[good],
        centres_px=holes.centres_px[good],
        centres_sigma_px=holes.sigma_px[good],
        camera_px=targets.camera_px,
        dmd_px=targets.dmd_px,
        dmd_sigma_px=targets.sigma_px,
        edge_sigma_px=targets.edge_sigma_px,
        xy_m=stack.place[:2],
    )


def decoded_targets(stack: Stack) -> Correspondences:
    """Projector's coordinates on whatever lies there.

    Raises
    ------
    CalibrationError
        When there are too few.
    """
    found = correspondences(stack.images, stack.sequence)
    if len(found) < MIN_TARGETS:
        raise CalibrationError(
            f"the projector's coordinates were decoded at {len(found)} places; expected at least "
            f"{MIN_TARGETS}: is what lies there in focus and evenly lit, and the exposure right?"
        )
    return found


def _targets(stack: Stack, white: NDArray[np.float32]) -> Correspondences:
    found = decoded_targets(stack)
    spread = np.std(found.dmd_px, axis=0) / np.std(found.camera_px, axis=0)
    moved = LIGHT_SLOPE_PX2 * light_slope(white, found.camera_px) * float(spread.max())
    model = np.hypot(moved, MODEL_SIGMA_PX)[:, np.newaxis]
    return replace(found, sigma_px=np.hypot(found.sigma_px, model))


def light_slope(white: NDArray[np.float32], at_px: Array) -> Array:
    """Relative slope (N,) of the light on the plate, per pixel; holes apart.

    Parameters
    ----------
    white : ndarray, (H, W)
        Image under full light.
    at_px : ndarray, (N, 2)
        Pixels (u, v).
    """
    size = (white.shape[1] // CELL_PX, white.shape[0] // CELL_PX)
    cells = cv2.resize(white, size, interpolation=cv2.INTER_AREA)
    near = cv2.dilate(cells, np.ones((9, 9), np.uint8))
    plate = (cells > np.maximum(0.9 * near, 0.1 * near.max())).astype(np.float32)
    weight = cv2.GaussianBlur(plate, (0, 0), SMOOTH_CELLS)
    light = cv2.GaussianBlur(plate * cells, (0, 0), SMOOTH_CELLS) / np.maximum(weight, 1e-6)
    down, across = np.gradient(np.log(np.maximum(light, 1e-3)))
    u, v = (np.asarray(at_px).T // CELL_PX).astype(int).clip(0, np.array(size)[:, np.newaxis] - 1)
    return np.asarray(np.hypot(down, across)[v, u] / CELL_PX, dtype=np.float64)


def white_image(stack: NDArray[Any], sequence: PatternSequence) -> NDArray[np.float32]:
    """Mean image under full light, (H, W): every pattern and its inverse add up to one.

    Averaging over all pairs takes the camera's noise down by their number's root, and the stripes
    cancel exactly.

    Parameters
    ----------
    stack : ndarray, (N, H, W)
        Images in pattern order.
    sequence : PatternSequence
        What was projected.

    Raises
    ------
    CalibrationError
        When the sequence has neither white nor pairs.
    """
    pairs = _pairs(sequence)
    lit = [i for i, p in enumerate(sequence.patterns) if _full(p) is True]
    dark = [i for i, p in enumerate(sequence.patterns) if _full(p) is False]
    if not lit and not pairs:
        raise CalibrationError(
            f"sequence {sequence.name!r} shows neither white nor a pattern with its inverse; "
            "expected one of them to find the holes in"
        )
    total = np.zeros(stack.shape[1:], np.float32)
    for i in [*lit, *itertools.chain(*pairs)]:
        total += stack[i]
    # A pair holds the ambient light twice, white holds it once.
    ambient = np.zeros_like(total)
    for i in dark:
        ambient += stack[i] / np.float32(len(dark))
    white: NDArray[np.float32] = total - np.float32(len(pairs)) * ambient
    white /= len(lit) + len(pairs)
    return white


def _full(pattern: Pattern) -> bool | None:
    """Whether everything is on (True) or off (False); None for stripes."""
    return None if pattern.kind == "gray" else (pattern.kind == "white") != pattern.inverted


def _pairs(sequence: PatternSequence) -> list[tuple[int, int]]:
    index = {p: i for i, p in enumerate(sequence.patterns) if p.kind == "gray"}
    found = [(i, index.get(p.inverse(), -1)) for p, i in index.items()]
    return [(i, j) for i, j in found if i < j]


def check_target_light(stack: NDArray[Any]) -> None:
    """Refuse a stack on which the projector's light makes no difference.

    Parameters
    ----------
    stack : ndarray, (N, H, W)
        Images in pattern order.

    Raises
    ------
    CalibrationError
        With the light that was found and the least that is expected.
    """
    few = stack[:, ::8, ::8]
    light = few.max(axis=0).astype(np.float64) - few.min(axis=0)
    full = full_scale_dn(stack)
    found = float(np.quantile(light, 1.0 - MIN_LIT_PART))
    if found < MIN_LIGHT * full:
        raise CalibrationError(
            f"the projector's light makes a difference of {found:.0f} of {full:.0f} DN; expected "
            f"at least {MIN_LIGHT * full:.0f} in {MIN_LIT_PART:.0%} of the image: is its lamp on, "
            "does it reach the plate, and is the camera exposed long enough?"
        )
