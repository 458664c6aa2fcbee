"""Calibrations made with OpenCV elsewhere, as a `Rig` whose world is the camera's frame.

Read are ``cv2.FileStorage`` files (XML, YAML) and plain JSON with a camera matrix, distortion
coefficients of both devices, and rotation and translation from camera to projector
(``X_projector = R X_camera + T``), in millimetres unless the file says otherwise.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_common.errors import CalibrationError
from sl_reconstruct.model.rig import BrownConrady, Device, Rig
from sl_reconstruct.model.rig_validation import nearest_rotation

Array = NDArray[np.float64]

#: Names under which such files are known to keep each quantity ("roration" is a real one).
ALIASES: Mapping[str, tuple[str, ...]] = {
    "camera matrix": ("cam_int", "cam_K", "camera_matrix", "cam_intrinsics", "K1"),
    "camera distortion": ("cam_dist", "camera_distortion", "cam_distortion", "D1"),
    "projector matrix": ("proj_int", "proj_K", "projector_matrix", "proj_intrinsics", "K2"),
    "projector distortion": ("proj_dist", "projector_distortion", "proj_distortion", "D2"),
    "rotation": ("R", "rotation", "roration"),
    "translation": ("T", "translation"),
    "camera size": ("img_shape", "cam_shape"),
    "projector size": ("proj_shape",),
}

#: Neither format knows the pixel pitch; nothing but reports depends on it.
NOMINAL_PITCH_M = 1e-5
METRES = {"mm": 1e-3, "m": 1.0, "cm": 1e-2}


def recognises(text: str) -> bool:
    """Whether a text is an OpenCV storage file or JSON rather than a YAML file of ours."""
    head = text.lstrip()[:400]
    return head.startswith(("{", "<?xml", "<opencv_storage", "%YAML:1.0", "%YAML 1.0")) or (
        "!!opencv-matrix" in head
    )


def read(
    path: Path,
    text: str,
    camera_size: tuple[int, int] | None = None,
    projector_size: tuple[int, int] | None = None,
) -> tuple[Rig, dict[str, Any], dict[str, Any]]:
    """Read an OpenCV calibration: the rig, its residuals, and what it was made from.

    Parameters
    ----------
    path, text : path, str
        The file, and what is in it.
    camera_size, projector_size : tuple of int, optional
        (width, height), pixels, where the file does not say.

    Raises
    ------
    CalibrationError
        When a quantity is missing or has the wrong shape, or a size is known from nowhere.
    """
    content = _from_json(text, path) if text.lstrip().startswith("{") else _from_storage(text, path)
    factor, unit = _unit(content, path)
    rotation = _rotation(content, path)
    translation_m = _array(content, "translation", (3,), path) * factor
    camera = _device(
        content, "camera", _size(content, "camera", camera_size, path), np.eye(3), np.zeros(3), path
    )
    projector = _device(
        content,
        "projector",
        _size(content, "projector", projector_size, path),
        rotation,
        translation_m,
        path,
    )
    made_from = {
        "file": path.name,
        "world": "camera frame",
        "translation_unit": unit,
        "pixel_pitch": "nominal, the file names none",
    }
    residuals = {k: v for k, v in content.items() if "rms" in k and isinstance(v, (int, float))}
    return Rig(camera, projector), residuals, made_from


def _from_json(text: str, path: Path) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as exc:
        raise CalibrationError(f"{path} is not well-formed JSON: {exc}") from None
    if not isinstance(content, dict):
        raise CalibrationError(f"{path} holds a {type(content).__name__}; expected a JSON object")
    return content


def _from_storage(text: str, path: Path) -> dict[str, Any]:
    flags = cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY
    try:
        storage = cv2.FileStorage(text, flags)
        root = storage.root()
        content = {key: _node(root.getNode(key)) for key in root.keys()}  # noqa: SIM118
    except (cv2.error, SystemError):
        raise CalibrationError(
            f"{path} is not a well-formed OpenCV storage file; is it complete?"
        ) from None
    storage.release()
    return content


def _node(node: Any) -> Any:
    if node.isReal() or node.isInt():
        return node.real()
    if node.isString():
        return node.string()
    matrix = node.mat()
    return None if matrix is None else matrix


def _find(content: Mapping[str, Any], what: str) -> Any:
    return next((content[key] for key in ALIASES[what] if content.get(key) is not None), None)


def _array(content: Mapping[str, Any], what: str, shape: tuple[int, ...], path: Path) -> Array:
    value = _find(content, what)
    if value is None:
        raise CalibrationError(
            f"{path} has no {what}; expected one of the keys {', '.join(ALIASES[what])}"
        )
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise CalibrationError(f"{path}: {what} is not numbers; expected {shape}") from None
    if array.size != np.prod(shape) or not np.all(np.isfinite(array)):
        raise CalibrationError(f"{path}: {what} has the shape {array.shape}; expected {shape}")
    return array.reshape(shape)


def _unit(content: Mapping[str, Any], path: Path) -> tuple[float, str]:
    """Metres per unit of the translation; OpenCV files are in millimetres by custom."""
    stated = content.get("units", content.get("unit"))
    if stated is None:
        return METRES["mm"], "mm (assumed)"
    unit = str(stated).replace(",", " ").split()[0]
    if unit not in METRES:
        raise CalibrationError(f"{path} is in {unit!r}; expected one of {', '.join(METRES)}")
    return METRES[unit], unit


def _rotation(content: Mapping[str, Any], path: Path) -> Array:
    return nearest_rotation(_array(content, "rotation", (3, 3), path), f"{path}: rotation")


def _size(
    content: Mapping[str, Any], name: str, given: tuple[int, int] | None, path: Path
) -> tuple[int, int]:
    """(width, height): what the file says as (rows, columns), or what is known from elsewhere."""
    if _find(content, f"{name} size") is not None:
        rows, columns = _array(content, f"{name} size", (2,), path)
        if given is not None and given != (int(columns), int(rows)):
            raise CalibrationError(
                f"{path} is for {name} images of {columns:.0f} x {rows:.0f} px; expected "
                f"{given[0]} x {given[1]}, as the data have"
            )
        return int(columns), int(rows)
    if given is None:
        raise CalibrationError(
            f"{path} does not say the size of the {name}'s image; expected it from the data or "
            f"under {', '.join(ALIASES[f'{name} size'])}"
        )
    return given


def _device(
    content: Mapping[str, Any],
    name: str,
    size: tuple[int, int],
    rotation: Array,
    translation_m: Array,
    path: Path,
) -> Device:
    matrix = _array(content, f"{name} matrix", (3, 3), path)
    if np.abs(matrix - np.diag(np.diag(matrix)))[[0, 1, 2, 2], [1, 0, 0, 1]].any():
        raise CalibrationError(
            f"{path}: {name} matrix has skew; expected [fx 0 cx; 0 fy cy; 0 0 1]"
        )
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    lens = _lens(content, f"{name} distortion", path)
    return Device(size, (fx, fy), (cx, cy), NOMINAL_PITCH_M, rotation, translation_m, lens)


def _lens(content: Mapping[str, Any], what: str, path: Path) -> BrownConrady:
    value = _find(content, what)
    if value is None:
        return BrownConrady()
    found = _array(content, what, (np.size(value),), path)
    padded = np.zeros(14)
    padded[: found.size] = found[:14]
    if found.size > 14 or padded[5:].any():
        raise CalibrationError(
            f"{path}: {what} has the {found.size} coefficients {found.tolist()}; expected no "
            "more than k1, k2, p1, p2, k3"
        )
    k1, k2, p1, p2, k3 = (float(c) for c in padded[:5])
    return BrownConrady((k1, k2, p1, p2, k3))
