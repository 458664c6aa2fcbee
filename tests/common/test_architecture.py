"""Import directions, sizes and habits of the code base, read from its syntax trees."""

from __future__ import annotations

import ast
import graphlib
import re
import runpy
import statistics
import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import setuptools

from support.paths import ROOT

PACKAGES = tuple(sorted(m.parent.name for m in (ROOT / "src").glob("*/package.xml")))
PYTHON_PACKAGES = tuple(name for name in PACKAGES if name != "sl_interfaces")
#: What each package may import of ours: packages, or rooms of them (``package.room``).
ALLOWED = {
    "sl_common": set(),
    "sl_projector": {"sl_common"},
    "sl_camera": {"sl_common", "sl_projector.sequence"},
    "sl_reconstruct": {"sl_common", "sl_projector.sequence"},
    "sl_calibration": {"sl_common", "sl_projector.sequence", "sl_reconstruct"},
    # The bench sees the rig, never how images are decoded: a shared error would cancel.
    "sl_bench": {"sl_common", "sl_projector", "sl_camera", "sl_reconstruct.model"},
    "sl_bringup": set(PYTHON_PACKAGES),
}
#: What each room may import of its own package; a package's top (nodes, messages) may import all.
ROOMS = {
    "sl_common": {"pages": set()},
    "sl_projector": {"sequence": set(), "hid": set(), "dlpc": {"hid", "sequence"}},
    "sl_camera": {
        "camera": set(), "drivers": {"camera"}, "stage": set(), "stage.grbl": {"stage"},
        "stage.zaber": {"stage"}, "sync": set(),
    },
    "sl_reconstruct": {
        "model": set(), "cloud": set(), "decode": {"cloud"}, "measure": {"cloud"},
        "reconstruction": {"model", "cloud", "decode"}, "scan": {"cloud", "reconstruction"},
    },
    "sl_calibration": {
        "target": set(), "data": {"target"}, "bundle": {"data"}, "solve": {"data", "bundle"},
        "board": {"data", "solve"}, "verify": {"target", "data", "solve"},
        "report": {"data", "bundle", "solve", "verify"},
        "workflow": {"target", "data", "bundle", "solve", "verify", "report"},
    },
    "sl_bench": {
        "world": set(), "dlpc": set(), "camera": set(), "stage": set(),
        "process": {"world", "dlpc", "camera", "stage"},
    },
    "sl_bringup": {
        "graph": set(), "bag": set(), "results": {"graph"},
        "evaluation": {"graph", "bag", "results"},
        "cli": {"graph", "bag", "results", "evaluation"},
    },
}  # fmt: skip
#: Device drivers and transports of the projector that nobody else has a use for, but its peers.
DEVICE_SDKS = {"usb", "serial", "hid", "termios", "gi", "pypylon"}
SDK_FILES = {
    "sl_projector/hid/usb_transport.py", "sl_projector/hid/usb_socket.py",
    "sl_camera/stage/grbl/grbl_stage.py", "sl_camera/stage/serial_lines.py",
    "sl_camera/drivers/aravis_library.py", "sl_bench/dlpc/usb_server.py",
    "sl_bench/stage/serial_emulator.py", "sl_bringup/cli/doctor.py",
    "sl_bringup/graph/doctor_devices.py",
}  # fmt: skip
ROS_MODULES = re.compile(
    r"^(rclpy|rcl_interfaces|sl_interfaces|builtin_interfaces|std_srvs|rosgraph_msgs|\w+_msgs)(\.|$)"
)
MAX_FOLDER_FILES = 14
MAX_FILE_LINES, MAX_BODY_LINES, MEDIAN_BODY_LINES, P95_BODY_LINES = 500, 60, 8, 40

Function = ast.FunctionDef | ast.AsyncFunctionDef


def sources() -> list[Path]:
    return sorted(
        file for package in PYTHON_PACKAGES
        for file in (ROOT / "src" / package / package).rglob("*.py")
    )  # fmt: skip


def label(file: Path) -> str:
    """Path from the package on: ``sl_camera/stage/stage.py``."""
    return "/".join(file.relative_to(ROOT / "src").parts[1:])


def room(file: Path) -> str:
    """Folder of a file within its package, dotted; empty at the package's top."""
    return ".".join(file.relative_to(ROOT / "src").parts[2:-1])


def tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text(), str(file))


def imports(file: Path) -> Iterator[tuple[str, int]]:
    """Dotted names that a file imports, with the names from a package as its members."""
    for node in ast.walk(tree(file)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}:{node.lineno} imports relatively"
            yield from ((f"{node.module}.{alias.name}", node.lineno) for alias in node.names)


