"""``--sweep``: the same recordings with several settings, side by side in one table."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sl_common.documents import write_text
from sl_common.errors import ConfigError
from sl_common.json_file import write_json
from sl_common.pages.page import length, number, render_page
from sl_reconstruct.cloud.cloud_reader import read_cloud

#: Standard deviation over the median of absolute values, of a normal distribution.
MAD = 1.4826
#: More would be a mistake: each takes as long as an evaluation.
MAX_VARIANTS = 64
PICTURES = ("picture_residual.png", "picture_refusals.png")
COLUMNS = (
    *("scans", "good", "points", "of the lit"),
    *("sigma of z", "noise / bound", "plane rms", "z off first"),
)
_TEMPLATE = Path(__file__).parent / "templates" / "sweep.html"


@dataclass(frozen=True)
class Variant:
    """One column of settings in a sweep; empty assignments: no sweep at all."""

    assignments: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """For people."""
        return ", ".join(self.assignments)

    @property
    def folder(self) -> str:
        """Below the output."""
        return "_".join(text.replace("/", "-") for text in self.assignments)


def variants(sweeps: Sequence[str]) -> Iterator[Variant]:
    """All combinations of the values of ``name=a,b,c``.

    Raises
    ------
    ConfigError
        When one is no such assignment, a name comes twice, or there are too many.
    """
    axes = [_axis(sweep) for sweep in sweeps]
    names = [axis[0].partition("=")[0] for axis in axes]
    if len(set(names)) < len(names):
        raise ConfigError(f"--sweep names a setting twice: {', '.join(names)}")
    count = int(np.prod([len(axis) for axis in axes], dtype=np.int64))
    if count > MAX_VARIANTS:
        raise ConfigError(f"--sweep makes {count} evaluations; expected at most {MAX_VARIANTS}")
    return (Variant(chosen) for chosen in itertools.product(*axes))


def _axis(sweep: str) -> list[str]:
    name, equals, values = sweep.partition("=")
    words = [word.strip() for word in values.split(",")]
    if not (name and equals and all(words)) or len(set(words)) < len(words):
        raise ConfigError(f"--sweep {sweep!r}; expected name=a,b,c with different values")
    return [f"{name}={word}" for word in words]


def write_sweep(
    output: Path,
    results: Sequence[tuple[Variant, Sequence[tuple[Path, Mapping[str, Any]]]]],
    common: Sequence[str] = (),
) -> list[str]:
    """Write ``sweep.json`` and ``sweep.html``.

    Parameters
    ----------
    output : Path
        For both.
    results : sequence of (Variant, sequence of (folder of the bag, report))
        What came of each variant.
    common : sequence of str
        Assignments that all variants share.

    Returns
    -------
    list of str
        The table, for a terminal.
    """
    clouds = [_first_cloud(found) for _, found in results]
    rows = [
        {
            "settings": list(v.assignments),
            **_row([r for _, r in found]),
            "z_off_first_m": _scatter_m(clouds[0], cloud),
        }
        for (v, found), cloud in zip(results, clouds, strict=True)
    ]
    write_json(output / "sweep.json", {"format": 1, "common": list(common), "variants": rows})
    shown = [
        {"title": variant.title, "cells": _cells(row), "pictures": _pictures(found)}
        for (variant, found), row in zip(results, rows, strict=True)
    ]
    page = render_page(_TEMPLATE, title="Sweep", columns=COLUMNS, variants=shown, common=common)
    write_text(output / "sweep.html", page)
    table = [("settings", COLUMNS), *((v["title"], v["cells"]) for v in shown)]
    width = max(len(title) for title, _ in table)
    return [f"{title:<{width}}" + "".join(f"{cell:>16}" for cell in row) for title, row in table]


def _row(reports: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures of a variant: medians over the scans that gave a cloud."""
    measured = [r for r in reports if "points" in r]
    return {
        "scans": len(reports),
        "good": sum(bool(r["good"]) for r in reports),
        "points": _middle([r["points"] for r in measured]),
        "present_fraction": _middle([r["present_fraction"] for r in measured]),
        "median_sigma_m": _middle([r["median_sigma_m"] for r in measured]),
        "bound_ratio": _middle([r["figures"]["bound_ratio"] for r in measured]),
        "plane_rms_m": _middle([r["plane"]["rms_m"] for r in measured if "plane" in r]),
        "settings_hash": reports[0].get("settings_hash", "") if reports else "",
        "cloud_hashes": [r.get("cloud_hash", "") for r in reports],
    }


def _first_cloud(found: Sequence[tuple[Path, Mapping[str, Any]]]) -> Path | None:
    """Organised cloud of the first scan, where it gave one."""
    files = [folder / report["folder"] / "cloud.pcd" for folder, report in found[:1]]
    return next((file for file in files if file.is_file()), None)


def _scatter_m(first: Path | None, other: Path | None) -> float:
    """How far two clouds of the same images differ in z: robust standard deviation, metres."""
    if first is None or other is None:
        return float("nan")
    here, there = read_cloud(first)["z"], read_cloud(other)["z"]
    if here.shape != there.shape:
        return float("nan")
    apart = (there - here)[np.isfinite(there - here)]
    return float(MAD * np.median(np.abs(apart))) if apart.size else float("nan")


def _middle(values: Sequence[float]) -> float:
    there = [v for v in values if np.isfinite(v)]
    return float(np.median(there)) if there else float("nan")


def _cells(row: Mapping[str, Any]) -> list[str]:
    return [
        f"{row['scans']}",
        f"{row['good']}",
        number(row["points"], ",.0f", missing="-"),
        number(row["present_fraction"], ".2f %", 100, "-"),
        length(row["median_sigma_m"]),
        number(row["bound_ratio"], ".3f", missing="-"),
        length(row["plane_rms_m"]),
        length(row["z_off_first_m"]) if np.isfinite(row["z_off_first_m"]) else "-",
    ]


def _pictures(found: Sequence[tuple[Path, Mapping[str, Any]]]) -> list[bytes]:
    """Pictures of the first scan that has any."""
    for folder, report in found:
        files = [folder / report["folder"] / name for name in PICTURES]
        if all(file.is_file() for file in files):
            return [file.read_bytes() for file in files]
    return []
