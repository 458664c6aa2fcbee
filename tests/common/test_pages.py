"""Pages of reports: text is escaped, nothing is missing, and nothing else is needed."""

from pathlib import Path

import jinja2
import pytest

from sl_common.json_file import plain_value
from sl_common.pages.page import number, render_page
from support.paths import SOURCES

TEMPLATE = """{% extends "base.html" %}
{% from "parts.html" import picture, row, table, verdict %}
{% block content %}
{{ verdict(false, words) }}
<table>{{ row(words, 3) }}{{ row("unknown", none) }}</table>
{{ table([words], [[words], ["1\\n2"]]) }}
{{ picture(words, png) }}
{% endblock %}
"""
BAD = "<script>alert('&')</script>"


def page(folder: Path, **content: object) -> str:
    (folder / "any.html").write_text(TEMPLATE)
    return render_page(folder / "any.html", **content)


def test_all_text_is_escaped(tmp_path: Path) -> None:
    text = page(tmp_path, title=BAD, words=BAD, png=b"picture")
    assert "<script" not in text
    assert text.count("&lt;script&gt;") == 8
    assert "<pre>1\n2</pre>" in text
    assert "unknown" not in text


def test_a_page_needs_no_other_file(tmp_path: Path) -> None:
    text = page(tmp_path, title="t", words="w", png=b"picture")
    assert ".verdict {" in text
    assert 'src="data:image/png;base64,cGljdHVyZQ=="' in text
    assert "href" not in text


def test_what_a_template_names_must_be_there(tmp_path: Path) -> None:
    with pytest.raises(jinja2.UndefinedError, match="words"):
        page(tmp_path, title="t", png=b"")


def test_numbers_for_people() -> None:
    assert number(1.23456e-6, ".3g µm", 1e6) == "1.23 µm"
    assert number(255, " DN") == "255 DN"
    assert number(None) == number(float("nan")) == ""
    assert number(float("inf"), ".2f s", missing="-") == "-"


def test_json_knows_no_nan_and_no_arrays() -> None:
    assert plain_value({1: (float("nan"), 2.5)}) == {"1": [None, 2.5]}


def test_every_template_is_well_formed() -> None:
    """Each compiles, and none writes text past the escaping."""
    files = sorted(SOURCES.glob("*/*/**/*.html"))
    assert len(files) >= 7
    for file in files:
        jinja2.Environment(autoescape=True).parse(file.read_text())
        assert "safe" not in file.read_text().split()
