"""The doctor's look at the devices: what is there, its state, what is wrong, and the remedy.

Devices are asked, never moved. Those of a running graph are left alone: its nodes report on them.
"""

from __future__ import annotations

import grp
import os
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import usb.core
import yaml
from serial.tools.list_ports import comports

import sl_projector
from sl_bringup.graph.doctor_checks import Finding, Trouble, collected
from sl_bringup.graph.graph_config import started_nodes
from sl_camera.drivers.aravis_library import INSTALL as ARAVIS_INSTALL
from sl_camera.drivers.aravis_library import find_camera, list_cameras, load_aravis
from sl_camera.drivers.camera_drivers import make_camera
from sl_camera.stage.grbl.grbl_stage import GrblStage
from sl_camera.stage.stage import StageDriver
from sl_camera.stage.zaber.zaber_stage import ZaberStage, zaber_axes
from sl_common.errors import DeviceLost, DeviceTimeout, SlError
from sl_projector.dlpc.dlpc350_driver import Dlpc350
from sl_projector.dlpc.dlpc900_driver import Dlpc900
from sl_projector.dlpc.dmd import DEFAULT_MODEL, MODELS, dmd_model
from sl_projector.hid.usb_transport import serial_number

VENDOR = 0x0451
#: USB product of each controller.
CONTROLLERS = {"DLPC900": 0xC900, "DLPC350": 0x6401}
USB_NODES = Path("/dev/bus/usb")
PSEUDO_TERMINALS = Path("/dev/pts")
SERIAL_NAMES = Path("/dev/serial/by-id")
RULES_DIRECTORIES = tuple(
    map(Path, ("/etc/udev/rules.d", "/run/udev/rules.d", "/lib/udev/rules.d"))
)
RULES = Path(sl_projector.__file__).parent / "udev" / "60-sl-projector.rules"
RELOAD = (
    "sudo udevadm control --reload && sudo udevadm trigger, then unplug it and plug it in again"
)
#: What is said of devices that the configuration has no section for.
LEFT_OUT = {
    "camera": Finding(
        "note",
        "camera",
        "no section /sl/camera: another driver is to publish camera/image_raw",
        "remap that driver's images (docs/cameras.md)",
    ),
    "stage": Finding(
        "note",
        "stage",
        "no section /sl/stage: a rig without a stage",
        "say require_pose: false in the section /sl/synchronizer",
    ),
}
#: Longest wait for a stage's answer; grblHAL may need a second.
STAGE_TIMEOUT_S = 2.0


def devices(source: Path, running: bool) -> list[Finding]:
    """Look at all devices that a configuration names.

    Parameters
    ----------
    source : Path
        The configuration file.
    running : bool
        Its graph has the devices open.
    """
    sections = yaml.safe_load(source.read_text()) or {}
    started = started_nodes(source)
    found: list[Finding] = []
    for node, look in (("projector", _projector), ("stage", _stage), ("camera", _camera)):
        parameters = sections.get(f"/sl/{node}", {}).get("ros__parameters", {})
        if node in started:
            found += collected(node, partial(look, parameters, running))
        else:
            found.append(LEFT_OUT[node])
    return found


# -- permissions and owners -----------------------------------------------------------------


def _may_use(node: Path) -> bool:
    return os.access(node, os.R_OK | os.W_OK)


def _join_group(node: Path) -> str:
    """Return the command that gives the user a device's group."""
    number, user = node.stat().st_gid, os.environ.get("USER", "$USER")
    try:
        group = grp.getgrgid(number)
    except KeyError:  # in a container, the host's groups have no names
        return f"in a container: start it with --group-add {number}"
    if user in group.gr_mem:
        return (
            f"you were put into the group {group.gr_name}, but not yet when you logged in: "
            "log in again"
        )
    return f"sudo usermod -aG {group.gr_name} {user}, then log out and in again"


