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


def rig_document(rig: Rig) -> dict[str, Any]:
    """Return the rig as the calibration file has it, plain numbers and lists."""
    return {"format": 1, "camera": _document(rig.camera), "projector": _document(rig.projector)}


def write_rig(path: str | Path, rig: Rig) -> None:
    """Write the rig as a calibration file, in one step.

    Parameters
    ----------
    path : str or Path
        The file.
    rig : Rig
        The true rig.
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
    lens: dict[str, Any]
    if isinstance(device.lens, Division):
        lens = {"model": "division", "kappa": float(device.lens.kappa)}
    else:
        lens = {
            "model": "brown_conrady",
            "distortion": [float(c) for c in device.lens.coefficients],
        }
    return {
        **lens,
        "image_size": [int(side) for side in device.image_size],
        "focal_length_px": [float(f) for f in device.focal_length_px],
        "pixel_pitch_m": float(device.pixel_pitch_m),
        "image_centre_px": [float(c) for c in device.image_centre_px],
        "rotation": device.rotation.tolist(),
        "translation_m": device.translation_m.tolist(),
    }


def _device(fields: Mapping[str, Any]) -> Device:
    lens: Division | BrownConrady
    if fields["model"] == "division":
        lens = Division(float(fields["kappa"]))
    else:
        k1, k2, p1, p2, k3 = (*map(float, fields["distortion"]), 0.0)[:5]
        lens = BrownConrady((k1, k2, p1, p2, k3))
    fx, fy = np.broadcast_to(np.asarray(fields["focal_length_px"], dtype=np.float64), 2)
    width, height = fields["image_size"]
    u, v = fields["image_centre_px"]
    return Device(
        (int(width), int(height)),
        (float(fx), float(fy)),
        (float(u), float(v)),
        float(fields["pixel_pitch_m"]),
        np.array(fields["rotation"], dtype=np.float64),
        np.array(fields["translation_m"], dtype=np.float64),
        lens,
    )
