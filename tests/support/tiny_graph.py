"""Nodes on drivers without devices, and what they make of the tiny plane."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from support import ros_graph

ros_graph.require_ros()

from sensor_msgs.msg import PointCloud2  # noqa: E402

from sl_calibration.calibration_node import CalibrationNode  # noqa: E402
from sl_common import topics  # noqa: E402
from sl_projector.projector_node import ProjectorNode  # noqa: E402
from sl_reconstruct.messages import cloud_from_msg  # noqa: E402
from support.devices.fake_devices import FakeProjector  # noqa: E402
from support.ros_graph import Graph  # noqa: E402
from support.scenes.tiny_scans import HEIGHT_M, SLOPE, render, tiny_sequence  # noqa: E402

SEQUENCE = tiny_sequence("precise")
PERIOD_NS = 20_000_000
HEIGHT, WIDTH = 12, 16
#: Of a cloud of `tiny_scans`: 0.5 DN noise and 180 DN contrast give edges to better than 0.02 px,
#: a camera pixel is 42 um on the part and the devices are 25 degrees apart, so 1-sigma of z is
#: below 0.02 * 42 um / tan(25 deg) = 1.8 um. The mean over thousands of points is far below that.
PLANE_TOLERANCE_M = 2e-6


def set_parameters(node: str) -> topics.Service:
    return topics.Service(f"{node}/set_parameters", "rcl_interfaces/srv/SetParameters")


@cache
def frames(name: str) -> np.ndarray:
    return render(tiny_sequence(name))


def assert_plane(message: PointCloud2) -> None:
    """The cloud is the tiny plane, in the world, in metres."""
    assert message.header.frame_id == "sl_world"
    assert [f.name for f in message.fields] == ["x", "y", "z", "intensity", "sigma"]
    assert (message.height, message.width, message.is_dense) == (120, 128, False)
    points = cloud_from_msg(message)
    there = np.isfinite(points["z"])
    assert there.mean() > 0.5
    error = points["z"] - (HEIGHT_M + SLOPE * points["x"])
    assert abs(np.median(error[there])) < PLANE_TOLERANCE_M
    assert np.median(np.abs(error[there])) < PLANE_TOLERANCE_M


def calibrated_by(graph: Graph, calibration: Path) -> CalibrationNode:
    """The node that owns the calibration in force."""
    return graph.add(
        CalibrationNode, calibration_file=str(calibration), store_dir=str(calibration.parent)
    )


def tiny_projector(make: Callable[[], FakeProjector], **options: object) -> ProjectorNode:
    """A projector node whose DMD has the size of `tiny_scans`."""
    node = ProjectorNode(make, **options)
    node._model = FakeProjector().model
    return node
