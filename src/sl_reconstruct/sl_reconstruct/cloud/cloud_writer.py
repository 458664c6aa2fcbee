"""Clouds as PLY and PCD files, both binary, lengths in metres.

A cloud is a structured array (rows, columns) of ``x, y, z, intensity, sigma`` (float32), NaN where
there is no point: one row per camera row, one column per DMD column boundary.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_common.documents import written_atomically
from sl_common.kernel_cache import kernel
from sl_reconstruct.cloud.cloud import CLOUD_DTYPE

POINT_FIELDS = CLOUD_DTYPE.names or ()


def cloud_hash(points: NDArray[Any]) -> str:
    """Hexadecimal sha256 of an organised cloud's bytes: equal clouds, and only they, share it."""
    return hashlib.sha256(np.ascontiguousarray(points).data.cast("B")).hexdigest()


def present(points: NDArray[Any]) -> NDArray[Any]:
    """Points that are there, (n,), in row order."""
    flat = points.reshape(-1)
    if flat.dtype == CLOUD_DTYPE:
        kept = np.empty(flat.shape, CLOUD_DTYPE)
        numbers = np.ascontiguousarray(flat).view(np.float32).reshape(-1, len(POINT_FIELDS))
        return kept[: _keep(numbers, kept.view(np.float32).reshape(numbers.shape))]
    there = np.isfinite(flat["z"])
    return flat if there.all() else np.asarray(flat[there])


@kernel(error_model="python")
def _keep(points: Any, kept: Any) -> int:
    """Copy the points that have a z, and return how many."""
    n = 0
    for i in range(points.shape[0]):
        if np.isfinite(points[i, 2]):
            for j in range(5):
                kept[n, j] = points[i, j]
            n += 1
    return n


def save_ply(path: str | Path, points: NDArray[Any], notes: Mapping[str, str] | None = None) -> int:
    """Write the points that are there as binary little-endian PLY.

    Parameters
    ----------
    path : path
        The file.
    points : ndarray, structured
        The cloud, any shape; NaN points are left out.
    notes : mapping, optional
        Written as comments, for example the hash of the calibration.

    Returns
    -------
    int
        Number of points written.
    """
    kept = _packed(present(points))
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in ("lengths in metres", *_lines(notes))),
        f"element vertex {len(kept)}",
        *(f"property float {name}" for name in POINT_FIELDS),
        "end_header",
    ]
    _write(Path(path), lines, kept)
    return len(kept)


def save_pcd(
    path: str | Path,
    points: NDArray[Any],
    notes: Mapping[str, str] | None = None,
    organised: bool = False,
) -> int:
    """Write a cloud as binary PCD 0.7 (pointclouds.org/documentation/tutorials/pcd_file_format).

    Parameters
    ----------
    path : path
        The file.
    points : ndarray, structured
        The cloud, (rows, columns).
    notes : mapping, optional
        Written as comments.
    organised : bool
        Keep rows and columns, with NaN where there is no point; else only points that are there.

    Returns
    -------
    int
        Number of points written, those that are NaN included.
    """
    kept = points if organised else present(points)
    height, width = points.shape if organised else (1, len(kept))
    packed = _packed(kept.reshape(-1))
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *(f"# {line}" for line in ("lengths in metres", *_lines(notes))),
        "VERSION 0.7",
        f"FIELDS {' '.join(POINT_FIELDS)}",
        f"SIZE {' '.join('4' for _ in POINT_FIELDS)}",
        f"TYPE {' '.join('F' for _ in POINT_FIELDS)}",
        f"COUNT {' '.join('1' for _ in POINT_FIELDS)}",
        f"WIDTH {width}",
        f"HEIGHT {height}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {packed.size}",
        "DATA binary",
    ]
    _write(Path(path), lines, packed)
    return int(packed.size)


def _packed(points: NDArray[Any]) -> NDArray[Any]:
    """Points with the fields of the files and no others, side by side; a copy only if need be."""
    wanted = np.dtype([(name, "<f4") for name in POINT_FIELDS])
    if points.dtype == wanted:
        return np.ascontiguousarray(points)
    packed = np.empty(points.shape, dtype=wanted)
    for name in POINT_FIELDS:
        packed[name] = points[name]
    return packed


def _write(path: Path, lines: Sequence[str], points: NDArray[Any]) -> None:
    with written_atomically(path) as partial, partial.open("wb") as file:
        file.write(("\n".join(lines) + "\n").encode("ascii"))
        file.write(points.data.cast("B") if points.size else b"")


def _lines(notes: Mapping[str, str] | None) -> list[str]:
    """One line of plain ASCII for each note."""
    lines = (f"{key}: {value}" for key, value in (notes or {}).items())
    return [" ".join(line.encode("ascii", "replace").decode().split()) for line in lines]
