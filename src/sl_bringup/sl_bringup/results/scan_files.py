"""The files of one scan: cloud, height map, pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_common.documents import written_atomically
from sl_common.errors import StackError
from sl_reconstruct.cloud.cloud import Cloud
from sl_reconstruct.cloud.cloud_writer import save_pcd, save_ply
from sl_reconstruct.cloud.height_map import HeightMap, make_height_map, save_png, save_tiff
from sl_reconstruct.cloud.plane_fit import Plane, fit_plane
from sl_reconstruct.cloud.refusals import REFUSALS, Reason

#: Captions and PNG by file name.
Drawn = dict[str, tuple[str, bytes]]
#: Points that a plane is fitted to, about; more change nothing.
PLANE_POINTS = 100_000
FILES = ("cloud.ply", "cloud.pcd", "height.tiff", "height.png", "report.json", "report.html")
PICTURES = tuple(
    f"picture_{name}"
    for name in ("height", "relief", "residual", "profile", "refusals", "contrast")
)


def write_scan(
    folder: Path,
    report: dict[str, Any],
    cloud: Cloud | None,
    with_pictures: bool,
    images: NDArray[Any] | None = None,
) -> dict[str, bytes]:
    """Write a scan's cloud, height map and pictures; files of an earlier evaluation go first.

    Parameters
    ----------
    folder : Path
        The scan's folder.
    report : dict
        Gets what is found here: height map, best plane, notes.
    cloud : Cloud or None
        None where the scan was refused.
    with_pictures : bool
        Whether pictures are drawn.
    images : ndarray, (N, H, W), optional
        What the cloud was made of: their contrast is drawn, above all where there is no cloud.

    Returns
    -------
    dict
        PNG pictures by caption.
    """
    clear_scan(folder)
    folder.mkdir(parents=True, exist_ok=True)
    title = f"{report['bag']}, scan {report['scan_id']}"
    drawn = {} if cloud is None else _write_cloud(folder, report, cloud, with_pictures, title)
    if with_pictures and images is not None and "saturation_dn" in report:
        from sl_bringup.results.scan_pictures import contrast_picture

        contrast = contrast_picture(images, report["saturation_dn"], title)
        drawn["picture_contrast"] = "Pattern contrast", contrast
    for name, (_, png) in drawn.items():
        with written_atomically(folder / f"{name}.png") as partial:
            partial.write_bytes(png)
    return dict(drawn.values())


def _write_cloud(
    folder: Path, report: dict[str, Any], cloud: Cloud, with_pictures: bool, title: str
) -> Drawn:
    """Write cloud and height map, and draw them."""
    notes = {key: report[key] for key in ("calibration_hash", "settings_hash", "cloud_hash")}
    save_ply(folder / "cloud.ply", cloud.points, notes)
    save_pcd(folder / "cloud.pcd", cloud.points, notes, organised=True)
    plane = _best_plane(cloud, report)
    height = _height_map(folder, cloud, report)
    return _draw(cloud, height, plane, title) if with_pictures else {}


def clear_scan(folder: Path) -> None:
    """Delete the files that an earlier evaluation wrote into a scan's folder, and no others."""
    for name in [*FILES, *(f"{picture}.png" for picture in PICTURES)]:
        (folder / name).unlink(missing_ok=True)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def _best_plane(cloud: Cloud, report: dict[str, Any]) -> Plane | None:
    every = max(1, round((cloud.points.size / PLANE_POINTS) ** 0.5))
    plane = fit_plane(cloud.xyz_m[::every, ::every].reshape(-1, 3).astype(np.float64))
    if plane is not None:
        report["plane"] = {
            "rms_m": plane.rms_m,
            "normal": plane.normal,
            "point_m": plane.point_m,
            "tilt_deg": float(np.degrees(np.arccos(min(1.0, plane.normal[2])))),
            "points": plane.used,
            "set_aside": plane.set_aside,
        }
    return plane


def _height_map(folder: Path, cloud: Cloud, report: dict[str, Any]) -> HeightMap | None:
    """Write the height map; a cloud that has none gets a note."""
    try:
        height = make_height_map(cloud.points)
    except StackError as exc:
        report.setdefault("notes", []).append(f"no height map: {exc}")
        return None
    save_tiff(folder / "height.tiff", height)
    low_m, high_m = save_png(folder / "height.png", height)
    report["height_map"] = {
        "x0_m": height.x0_m,
        "y0_m": height.y0_m,
        "step_m": height.step_m,
        "rows": height.z_m.shape[0],
        "columns": height.z_m.shape[1],
        "png_value_1_m": low_m,
        "png_value_65535_m": high_m,
        "note": "first row has the largest y; TIFF in metres, NaN where nothing was measured",
    }
    return height


def _draw(cloud: Cloud, height: HeightMap | None, plane: Plane | None, title: str) -> Drawn:
    """Pictures by file name, each with its caption."""
    # Imported late: matplotlib takes half a second, which clouds alone do without.
    from sl_bringup.results import scan_pictures as draw

    drawn = {}
    if height is not None:
        drawn["picture_height"] = "Height map", draw.height_picture(height, title)
        drawn["picture_relief"] = "Shaded relief", draw.relief_picture(height, title)
    if height is not None and plane is not None:
        caption = "Deviation from the best plane"
        subtitle = f"{title}\n{caption.lower()}"
        picture = draw.residual_picture(height, _deviation_m(height, plane), subtitle)
        drawn["picture_residual"] = caption, picture
    if cloud.present:
        drawn["picture_profile"] = "Section", draw.profile_picture(cloud.points, title)
    # The map of a live scan comes in a message of its own, which may be missing.
    if bool((cloud.reason > Reason.UNLIT).any()) or not any(cloud.refused.values()):
        caption = "Why points are missing"
        unlit = cloud.reason.size - cloud.lit
        counts = {"points": cloud.present, "not lit": unlit, **cloud.refused}
        names, subtitle = tuple(REFUSALS.values()), f"{title}\n{caption.lower()}"
        picture = draw.refusal_picture(cloud.reason, names, counts, subtitle)
        drawn["picture_refusals"] = caption, picture
    return drawn


def _deviation_m(height: HeightMap, plane: Plane) -> Any:
    rows, columns = height.z_m.shape
    x = height.x0_m + np.arange(columns) * height.step_m
    y = height.y0_m - np.arange(rows) * height.step_m
    xyz = np.stack(np.broadcast_arrays(x[None, :], y[:, None], height.z_m), axis=-1)
    return plane.distances_m(xyz)