def _holders(node: Path) -> str:
    """Name the processes that have a device file open; empty when none is known."""
    files = list(_open_files())
    found = {pid for pid, file in files if file == str(node)}
    if node.parent == PSEUDO_TERMINALS:  # an emulator's: who serves it does not keep it busy
        found -= {pid for pid, file in files if file.endswith("/ptmx")}
    names = (f"{_name(pid)} (process {pid})" for pid in sorted(found) if pid != os.getpid())
    return ", ".join(names)


def _open_files() -> Iterator[tuple[int, str]]:
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            yield int(link.parts[2]), str(link.readlink())
        except OSError:
            continue  # another user's, or gone


def _name(pid: int) -> str:
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return "a program"
    return " ".join(words[:3]).strip()


def _busy(text: str, node: Path | None) -> Trouble:
    holders = _holders(node) if node else ""
    if holders:
        return Trouble(f"{text}: {holders} has it", "stop that program")
    who = f"sudo fuser -v {node}   shows who has it; stop that" if node else "stop who has it"
    return Trouble(text, who)


# -- projector ------------------------------------------------------------------------------------


def _projector(parameters: Mapping[str, Any], running: bool) -> Iterator[Finding]:
    """The projector's controller: there, permitted, free, of the right kind, and well."""
    name, device = parameters.get("dmd_model", DEFAULT_MODEL), str(parameters.get("device", "usb"))
    if name not in MODELS:
        text = f"dmd_model {name!r} is unknown; there are {', '.join(sorted(MODELS))}"
        raise Trouble(text, "correct dmd_model in the configuration")
    kind, _, place = device.partition(":")
    if kind != "socket":
        node = _usb_controller(name, place)
        yield _projector_state(device, name, running, node)
    elif Path(place).exists():
        yield _projector_state(device, name, running, None)
    else:
        remedy = "start what serves it (the bench: slrig up --bench), or say device: usb"
        raise Trouble(f"nothing at {place}", remedy)


def _usb_controller(name: str, serial: str) -> Path:
    """Device file of the controller that the configuration means, where it may be used."""
    chip = MODELS[name].controller
    there = {c: _find_usb(product) for c, product in CONTROLLERS.items()}
    if not there[chip]:
        raise _no_controller(name, [other for other, found in there.items() if found])
    found = there[chip]
    means = [one for one in found if not serial or serial_number(one) == serial]
    closed = [one for one in found if not _may_use(_usb_node(one))]
    if not means and not closed:
        others = ", ".join(serial_number(one) or "none" for one in found)
        raise Trouble(
            f"no {chip} of serial number {serial!r}; on the USB: {others}",
            "correct device in the configuration (usb: the first that is found)",
        )
    node = _usb_node((means or closed)[0])
    if not _may_use(node):
        raise _forbidden(chip, node)
    return node


def _find_usb(product: int) -> list[Any]:
    try:
        return list(usb.core.find(find_all=True, idVendor=VENDOR, idProduct=product))
    except usb.core.NoBackendError:
        raise Trouble("libusb is not installed", "sudo apt install libusb-1.0-0") from None


def _no_controller(name: str, others: Sequence[str]) -> Trouble:
    chip = MODELS[name].controller
    if others:
        models = [m.name for m in MODELS.values() if m.controller == others[0]]
        return Trouble(
            f"no {chip}, but a {others[0]} is on the USB",
            f"say dmd_model: {' or '.join(models)} in the configuration",
        )
    return Trouble(
        f"no {chip} ({VENDOR:04x}:{CONTROLLERS[chip]:04x}) on the USB; the configuration asks for "
        f"a {name}",
        "plug it in and switch it on (lsusb must list it); without hardware: add --bench",
    )


def _usb_node(device: Any) -> Path:
    return USB_NODES / f"{device.bus:03d}" / f"{device.address:03d}"


