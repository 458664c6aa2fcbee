"""The acceptance gate: the limits of a calibration's figures, and the verdict on a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Limits:
    """Acceptance gate: the largest value of each figure.

    Parameters
    ----------
    hole_rms_px, target_rms_px : float
        Residuals of holes (camera pixels) and of targets (DMD pixels).
    rejected_part : float
        Part of holes or targets that were left out as wrong.
    point_sigma_m : float
        Predicted 1-sigma of z, from the calibration alone, worst in the volume, metres.
    left_out_z_m : float
        Rms error of z at a height that the calibration has not seen, worst height, metres.
    stage_scale_error : float
        True travel of z per metre read, off 1.
    stage_lean_rad : float
        Lean of z travel against the plate's normal, radians.
    uncovered_part : float
        Part of the camera's image farther from any hole than an eighth of its width.
    kept_lens_sigmas : float
        Where one device's lens is kept: how far it lies from the one that the run itself finds.
    """

    hole_rms_px: float = 0.1
    target_rms_px: float = 0.1
    rejected_part: float = 0.15
    point_sigma_m: float = 1e-6
    left_out_z_m: float = 2e-6
    stage_scale_error: float = 0.01
    stage_lean_rad: float = 0.1
    uncovered_part: float = 0.5
    kept_lens_sigmas: float = 6.0


@dataclass(frozen=True)
class Verdict:
    """Whether a calibration may be put in force.

    Parameters
    ----------
    passed : bool
        All figures are known and within their limits.
    reasons : tuple of str
        For each figure that is not, what was found and what was expected.
    figures : mapping
        All that were judged.
    """

    passed: bool
    reasons: tuple[str, ...]
    figures: Mapping[str, float]


def judge(figures: Mapping[str, float], limits: Any) -> Verdict:
    """Hold figures against their limits.

    Parameters
    ----------
    figures : mapping of str to float
        Named as the limits are; NaN is never within a limit.
    limits : Limits, or another dataclass of numbers
        Those without a figure limit nothing.
    """
    reasons = tuple(
        f"{name} is {figures[name]:.3g}; expected at most {limit:.3g}"
        for name, limit in asdict(limits).items()
        if name in figures and not figures[name] <= limit
    )
    return Verdict(not reasons, reasons, dict(figures))
