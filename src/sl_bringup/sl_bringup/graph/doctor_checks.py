"""The checks of ``slrig doctor``: what each found and, where it is bad, the remedy."""

from __future__ import annotations

import importlib
import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

import yaml

from sl_bringup.graph.graph import GraphOptions, client_environment, readiness_command
from sl_bringup.graph.graph_config import write_config
from sl_bringup.graph.transport import (
    MIB,
    SEGMENT_BYTES,
    SHM_DIRECTORY,
    SMALL_SEGMENT_BYTES,
    free_bytes,
)
from sl_common.errors import SlError

PYTHON_RANGE = ((3, 11), (3, 13))
#: Module and the name under which pip knows it.
LIBRARIES = {
    **{name: name for name in ("numpy", "scipy", "numba", "rosbags", "mcap", "matplotlib")},
    **{"cv2": "opencv-python-headless", "yaml": "PyYAML", "plyfile": "plyfile"},
    **{"usb.core": "pyusb", "serial": "pyserial"},
}
INSTALL = "make venv"
#: What to look for: the module that shows it is there, and the remedy when it is not.
ROS_MODULES = {
    "rclpy": ("rclpy", INSTALL + "   (or source a ROS 2 Jazzy workspace)"),
    "middleware": ("rmw_dds_common", INSTALL),
    "sl_interfaces": ("sl_interfaces.action", "pip install src/sl_interfaces   (or colcon build)"),
}


@dataclass(frozen=True)
class Finding:
    """One line of the doctor.

    Parameters
    ----------
    level : {"ok", "note", "bad"}
        "note" is worth knowing but stops nothing.
    subject, text : str
        What was looked at, what was found.
    remedy : str
        What to do.
    """

    level: Literal["ok", "note", "bad"]
    subject: str
    text: str
    remedy: str = ""


class Trouble(Exception):
    """Ends a check with a bad finding: what is wrong, and the remedy."""

    def __init__(self, text: str, remedy: str) -> None:
        super().__init__(text)
        self.remedy = remedy


def collected(subject: str, check: Callable[[], Iterable[Finding]]) -> list[Finding]:
    """Carry out a check, whatever it meets.

    Parameters
    ----------
    subject : str
        What it looks at.
    check : callable
        Gives its findings one after the other, and may raise `Trouble`.

    Returns
    -------
    list of Finding
        A check that fails by itself is a finding too.
    """
    found = []
    try:
        for finding in check():
            found.append(finding)  # noqa: PERF402  # those before a trouble count
    except Trouble as trouble:
        found.append(Finding("bad", subject, str(trouble), trouble.remedy))
    except Exception as error:
        found.append(Finding("bad", subject, f"cannot be checked: {error!r}", "report this"))
    return found


def python() -> Iterator[Finding]:
    """Interpreter and environment."""
    version = ".".join(map(str, sys.version_info[:3]))
    low, high = PYTHON_RANGE
    if not low <= sys.version_info[:2] <= high:
        remedy = "install Python 3.12 and make the environment again: make distclean venv"
        raise Trouble(f"{version}; the wheels of ROS are for 3.11-3.13", remedy)
    yield Finding("ok", "python", f"{version} in {sys.prefix}")


def libraries() -> Iterator[Finding]:
    """Libraries that the commands need."""
    missing = [name for module, name in LIBRARIES.items() if not _there(module)]
    if missing:
        remedy = f"{sys.executable} -m pip install {' '.join(missing)}   (or: {INSTALL})"
        raise Trouble(f"missing: {', '.join(missing)}", remedy)
    yield Finding("ok", "libraries", f"all {len(LIBRARIES)} are there")


def _there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def ros() -> Iterator[Finding]:
    """Middleware, client library and our messages."""
    for subject, (module, remedy) in ROS_MODULES.items():
        try:
            importlib.import_module(module)
        except ImportError as error:
            yield Finding("bad", subject, f"cannot be imported: {error}", remedy)
        else:
            yield Finding("ok", subject, _version(subject))
    chosen = os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    if chosen != "rmw_fastrtps_cpp":
        text = f"RMW_IMPLEMENTATION={chosen}: tools started from here would not see the graph"
        yield Finding("note", "middleware", text, "unset RMW_IMPLEMENTATION")


