"""Calibrations for OpenCV's tools; reading theirs is `sl_reconstruct.model.opencv_calibration`'s.

Written are camera matrices and distortion coefficients of both devices, and rotation and
translation from camera to projector (``X_projector = R X_camera + T``) in millimetres: what
`load_calibration` reads back. The world's place is not in such a file; the camera's frame is the
world afterwards. The paper's lens becomes OpenCV's five coefficients, with the error stated.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sl_common.documents import write_text
from sl_common.errors import CalibrationError
from sl_reconstruct.model.opencv_lens import plumb_bob
from sl_reconstruct.model.rig import Device, Rig

_STORAGE = {
    ".xml": cv2.FILE_STORAGE_FORMAT_XML,
    ".yml": cv2.FILE_STORAGE_FORMAT_YAML,
    ".yaml": cv2.FILE_STORAGE_FORMAT_YAML,
}


def opencv_values(rig: Rig) -> dict[str, Any]:
    """Return the rig in OpenCV's terms.

    Returns
    -------
    dict
        ``cam_K``, ``proj_K`` (3, 3), ``cam_dist``, ``proj_dist`` (5,), ``R`` (3, 3), ``T`` (3,) in
        ``units`` mm, ``cam_shape``, ``proj_shape`` (rows, columns), and the largest errors of the
        lens conversions, ``cam_lens_error_px``, ``proj_lens_error_px``.
    """
    rotation = rig.projector.rotation @ rig.camera.rotation.T
    translation_m = rig.projector.translation_m - rotation @ rig.camera.translation_m
    values: dict[str, Any] = {"units": "mm", "R": rotation, "T": translation_m * 1e3}
    for name, device in (("cam", rig.camera), ("proj", rig.projector)):
        values |= {f"{name}_{key}": value for key, value in _device_values(device).items()}
    return values


def _device_values(device: Device) -> dict[str, Any]:
    lens, error_px = plumb_bob(device)
    return {
        "K": device.camera_matrix,
        "dist": np.array(lens.coefficients),
        "shape": np.array(device.image_size[::-1], dtype=np.float64),
        "lens_error_px": error_px,
    }


def save_opencv(path: str | Path, rig: Rig) -> None:
    """Write the rig for OpenCV's tools, in one step.

    Parameters
    ----------
    path : path
        ``.json``, or ``.xml``, ``.yml``, ``.yaml`` for ``cv2.FileStorage``.
    rig : Rig
        With either lens model.

    Raises
    ------
    CalibrationError
        When the suffix is another.
    """
    path = Path(path)
    values = opencv_values(rig)
    if path.suffix == ".json":
        plain = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}
        write_text(path, json.dumps(plain, indent=1) + "\n")
    elif path.suffix in _STORAGE:
        write_text(path, _storage_text(values, _STORAGE[path.suffix]))
    else:
        raise CalibrationError(
            f"{path.name} ends in {path.suffix!r}; expected .json, {', '.join(_STORAGE)}"
        )


def _storage_text(values: dict[str, Any], form: int) -> str:
    flags = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | form
    storage = cv2.FileStorage("", flags)
    for name, value in values.items():
        storage.write(name, value)
    return str(storage.releaseAndGetString())
