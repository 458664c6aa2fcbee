"""The file of a camera that was calibrated alone: like a rig's, without a projector."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sl_calibration.bundle.bundle_adjustment import Bundle
from sl_calibration.bundle.parameters import FixedLens
from sl_calibration.solve.fixed_intrinsics import fixed_lens, fixed_lens_of
from sl_common.documents import (
    Fields,
    a_whole_number,
    dump_document,
    parse_document,
    read_text,
    write_text,
)
from sl_common.errors import CalibrationError
from sl_reconstruct.model.calibration_file import (
    FORMAT,
    a_covariance,
    a_device,
    covariance_document,
    device_document,
    load_calibration,
)

_KEYS = ("format", "camera", "covariance", "residuals", "made_from")


def save_camera(path: Path, bundle: Bundle, made_from: Mapping[str, Any]) -> None:
    """Write a camera's file in one step.

    Parameters
    ----------
    path : Path
        The file.
    bundle : Bundle
        Of the camera alone.
    made_from : mapping
        Plain values.
    """
    document = {
        "format": FORMAT,
        "camera": device_document(bundle.state.devices[0]),
        "covariance": covariance_document(bundle.covariance),
        "residuals": {"camera_rms_px": bundle.rms_px(0)},
        "made_from": dict(made_from),
    }
    write_text(path, dump_document(document))


def load_fixed_lens(path: Path, name: str) -> FixedLens:
    """Read the lens of one device: from a rig's calibration, or from a camera's file.

    Parameters
    ----------
    path : Path
        The file.
    name : {"camera", "projector"}
        Whose lens is wanted.

    Raises
    ------
    CalibrationError
        When the file cannot be read, holds no such device, or its lens is not the paper's.
    """
    text = read_text(path, CalibrationError)
    if "\nprojector:" in text or not text.lstrip().startswith("format"):
        return fixed_lens_of(load_calibration(path), name, str(path))
    if name != "camera":
        raise CalibrationError(f"{path} holds a camera alone; expected a file with a {name}")
    document = parse_document(text, str(path), CalibrationError)
    fields = Fields(document, str(path), CalibrationError, _KEYS)
    version = fields.get("format", a_whole_number)
    if version != FORMAT:
        raise CalibrationError(f"{path} is of format {version}; expected format {FORMAT}")
    covariance = fields.get("covariance", a_covariance, None)
    return fixed_lens("camera", fields.get("camera", a_device), covariance, str(path))