def _version(subject: str) -> str:
    names = {"rclpy": "ros-rclpy", "sl_interfaces": "sl-interfaces"}
    try:
        return f"version {metadata.version(names[subject])}"
    except (KeyError, metadata.PackageNotFoundError):
        return "found"


def shared_memory() -> Iterator[Finding]:
    """Room for the segments of large messages."""
    free = free_bytes()
    wanted = 2 * (sum(SEGMENT_BYTES.values()) + 4 * SMALL_SEGMENT_BYTES)
    text = f"{free // MIB} MB free in {SHM_DIRECTORY}"
    if free >= wanted:
        yield Finding("ok", "shared memory", text)
        return
    remedy = (
        f"container: --shm-size={wanted // MIB}m or --ipc=host; host: "
        f"mount -o remount,size={wanted // MIB}m {SHM_DIRECTORY}"
    )
    text += f"; {wanted // MIB} MB are needed for full speed, segments shrink until then"
    yield Finding("note" if free >= 32 * MIB else "bad", "shared memory", text, remedy)


def configuration(options: GraphOptions) -> Iterator[Finding]:
    """Configuration file, and the calibration that it names."""
    try:
        # A directory of its own: the files of a running graph stay as they are.
        config = write_config(options.source, options.directory / "doctor", options.changes)
    except SlError as error:
        raise Trouble(str(error), "correct the file") from None
    yield Finding("ok", "configuration", str(options.source))
    if not options.bench:
        node = f"{options.changes.namespace}/calibration"
        parameters = yaml.safe_load(config.read_text()).get(node, {}).get("ros__parameters", {})
        named = parameters.get("calibration_file") or _accepted(parameters.get("store_dir"))
        yield from collected("calibration", lambda: _calibration(str(named)))


def _accepted(store_dir: str | None) -> str:
    """Last accepted calibration of the store; empty when there is none."""
    from sl_calibration.data.run_store import Store, default_directory

    try:
        return str(Store(Path(store_dir) if store_dir else default_directory()).current() or "")
    except SlError:
        return ""


def _calibration(file: str) -> Iterator[Finding]:
    from sl_reconstruct.model.calibration_file import load_calibration

    if not file:
        remedy = "run 'slrig calibrate', or name one with --calibration FILE"
        raise Trouble("none is named; scans will be refused", remedy)
    try:
        calibration = load_calibration(Path(file))
    except SlError as error:
        raise Trouble(str(error), "name another file, or calibrate anew") from None
    yield Finding("ok", "calibration", f"{file} ({calibration.hash[:12]})")


def graph(options: GraphOptions) -> Iterator[Finding]:
    """A running graph and what its nodes say."""
    if not _there("rclpy"):
        return
    command = readiness_command(options, "--timeout", "4", "--states")
    asked = subprocess.run(
        command, env=client_environment(options), capture_output=True, text=True, check=False
    )
    complaint = asked.stderr.strip().removeprefix("graph not ready: ")
    if asked.returncode == 0:
        yield Finding("ok", "graph", f"running and ready in domain {options.domain}")
    elif all(f"{name} is silent" in complaint for name in options.nodes):
        remedy = "slrig up" + (" --bench" if options.bench else "")
        remedy += f" --config {options.config}" if options.config else ""
        yield Finding("note", "graph", f"none runs in domain {options.domain}", remedy)
        return
    else:
        yield Finding("bad", "graph", complaint, "see the nodes' log; slrig up restarts dead ones")
    yield from (_state(line) for line in asked.stdout.splitlines() if " | " in line)


def _state(line: str) -> Finding:
    """What a node of the running graph says of itself: the devices are its own meanwhile."""
    name, level, message = line.split(" | ", 2)
    return Finding("ok" if level == "ok" else "note", f"  {name}", message)