FILES = [pytest.param(file, id=label(file)) for file in sources()]


def room_of(name: str) -> str:
    """Room that a dotted name of ours lies in: the longest that is a folder."""
    package, *parts = name.split(".")
    folder, found = ROOT / "src" / package / package, []
    while parts and (folder / parts[0]).is_dir():
        folder, found = folder / parts[0], [*found, parts.pop(0)]
    return ".".join(found)


@pytest.mark.parametrize("file", FILES)
def test_packages_import_one_way(file: Path) -> None:
    package = file.relative_to(ROOT / "src").parts[0]
    for name, line in imports(file):
        top = name.split(".")[0]
        if top in ALLOWED and top != package:
            allowed = {top, f"{top}.{room_of(name)}"} & ALLOWED[package]
            assert allowed, f"{label(file)}:{line}: {package} imports {name}"


@pytest.mark.parametrize("file", FILES)
def test_rooms_import_one_way(file: Path) -> None:
    package, own = file.relative_to(ROOT / "src").parts[0], room(file)
    for name, line in imports(file):
        other = room_of(name)
        if own and name.split(".")[0] == package and other != own:
            assert other in ROOMS[package][own], f"{label(file)}:{line}: {own} imports {name}"


@pytest.mark.parametrize("package", PYTHON_PACKAGES)
def test_every_room_is_known_and_holds_few_files(package: str) -> None:
    folder = ROOT / "src" / package / package
    files = [f for f in sources() if f.is_relative_to(folder)]
    assert {room(f) for f in files} - {""} == set(ROOMS.get(package, ()))
    for name in {f.parent for f in files}:
        assert len(list(name.glob("*.py"))) <= MAX_FOLDER_FILES, f"{name} holds too many files"
        assert (name / "__init__.py").exists()


def test_test_files_are_short_and_their_folders_hold_few() -> None:
    files = sorted((ROOT / "tests").rglob("*.py"))
    assert not [f for f in files if len(f.read_text().splitlines()) > MAX_FILE_LINES]
    folders = {f.parent: len(list(f.parent.glob("*.py"))) for f in files}
    assert not {f: count for f, count in folders.items() if count > MAX_FOLDER_FILES}
    # Modules of tests are no packages, so their names must differ.
    names = [f.name for f in files if f.name.startswith("test_")]
    assert len(names) == len(set(names))
    shared = [f for f in files for name, _ in imports(f) if name.startswith("test_")]
    assert not shared, "what tests share belongs to tests/support"


def module(file: Path) -> str:
    parts = file.relative_to(ROOT / "src").with_suffix("").parts[1:]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def test_no_files_import_each_other_in_a_circle() -> None:
    modules = {module(file): file for file in sources()}
    graph = {
        name: {
            next((m for m in (target, target.rpartition(".")[0]) if m in modules), None)
            for target, _ in imports(file)
        } - {None, name}
        for name, file in modules.items()
    }  # fmt: skip
    # Raises CycleError, which names the circle.
    assert len(list(graphlib.TopologicalSorter(graph).static_order())) == len(modules)


@pytest.mark.parametrize("file", FILES)
def test_ros_stays_in_nodes_and_messages(file: Path) -> None:
    if file.name.endswith("_node.py") or file.name == "messages.py":
        return
    found = [f"{name} (line {line})" for name, line in imports(file) if ROS_MODULES.match(name)]
    assert not found, f"{label(file)} imports {', '.join(found)}"


@pytest.mark.parametrize("file", FILES)
def test_device_sdks_stay_in_drivers(file: Path) -> None:
    found = {name.split(".")[0] for name, _ in imports(file)} & DEVICE_SDKS
    assert not found or label(file) in SDK_FILES, f"{label(file)} imports {found}"


@pytest.mark.parametrize("file", FILES)
def test_a_file_is_short_and_its_module_says_what_it_is(file: Path) -> None:
    assert len(file.read_text().splitlines()) <= MAX_FILE_LINES
    assert ast.get_docstring(tree(file)), f"{label(file)} has no docstring"
    assert "utils" not in file.stem


@pytest.mark.parametrize("file", FILES)
def test_nothing_prints(file: Path) -> None:
    calls = [node for node in ast.walk(tree(file)) if isinstance(node, ast.Call)]
    calls = [c.lineno for c in calls if isinstance(c.func, ast.Name) and c.func.id == "print"]
    assert not calls, f"{label(file)} prints in lines {calls}"


