"""What README and docs/ mention is there: files, modules, links; and every room has its line."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.paths import ROOT

#: A changelog names what once was.
PAGES = sorted(
    {*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")} - {ROOT / "CHANGELOG.md"}
)  # fmt: skip
EVERY_PAGE = pytest.mark.parametrize(
    "page", [pytest.param(p, id=str(p.relative_to(ROOT))) for p in PAGES]
)
PACKAGES = sorted(m.parent.name for m in (ROOT / "src").glob("*/package.xml"))

PATH = re.compile(r"(?<![\w/.-])(?:src|docs|tests|benchmarks|examples)/[\w./*-]*")
#: Below a package: `sl_camera/sync`, `sl_interfaces/srv/Scan`.
PACKAGE_PATH = re.compile(rf"(?<![\w/.-])(?:{'|'.join(PACKAGES)})/[\w./*-]*")
MODULE = re.compile(rf"(?<![\w/.])(?:{'|'.join(PACKAGES)})(?:\.\w+)+(?!\w*/)")
#: A file named alone: `test_stage_faults.py`.
PYTHON_FILE = re.compile(r"`([\w*]+\.py)`")
LINK = re.compile(r"\]\(([^)\s#]+)(?:#[^)\s]*)?\)")


def mentioned(pattern: re.Pattern[str], page: Path) -> Iterator[str]:
    for line in page.read_text().splitlines():
        yield from (m.rstrip(".") for m in pattern.findall(line))


def exists(*patterns: str) -> bool:
    return any(next(ROOT.glob(pattern), None) for pattern in patterns)


@EVERY_PAGE
def test_every_file_that_is_mentioned_exists(page: Path) -> None:
    missing = [path for path in mentioned(PATH, page) if not exists(path.rstrip("/"))]
    missing += [path for path in mentioned(PACKAGE_PATH, page) if not in_package(path.rstrip("/"))]
    folders = ("src/**", "tests/**", "benchmarks", "docs")
    missing += [
        name for name in mentioned(PYTHON_FILE, page)
        if not exists(*(f"{folder}/{name}" for folder in folders))
    ]  # fmt: skip
    assert not missing


def in_package(path: str) -> bool:
    """Whether a path that begins with a package is there, or is the name of an interface."""
    return exists(f"src/{path.partition('/')[0]}/{path}", f"src/{path}", f"src/{path}.*")


@EVERY_PAGE
def test_every_module_that_is_mentioned_exists(page: Path) -> None:
    missing = [name for name in mentioned(MODULE, page) if not resolves(name)]
    assert not missing


def resolves(name: str) -> bool:
    """Whether a dotted name is a package, a module, or something that a module defines."""
    package, *parts = name.split(".")
    if package == "sl_interfaces":
        return in_package(name.replace(".", "/"))
    place = ROOT / "src" / package / package
    while parts and (place / parts[0]).is_dir():
        place /= parts.pop(0)
    if parts and place.joinpath(f"{parts[0]}.py").is_file():
        place /= f"{parts.pop(0)}.py"
    body = ast.parse((place if place.is_file() else place / "__init__.py").read_text()).body
    for part in parts:
        found = next((node for node in body if part in defined(node)), None)
        if found is None:
            return False
        body = getattr(found, "body", [])
    return True


def defined(node: ast.stmt) -> set[str]:
    """Names that a statement of a module or class defines."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
        return {node.name}
    if isinstance(node, ast.ImportFrom):
        return {alias.asname or alias.name for alias in node.names}
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return {target.id for target in targets if isinstance(target, ast.Name)}


@EVERY_PAGE
def test_relative_links_lead_somewhere(page: Path) -> None:
    links = [link for link in mentioned(LINK, page) if "://" not in link]
    assert not [link for link in links if not (page.parent / link).exists()]


@EVERY_PAGE
def test_a_page_begins_with_what_it_is_for(page: Path) -> None:
    title, blank, first = page.read_text().splitlines()[:3]
    assert title.startswith("# ")
    assert not blank
    assert re.match(r"[A-Z`]|\*\*Decided:\*\* ", first), "expected a sentence below the title"


def test_a_decision_has_the_number_of_its_file() -> None:
    decisions = sorted((ROOT / "docs/decisions").glob("*.md"))
    titles = [page.read_text().partition(":")[0] for page in decisions]
    assert titles == [f"# {page.name[:4]}" for page in decisions]
    assert len(set(titles)) == len(titles)


def test_the_readme_has_a_line_for_every_room() -> None:
    section = (ROOT / "README.md").read_text().partition("## Where things are")[2]
    lines = re.findall(r"^\| \**`([\w/]+)`\** \| \S", section, re.MULTILINE)
    rooms = [
        init.parent.relative_to(ROOT / "src" / package).as_posix()
        for package in PACKAGES
        for init in (ROOT / "src" / package / package).rglob("__init__.py")
    ]
    assert sorted({*rooms, *PACKAGES} - set(lines)) == []
    assert len(lines) == len(set(lines))
