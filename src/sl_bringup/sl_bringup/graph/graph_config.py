"""The one configuration file that a graph is started on, and what the user changes about it.

It is a ROS parameter file. What a start adds (endpoints of the bench, another surface, another
namespace) is written into a copy in the graph's runtime directory, which all processes read.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sl_camera.camera.camera import PIXEL_BITS
from sl_common.documents import dump_document, parse_document, read_text, write_text
from sl_common.errors import ConfigError
from sl_common.topics import NAMESPACE

BENCH = "/sl/bench"
#: Every node with its module, in the order of the light.
NODES = {
    "projector": "sl_projector.projector_node",
    "camera": "sl_camera.camera_node",
    "stage": "sl_camera.stage_node",
    "synchronizer": "sl_camera.synchronizer_node",
    "reconstruct": "sl_reconstruct.reconstruct_node",
    "calibration": "sl_calibration.calibration_node",
}
#: What a rig may do without: without a section of its own in the file it is not started.
OPTIONAL = ("camera", "stage")
CALIBRATION, RECONSTRUCT = "/sl/calibration", "/sl/reconstruct"
RUNTIME_VARIABLE = "$(var runtime_dir)"
TRUE_RIG = "true_rig.yaml"


@dataclass(frozen=True)
class Changes:
    """What a start changes about the file.

    Parameters
    ----------
    calibration : Path or None
        Calibration that is in force at the start.
    surface : str
        Part on the bench; empty: the file's.
    ros_args : sequence of str
        Passed on to every node; a new ``__ns`` moves the sections of the file as well.
    uncalibrated : bool
        Start without any calibration, whatever the file names.
    """

    calibration: Path | None = None
    surface: str = ""
    ros_args: Sequence[str] = field(default_factory=tuple)
    uncalibrated: bool = False

    @property
    def namespace(self) -> str:
        """Namespace of the nodes."""
        found = [a.partition(":=")[2] for a in self.ros_args if a.startswith("__ns:=")]
        return "/" + found[-1].strip("/") if found else NAMESPACE


def find_config(name: str) -> Path:
    """Return the path of a configuration file that comes with the package.

    Raises
    ------
    ConfigError
        When it was not installed.
    """
    places = [Path(__file__).resolve().parents[2] / "config"]
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(":"), sys.prefix]
    places += [Path(prefix) / "share" / "sl_bringup" / "config" for prefix in prefixes if prefix]
    for place in places:
        if (place / name).is_file():
            return place / name
    raise ConfigError(f"no {name}; expected in one of {', '.join(map(str, places))}")


def runtime_directory(domain: int) -> Path:
    """Return the directory of the one graph of this user in a ROS domain; made when missing."""
    base = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir())
    directory = base / f"slrig-{os.getuid()}" / f"domain-{domain}"
    directory.mkdir(parents=True, exist_ok=True, mode=0o700)
    return directory


def started_nodes(source: Path) -> dict[str, str]:
    """Return the nodes that a configuration starts and their modules, in the order of the light.

    Another program's camera driver may publish the images, and a rig may do without a stage.

    Raises
    ------
    ConfigError
        When the file is not a parameter file.
    """
    text = read_text(source, ConfigError)
    document = _checked(parse_document(text, str(source), ConfigError), source)
    there = {key.removeprefix(NAMESPACE + "/") for key in document}
    return {name: m for name, m in NODES.items() if name not in OPTIONAL or name in there}


def write_config(source: Path, directory: Path, changes: Changes) -> Path:
    """Write the configuration that the graph's processes read, return its path.

    Parameters
    ----------
    source : Path
        The user's file.
    directory : Path
        Of the running graph.
    changes : Changes
        What this start changes.

    Raises
    ------
    ConfigError
        When the file is not a parameter file, or there is no bench whose surface could be changed.
    """
    text = read_text(source, ConfigError).replace(RUNTIME_VARIABLE, str(directory))
    document = _checked(parse_document(text, str(source), ConfigError), source)
    if "calibration_file" in document.get(RECONSTRUCT, {}).get("ros__parameters", {}):
        raise ConfigError(
            f"{source}: {RECONSTRUCT} names a calibration_file; expected it in {CALIBRATION}, the "
            "only node that says which calibration is in force"
        )
    for name in ("calibration_file", "store_dir"):
        _resolve(document, CALIBRATION, name, source.parent)
    if document.get(BENCH, {}).get("ros__parameters", {}).get("rig") != "reference":
        _resolve(document, BENCH, "rig", source.parent)
    if changes.calibration or changes.uncalibrated:
        document.get(CALIBRATION, {}).get("ros__parameters", {}).pop("calibration_file", None)
    if changes.calibration:
        set_parameter(document, CALIBRATION, "calibration_file", changes.calibration)
    if changes.surface:
        set_parameter(document, BENCH, "surface", changes.surface)
    _tell_full_scale(document)
    moved = {_moved(key, changes.namespace): value for key, value in document.items()}
    write_text(directory / "config.yaml", dump_document(moved))
    return directory / "config.yaml"


def set_parameter(document: dict[str, Any], node: str, name: str, value: object) -> None:
    """Set one parameter; its section is made when missing.

    Parameters
    ----------
    document : dict
        The configuration, changed in place.
    node, name : str
        The node's and the parameter's name.
    value : object
        What YAML can hold.
    """
    section = document.setdefault(node, {}).setdefault("ros__parameters", {})
    section[name] = str(value.resolve()) if isinstance(value, Path) else value


def _tell_full_scale(document: dict[str, Any]) -> None:
    """Let the reconstruction know where 10 and 12 bits end that come in 16-bit images."""
    camera = document.get("/sl/camera", {}).get("ros__parameters", {})
    bits = PIXEL_BITS.get(camera.get("pixel_format", "mono8"), 16)
    reconstruct = document.get(RECONSTRUCT, {}).get("ros__parameters", {})
    if bits not in (8, 16) and not reconstruct.get("saturation_dn"):
        set_parameter(document, RECONSTRUCT, "saturation_dn", (1 << bits) - 1)


def _checked(document: Any, source: Path) -> dict[str, Any]:
    if not isinstance(document, dict) or not document:
        raise ConfigError(
            f"{source} is no ROS parameter file; expected sections such as /sl/camera"
        )
    for key, section in document.items():
        parameters = section.get("ros__parameters") if isinstance(section, dict) else None
        if not isinstance(parameters, dict):
            raise ConfigError(f"{source}: section {key} lacks the mapping ros__parameters")
    return document


def _resolve(document: dict[str, Any], node: str, name: str, base: Path) -> None:
    """Make a relative path absolute: the copy is elsewhere."""
    parameters = document.get(node, {}).get("ros__parameters", {})
    if parameters.get(name):
        parameters[name] = str((base / str(parameters[name])).resolve())


def _moved(key: str, namespace: str) -> str:
    if key == BENCH or not key.startswith(NAMESPACE + "/"):
        return key
    return namespace.rstrip("/") + key.removeprefix(NAMESPACE)