def _forbidden(chip: str, node: Path) -> Trouble:
    """No permission: the rule is missing, or there and not in force."""
    if not node.exists():
        text = f"{chip} is on the USB, but there is no {node}"
        return Trouble(text, "in a container: start it with --device=/dev/bus/usb")
    rule = _udev_rule(CONTROLLERS[chip])
    if rule is None:
        text = f"{chip} is there, but you have no permission for {node} and no udev rule gives it"
        return Trouble(text, f"sudo cp {RULES} /etc/udev/rules.d/ && {RELOAD}")
    text = f"{chip} is there, {rule} has a rule for it, but you have no permission for {node}"
    return Trouble(text, f"{RELOAD}; or {_join_group(node)}")


def _udev_rule(product: int) -> Path | None:
    """First udev rule that names a controller."""
    for directory in RULES_DIRECTORIES:
        for file in sorted(directory.glob("*.rules")):
            lines = file.read_text(errors="replace").splitlines()
            rules = (line.lower() for line in lines if not line.lstrip().startswith("#"))
            if any(f'"{VENDOR:04x}"' in rule and f'"{product:04x}"' in rule for rule in rules):
                return file
    return None


def _projector_state(device: str, name: str, running: bool, node: Path | None) -> Finding:
    chip, place = MODELS[name].controller, f" at {node or device}"
    if running:
        return Finding("ok", "projector", f"{chip}{place}, the running graph has it")
    driver = Dlpc350(device) if chip == "DLPC350" else Dlpc900(device, dmd_model(name))
    try:
        status = driver.look()
    except DeviceLost as error:
        if "another program" in str(error):
            raise _busy(f"{chip}{place} is busy", node) from None
        raise Trouble(str(error), "unplug it and plug it in again") from None
    except DeviceTimeout as error:
        text = f"{chip}{place} does not answer: {error}"
        raise Trouble(text, "switch it off and on again") from None
    except SlError as error:
        raise Trouble(str(error), "correct dmd_model, or see docs/dlpc350.md") from None
    text = f"{name} on a {chip}{place}, firmware {status.firmware}, {status.power}"
    if status.problems:
        remedy = "switch it off and on; if it says so again, check the DMD's cable and supply"
        raise Trouble(f"{text}: {'; '.join(status.problems)}", remedy)
    return Finding("ok", "projector", text + (", showing patterns" if status.running else ""))


# -- stage ----------------------------------------------------------------------------------------


def _stage(parameters: Mapping[str, Any], running: bool) -> Iterator[Finding]:
    """The stage's port: there, permitted, free; and what answers on it."""
    kind, port = parameters.get("kind", "grbl"), parameters.get("port", "")
    if kind == "manual":
        yield Finding("ok", "stage", "moved by hand, confirmed by stage/confirm")
        return
    yield Finding("note", "serial ports", _ports() or "none on this machine")
    node = Path(port)
    if not port:
        remedy = "put port: into the configuration, or require_pose: false for a rig without stage"
        yield Finding("note", "stage", "the configuration names no port", remedy)
    elif not node.exists():
        remedy = "plug it in and switch it on, or name one of the ports above in the configuration"
        raise Trouble(f"no port {port}", remedy)
    elif not _may_use(node):
        raise Trouble(f"you have no permission for {port}", _join_group(node))
    elif running:
        yield Finding("ok", "stage", f"{kind} at {node}, the running graph has it")
    else:
        yield _stage_state(kind, node, parameters)


def _ports() -> str:
    """Serial ports with the names that stay when they are plugged in elsewhere."""
    names = {str(link.resolve()): link for link in SERIAL_NAMES.glob("*")}
    return ", ".join(f"{p.device} ({names.get(p.device, p.description)})" for p in comports())


