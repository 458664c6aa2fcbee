"""From a stack of images to a measured surface.

Knows: the rig model (Eqs. 1-4 of Tsai & Hung 2005), decoding, sub-pixel edges and centres,
triangulation, clouds and their files, measurement of surfaces. Must not know: devices, how the
images were taken, the bench. Imports data types of `sl_projector` only.

The names in ``__all__`` are for users (``docs/python.md``); each is imported at its first use.
"""

import importlib
from typing import Any

#: What users need, and the room that it lives in.
_PUBLIC = {
    "Reconstructor": "reconstruction.reconstructor",
    "Settings": "decode.settings",
    "Rig": "model.rig",
    "load_rig": "model.calibration_file",
    "save_calibration": "model.calibration_file",
    "read_cloud": "cloud.cloud_reader",
    "read_height_map": "cloud.cloud_reader",
    "save_ply": "cloud.cloud_writer",
    "save_pcd": "cloud.cloud_writer",
    "MeasurementRequest": "measure.request",
    "measure_cloud": "measure.request",
}
__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    """Import a public name at its first use (PEP 562)."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_PUBLIC[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
