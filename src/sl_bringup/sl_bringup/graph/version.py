"""Which software this is, for everything that is written."""

from __future__ import annotations

from importlib import metadata


def software_version() -> str:
    """Name and version; without a version where only the sources are on the path."""
    try:
        return f"slrig {metadata.version('slrig')}"
    except metadata.PackageNotFoundError:
        return "slrig (not installed)"
