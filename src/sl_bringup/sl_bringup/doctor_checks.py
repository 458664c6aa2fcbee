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

from sl_bringup.graph import GraphOptions, client_command, client_environment
from sl_bringup.graph_config import NODES, write_config
from sl_bringup.transport import (
    MIB,
    SEGMENT_BYTES,
    SHM_DIRECTORY,
    SMALL_SEGMENT_BYTES,
    free_bytes,
)
from sl_camera.aravis_library import INSTALL as ARAVIS_INSTALL
from sl_camera.aravis_library import find_camera, list_cameras, load_aravis
from sl_camera.camera_drivers import make_camera
from sl_projector.dmd import DEFAULT_MODEL, MODELS
from sl_projector.errors import DeviceLost, SlError

PYTHON_RANGE = ((3, 11), (3, 13))
#: Module and the name under which pip knows it.
LIBRARIES = {
    "numpy": "numpy", "scipy": "scipy", "numba": "numba", "cv2": "opencv-python-headless",
    "yaml": "PyYAML", "usb.core": "pyusb", "serial": "pyserial", "rosbags": "rosbags",
    "matplotlib": "matplotlib", "plyfile": "plyfile",
}  # fmt: skip
#: USB vendor and product of each controller.
CONTROLLER_IDS = {"DLPC900": (0x0451, 0xC900), "DLPC350": (0x0451, 0x6401)}
UDEV_FILE = Path("/etc/udev/rules.d/70-slrig.rules")
UDEV_RULE = (
    'SUBSYSTEM=="usb", ATTRS{{idVendor}}=="0451", ATTRS{{idProduct}}=="{product:04x}", '
    'MODE="0660", GROUP="plugdev", TAG+="uaccess"'
)
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
    sections = yaml.safe_load(config.read_text())
    parameters = {
        name: sections.get(f"{options.changes.namespace}/{name}", {}).get("ros__parameters", {})
        for name in ("calibration", "reconstruct")
    }
    named = [str(p["calibration_file"]) for p in parameters.values() if p.get("calibration_file")]
    store = parameters["calibration"].get("store_dir")
    return [*found, _calibration(named[0] if named else _accepted(store))]


def _accepted(store_dir: str | None) -> str:
    """Last accepted calibration of the store; empty when there is none."""
    from sl_calibration.store import Store, default_directory

    try:
        return str(Store(Path(store_dir) if store_dir else default_directory()).current() or "")
    except SlError:
        return ""


def _calibration(file: str) -> Finding:
    from sl_reconstruct.calibration_file import load_calibration

    if not file:
        remedy = "run 'slrig calibrate', or name one with --calibration FILE"
        return Finding("bad", "calibration", "none is named; scans will be refused", remedy)
    try:
        calibration = load_calibration(Path(file))
    except SlError as error:
        return Finding("bad", "calibration", str(error), "name another file, or calibrate anew")
    return Finding("ok", "calibration", f"{file} ({calibration.hash[:12]})")


def projector(source: Path, bench: bool) -> list[Finding]:
    """The projector's controller on the USB, and the permission to use it."""
    if bench:
        return []
    import usb.core

    dmd = _parameter(source, "projector", "dmd_model") or DEFAULT_MODEL
    chip = MODELS[dmd].controller if dmd in MODELS else MODELS[DEFAULT_MODEL].controller
    vendor, product = CONTROLLER_IDS[chip]
    try:
        device = usb.core.find(idVendor=vendor, idProduct=product)
    except usb.core.NoBackendError:
        return [Finding("bad", "projector", "no libusb", "apt install libusb-1.0-0")]
    if device is None:
        remedy = "plug it in and switch it on; without hardware: --bench"
        text = f"no {chip} ({vendor:04x}:{product:04x}) on the USB"
        return [Finding("bad", "projector", text, remedy)]
    node = Path(f"/dev/bus/usb/{device.bus:03d}/{device.address:03d}")
    if not os.access(node, os.R_OK | os.W_OK):
        rule = UDEV_RULE.format(product=product)
        remedy = f"echo '{rule}' | sudo tee {UDEV_FILE}; sudo udevadm control --reload; replug"
        return [Finding("bad", "projector", f"no permission for {node}", remedy)]
    return [Finding("ok", "projector", f"{chip} at {node}")]


