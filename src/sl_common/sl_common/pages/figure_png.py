"""Figures of matplotlib as PNG, drawn without a display."""

from __future__ import annotations

import io

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def png(figure: Figure) -> bytes:
    """Draw a figure once; ``savefig`` would draw it twice, the first time for its layout."""
    buffer = io.BytesIO()
    canvas = FigureCanvasAgg(figure)
    canvas.print_png(buffer, pil_kwargs={"compress_level": 4})  # type: ignore[no-untyped-call]
    return buffer.getvalue()