def _stage_state(kind: str, node: Path, parameters: Mapping[str, Any]) -> Finding:
    if _holders(node.resolve()):
        raise _busy(f"{node} is busy", node.resolve())
    driver = _stage_driver(kind, str(node), parameters)
    try:
        driver.open()
        state = driver.state()
    except DeviceTimeout as error:
        text = f"{node} is there, but no {kind} stage: {error}"
        remedy = "is it switched on? is it this port (see above), this baud and this kind?"
        raise Trouble(text, remedy) from None
    except DeviceLost as error:
        raise _busy(str(error), node.resolve()) from None
    except SlError as error:
        raise Trouble(str(error), "correct kind and port in the configuration") from None
    finally:
        driver.close()
    text = f"{kind} at {node}, {state.kind}{f': {state.text}' if state.text else ''}"
    if state.kind == "alarm":
        raise Trouble(text, "remove the cause, then call the service stage/clear of the graph")
    if state.kind == "not_homed":
        remedy = "call the service stage/home of the graph, or say home_at_start: true"
        return Finding("note", "stage", text, remedy)
    return Finding("ok", "stage", text)


def _stage_driver(kind: str, port: str, parameters: Mapping[str, Any]) -> StageDriver:
    baud = int(parameters.get("baud", 115200))
    if kind == "zaber":
        addresses = parameters.get("zaber_devices", (1, 2, 3))
        axes = zaber_axes(addresses, parameters.get("zaber_axes", (1, 1, 1)))
        return ZaberStage(port, axes, baud=baud)
    return GrblStage(port, baud=baud, reply_timeout_s=STAGE_TIMEOUT_S)


# -- camera ---------------------------------------------------------------------------------------


def _camera(parameters: Mapping[str, Any], running: bool) -> Iterator[Finding]:
    """The camera that the configuration names, and those that answer."""
    address = str(parameters.get("address", ""))
    kind, _, place = address.rpartition(":")
    if kind != "aravis":
        yield _aravis()
    if not address:
        remedy = "put its address into the configuration (docs/cameras.md)"
        yield Finding("note", "camera", "no address in the configuration", remedy)
        return
    try:
        make_camera(address)
    except SlError as error:
        raise Trouble(str(error), "correct the configuration") from None
    if kind == "aravis":
        yield _genicam(place)
    elif kind == "uvc":
        yield _video(place, running)
    elif Path(place).exists():
        yield Finding("ok", "camera", address)
    else:
        remedy = "start the process that serves the camera, or correct the configuration"
        raise Trouble(f"nothing at {place}", remedy)


def _aravis() -> Finding:
    try:
        found = ", ".join(list_cameras())
    except SlError:
        return Finding("note", "Aravis", "not installed; only cameras over GenICam need it")
    return Finding("note", "Aravis", f"GenICam cameras that answer: {found or 'none'}")


def _genicam(name: str) -> Finding:
    try:
        found = find_camera(load_aravis(), name)
        others = ", ".join(list_cameras())
    except DeviceLost as error:
        remedy = (
            "arv-tool-0.8 (package aravis-tools-cli) lists what answers; GigE: an address in the "
            "camera's network, UDP let in; USB3: 61-sl-camera.rules (docs/cameras.md)"
        )
        raise Trouble(str(error), remedy) from None
    except SlError as error:
        raise Trouble(str(error).removesuffix(f"; {ARAVIS_INSTALL}"), ARAVIS_INSTALL) from None
    return Finding("ok", "camera", f"{found} (answering: {others or 'none'})")


def _video(device: str, running: bool) -> Finding:
    path = Path(f"/dev/video{device}") if device.isdigit() else Path(device)
    if not path.exists():
        there = ", ".join(map(str, sorted(Path("/dev").glob("video*")))) or "none"
        remedy = "plug it in, or name another (v4l2-ctl --list-devices)"
        raise Trouble(f"no {path}; there are: {there}", remedy)
    if not _may_use(path):
        raise Trouble(f"you have no permission for {path}", _join_group(path))
    if not running and _holders(path.resolve()):
        raise _busy(f"{path} is busy", path.resolve())
    return Finding("ok", "camera", str(path))
