"""The paper's Table 1 for any rig, from what a calibration's ``report.json`` holds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

#: The paper's Table 1 as it can be read (its matrices are not orthonormal and T's units unclear).
PAPER_TABLE_1: Mapping[str, tuple[str, str]] = {
    "Effective focal length f, mm": ("95.665", "192.792"),
    "Distortion factor kappa, px^-2": ("3.76e-8", "1.20e-8"),
    "Image centre C, px": ("(28.93, 479.42)", "(831.0, 420.2)"),
}


def table_1(content: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Rows of the paper's Table 1 for this rig: parameter, projector, camera, the paper's.

    The cells of a device that was not calibrated are empty.
    """
    cells: dict[str, Callable[[Mapping[str, Any]], str]] = {
        "Rotation matrix R": _rotation_cell,
        "Translation vector T, mm": _translation_cell,
        "Effective focal length f, mm": _focal_cell,
        "Effective focal length f, px": lambda d: _pm(
            d["focal_length_px"], d["sigma"]["focal_length_px"]
        ),
        "Distortion factor kappa, px^-2": lambda d: _pm(d["kappa"], d["sigma"]["kappa"]),
        "Image centre C, px": _centre_cell,
        "Residual on the part, µm rms": lambda d: f"{d['rms_m'] * 1e6:.4f}",
    }
    paper = {**PAPER_TABLE_1, "Residual on the part, µm rms": ("15", "10")}
    devices = [content.get("projector"), content.get("camera")]
    return [
        (name, *(cell(d) if d else "" for d in devices), ", ".join(paper.get(name, ())))
        for name, cell in cells.items()
    ]


def _focal_cell(device: Mapping[str, Any]) -> str:
    sigma_m = device["sigma"]["focal_length_px"] * device["pixel_pitch_m"]
    return _pm(device["focal_length_m"] * 1e3, sigma_m * 1e3)


def _pm(value: float, sigma: float) -> str:
    """Value with as many digits as its sigma deserves."""
    if not (math.isfinite(sigma) and sigma > 0):
        return f"{value:.7g}"
    exponent = math.floor(math.log10(sigma))
    if abs(value) < 1e-3:
        scale = math.floor(math.log10(abs(value))) if value else exponent
        digits = max(0, scale - exponent + 1)
        return f"({value / 10.0**scale:.{digits}f} ± {sigma / 10.0**scale:.{digits}f})e{scale}"
    digits = max(0, 1 - exponent)
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def _rotation_cell(device: Mapping[str, Any]) -> str:
    rows = ["  ".join(f"{v:+.6f}" for v in row) for row in np.asarray(device["rotation"])]
    worst = max(v for k, v in device["sigma"].items() if k.startswith("rotation_rad"))
    return "\n".join([*rows, f"± {worst * 1e6:.2g} µrad at most"])


def _translation_cell(device: Mapping[str, Any]) -> str:
    sigma = device["sigma"]
    return "\n".join(
        _pm(t * 1e3, sigma[f"translation_m.{i}"] * 1e3)
        for i, t in enumerate(np.asarray(device["translation_m"]))
    )


def _centre_cell(device: Mapping[str, Any]) -> str:
    centre, sigma = device["image_centre_px"], device["sigma"]
    return ", ".join(_pm(c, sigma[f"image_centre_px.{i}"]) for i, c in enumerate(centre))
