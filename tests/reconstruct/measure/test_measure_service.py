"""The service `measure`: the library's answers over ROS, a word for everything it cannot do."""

from __future__ import annotations

import importlib
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from support import ros_graph
from support.paths import ROOT

ros_graph.require_ros()

from sl_interfaces.srv import Measure  # noqa: E402

from sl_common import topics  # noqa: E402
from sl_common.base_node import RigNode  # noqa: E402
from sl_reconstruct.cloud.cloud import CLOUD_DTYPE  # noqa: E402
from sl_reconstruct.cloud.cloud_writer import save_pcd  # noqa: E402
from sl_reconstruct.cloud.height_map import make_height_map, save_tiff  # noqa: E402
from sl_reconstruct.measure_service_node import MeasureService  # noqa: E402
from support.scenes.measured_clouds import cloud  # noqa: E402

SLOPE = 0.2
ANGLE_DEG = 180.0 - 2.0 * math.degrees(math.atan(SLOPE))
STAMP_NS = 1_700_000_000_123_456_789


def groove() -> np.ndarray:
    return cloud(lambda x, y: SLOPE * np.abs(x), (40, 200)).astype(CLOUD_DTYPE)


class Measurer(RigNode):
    def __init__(self, **options: Any) -> None:
        super().__init__("measurer", **options)
        self.service = MeasureService(self)


@pytest.fixture(scope="module")
def empty() -> Iterator[ros_graph.Graph]:
    """A node that has no cloud yet."""
    with ros_graph.graph() as graph:
        graph.add(Measurer)
        yield graph


@pytest.fixture(scope="module")
def graph() -> Iterator[ros_graph.Graph]:
    with ros_graph.graph() as graph:
        graph.add(Measurer).service.remember(groove(), STAMP_NS)
        yield graph


def call(graph: ros_graph.Graph, **request: Any) -> Any:
    return graph.call(topics.MEASURE, Measure.Request(**request))


def test_the_last_cloud_is_measured(graph) -> None:
    answer = call(graph, kind="groove", tolerance=[ANGLE_DEG - 0.5, ANGLE_DEG + 0.5])
    assert answer.success
    assert (answer.kind, answer.unit, answer.verdict) == ("angle", "deg", "pass")
    assert abs(answer.value - ANGLE_DEG) < 4.0 * answer.uncertainty < 0.5
    assert answer.cloud == "scan 1700000000.123456789"
    assert answer.points > 0.5 * 40 * 200
    assert answer.degrees_of_freedom == answer.points - 6
    assert 0.3e-6 < answer.residual_rms_m < 0.45e-6  # the noise of `cloud`
    assert answer.inflation >= 1.0
    assert answer.names[0] == "included_angle"
    named = dict(zip(answer.names, answer.values, strict=True))
    assert named["first_a"] == pytest.approx(-SLOPE, abs=1e-3)
    assert named["second_a"] == pytest.approx(SLOPE, abs=1e-3)
    assert len(answer.uncertainties) == len(answer.units) == len(answer.names)


def test_a_region_and_a_quantity_are_judged(graph) -> None:
    answer = call(
        graph, kind="plane", region_m=[0.2e-3, -1e-3, 1.8e-3, 1e-3], quantity="a",
        tolerance=[-math.inf, 0.15],
    )  # fmt: skip
    assert (answer.success, answer.verdict, answer.names[1]) == (True, "fail", "a")
    # The sentence says what was judged, to the digits that are known.
    assert re.search(
        r"^flatness .* µm \(k = 1\) .*; a 0\.200\d+ ± 0\.0000\d\d: fail$", answer.message
    )
    corners = np.reshape(answer.region_used_m, (-1, 2))
    np.testing.assert_allclose(corners.min(axis=0), [0.2e-3, -1e-3])
    np.testing.assert_allclose(corners.max(axis=0), [1.8e-3, 1e-3])


def test_a_file_is_measured_and_compared(empty, tmp_path: Path) -> None:
    save_pcd(tmp_path / "cloud.pcd", groove(), organised=True)
    height = make_height_map(groove())
    save_tiff(tmp_path / "height.tiff", height)
    grid = {"x0_m": height.x0_m, "y0_m": height.y0_m, "step_m": height.step_m}
    (tmp_path / "report.json").write_text(json.dumps({"height_map": grid}))
    file = str(tmp_path / "cloud.pcd")
    answer = call(
        empty, kind="deviation", cloud_file=file, reference_file=str(tmp_path / "height.tiff")
    )
    assert answer.success, answer.message
    assert answer.cloud == file
    # Both are the same noise; the map's interpolation at the bend is off by 0.2 of a spacing.
    assert abs(answer.value) < SLOPE * 4e-3 / 200
    assert list(answer.names) == ["mean_deviation", "form_rms", "peak", "valley"]


@pytest.mark.parametrize(
    ("request_", "word"),
    [
        ({"kind": "volume"}, "profile, deviation"),
        ({"kind": ""}, "expected one of plane"),
        ({"kind": "plane", "region_m": [0.0, 0.0, 1.0]}, "3 numbers"),
        ({"kind": "plane", "region_m": [0.0, 0.0, math.nan, 1.0]}, "finite"),
        ({"kind": "plane", "region_m": [5.0, 5.0, 6.0, 6.0]}, "no points"),
        ({"kind": "angle"}, "two rectangles"),
        ({"kind": "plane", "tolerance": [1.0]}, "low, high"),
        ({"kind": "plane", "tolerance": [2.0, 1.0]}, "low < high"),
        ({"kind": "plane", "quantity": "radius"}, "flatness, a, b, c"),
        ({"kind": "deviation"}, "reference_file"),
        ({"kind": "deviation", "reference_file": "/nowhere/height.tiff"}, "nowhere"),
        ({"kind": "plane", "cloud_file": "/nowhere/cloud.pcd"}, "nowhere"),
        ({"kind": "hole"}, "hole"),
    ],
)
def test_what_cannot_be_measured_is_told(graph, request_, word) -> None:
    answer = call(graph, **request_)
    assert not answer.success
    assert word in answer.message
    assert math.isnan(answer.value)
    assert answer.verdict == ""


def test_without_a_cloud_it_says_what_it_waits_for(empty) -> None:
    answer = call(empty, kind="groove")
    assert not answer.success
    assert "no cloud yet" in answer.message


def stock_calls() -> list[tuple[str, str]]:
    """Type and request of every call by the stock tools that the manual shows."""
    root = ROOT
    text = "".join(file.read_text() for file in [root / "README.md", *root.glob("docs/*.md")])
    return re.findall(
        r'^ros2 (?:service|action) .* (sl_interfaces/\S+) "(.*)"$', text, re.MULTILINE
    )


@pytest.mark.parametrize(("kind", "text"), stock_calls())
def test_the_manuals_calls_fit_their_types(kind: str, text: str) -> None:
    """To YAML 1.1, and so to the stock tools, 4e-3 is a word; they then refuse the request."""
    package, group, name = kind.split("/")
    found = getattr(importlib.import_module(f"{package}.{group}"), name)
    types = getattr(found, "Request" if group == "srv" else "Goal").get_fields_and_field_types()
    for field, value in yaml.safe_load(text).items():
        words = [v for v in np.ravel(value).tolist() if isinstance(v, str)]
        assert bool(words) == (types[field] == "string"), (field, value)
