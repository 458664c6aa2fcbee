"""Options of the whole suite."""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--hardware",
        action="append",
        default=[],
        metavar="KIND=ADDRESS",
        help="run the contract tests on a real device too, e.g. --hardware grbl=/dev/ttyUSB0; "
        "it will move",
    )
