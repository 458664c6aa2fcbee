"""HTML pages from Jinja templates; a page contains its style and pictures and needs no other file.

Templates lie beside the code that fills them. They extend ``base.html``, take tables and pictures
from ``parts.html``, and write numbers with the filters `number` and `length`.
"""

from __future__ import annotations

import base64
import math
from pathlib import Path
from typing import Any


def render_page(template: Path, **content: Any) -> str:
    """Return a page; all text in it is escaped.

    Parameters
    ----------
    template : Path
        A file that extends ``base.html``.
    **content
        What the template names; ``title`` is the page's heading. A name that is missing is an
        error.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader([template.parent, Path(__file__).parent]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(number=number, length=length, base64=_base64)
    return environment.get_template(template.name).render(**content)


def number(value: float | None, form: str = ".4g", factor: float = 1, missing: str = "") -> str:
    """Write a number for people.

    Parameters
    ----------
    value : float or None
        The number.
    form : str
        Format, and behind a space the unit: ``".2f s"``.
    factor : float
        Units per unit of the value: 1e6 writes metres as micrometres.
    missing : str
        Written where the value is None or not finite.
    """
    if value is None or not math.isfinite(value):
        return missing
    form, space, unit = form.partition(" ")
    return f"{value * factor:{form}}{space}{unit}"


def length(value_m: float) -> str:
    """Write a length for people: micrometres below 1 mm, else millimetres."""
    micrometres = abs(value_m) < 1e-3
    return number(value_m, *((".4g µm", 1e6) if micrometres else (".4g mm", 1e3)), "unknown")


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
