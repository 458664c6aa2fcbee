"""The calibration file: a rig as one YAML document, read strictly.

A file from which a number is missing, mistyped or off by a factor of a thousand must not become
a wrong point cloud, so everything is checked: keys, types, rotations, magnitudes, and the hash
where the file carries one. OpenCV's files are read as well
(`sl_reconstruct.model.opencv_calibration`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_common.documents import (
    Fields,
    a_list,
    a_number,
    a_size,
    a_string,
    a_whole_number,
    describe,
    dump_document,
    numbers,
    parse_document,
    read_text,
    write_text,
)
from sl_common.errors import CalibrationError, SlError
from sl_reconstruct.model import opencv_calibration
from sl_reconstruct.model.rig import BrownConrady, Device, Division, Rig
from sl_reconstruct.model.rig_validation import check_rig, nearest_rotation

Array = NDArray[np.float64]

FORMAT = 1
_TOP_KEYS = ("format", "camera", "projector", "covariance", "residuals", "made_from", "hash")
_DEVICE_KEYS = (
    "model",
    "kappa",
    "distortion",
    "image_size",
    "focal_length_px",
    "pixel_pitch_m",
    "image_centre_px",
    "rotation",
    "translation_m",
)


@dataclass(frozen=True)
class Covariance:
    """Covariance of the calibrated parameters.

    Parameters
    ----------
    parameters : tuple of str
        Names in the order of the matrix, such as ``camera.kappa`` or ``projector.translation_m.2``.
    matrix : ndarray, (n, n)
        In the parameters' units.
    """

    parameters: tuple[str, ...]
    matrix: Array


@dataclass(frozen=True)
class Calibration:
    """A rig and the evidence for it.

    Parameters
    ----------
    rig : Rig
        Camera and projector.
    covariance : Covariance or None
        Uncertainty of the parameters.
    residuals : mapping
        Figures of the fit by name, for example ``camera_rms_px``.
    made_from : mapping
        What it was made from: files, dates, versions, views.
    """

    rig: Rig
    covariance: Covariance | None = None
    residuals: Mapping[str, Any] = field(default_factory=dict)
    made_from: Mapping[str, Any] = field(default_factory=dict)

    @property
    def hash(self) -> str:
        """Hash of the rig; see `rig_hash`."""
        return rig_hash(self.rig)


def rig_hash(rig: Rig) -> str:
    """Return the sha256 (64 hex digits) of everything that the rig's geometry depends on.

    Two rigs with the same numbers, bit for bit, have the same hash; where they were stored and
    what they were made from does not matter.
    """
    content = {"format": FORMAT, **_rig_document(rig)}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def load_rig(
    path: str | Path,
    camera_size: tuple[int, int] | None = None,
    projector_size: tuple[int, int] | None = None,
) -> Rig:
    """Return the rig in a calibration file; see `load_calibration`.

    Parameters
    ----------
    path : str or Path
        The file.
    camera_size, projector_size : tuple of int, optional
        Width and height, pixels, for files that lack them.
    """
    return load_calibration(path, camera_size, projector_size).rig


def load_calibration(
    path: str | Path,
    camera_size: tuple[int, int] | None = None,
    projector_size: tuple[int, int] | None = None,
) -> Calibration:
    """Read a calibration: ours (YAML), or OpenCV's (JSON, XML, OpenCV YAML), known by content.

    Parameters
    ----------
    path : path
        The file.
    camera_size, projector_size : tuple of int, optional
        (width, height) in pixels for OpenCV files, which may not say; ignored by ours.

    Raises
    ------
    CalibrationError
        When the file cannot be read, is incomplete, has unknown keys or implausible numbers, or
        is not what its hash was made of.
    """
    path = Path(path)
    text = read_text(path, CalibrationError)
    if opencv_calibration.recognises(text):
        rig, residuals, made_from = opencv_calibration.read(path, text, camera_size, projector_size)
        check_rig(rig, str(path))
        return Calibration(rig, residuals=residuals, made_from=made_from)
    return parse_calibration(text, str(path))


def parse_calibration(text: str, source: str = "calibration") -> Calibration:
    """Read a calibration from YAML text (format 1); errors as in `load_calibration`.

    Parameters
    ----------
    text, source : str
        The document; what it is, for messages.
    """
    document = parse_document(text, source, CalibrationError)
    fields = Fields(document, source, CalibrationError, _TOP_KEYS)
    version = fields.get("format", a_whole_number)
    if version != FORMAT:
        raise CalibrationError(f"{source} is of format {version}; expected format {FORMAT}")
    rig = Rig(fields.get("camera", a_device), fields.get("projector", a_device))
    check_rig(rig, source)
    _check_hash(fields.get("hash", a_string, None), rig, source)
    return Calibration(
        rig,
        fields.get("covariance", a_covariance, None),
        fields.get("residuals", _a_mapping, {}),
        fields.get("made_from", _a_mapping, {}),
    )


def _check_hash(stored: str | None, rig: Rig, source: str) -> None:
    if stored is not None and stored != rig_hash(rig):
        raise CalibrationError(
            f"{source} carries the hash {stored[:12]}... but its numbers have {rig_hash(rig)[:12]}"
            "...; expected the same: the file was changed or cut after it was written (remove the "
            "hash if the change is meant)"
        )


def a_device(value: Any, where: str, error: type[SlError]) -> Device:
    """Check that a value is a device's section, and return the device.

    Parameters
    ----------
    value, where, error
        As in `a_string`.
    """
    fields = Fields(value, where, error, _DEVICE_KEYS)
    model = fields.get("model", a_string)
    if model not in ("division", "brown_conrady"):
        raise error(f"{where}.model is {model!r}; expected division or brown_conrady")
    superfluous = "distortion" if model == "division" else "kappa"
    if superfluous in fields:
        raise error(f"{where} has {superfluous}, which the model {model} does not know")
    try:
        return Device(
            image_size=fields.get("image_size", a_size),
            focal_length_px=fields.get("focal_length_px", _focal_length),
            image_centre_px=_pair(fields.get("image_centre_px", numbers(2))),
            pixel_pitch_m=fields.get("pixel_pitch_m", a_number),
            rotation=fields.get("rotation", _rotation),
            translation_m=np.array(fields.get("translation_m", numbers(3))),
            lens=_lens(fields, model),
        )
    except CalibrationError as exc:
        raise error(f"{exc}" if where in str(exc) else f"{where}: {exc}") from None


def _lens(fields: Fields, model: str) -> Division | BrownConrady:
    if model == "division":
        return Division(fields.get("kappa", a_number))
    k1, k2, p1, p2, *k3 = fields.get("distortion", numbers(4, 5))
    return BrownConrady((k1, k2, p1, p2, k3[0] if k3 else 0.0))


def _pair(items: list[float]) -> tuple[float, float]:
    first, second = items
    return first, second


def _focal_length(value: Any, where: str, error: type[SlError]) -> tuple[float, float]:
    if isinstance(value, list):
        return _pair(numbers(2)(value, where, error))
    length = a_number(value, where, error)
    return length, length


def _rotation(value: Any, where: str, error: type[SlError]) -> Array:
    """Check that a value is a 3 x 3 rotation, row by row; see `nearest_rotation`."""
    rows = a_list(value, where, error)
    if len(rows) != 3:
        raise error(f"{where} has {len(rows)} rows; expected 3")
    matrix = np.array([numbers(3)(row, f"{where}[{i}]", error) for i, row in enumerate(rows)])
    return nearest_rotation(matrix, where, error)


def a_covariance(value: Any, where: str, error: type[SlError]) -> Covariance:
    """Check that a value is a covariance with as many rows as names.

    Parameters
    ----------
    value, where, error
        As in `a_string`.
    """
    fields = Fields(value, where, error, ("parameters", "matrix"))
    names = [a_string(name, where, error) for name in fields.get("parameters", a_list)]
    rows = fields.get("matrix", a_list)
    if len(rows) != len(names):
        raise error(f"{where}.matrix has {len(rows)} rows; expected {len(names)}, as parameters")
    check = numbers(len(names))
    matrix = [check(row, f"{where}.matrix[{i}]", error) for i, row in enumerate(rows)]
    return Covariance(tuple(names), np.array(matrix).reshape(len(names), len(names)))


def _a_mapping(value: Any, where: str, error: type[SlError]) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise error(f"{where} is {describe(value)}; expected a mapping")
    return value


def device_document(device: Device) -> dict[str, Any]:
    """Return a device's section, every number with all its digits."""
    lens = device.lens
    model: dict[str, Any] = (
        {"model": "division", "kappa": _number(lens.kappa)}
        if isinstance(lens, Division)
        else {"model": "brown_conrady", "distortion": _numbers(lens.coefficients)}
    )
    focal = _numbers(device.focal_length_px)
    return {
        **model,
        "image_size": [int(side) for side in device.image_size],
        "focal_length_px": focal[0] if focal[0] == focal[1] else focal,
        "pixel_pitch_m": _number(device.pixel_pitch_m),
        "image_centre_px": _numbers(device.image_centre_px),
        "rotation": [_numbers(row) for row in device.rotation],
        "translation_m": _numbers(device.translation_m),
    }


