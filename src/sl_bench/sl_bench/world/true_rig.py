"""The bench's true rig as a calibration document (format 1), written and read.

On its own on purpose: the bench must not share the code that reads calibrations for the
reconstruction, or an error in it would cancel.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sl_common.documents import dump_document, read_document, write_text
from sl_common.errors import CalibrationError
from sl_reconstruct.model.rig import BrownConrady, Device, Division, Rig

_KEYS = (
    "image_size",
    "focal_length_px",
    "pixel_pitch_m",
    "image_centre_px",
    "rotation",
    "translation_m",
)


def rig_document(rig: Rig) -> dict[str, Any]:
    """Return the rig as the calibration file has it, plain numbers and lists."""
    return {"format": 1, "camera": _document(rig.camera), "projector": _document(rig.projector)}


def write_rig(path: str | Path, rig: Rig) -> None:
    """Write the rig as a calibration file, in one step.

    Parameters
    ----------
    path : path
        The file.
    rig : Rig
        The true one.
    """
    document = rig_document(rig) | {"made_from": {"bench": "the simulated world's true rig"}}
    write_text(Path(path), dump_document(document))


def read_rig(path: str | Path) -> Rig:
    """Read a rig from a calibration file of this project.

    Raises
    ------
    CalibrationError
        When it is not one.
    """
    document = read_document(Path(path), CalibrationError)
    try:
        return Rig(_device(document["camera"]), _device(document["projector"]))
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"{path} is no rig for the bench ({error!r}); expected a calibration file of format 1"
        ) from None


def _document(device: Device) -> dict[str, Any]:
    lens: dict[str, Any] = (
        {"model": "division", "kappa": float(device.lens.kappa)}
        if isinstance(device.lens, Division)
        else {"model": "brown_conrady", "distortion": [float(c) for c in device.lens.coefficients]}
    )
    return lens | {key: np.asarray(getattr(device, key)).tolist() for key in _KEYS}


def _device(fields: Mapping[str, Any]) -> Device:
    lens: Division | BrownConrady
    if fields["model"] == "division":
        lens = Division(float(fields["kappa"]))
    else:
        k1, k2, p1, p2, k3 = (*map(float, fields["distortion"]), 0.0)[:5]
        lens = BrownConrady((k1, k2, p1, p2, k3))
    size, focal_px, pitch_m, centre_px, rotation, translation_m = (
        np.asarray(fields[key], dtype=np.float64) for key in _KEYS
    )
    fx, fy = map(float, np.broadcast_to(focal_px, 2))
    width, height = map(int, size)
    u, v = map(float, centre_px)
    return Device((width, height), (fx, fy), (u, v), float(pitch_m), rotation, translation_m, lens)
