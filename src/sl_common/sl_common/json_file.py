"""Reports as JSON files, for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sl_common.documents import write_text


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a report as JSON.

    Parameters
    ----------
    path : Path
        The file; replaced in one step.
    content : mapping
        Plain values and arrays; numbers that are not finite become null.
    """
    text = json.dumps(plain_value(content), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(path, text + "\n")


def plain_value(value: Any) -> Any:
    """Return a value as JSON knows it: arrays as lists, numbers that are not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): plain_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_value(item) for item in value]
    if hasattr(value, "tolist"):
        return plain_value(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