def _number(value: Any) -> float:
    """Plain float without a negative zero, so that equal numbers have equal text."""
    return float(value) + 0.0


def _numbers(values: Any) -> list[float]:
    return [_number(value) for value in values]


def _rig_document(rig: Rig) -> dict[str, Any]:
    return {"camera": device_document(rig.camera), "projector": device_document(rig.projector)}


def covariance_document(covariance: Covariance) -> dict[str, Any]:
    """Return the section of a covariance."""
    matrix = [_numbers(row) for row in covariance.matrix]
    return {"parameters": list(covariance.parameters), "matrix": matrix}


def dump_calibration(calibration: Calibration | Rig) -> str:
    """Return the YAML text (format 1): every number with all its digits, the hash last."""
    if isinstance(calibration, Rig):
        calibration = Calibration(calibration)
    document: dict[str, Any] = {"format": FORMAT, **_rig_document(calibration.rig)}
    if calibration.covariance is not None:
        document["covariance"] = covariance_document(calibration.covariance)
    for key in ("residuals", "made_from"):
        if content := getattr(calibration, key):
            document[key] = dict(content)
    # Last: a file that is cut anywhere before it lacks the hash or a key, never both unnoticed.
    document["hash"] = calibration.hash
    return dump_document(document)


def save_calibration(path: str | Path, calibration: Calibration | Rig) -> None:
    """Write a calibration file in one step; a rig that no file may hold is refused.

    Parameters
    ----------
    path : str or Path
        The file.
    calibration : Calibration or Rig
        A rig alone is written without evidence.

    Raises
    ------
    CalibrationError
        When the rig's numbers are implausible, so that the file could not be read back.
    """
    rig = calibration if isinstance(calibration, Rig) else calibration.rig
    check_rig(rig, str(path))
    write_text(Path(path), dump_calibration(calibration))
