"""Clouds and height maps read back from their files, for measurements."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_common.errors import ConfigError
from sl_reconstruct.cloud.cloud import CLOUD_DTYPE
from sl_reconstruct.cloud.height_map import HeightMap

#: PCD field types as numpy has them.
PCD_TYPES = {"F": "f", "I": "i", "U": "u"}


def read_cloud(path: str | Path) -> NDArray[Any]:
    """Read a cloud as structured points; a height map becomes an organised cloud without sigma.

    Parameters
    ----------
    path : path
        ``.pcd`` (binary, 0.7), ``.ply``, ``.npy`` (structured), or ``.tif``/``.tiff`` with the
        ``report.json`` beside it, which has its grid.

    Returns
    -------
    ndarray, structured
        At least ``x, y, z`` in metres; (rows, columns) where the file is organised, else (n,).

    Raises
    ------
    ConfigError
        When the file is missing, damaged or of another kind.
    """
    path = Path(path)
    readers = {
        ".pcd": _read_pcd,
        ".ply": _read_ply,
        ".tif": _read_map,
        ".tiff": _read_map,
        ".npy": _read_npy,
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ConfigError(f"{path} is no cloud; expected one of {', '.join(readers)}")
    try:
        points = reader(path)
    except (OSError, ValueError, KeyError, IndexError, EOFError) as exc:
        raise ConfigError(f"cannot read {path}: {exc}") from None
    missing = {"x", "y", "z"} - set(points.dtype.names or ())
    if missing:
        raise ConfigError(f"{path} has no {sorted(missing)}; expected x, y, z in metres")
    return points


def read_height_map(path: str | Path) -> HeightMap:
    """Read a height map (32-bit TIFF) with the grid in the ``report.json`` beside it.

    Raises
    ------
    ConfigError
        When either is missing or damaged.
    """
    path = Path(path)
    report = path.parent / "report.json"
    try:
        grid = json.loads(report.read_text())["height_map"]
        z = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if z is None or z.ndim != 2:
            raise ConfigError(f"{path} is no readable TIFF of one channel")
        z_m = np.asarray(z, dtype=np.float32)
        return HeightMap(z_m, *(float(grid[key]) for key in ("x0_m", "y0_m", "step_m")))
    except (OSError, ValueError, KeyError, TypeError) as exc:
        raise ConfigError(f"cannot read the grid of {path} from {report}: {exc!r}") from None


def _read_map(path: Path) -> NDArray[Any]:
    height = read_height_map(path)
    rows, columns = height.z_m.shape
    points = np.full(height.z_m.shape, np.nan, dtype=CLOUD_DTYPE)
    points["x"] = height.x0_m + height.step_m * np.arange(columns)
    points["y"] = height.y0_m - height.step_m * np.arange(rows)[:, None]
    points["z"] = height.z_m
    return points


def _read_npy(path: Path) -> NDArray[Any]:
    return np.asarray(np.load(path, allow_pickle=False))


def _read_ply(path: Path) -> NDArray[Any]:
    from plyfile import PlyData, PlyParseError

    try:
        return np.asarray(PlyData.read(str(path))["vertex"].data)
    except PlyParseError as exc:
        raise ValueError(str(exc)) from None


def _read_pcd(path: Path) -> NDArray[Any]:
    blob = path.read_bytes()
    mark = b"DATA binary\n"
    end = blob.find(mark)
    if end < 0:
        raise ValueError("expected a PCD file with binary data")
    lines = [line.split() for line in blob[:end].decode("ascii").splitlines() if line[:1] != "#"]
    head = {words[0]: words[1:] for words in lines if words}
    kinds = [f"<{PCD_TYPES[t]}{s}" for t, s in zip(head["TYPE"], head["SIZE"], strict=True)]
    dtype = np.dtype(list(zip(head["FIELDS"], kinds, strict=True)))
    height, width = int(head["HEIGHT"][0]), int(head["WIDTH"][0])
    body = blob[end + len(mark) :]
    if len(body) < height * width * dtype.itemsize:
        raise ValueError(f"{len(body)} bytes of points; expected {height} x {width} of them")
    points = np.frombuffer(body, dtype, height * width)
    return points.reshape(height, width) if height > 1 else points
