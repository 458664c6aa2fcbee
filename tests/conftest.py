"""Options, isolation and data of the whole suite."""

from __future__ import annotations

import fcntl
import os
import tempfile
from pathlib import Path
from typing import IO

import pytest

from sl_bringup.transport import Transport

ROOT = Path(__file__).resolve().parents[1]
#: Below the users' graphs (0) and beside those that a person would choose by hand.
DOMAINS = range(30, 100)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--hardware",
        action="append",
        default=[],
        metavar="KIND=ADDRESS",
        help="run the contract tests on a real device too, e.g. --hardware grbl=/dev/ttyUSB0; "
        "it will move",
    )


def reserve_domain() -> tuple[int, IO[str]]:
    """A ROS domain that no other test process of this machine uses, and the file that holds it."""
    for domain in DOMAINS:
        file = (Path(tempfile.gettempdir()) / f"slrig-test-domain-{domain}.lock").open("w")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
        else:
            return domain, file
    raise RuntimeError(f"all test domains {DOMAINS} are taken")


def pytest_configure(config: pytest.Config) -> None:
    """Give this process (a worker of xdist, or the only one) a graph of its own.

    It must happen before anything imports rclpy: Fast DDS reads its profile once.
    """
    domain, config.slrig_domain_lock = reserve_domain()  # type: ignore[attr-defined]
    config.slrig_scratch = tempfile.TemporaryDirectory(prefix="slrig-test-")  # type: ignore[attr-defined]
    directory = Path(config.slrig_scratch.name)  # type: ignore[attr-defined]
    # The segments of the camera are enough for images and stacks of tests in one process.
    os.environ.update(Transport(directory, domain).environment("camera"))
    os.environ["XDG_RUNTIME_DIR"] = str(directory)


def pytest_unconfigure(config: pytest.Config) -> None:
    config.slrig_domain_lock.close()  # type: ignore[attr-defined]
    config.slrig_scratch.cleanup()  # type: ignore[attr-defined]


@pytest.fixture(scope="session")
def ros_domain() -> int:
    """ROS domain of this test process."""
    return int(os.environ["ROS_DOMAIN_ID"])


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Foreign data beside the repository; tests that need it are skipped without."""
    directory = ROOT.parent / "shared" / "data"
    if not directory.is_dir():
        pytest.skip("no foreign data: ../shared/data is not beside the repository")
    return directory
