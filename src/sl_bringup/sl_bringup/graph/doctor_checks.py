"""The checks of ``slrig doctor``: each says what it found and, where it is bad, what mends it."""

from __future__ import annotations

import importlib
import importlib.util
import os
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

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
from sl_common.errors import DeviceError, SlError

PYTHON_RANGE = ((3, 11), (3, 13))
#: Module and the name under which pip knows it.
LIBRARIES = {
    "numpy": "numpy", "scipy": "scipy", "numba": "numba", "cv2": "opencv-python-headless",
    "yaml": "PyYAML", "usb.core": "pyusb", "serial": "pyserial", "rosbags": "rosbags",
    "matplotlib": "matplotlib", "plyfile": "plyfile",
}  # fmt: skip
INSTALL = "make venv"


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


def python() -> list[Finding]:
    """Interpreter and environment."""
    version = ".".join(map(str, sys.version_info[:3]))
    low, high = PYTHON_RANGE
    if not low <= sys.version_info[:2] <= high:
        remedy = "install Python 3.12 and make the environment anew: make distclean venv"
        return [Finding("bad", "python", f"{version}; the wheels of ROS are for 3.11-3.13", remedy)]
    return [Finding("ok", "python", f"{version} in {sys.prefix}")]


def libraries() -> list[Finding]:
    """Libraries that the commands need."""
    missing = [name for module, name in LIBRARIES.items() if not _there(module)]
    if missing:
        remedy = f"{sys.executable} -m pip install {' '.join(missing)}   (or: {INSTALL})"
        return [Finding("bad", "libraries", f"missing: {', '.join(missing)}", remedy)]
    return [Finding("ok", "libraries", f"all {len(LIBRARIES)} are there")]


def _there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def ros() -> list[Finding]:
    """Middleware, client library and our messages."""
    found = []
    for subject, module, remedy in (
        ("rclpy", "rclpy", INSTALL + "   (or source a ROS 2 Jazzy workspace)"),
        ("middleware", "rmw_dds_common", INSTALL),
        (
            "sl_interfaces",
            "sl_interfaces.action",
            "pip install src/sl_interfaces   (or colcon build)",
        ),
    ):
        try:
            importlib.import_module(module)
        except ImportError as error:
            found.append(Finding("bad", subject, f"cannot be imported: {error}", remedy))
        else:
            found.append(Finding("ok", subject, _version(subject)))
    return found + _rmw()


def _version(subject: str) -> str:
    names = {"rclpy": "ros-rclpy", "sl_interfaces": "sl-interfaces"}
    try:
        return f"version {metadata.version(names[subject])}"
    except (KeyError, metadata.PackageNotFoundError):
        return "found"


def _rmw() -> list[Finding]:
    chosen = os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    if chosen != "rmw_fastrtps_cpp":
        text = f"RMW_IMPLEMENTATION={chosen}: tools started from here would not see the graph"
        return [Finding("note", "middleware", text, "unset RMW_IMPLEMENTATION")]
    return []


def shared_memory() -> list[Finding]:
    """Room for the segments of large messages."""
    free = free_bytes()
    wanted = 2 * (sum(SEGMENT_BYTES.values()) + 4 * SMALL_SEGMENT_BYTES)
    text = f"{free // MIB} MB free in {SHM_DIRECTORY}"
    if free >= wanted:
        return [Finding("ok", "shared memory", text)]
    remedy = (
        f"container: --shm-size={wanted // MIB}m or --ipc=host; host: "
        f"mount -o remount,size={wanted // MIB}m {SHM_DIRECTORY}"
    )
    text += f"; {wanted // MIB} MB are needed for full speed, segments shrink until then"
    return [Finding("note" if free >= 32 * MIB else "bad", "shared memory", text, remedy)]


def configuration(options: GraphOptions) -> list[Finding]:
    """Configuration file, and the calibration that it names."""
    try:
        # A directory of its own: the files of a running graph stay as they are.
        config = write_config(options.source, options.directory / "doctor", options.changes)
    except SlError as error:
        return [Finding("bad", "configuration", str(error), "mend the file")]
    found = [Finding("ok", "configuration", str(options.source))]
    if options.bench:
        return found
    section = yaml.safe_load(config.read_text()).get(f"{options.changes.namespace}/calibration", {})
    parameters = section.get("ros__parameters", {})
    named = str(parameters.get("calibration_file") or _accepted(parameters.get("store_dir")))
    return [*found, _calibration(named)]


def _accepted(store_dir: str | None) -> str:
    """Last accepted calibration of the store; empty when there is none."""
    from sl_calibration.data.run_store import Store, default_directory

    try:
        return str(Store(Path(store_dir) if store_dir else default_directory()).current() or "")
    except SlError:
        return ""


def _calibration(file: str) -> Finding:
    from sl_reconstruct.model.calibration_file import load_calibration

    if not file:
        remedy = "run 'slrig calibrate', or name one with --calibration FILE"
        return Finding("bad", "calibration", "none is named; scans will be refused", remedy)
    try:
        calibration = load_calibration(Path(file))
    except SlError as error:
        return Finding("bad", "calibration", str(error), "name another file, or calibrate anew")
    return Finding("ok", "calibration", f"{file} ({calibration.hash[:12]})")


def find_usb(vendor: int, product: int) -> list[Any]:
    """Return the USB devices with these ids.

    Parameters
    ----------
    vendor, product : int
        USB ids.

    Raises
    ------
    DeviceError
        When libusb is missing.
    """
    import usb.core

    try:
        return list(usb.core.find(find_all=True, idVendor=vendor, idProduct=product))
    except usb.core.NoBackendError as error:
        raise DeviceError("libusb is not installed") from error


def serial_ports() -> dict[str, str]:
    """Serial ports of this machine and what they say of themselves."""
    from serial.tools.list_ports import comports

    return {port.device: port.description for port in comports()}


def graph(options: GraphOptions) -> list[Finding]:
    """A running graph and what its nodes say."""
    if not _there("rclpy"):
        return []
    command = readiness_command(options, "--timeout", "4", "--states")
    asked: Any = subprocess.run(
        command, env=client_environment(options), capture_output=True, text=True, check=False
    )
    states = [_state(line) for line in asked.stdout.splitlines() if " | " in line]
    if asked.returncode == 0:
        return [Finding("ok", "graph", f"running and ready in domain {options.domain}"), *states]
    complaint = asked.stderr.strip().removeprefix("graph not ready: ")
    if all(f"{name} is silent" in complaint for name in options.nodes):
        remedy = "slrig up" + (" --bench" if options.bench else "")
        remedy += f" --config {options.config}" if options.config else ""
        return [Finding("note", "graph", f"none runs in domain {options.domain}", remedy)]
    remedy = "see the nodes' log; slrig up restarts dead ones"
    return [Finding("bad", "graph", complaint, remedy), *states]


def _state(line: str) -> Finding:
    """What a node of the running graph says of itself: the devices are its own meanwhile."""
    name, level, message = line.split(" | ", 2)
    return Finding("ok" if level == "ok" else "note", f"  {name}", message)
