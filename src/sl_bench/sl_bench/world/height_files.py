"""Height maps from files that others wrote."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sl_common.errors import ConfigError

Array = NDArray[np.float64]

TMD_MAGIC = b"Binary TrueMap Data File v2.0\r\n\0"
#: TMD lengths are millimetres.
TMD_UNIT_M = 1e-3


def read_height_file(path: Path, unit_m: float = 1.0) -> tuple[Array, float | None]:
    """Read a height map.

    Parameters
    ----------
    path : Path
        ``.npy`` (2-D), ``.tif``/``.tiff`` (one channel) or ``.tmd`` (GelSight, TrueMap).
    unit_m : float
        What one unit of height is; does not apply to TMD.

    Returns
    -------
    heights : ndarray, (rows, columns)
        Metres.
    step_m : float or None
        Distance of neighbours where the file says it.

    Raises
    ------
    ConfigError
        When the file is missing, unknown or damaged.
    """
    try:
        if path.suffix.lower() == ".npy":
            return np.load(path, allow_pickle=False).astype(np.float64) * unit_m, None
        if path.suffix.lower() in (".tif", ".tiff"):
            return _read_tiff(path) * unit_m, None
        if path.suffix.lower() == ".tmd":
            return parse_tmd(path.read_bytes())
    except (OSError, ValueError, cv2.error) as error:
        raise ConfigError(f"height map {path}: {error}") from error
    raise ConfigError(f"height map {path}: expected a .npy, .tif or .tmd file")


def _read_tiff(path: Path) -> Array:
    path.stat()
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2:
        raise ValueError("not a readable TIFF of one channel")
    return np.asarray(image, dtype=np.float64)


def parse_tmd(blob: bytes) -> tuple[Array, float]:
    """Heights (rows, columns) and step, metres, of a TrueMap v6 file's bytes.

    Layout: magic, a comment up to NUL, then little-endian columns and rows (int32), width, height
    and two offsets (float32), then the heights (float32), row by row.
    """
    if not blob.startswith(TMD_MAGIC):
        raise ValueError(f"starts with {blob[:20]!r}; expected {TMD_MAGIC!r}")
    start = blob.index(b"\0", len(TMD_MAGIC)) + 1
    header = struct.Struct("<iiffff")
    if len(blob) < start + header.size:
        raise ValueError("ends within its header")
    columns, rows, width, _, _, _ = header.unpack_from(blob, start)
    body = len(blob) - start - header.size
    if min(columns, rows) < 2 or body != 4 * columns * rows or not width > 0.0:
        raise ValueError(f"{columns}x{rows} heights over {width} mm, {body} bytes of them")
    heights = np.frombuffer(blob, "<f4", columns * rows, start + header.size)
    return heights.reshape(rows, columns) * np.float64(TMD_UNIT_M), width / columns * TMD_UNIT_M
