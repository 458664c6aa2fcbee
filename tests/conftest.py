"""Options, isolation and data of the whole suite."""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

import pytest

from sl_bringup.graph.transport import Transport
from support.domains import ReservedDomain
from support.paths import DATA

#: Kinds of devices that have contract tests.
HARDWARE = ("dlpc900", "camera", "grbl", "zaber")


def hardware(text: str) -> str:
    """Check KIND=ADDRESS: another kind would be passed over by every test."""
    kind, _, address = text.partition("=")
    if kind not in HARDWARE or not address:
        raise argparse.ArgumentTypeError(f"{text}; expected KIND one of {HARDWARE}")
    return text


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--hardware",
        action="append",
        default=[],
        type=hardware,
        metavar="KIND=ADDRESS",
        help="run the contract tests on a real device too, e.g. --hardware grbl=/dev/ttyUSB0; "
        f"it will move. KIND: {', '.join(HARDWARE)}",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Give this process (a worker of xdist, or the only one) a graph of its own.

    It must happen before anything imports rclpy: Fast DDS reads its profile once.
    """
    config.slrig_domain = ReservedDomain()  # type: ignore[attr-defined]
    config.slrig_scratch = tempfile.TemporaryDirectory(prefix="slrig-test-")  # type: ignore[attr-defined]
    directory = Path(config.slrig_scratch.name)  # type: ignore[attr-defined]
    # The segments of the camera are enough for images and stacks of tests in one process.
    os.environ.update(Transport(directory, config.slrig_domain.number).environment("camera"))
    os.environ["XDG_RUNTIME_DIR"] = str(directory)


def pytest_unconfigure(config: pytest.Config) -> None:
    config.slrig_domain.release()  # type: ignore[attr-defined]
    config.slrig_scratch.cleanup()  # type: ignore[attr-defined]


@pytest.fixture(scope="session")
def ros_domain() -> int:
    """ROS domain of this test process."""
    return int(os.environ["ROS_DOMAIN_ID"])


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Foreign data beside the repository; tests that need it are skipped without."""
    directory = DATA
    if not directory.is_dir():
        pytest.skip("no foreign data: ../shared/data is not beside the repository")
    return directory
