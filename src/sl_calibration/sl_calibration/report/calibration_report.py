"""The report of a calibration: one self-contained page for people, JSON for programs."""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sl_calibration.data.run_store import CAMERA_PAGE, CAMERA_REPORT, PAGE, REPORT
from sl_calibration.report.report_pictures import camera_pictures, pictures
from sl_calibration.report.table_1 import table_1
from sl_calibration.solve.solution import metres_per_pixel
from sl_common.documents import write_text
from sl_reconstruct.model.calibration_file import Calibration
from sl_reconstruct.model.rig import Device, Division

if TYPE_CHECKING:
    from sl_calibration.bundle.bundle_adjustment import Bundle
    from sl_calibration.solve.solution import JudgedSolution

Array = NDArray[np.float64]

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2em auto; max-width: 68em; color: #222;
  background: #fff; padding: 0 1em }
h1 { font-size: 1.5em } h2 { font-size: 1.15em; margin-top: 2em }
.verdict { padding: .6em 1em; border-radius: .4em; font-weight: 600 }
.good { background: #e2f3e2; color: #145214 } .bad { background: #fbe3e0; color: #7a1708 }
table { border-collapse: collapse } td, th { padding: .25em 1.4em .25em 0; text-align: left;
  vertical-align: top; border-bottom: 1px solid #eee } td { font-variant-numeric: tabular-nums }
img { max-width: 100%; display: block; margin: 1em 0 } pre { margin: 0 }
"""

#: What each limited figure is, and the factor and unit in which people read it.
FIGURES: Mapping[str, tuple[str, float, str]] = {
    "hole_rms_px": ("Residuals of the holes, rms", 1.0, "camera px"),
    "target_rms_px": ("Residuals of the projected targets, rms", 1.0, "DMD px"),
    "rejected_part": ("Points left out as wrong", 100.0, "%"),
    "point_sigma_m": ("1-sigma of z from the calibration, worst in the volume", 1e6, "µm"),
    "left_out_z_m": ("z at a height left out, rms, worst", 1e6, "µm"),
    "stage_scale_error": ("Stage's z scale off by", 1e6, "ppm"),
    "stage_lean_rad": ("Stage's z travel against the plate's normal", math.degrees(1.0), "°"),
    "uncovered_part": ("Camera image far from any hole", 100.0, "%"),
    "kept_lens_sigmas": ("Kept lens off the one that this run finds", 1.0, "sigma"),
}


def write_report(folder: Path, solved: JudgedSolution, calibration: Calibration) -> None:
    """Write ``report.json`` and ``report.html`` into a run's folder."""
    content = report_content(solved, calibration)
    write_json(folder / REPORT, content)
    write_text(folder / PAGE, _page(solved, content))


def write_camera_report(folder: Path, solved: JudgedSolution) -> None:
    """Write ``camera_report.json`` and ``camera_report.html`` of a camera alone."""
    content = common_content(solved)
    write_json(folder / CAMERA_REPORT, content)
    title = f"Calibration of the camera, {content['made_from'].get('date', 'unknown date')}"
    parts = [
        *_head(title, content),
        *(picture(caption, image) for caption, image in camera_pictures(solved)),
        table("Made from", ("", ""), _origin_rows(content)),
    ]
    write_text(folder / CAMERA_PAGE, page(title, parts))


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON; numbers that are not finite become null."""
    text = json.dumps(_plain(content), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(path, text + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def report_content(solved: JudgedSolution, calibration: Calibration) -> dict[str, Any]:
    """Everything that the report says, plain values."""
    return {
        **common_content(solved),
        "predicted_sigma_m": solved.predicted_sigma_m,
        "edge_sigma_px": solved.edge_noise.camera_u_px,
        "hash": calibration.hash,
    }


def common_content(solved: JudgedSolution) -> dict[str, Any]:
    """What is said of a rig and of a camera alone."""
    bundle, verdict = solved.bundle, solved.verdict
    devices = {name: device_content(solved, i) for i, name in enumerate(solved.names)}
    return {
        "format": 1,
        "accepted": verdict.passed,
        "reasons": list(verdict.reasons),
        "figures": dict(verdict.figures),
        "limits": dict(vars(solved.limits)),
        **devices,
        "stage": {name: value.tolist() for name, value in vars(bundle.stage).items()},
        "chi2": bundle.chi2,
        "degrees_of_freedom": bundle.dof,
        "sigma_scales": bundle.scales,
        "heights": _heights(solved),
        "solving_s": solved.seconds,
        "made_from": dict(solved.observations.made_from),
    }


def device_content(solved: JudgedSolution, index: int) -> dict[str, Any]:
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


# -- the page -------------------------------------------------------------------------------------


def _page(solved: JudgedSolution, content: Mapping[str, Any]) -> str:
    title = f"Calibration of {content['made_from'].get('date', 'unknown date')}"
    parts = _head(title, content)
    parts += [picture(caption, image) for caption, image in pictures(solved)]
    parts.append(table("Made from", ("", ""), _origin_rows(content)))
    return page(title, parts)


def _head(title: str, content: Mapping[str, Any]) -> list[str]:
    """Verdict and tables."""
    return [
        f"<h1>{_text(title)}</h1>",
        _banner(content["accepted"], content["reasons"]),
        table("Verdict", ("Figure", "Found", "Limit"), _figure_rows(content)),
        table("Table 1: calibrated parameters, ± 1 sigma",
               ("Parameter", "Projection device", "Camera", "Paper: projection device, camera"),
               table_1(content)),
        table("The paper's search of the image centre: cost J", *_search_rows(content)),
        table("Stage", ("Quantity", "Value"), _stage_rows(content["stage"])),
        table("Views", *_height_rows(content["heights"])),
    ]  # fmt: skip


def page(title: str, parts: Sequence[str]) -> str:
    """Return a whole page that needs nothing else."""
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{_text(title)}'
        f"</title><style>{_STYLE}</style></head><body>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def _banner(accepted: bool, reasons: Sequence[str]) -> str:
    if accepted:
        return banner(True, "Accepted: every figure is within its limit")
    return banner(False, f"Not accepted: {'; '.join(reasons)}")


def banner(good: bool, text: str) -> str:
    """Return the verdict in its colour."""
    return f'<p class="verdict {"good" if good else "bad"}">{_text(text)}</p>'


def _figure_rows(content: Mapping[str, Any]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for name, (label, factor, unit) in FIGURES.items():
        if name in content["figures"]:
            found, limit = (content[kind][name] * factor for kind in ("figures", "limits"))
            rows.append((label, f"{found:.4g} {unit}", f"{limit:.4g} {unit}"))
    if "predicted_sigma_m" not in content:
        return rows
    sigma = content["predicted_sigma_m"] * 1e6
    noise = content["edge_sigma_px"]
    return [
        *rows,
        (
            f"1-sigma of z with the noise of one edge ({noise:.3f} px), worst",
            f"{sigma:.4g} µm",
            "-",
        ),
    ]


def _search_rows(content: Mapping[str, Any]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    head = ("Device", "J, centre in the middle, px²", "J at the minimum, px²", "Points",
            "Centre found, px", "f, px", "Linear steps")  # fmt: skip
    rows: list[tuple[str, ...]] = []
    for name in ("camera", "projector"):
        if name not in content:
            continue
        s = content[name]["paper_search"]
        u, v = s["image_centre_px"]
        rows.append(
            (name, f"{s['cost_before_px2']:.4g}", f"{s['cost_after_px2']:.4g}", f"{s['points']:,}",
             f"{u:.2f}, {v:.2f}", f"{s['focal_length_px']:.2f}", str(s["linear_steps"]))
        )  # fmt: skip
    return head, rows


def _stage_rows(stage: Mapping[str, Any]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for axis, scale, sigma in zip("xyz", stage["scale"], stage["scale_sigma"], strict=True):
        if math.isfinite(scale):
            rows.append(
                (f"{axis}: true travel per metre read", f"1 {(scale - 1) * 1e6:+.1f} ppm "
                                                        f"± {sigma * 1e6:.1f} ppm")
            )  # fmt: skip
    leans = zip("xy", stage["z_lean_rad"], stage["z_lean_sigma_rad"], strict=True)
    for axis, lean, sigma in leans:
        if math.isfinite(lean):
            text = f"{math.degrees(lean):+.5f}° ± {math.degrees(sigma):.5f}°"
            rows.append((f"z travel leans from the plate's normal towards {axis}", text))
    angles = zip(("x to y", "x to z", "y to z"), stage["squareness_rad"],
                 stage["squareness_sigma_rad"], strict=True)  # fmt: skip
    for axes, angle, sigma in angles:
        if math.isfinite(angle):
            text = f"{math.degrees(angle):+.5f}° ± {math.degrees(sigma):.5f}°"
            rows.append((f"stage out of square, {axes} (90° less their angle)", text))
    return rows


def _height_rows(
    heights: Sequence[Mapping[str, Any]],
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    head = ("Stage height, mm", "Aside, x and y, mm", "Holes", "rms, camera px", "Targets",
            "rms, DMD px", "z when left out, µm rms")  # fmt: skip
    rows: list[tuple[str, ...]] = []
    for h in heights:
        x, y = (f"{a * 1e3:g}" for a in h["aside_m"])
        targets = h.get("targets", 0), h.get("target_rms_px", math.nan)
        rows.append(
            (f"{h['height_m'] * 1e3:.4f}", f"{x}, {y}", str(h["holes"]),
             f"{h['hole_rms_px']:.4f}", str(targets[0]), f"{targets[1]:.4f}",
             f"{h['left_out_z_rms_m'] * 1e6:.4f}")
        )  # fmt: skip
    return head, [tuple("" if cell == "nan" else cell for cell in row) for row in rows]


def _origin_rows(content: Mapping[str, Any]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [("calibration hash", str(content.get("hash", "none"))),
            ("solving", f"{content['solving_s']:.2f} s")]  # fmt: skip
    return rows + [
        (str(name), json.dumps(_plain(value), ensure_ascii=False))
        for name, value in content["made_from"].items()
    ]


def table(heading: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table under its heading; cells are plain text."""
    top = "".join(f"<th>{_text(name)}</th>" for name in head)
    body = "".join(
        "<tr>" + "".join(f"<td>{_cell(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<h2>{_text(heading)}</h2><table><tr>{top}</tr>{body}</table>"


def _cell(text: str) -> str:
    return f"<pre>{_text(text)}</pre>" if "\n" in text else _text(text)


def picture(caption: str, image: bytes) -> str:
    """Return a PNG, contained in the page, under its caption."""
    return (
        f'<h2>{_text(caption)}</h2><img alt="{_text(caption)}" '
        f'src="data:image/png;base64,{base64.b64encode(image).decode()}">'
    )


def _text(value: str) -> str:
    return html.escape(value, quote=True)