def _parameter(source: Path, node: str, name: str) -> str:
    sections = yaml.safe_load(source.read_text()) or {}
    return str(sections.get(f"/sl/{node}", {}).get("ros__parameters", {}).get(name, ""))


def serial_ports(source: Path, bench: bool) -> list[Finding]:
    """The stage's port, and the permission to use it."""
    if bench:
        return []
    from serial.tools.list_ports import comports

    there = [port.device for port in comports()]
    found = [Finding("note", "serial ports", ", ".join(there) or "none on this machine")]
    port = _parameter(source, "stage", "port")
    if not port:
        return [*found, Finding("note", "stage", "the configuration names no port")]
    if not Path(port).exists():
        remedy = "plug it in, or name another port in the configuration"
        return [*found, Finding("bad", "stage", f"no port {port}", remedy)]
    if not os.access(port, os.R_OK | os.W_OK):
        remedy = "sudo usermod -aG dialout $USER, then log in again"
        return [*found, Finding("bad", "stage", f"no permission for {port}", remedy)]
    return [*found, Finding("ok", "stage", port)]


def camera(source: Path, bench: bool) -> list[Finding]:
    """The camera that the configuration names, and those that answer."""
    if bench:
        return []
    address = _parameter(source, "camera", "address")
    if not address:
        remedy = "put its address into the configuration (docs/cameras.md)"
        return [Finding("note", "camera", "no address in the configuration", remedy), _aravis()]
    try:
        make_camera(address)
    except SlError as error:
        return [Finding("bad", "camera", str(error), "correct the configuration")]
    kind, _, place = address.rpartition(":")
    if kind == "aravis":
        return [_genicam(place)]
    if kind == "uvc":
        return [_video(place), _aravis()]
    if not Path(place).exists():
        remedy = "start the process that serves the camera, or correct the configuration"
        return [Finding("bad", "camera", f"nothing at {place}", remedy), _aravis()]
    return [Finding("ok", "camera", address), _aravis()]


def _aravis() -> Finding:
    text = "there" if _there("gi") else "not installed; only cameras over GenICam need it"
    return Finding("note", "Aravis", text)


def _genicam(name: str) -> Finding:
    try:
        found = find_camera(load_aravis(), name)
        others = ", ".join(list_cameras())
    except DeviceLost as error:
        return Finding("bad", "camera", str(error), "arv-tool-0.8   (package aravis-tools-cli)")
    except SlError as error:
        return Finding("bad", "camera", str(error), ARAVIS_INSTALL)
    return Finding("ok", "camera", f"{found} (answering: {others or 'none'})")


def _video(device: str) -> Finding:
    path = Path(f"/dev/video{device}") if device.isdigit() else Path(device)
    if not path.exists():
        there = ", ".join(map(str, sorted(Path("/dev").glob("video*")))) or "none"
        remedy = "plug it in, or name another (v4l2-ctl --list-devices)"
        return Finding("bad", "camera", f"no {path}; there are: {there}", remedy)
    if not os.access(path, os.R_OK | os.W_OK):
        remedy = "sudo usermod -aG video $USER, then log in again"
        return Finding("bad", "camera", f"no permission for {path}", remedy)
    return Finding("ok", "camera", str(path))


def graph(options: GraphOptions) -> list[Finding]:
    """A running graph and what its nodes say."""
    if not _there("rclpy"):
        return []
    command = client_command("sl_bringup.ready_node", options, "--nodes", *NODES, "--timeout", "4")
    asked: Any = subprocess.run(
        command, env=client_environment(options), capture_output=True, text=True, check=False
    )
    if asked.returncode == 0:
        return [Finding("ok", "graph", f"running and ready in domain {options.domain}")]
    complaint = asked.stderr.strip().removeprefix("graph not ready: ")
    if all(f"{name} is silent" in complaint for name in NODES):
        remedy = f"slrig up{' --bench' if options.bench else ''}"
        return [Finding("note", "graph", f"none runs in domain {options.domain}", remedy)]
    return [Finding("bad", "graph", complaint, "see the nodes' log; slrig up restarts dead ones")]
