"""Lines that tell a person what a calibration found."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sl_calibration.workflow.conclusion import Outcome


def outcome_lines(outcome: Outcome | Any) -> list[str]:
    """Lines that tell a person what came out; of an `Outcome` or the action's result."""
    lines = [outcome.message]
    if outcome.views:
        lines += [
            f"views             {outcome.views}, {outcome.holes} holes",
            f"camera            {outcome.camera_rms_px:.4f} px, "
            f"{outcome.camera_rms_m * 1e6:.3f} um on the part (rms of the holes)",
            *_stage_lines(outcome),
        ]
    if outcome.projector_rms_px:
        lines += [
            f"projector         {outcome.projector_rms_px:.4f} px, "
            f"{outcome.projector_rms_m * 1e6:.3f} um on the part (rms of the targets)",
            f"sigma of z        {outcome.predicted_sigma_m * 1e6:.3f} um at worst in the volume",
            f"left-out heights  {outcome.left_out_rms_m * 1e6:.3f} um rms of z",
        ]
    if outcome.calibration_file:
        lines += [
            f"calibration       {outcome.calibration_file}",
            f"hash              {outcome.hash}",
        ]
    if outcome.report:
        lines.append(f"report            {outcome.report}")
    return lines


def _stage_lines(outcome: Outcome | Any) -> list[str]:
    """Lines that tell what the stage really does."""
    lean = ", ".join(f"{math.degrees(angle):+.4f}" for angle in outcome.stage_z_lean_rad)
    lines = [
        f"stage z           scale off by {(outcome.stage_z_scale - 1) * 1e6:+.0f} ppm, leans by "
        f"({lean}) deg from the plate's normal"
    ]
    square = [math.degrees(angle) for angle in outcome.stage_squareness_rad]
    if all(map(math.isfinite, square)):
        xy, xz, yz = square
        lines.append(f"stage squareness  xy {xy:+.4f}, xz {xz:+.4f}, yz {yz:+.4f} deg off 90")
    return lines
