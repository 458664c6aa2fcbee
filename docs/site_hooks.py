"""What `make docs` adds to the pages in docs/: the README and its neighbours, messages, the API.

Nothing is listed by hand. Packages are the folders of src/ with a package.xml, modules the files in
them, and a new page in docs/ appears in the navigation by itself. The modules are read as text
(griffe), so neither ROS nor a device library has to be installed.
"""

from __future__ import annotations

import ast
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
#: Pages outside docs/, and where they stand in the site.
NEIGHBOURS = {
    ROOT / "README.md": "index.md",
    ROOT / "CONTRIBUTING.md": "contributing.md",
    ROOT / "SECURITY.md": "security.md",
    ROOT / "CHANGELOG.md": "changelog.md",
}
#: Sections of the navigation with the pages that begin them; all other pages of docs/ are guides.
DEVICES = ("cameras", "stages", "dlpc900", "dlpc350", "faults")
PYTHON = ("python",)
LINK = re.compile(r"(!?)\[([^\]\n]*)\]\(([^)\s#]+)(#[^)\s]*)?\)")
MESSAGE_KINDS = {"msg": "Messages", "srv": "Services", "action": "Actions"}


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the generated pages, and lay the navigation over all of them."""
    for file, uri in NEIGHBOURS.items():
        files.append(File.generated(config, uri, content=file.read_text()))
    reference = [_package_pages(folder, files, config) for folder in packages()]
    files.append(File.generated(config, "reference/interfaces.md", content=_interfaces()))
    guides = [f"{name}.md" for name in sorted(f.stem for f in DOCS.glob("*.md"))
              if name not in (*DEVICES, *PYTHON)]  # fmt: skip
    folders = sorted(f for f in DOCS.iterdir() if f.is_dir() and any(f.glob("*.md")))
    config.nav = [
        {"Overview": "index.md"},
        {"Guides": guides},
        {"Devices": _there(DEVICES)},
        {"Python and ROS": [*_there(PYTHON), "reference/interfaces.md", *reference]},
        *({f.name.capitalize(): _pages_in(f)} for f in folders),
        {"Project": ["contributing.md", "security.md", "changelog.md"]},
    ]
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: Any) -> str:
    """Let links lead where their files stand in the site; those to sources become plain text."""
    uri = page.file.src_uri
    origin = {uri: file for file, uri in NEIGHBOURS.items()}.get(uri, DOCS / uri)

    def moved(link: re.Match[str]) -> str:
        image, text, target, anchor = link.groups(default="")
        if ":" in target:
            return link[0]
        file = (origin.parent / target).resolve()
        place = NEIGHBOURS.get(file)
        if place is None and file.is_relative_to(DOCS) and file.is_file():
            place = file.relative_to(DOCS).as_posix()
        if place is None:
            # What is nowhere stays as it is: mkdocs then reports it.
            return text if file.exists() and file.is_relative_to(ROOT) else link[0]
        return f"{image}[{text}]({posixpath.relpath(place, posixpath.dirname(uri))}{anchor})"

    return LINK.sub(moved, markdown)


def packages() -> Iterator[Path]:
    """Folders of the Python packages of all ROS packages."""
    for manifest in sorted(ROOT.glob("src/*/package.xml")):
        folder = manifest.parent / manifest.parent.name
        if (folder / "__init__.py").is_file():
            yield folder


def _there(names: tuple[str, ...]) -> list[str]:
    return [f"{name}.md" for name in names if (DOCS / f"{name}.md").is_file()]


def _pages_in(folder: Path) -> list[str]:
    return [f.relative_to(DOCS).as_posix() for f in sorted(folder.glob("*.md"))]


# -- the API --------------------------------------------------------------------------------------


def _package_pages(folder: Path, files: Files, config: MkDocsConfig) -> dict[str, list[Any]]:
    """Add the pages of a package and its sub-packages; return their part of the navigation."""
    dotted = _dotted(folder)
    place = "reference/" + dotted.replace(".", "/")
    modules = [f for f in sorted(folder.glob("*.py")) if not f.name.startswith("_")]
    below = [f.parent for f in sorted(folder.glob("*/__init__.py"))]
    index = [f"::: {dotted}\n", "| module | what |\n|---|---|"]
    index += [f"| [`{f.name}`]({f.name}/index.md) | {_summary(f / '__init__.py')} |" for f in below]
    index += [f"| [`{f.stem}`]({f.stem}.md) | {_summary(f)} |" for f in modules]
    files.append(File.generated(config, f"{place}/index.md", content="\n".join(index) + "\n"))
    pages: list[Any] = [{"Overview": f"{place}/index.md"}]
    pages += [_package_pages(sub, files, config) for sub in below]
    for file in modules:
        page = f"{place}/{file.stem}.md"
        files.append(File.generated(config, page, content=f"::: {dotted}.{file.stem}\n"))
        pages.append({file.stem: page})
    return {folder.name: pages}


def _dotted(folder: Path) -> str:
    return ".".join(folder.relative_to(ROOT / "src").parts[1:])


def _summary(file: Path) -> str:
    """First line of a module's docstring."""
    text = ast.get_docstring(ast.parse(file.read_text())) or ""
    return text.partition("\n")[0].replace("|", "\\|")


def _interfaces() -> str:
    """Page of all messages, services and actions, as their files have them."""
    parts = ["# Messages, services and actions\n"]
    for kind, title in MESSAGE_KINDS.items():
        parts.append(f"## {title}\n")
        for file in sorted(ROOT.glob(f"src/*/{kind}/*.{kind}")):
            parts.append(f"### {file.parents[1].name}/{kind}/{file.stem}\n")
            parts.append(f"```text\n{file.read_text().strip()}\n```\n")
    return "\n".join(parts)
