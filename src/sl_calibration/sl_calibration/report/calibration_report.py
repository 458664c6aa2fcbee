"""The report of a calibration: one self-contained page for people, JSON for programs."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sl_calibration.data.run_store import CAMERA_PAGE, CAMERA_REPORT, PAGE, REPORT
from sl_calibration.report.report_pictures import pictures
from sl_calibration.report.table_1 import table_1
from sl_calibration.solve.solution import metres_per_pixel
from sl_common.documents import write_text
from sl_common.json_file import plain_value, write_json
from sl_common.pages.page import render_page
from sl_reconstruct.model.calibration_file import Calibration
from sl_reconstruct.model.rig import Device, Division

if TYPE_CHECKING:
    from sl_calibration.bundle.bundle_adjustment import Bundle
    from sl_calibration.solve.solution import JudgedSolution

Array = NDArray[np.float64]

_TEMPLATE = Path(__file__).parent / "templates" / "calibration.html"


def write_report(folder: Path, solved: JudgedSolution, calibration: Calibration | None) -> None:
    """Write the report of a run, as JSON and as a page.

    Parameters
    ----------
    folder : Path
        The run's folder.
    solved : JudgedSolution
        What the run found.
    calibration : Calibration or None
        The rig's; None for a camera alone, whose files have names of their own.
    """
    report = _report(solved, calibration)
    write_json(folder / (REPORT if calibration else CAMERA_REPORT), report)
    made_from = report["made_from"]
    what = "" if calibration else "of the camera, "
    page = render_page(
        _TEMPLATE,
        title=f"Calibration {what or 'of '}{made_from.get('date', 'unknown date')}",
        report=report,
        table_1=table_1(report),
        pictures=pictures(solved),
        made_from={k: json.dumps(plain_value(v), ensure_ascii=False) for k, v in made_from.items()},
        degrees=math.degrees(1.0),
    )
    write_text(folder / (PAGE if calibration else CAMERA_PAGE), page)


def _report(solved: JudgedSolution, calibration: Calibration | None) -> dict[str, Any]:
    bundle, verdict = solved.bundle, solved.verdict
    of_rig = calibration and {
        "predicted_sigma_m": solved.predicted_sigma_m,
        "edge_sigma_px": solved.edge_noise.camera_u_px,
        "hash": calibration.hash,
    }
    return {
        "format": 1,
        "accepted": verdict.passed,
        "reasons": list(verdict.reasons),
        "figures": dict(verdict.figures),
        "limits": dict(vars(solved.limits)),
        **{name: _device(solved, i) for i, name in enumerate(solved.names)},
        "stage": {name: value.tolist() for name, value in vars(bundle.stage).items()},
        "chi2": bundle.chi2,
        "degrees_of_freedom": bundle.dof,
        "sigma_scales": bundle.scales,
        "heights": _heights(solved),
        "solving_s": solved.seconds,
        "made_from": dict(solved.observations.made_from),
        **(of_rig or {}),
    }


def _device(solved: JudgedSolution, index: int) -> dict[str, Any]:
    """One device with its sigmas, and the paper's own solution of it."""
    joint, search = solved.bundle, solved.solution.searches[index]
    device: Device = joint.state.devices[index]
    prefix = f"{solved.names[index]}."
    sigmas = {k.removeprefix(prefix): v for k, v in joint.sigmas.items() if k.startswith(prefix)}
    kappa = device.lens.kappa if isinstance(device.lens, Division) else math.nan
    return {
        "focal_length_px": device.focal_length_px[0],
        "focal_length_m": device.focal_length_px[0] * device.pixel_pitch_m,
        "pixel_pitch_m": device.pixel_pitch_m,
        "kappa": kappa,
        "image_centre_px": list(device.image_centre_px),
        "rotation": device.rotation,
        "translation_m": device.translation_m,
        "sigma": sigmas,
        "rms_px": joint.rms_px(index),
        "rms_m": joint.rms_px(index) * metres_per_pixel(device),
        "paper_search": {
            "cost_before_px2": search.cost_before_px2,
            "cost_after_px2": search.cost_after_px2,
            "points": search.points,
            "linear_steps": search.steps,
            "image_centre_px": list(search.device.image_centre_px),
            "focal_length_px": search.device.focal_length_px[0],
            "kappa": search.device.lens.kappa if isinstance(search.device.lens, Division) else None,
        },
    }


def _heights(solved: JudgedSolution) -> list[dict[str, Any]]:
    """Residuals of each view, and its error when its height is left out."""
    left_out = solved.solution.left_out
    left = {check.height_m: check.z_rms_m for check in left_out}
    rows = []
    for stage_m in solved.observations.stage_m:
        row: dict[str, Any] = {"height_m": float(stage_m[2]), "aside_m": stage_m[:2].tolist()}
        for index, what in enumerate(("hole", "target")[: len(solved.names)]):
            row |= _view_residuals(solved.bundle, index, what, stage_m)
        aside = bool(stage_m[:2].any())
        row["left_out_z_rms_m"] = math.nan if aside else left.get(stage_m[2], math.nan)
        rows.append(row)
    return rows


def _view_residuals(bundle: Bundle, index: int, what: str, stage_m: Array) -> dict[str, Any]:
    data = bundle.problem.holes if index == 0 else bundle.problem.targets
    used = bundle.used[bundle.problem.groups[index]]
    here = np.all(data.stage_m[used] == stage_m, axis=1)
    residuals = bundle.residuals_of(index)[here]
    rms = float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))) if here.any() else math.nan
    return {f"{what}s": int(here.sum()), f"{what}_rms_px": rms}
