"""The examples of docs/python.md, pasted in their order."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from sl_bringup.cli.main import main
from sl_reconstruct.model.calibration_file import save_calibration
from support import ros_graph
from support.paths import ROOT
from support.scenes.tiny_scans import HEIGHT_M, SLOPE, render, tiny_rig, tiny_sequence, write_images

BLOCKS = re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs/python.md").read_text(), re.M | re.S)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recording of one small scan and its calibration, in the current folder."""
    from sl_projector.sequence.sequence_file import save_sequence

    sequence = tiny_sequence("precise")
    write_images(tmp_path / "images", render(sequence))
    save_sequence(tmp_path / "sequence.yaml", sequence)
    save_calibration(tmp_path / "rig.yaml", tiny_rig())
    monkeypatch.chdir(tmp_path)
    words = ["images", "--sequence", "sequence.yaml", "--calibration", "rig.yaml"]
    assert main(["import", *words, "--output", "bag"]) == 0
    return tmp_path


def test_every_example_runs(folder: Path) -> None:
    ros_graph.require_ros()
    names: dict[str, object] = {"__name__": "example"}
    assert len(BLOCKS) == 6
    for number, block in enumerate(BLOCKS, 1):
        exec(compile(block, f"docs/python.md, block {number}", "exec"), names)
    # The plane that was scanned: z = HEIGHT_M + SLOPE x. Its mean is to be known far better than
    # one point: to a tenth (0.03 um of systematic error were found); the slopes follow.
    found = {q.name: q.value for q in names["answer"].quantities}  # type: ignore[attr-defined]
    atol_m = np.nanmedian(names["points"]["sigma"]) / 10  # type: ignore[index]
    assert abs(found["c"] - HEIGHT_M) < atol_m
    assert abs(found["a"] - SLOPE) < atol_m / 2e-3
    assert abs(found["b"]) < atol_m / 1e-3
    _a_subscriber_gets_the_cloud(names)


def _a_subscriber_gets_the_cloud(names: dict[str, object]) -> None:
    from sl_common import topics
    from sl_reconstruct.messages import cloud_to_msg
    from support.patience import wait

    with ros_graph.graph() as graph:
        listener = names["Listener"](context=graph.context)  # type: ignore[operator]
        graph.executor.add_node(listener)
        publisher = graph.publisher(topics.POINTS)
        publisher.publish(cloud_to_msg(names["cloud"].points, 1))  # type: ignore[attr-defined]
        wait(lambda: listener.heights, "the cloud")
        assert listener.heights[0] == np.nanmedian(names["points"]["z"])  # type: ignore[index]
        graph.executor.remove_node(listener)
        listener.destroy_node()