def functions(file: Path) -> Iterator[Function]:
    yield from (n for n in ast.walk(tree(file)) if isinstance(n, Function))


def body_lines(function: Function) -> int:
    """Lines of a body that hold code: without docstring, comments and blank lines."""
    body = function.body
    if ast.get_docstring(function):
        body = body[1:]
    nodes = [node for statement in body for node in ast.walk(statement)]
    coded = [node for node in nodes if isinstance(node, ast.expr | ast.stmt)]
    return len({line for node in coded for line in (node.lineno, node.end_lineno)})


def test_functions_are_short() -> None:
    lengths = {
        f"{label(file)}:{f.name}": body_lines(f) for file in sources() for f in functions(file)
    }
    long = {name: n for name, n in lengths.items() if n > MAX_BODY_LINES}
    assert not long
    assert statistics.median(lengths.values()) <= MEDIAN_BODY_LINES
    assert statistics.quantiles(lengths.values(), n=20)[-1] <= P95_BODY_LINES


# -- packages -------------------------------------------------------------------------------------


def manifest(package: str) -> ElementTree.Element:
    return ElementTree.parse(ROOT / "src" / package / "package.xml").getroot()


def test_one_version_everywhere() -> None:
    top = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    wheel = (ROOT / "src/sl_interfaces/pyproject.toml").read_text()
    assert tomllib.loads(wheel)["project"]["version"] == top
    assert {manifest(p).findtext("version") for p in PACKAGES} == {top}


#: What rosdep calls the libraries; llvmlite is a part of numba, others come from pip.
KEYS = {
    "cv2": "python3-opencv", "jinja2": "python3-jinja2", "matplotlib": "python3-matplotlib",
    "numba": "python3-numba", "numpy": "python3-numpy", "scipy": "python3-scipy",
    "serial": "python3-serial", "usb": "python3-usb", "yaml": "python3-yaml",
}  # fmt: skip


@pytest.mark.parametrize("package", PYTHON_PACKAGES)
def test_the_manifest_names_what_is_imported(package: str) -> None:
    listed = {e.text for kind in ("exec_depend", "depend") for e in manifest(package).iter(kind)}
    used = {name.split(".")[0] for file in sources() if label(file).startswith(f"{package}/")
            for name, _ in imports(file)}  # fmt: skip
    ros = {name for name in used if ROS_MODULES.match(name) or name in ALLOWED} - {package}
    optional = {"tf2_msgs"}
    wanted = (ros - optional) | {KEYS[name] for name in used & KEYS.keys()}
    assert wanted <= listed, f"{package}/package.xml lacks {sorted(wanted - listed)}"


@pytest.mark.parametrize("package", PYTHON_PACKAGES)
def test_ros2_run_finds_every_node(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {}
    monkeypatch.chdir(ROOT / "src" / package)
    monkeypatch.setattr(setuptools, "setup", given.update)
    runpy.run_path("setup.py")
    assert given["name"] == package
    for file in Path(package).glob("*_node.py"):
        if any(f.name == "main" for f in tree(file).body if isinstance(f, ast.FunctionDef)):
            script = f"{file.stem} = {package}.{file.stem}:main"
            assert script in given["entry_points"]["console_scripts"]


def interface_files() -> list[Path]:
    folder = ROOT / "src" / "sl_interfaces"
    return sorted(f for kind in ("msg", "srv", "action") for f in folder.glob(f"{kind}/*.{kind}"))


@pytest.mark.parametrize("file", interface_files(), ids=lambda file: file.name)
def test_every_field_says_what_it_means(file: Path) -> None:
    lines = file.read_text().splitlines()
    assert lines[0].startswith("# "), "the first line says what it is"
    # A bool success and a string message are the answer's own words.
    plain = re.compile(r"^(bool success|string message)\s*$")
    fields = [line for line in lines if line.strip() and not line.startswith(("#", "---"))]
    bare = [line for line in fields if "#" not in line and not plain.match(line)]
    # A lone sub-message is explained in its own file.
    bare = [line for line in bare if not line.startswith("sl_interfaces/")]
    assert not bare, f"{file.name}: no meaning at {bare}"


def test_every_interface_is_built() -> None:
    cmake = (ROOT / "src/sl_interfaces/CMakeLists.txt").read_text()
    names = [f"{f.parent.name}/{f.name}" for f in interface_files()]
    missing = [name for name in names if f'"{name}"' not in cmake]
    assert not missing
