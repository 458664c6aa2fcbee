"""Every public function of two or more arguments says what each of them is."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.paths import SOURCES

Function = ast.FunctionDef | ast.AsyncFunctionDef

FILES = sorted(f for f in SOURCES.glob("sl_*/sl_*/**/*.py"))
#: From the heading to the next one; numpydoc.
PARAMETERS = re.compile(r"^Parameters\n-+\n(.*?)(?:\n\n\w[\w ]*\n---|\Z)", re.DOTALL | re.MULTILINE)
#: A method that does what a documented protocol says.
INHERITED = re.compile(r"See `")


def public_functions(node: ast.Module | ast.ClassDef) -> Iterator[Function]:
    for child in node.body:
        if isinstance(child, ast.ClassDef) and not child.name.startswith("_"):
            yield from public_functions(child)
        elif isinstance(child, Function) and not child.name.startswith("_"):
            yield child


def arguments(function: Function) -> list[str]:
    given = function.args
    stars = [a for a in (given.vararg, given.kwarg) if a]
    names = [a.arg for a in (*given.posonlyargs, *given.args, *given.kwonlyargs, *stars)]
    return [n for n in names if n not in ("self", "cls") and not n.startswith("_")]


def undocumented(function: Function) -> list[str]:
    """Arguments that the docstring does not explain; numpydoc names them at the margin."""
    names, text = arguments(function), ast.get_docstring(function) or ""
    if len(names) < 2 or INHERITED.match(text):
        return []
    section = PARAMETERS.search(text)
    lines = section[1].split("\n") if section else []
    explained = set(
        re.findall(r"\w+", " ".join(line for line in lines if not line.startswith(" ")))
    )
    return [name for name in names if name not in explained]


@pytest.mark.parametrize("file", FILES, ids=lambda f: "/".join(f.relative_to(SOURCES).parts[1:]))
def test_every_argument_is_explained(file: Path) -> None:
    functions = public_functions(ast.parse(file.read_text()))
    lacking = {f"{f.name} (line {f.lineno})": u for f in functions if (u := undocumented(f))}
    assert not lacking


def test_a_missing_argument_is_seen() -> None:
    source = 'def f(a, b):\n    """Do.\n\n    Parameters\n    ----------\n    a : int\n    """'
    (function,) = public_functions(ast.parse(source))
    assert undocumented(function) == ["b"]
