"""The nodes against bad messages and failing devices: a clear word each, alive, the next one right.

Real nodes in one process, drivers without devices, a private ROS domain.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from support import ros_graph

ros_graph.require_ros()

from geometry_msgs.msg import Point, PoseStamped  # noqa: E402
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import Image, PointCloud2  # noqa: E402
from sl_interfaces.action import Scan as ScanAction  # noqa: E402
from sl_interfaces.msg import MatchedFrame, PatternStack, PatternTrigger, RigCalibration  # noqa: E402
from sl_interfaces.msg import Pattern as PatternMsg  # noqa: E402
from sl_interfaces.srv import Measure, MoveStage, Project, Scan  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from sl_bench.dlpc.dlpc900_emulator import Dlpc900Emulator  # noqa: E402
from sl_bench.dlpc.usb_server import EmulatedUsb, UsbSocketServer  # noqa: E402
from sl_calibration.calibration_node import CalibrationNode  # noqa: E402
from sl_camera.camera.camera import Frame, FrameStatus  # noqa: E402
from sl_camera.camera_node import CameraNode  # noqa: E402
from sl_camera.stage_node import StageNode  # noqa: E402
from sl_camera.synchronizer_node import SynchronizerNode  # noqa: E402
from sl_common import topics  # noqa: E402
from sl_common.errors import ConfigError, DeviceError, DeviceLost, StackError  # noqa: E402
from sl_common.messages import stamp_from_msg, stamp_to_msg  # noqa: E402
from sl_projector.projector_node import ProjectorNode  # noqa: E402
from sl_projector.sequence.messages import image_to_msg, pose_to_msg, stack_to_msg, trigger_to_msg  # noqa: E402
from sl_projector.sequence.stack import Stack, StagePose  # noqa: E402
from sl_reconstruct.cloud.cloud_writer import cloud_hash  # noqa: E402
from sl_reconstruct.cloud.refusals import REFUSALS, Reason  # noqa: E402
from sl_reconstruct.messages import cloud_from_msg, refusals_from_msg  # noqa: E402
from sl_reconstruct.model.calibration_file import dump_calibration, rig_hash, save_calibration  # noqa: E402
from sl_reconstruct.reconstruct_node import ReconstructNode  # noqa: E402
from support.fake_devices import FakeCamera, FakeProjector, FakeStage, WiredPair  # noqa: E402
from support.patience import PATIENCE_S, patience, wait  # noqa: E402
from support.ros_graph import Graph  # noqa: E402
from support.tiny_scans import HEIGHT_M, SLOPE, render, tiny_rig, tiny_sequence  # noqa: E402

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


# -- synchronizer ---------------------------------------------------------------------------------


class Feed:
    """Triggers, images and poses for a synchroniser, and what it says."""

    def __init__(self, graph: Graph) -> None:
        self.node = graph.add(SynchronizerNode, timeout_s=0.4, early_image_s=0.4)
        self.triggers = graph.publisher(topics.TRIGGER)
        self.images = graph.publisher(topics.IMAGE)
        self.poses = graph.publisher(topics.POSE)
        self.frames = graph.collect(topics.FRAME)
        self.stacks = graph.collect(topics.STACK)
        self.scan_id = 0
        self.clock_ns = time.time_ns()
        self.rng = np.random.default_rng(5)

    def scan(
        self,
        images: Callable[[list[Image]], list[Image]] = lambda x: x,
        triggers: Callable[[list[PatternTrigger]], list[PatternTrigger]] = lambda x: x,
        poses: Callable[[list[PoseStamped]], list[PoseStamped]] = lambda x: x,
    ) -> tuple[MatchedFrame, np.ndarray]:
        """Publish one scan, changed on the way, and wait for its verdict."""
        self.scan_id += 1
        self.frames.clear(), self.stacks.clear()
        # Scans are apart in time as real ones are, whatever the pace of the test.
        self.clock_ns += 2 * len(SEQUENCE) * PERIOD_NS
        start_ns = self.clock_ns
        stamps = [start_ns + i * PERIOD_NS for i in range(len(SEQUENCE))]
        pixels = self.rng.integers(0, 256, (len(SEQUENCE), HEIGHT, WIDTH), dtype=np.uint8)
        for message in poses([pose(start_ns - 1000), pose(stamps[-1] + PERIOD_NS)]):
            self.poses.publish(message)
        wanted = [
            trigger_to_msg(SEQUENCE, i, self.scan_id, stamp, 0.019)
            for i, stamp in enumerate(stamps)
        ]
        for message in triggers(wanted):
            self.triggers.publish(message)
        sent = [image_to_msg(p, s) for p, s in zip(pixels, stamps, strict=True)]
        for image in images(sent):
            self.images.publish(image)
        return wait(self.verdict, "a verdict of the synchronizer"), pixels

    def verdict(self) -> MatchedFrame | None:
        over = (MatchedFrame.STACK_COMPLETE, MatchedFrame.STACK_REFUSED)
        return next((f for f in list(self.frames) if f.status in over), None)


def pose(stamp_ns: int, x_m: float = 0.0) -> PoseStamped:
    return pose_to_msg(StagePose(stamp_ns, (x_m, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))


@pytest.fixture(scope="module")
def feed() -> Iterator[Feed]:
    with ros_graph.graph() as graph:
        yield Feed(graph)


def changed(index: int, **fields: object) -> Callable[[list[Image]], list[Image]]:
    """Change fields of one image."""

    def change(messages: list[Image]) -> list[Image]:
        for name, value in fields.items():
            setattr(messages[index], name, value)
        return messages

    return change


def shifted(messages: list[PatternTrigger]) -> list[PatternTrigger]:
    messages[2].pattern.bits = 0
    return messages


def test_a_good_scan_becomes_a_stack_of_the_same_bits(feed: Feed) -> None:
    verdict, pixels = feed.scan()
    assert verdict.status == MatchedFrame.STACK_COMPLETE
    stack = wait(lambda: feed.stacks and feed.stacks[0], "the stack")
    assert (stack.scan_id, stack.sequence) == (feed.scan_id, "precise")
    assert (stack.height, stack.width, stack.encoding) == (HEIGHT, WIDTH, "mono8")
    assert bytes(stack.data) == pixels.tobytes()
    assert [stamp_from_msg(s) for s in stack.stamps] == sorted(
        stamp_from_msg(s) for s in stack.stamps
    )
    assert stack.stage_pose.header.frame_id == "sl_world"


@pytest.mark.parametrize(
    ("part", "change", "word"),
    [
        ("images", changed(3, encoding="rgb8"), "encoding"),
        ("images", changed(3, width=WIDTH + 1), "bytes"),
        ("images", changed(3, data=b""), "0 bytes"),
        ("images", changed(3, data=bytes(3_000_000)), "3000000 bytes"),
        ("images", changed(3, height=2**32 - 1, width=2**32 - 1), "bytes"),
        ("images", lambda m: m[:3] + m[4:], "image"),
        ("images", lambda m: [*m[:3], m[4], m[3], *m[5:]], "order"),
        ("images", lambda m: m[:4] + m[3:], "twice"),
        ("images", lambda m: [], "image"),
        ("triggers", lambda m: m[:3] + m[4:], "trigger"),
        ("triggers", lambda m: m[:4] + m[3:], "twice"),
        ("triggers", shifted, "trigger"),
        ("poses", lambda m: [m[0], pose(stamp_from_msg(m[1].header.stamp), math.nan)], "number"),
        ("poses", lambda m: [m[0], pose(stamp_from_msg(m[1].header.stamp), 1e-3)], "moved"),
    ],
)
def test_a_spoilt_scan_is_refused_with_a_reason_and_the_next_one_is_right(
    feed: Feed, part: str, change: Callable[[list[object]], list[object]], word: str
) -> None:
    verdict, _ = feed.scan(**{part: change})  # type: ignore[arg-type]
    assert verdict.status == MatchedFrame.STACK_REFUSED
    reasons = " | ".join([verdict.reason, *(f.reason for f in feed.frames)])
    assert word in reasons
    assert not feed.stacks
    verdict, pixels = feed.scan()
    assert verdict.status == MatchedFrame.STACK_COMPLETE, verdict.reason
    stack = wait(lambda: feed.stacks and feed.stacks[0], "the stack")
    assert bytes(stack.data) == pixels.tobytes()


# -- reconstruct ----------------------------------------------------------------------------------


def stack_message(name: str = "precise", scan_id: int = 1) -> PatternStack:
    """A good stack of the tiny plane."""
    sequence = tiny_sequence(name)
    start_ns = time.time_ns()
    stamps = tuple(start_ns + i * PERIOD_NS for i in range(len(sequence)))
    still = StagePose(start_ns, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    stack = Stack(frames(name), sequence, scan_id, stamps, 0.019, still)
    return stack_to_msg(stack)


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


class Works:
    """A reconstruction node with the tiny rig's calibration, and what it publishes."""

    def __init__(self, graph: Graph, calibration: Path) -> None:
        self.graph = graph
        self.owner = calibrated_by(graph, calibration)
        self.node = graph.add(ReconstructNode)
        self.stacks = graph.publisher(topics.STACK)
        self.clouds = graph.collect(topics.POINTS)
        self.refusals = graph.collect(topics.REFUSALS)
        self.reports = graph.collect(topics.REPORT)
        wait(lambda: self.node.health().level == "ok", "the kernels", 200.0)

    def refused(self) -> int:
        return int(sum(n for what, n in self.node.counts.items() if "refused" in what))

    def expect_refusal(self, message: PatternStack, word: str) -> None:
        before = self.refused()
        self.stacks.publish(message)
        wait(lambda: self.refused() > before, "a refusal")
        assert word in self.node.last_error

    def expect_plane(self) -> None:
        self.clouds.clear()
        self.stacks.publish(stack_message())
        assert_plane(wait(lambda: self.clouds and self.clouds[0], "the cloud", 60.0))


@pytest.fixture(scope="module")
def works(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Works]:
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    save_calibration(path, tiny_rig())
    with ros_graph.graph() as graph:
        yield Works(graph, path)


def with_fields(**fields: object) -> PatternStack:
    message = stack_message()
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def exchanged() -> PatternStack:
    """Two images with each other's content, as no time stamp betrays."""
    message = stack_message()
    images = frames("precise").copy()
    images[[4, 5]] = images[[5, 4]]
    message.data = images.tobytes()
    return message


def disordered() -> PatternStack:
    message = stack_message()
    message.stamps[3] = message.stamps[2]
    return message


def test_a_stack_that_nobody_asked_for_becomes_a_cloud(works: Works) -> None:
    works.expect_plane()


def test_every_position_without_a_point_has_its_reason(works: Works) -> None:
    works.refusals.clear()
    works.reports.clear()
    works.expect_plane()
    image = wait(lambda: works.refusals and works.refusals[0], "the refusals")
    report = wait(lambda: works.reports and works.reports[0], "the report")
    cloud, codes = works.clouds[0], refusals_from_msg(image)
    assert image.header.stamp == cloud.header.stamp
    np.testing.assert_array_equal(codes == 0, np.isfinite(cloud_from_msg(cloud)["z"]))
    counted = {REFUSALS[Reason(code)]: np.count_nonzero(codes == code) for code in range(2, 12)}
    assert counted == {item.reason: item.count for item in report.refused}
    assert report.points + sum(counted.values()) == report.lit_positions
    image.height += 1
    with pytest.raises(StackError, match="121 x 128 with 15360 bytes"):
        refusals_from_msg(image)


def test_the_last_cloud_can_be_measured(works: Works) -> None:
    works.expect_plane()
    answer = works.graph.call(topics.MEASURE, Measure.Request(kind="plane"))
    assert answer.success, answer.message
    slope = dict(zip(answer.names, answer.values, strict=True))["a"]
    # Over 5 mm and more a tilt shifts the border by the plane's tolerance.
    assert slope == pytest.approx(SLOPE, abs=PLANE_TOLERANCE_M / 2.5e-3)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (PatternStack, "dmd_size"),
        (lambda: with_fields(data=b""), "0 bytes"),
        (lambda: with_fields(data=bytes(5_000_000)), "5000000 bytes"),
        (lambda: with_fields(encoding="rgb8"), "rgb8"),
        (lambda: with_fields(encoding="mono16"), "bytes"),
        (lambda: with_fields(width=2**32 - 1, height=2**32 - 1), "bytes"),
        (lambda: with_fields(width=160, height=240), "expected"),
        (lambda: with_fields(dmd_columns=1024, dmd_rows=768), "1024"),
        (lambda: with_fields(dmd_columns=0), "dmd_size"),
        (lambda: with_fields(patterns=[PatternMsg(kind="sine")]), "sine"),
        (lambda: with_fields(stamps=[]), "0 stamps"),
        (disordered, "stamps"),
        (exchanged, "image"),
        (lambda: with_fields(data=bytes(frames("precise").size)), "no points"),
    ],
)
def test_a_bad_stack_is_refused_with_a_word_and_the_next_one_is_right(
    works: Works, make: Callable[[], PatternStack], word: str
) -> None:
    works.expect_refusal(make(), word)
    works.expect_plane()


def set_calibration(works: Works, path: Path) -> tuple[bool, str]:
    request = SetParameters.Request(
        parameters=[Parameter("calibration_file", value=str(path)).to_parameter_msg()]
    )
    answer = works.graph.call(set_parameters("calibration"), request)
    return answer.results[0].successful, answer.results[0].reason


def test_a_calibration_cut_in_half_is_refused_and_the_old_one_stays(
    works: Works, tmp_path: Path
) -> None:
    text = dump_calibration(tiny_rig())
    half = tmp_path / "half.yaml"
    half.write_text(text[: len(text) // 2])
    before = works.node.health().values["calibration"]
    successful, reason = set_calibration(works, half)
    assert not successful
    assert "half.yaml" in reason
    assert works.node.health().values["calibration"] == before == rig_hash(tiny_rig())
    assert works.owner.health().values["calibration"] == before
    works.expect_plane()


def test_the_calibration_in_force_is_latched_for_who_comes_late(works: Works) -> None:
    found = works.graph.collect(topics.CALIBRATION)
    message = wait(lambda: found and found[0], "the latched calibration")
    assert works.graph.tester.count_publishers(topics.CALIBRATION.name) == 1
    assert message.hash == rig_hash(tiny_rig())
    assert (message.camera.width, message.camera.height) == (320, 120)
    assert message.projector.header.frame_id == "sl_projector_optical"
    assert list(message.camera.k[:3]) == [2400.0, 0.0, 159.5]


def test_a_false_calibration_message_changes_nothing(works: Works) -> None:
    rigs = works.graph.publisher(topics.CALIBRATION)
    for yaml in ("", "format: 1\ncamera: [", dump_calibration(tiny_rig())):
        before = works.refused()
        message = RigCalibration(hash="0" * 64, source="test", yaml=yaml)
        message.header.stamp = stamp_to_msg(time.time_ns())
        rigs.publish(message)
        wait(lambda b=before: works.refused() > b, "a refusal")
    works.graph.tester.destroy_publisher(rigs)
    works.expect_plane()


def test_without_a_calibration_a_node_says_so_until_its_file_is_there(tmp_path: Path) -> None:
    path = tmp_path / "later.yaml"
    path.write_text(dump_calibration(tiny_rig())[:500])
    with ros_graph.graph() as graph:
        owner = calibrated_by(graph, path)
        node = graph.add(ReconstructNode)
        stacks = graph.publisher(topics.STACK)
        clouds = graph.collect(topics.POINTS)
        stacks.publish(stack_message())
        wait(lambda: node.counts["synchronizer/stack refused"], "a refusal", 60.0)
        assert node.health().level == "warn"
        assert owner.health().level == "error"
        assert "later.yaml" in owner.health().message
        save_calibration(path, tiny_rig())
        wait(lambda: node.health().values["calibration"], "the calibration")
        stacks.publish(stack_message())
        assert_plane(wait(lambda: clouds and clouds[0], "the cloud", 60.0))
        assert node.health().level == "ok"


# -- projector ------------------------------------------------------------------------------------


def project(graph: Graph, name: str = "paper", exposure_s: float = 0.004) -> Project.Response:
    request = Project.Request(sequence=name, exposure_s=exposure_s)
    return graph.call(topics.PROJECT, request)


def test_each_trigger_is_published_at_its_exposure_and_not_before(tmp_path: Path) -> None:
    outside = tmp_path / "outside.yaml"
    outside.write_text("- {kind: white}\n")
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside" / "mine.yaml").write_text(
        "format: 1\nname: mine\ndmd_size: [128, 96]\npatterns:\n- {kind: white}\n- {kind: black}\n"
    )
    arrived: list[tuple[int, PatternTrigger]] = []
    with ros_graph.graph() as graph:
        driver = FakeProjector()
        graph.add(tiny_projector, lambda: driver, sequence_dir=str(tmp_path / "inside"))
        graph.tester.listen(topics.TRIGGER, lambda m: arrived.append((time.time_ns(), m)))
        wait(lambda: driver.opened, "the projector")
        wait(lambda: graph.tester.count_publishers(topics.TRIGGER.name), "its triggers")
        assert project(graph, "mine").success
        answer = project(graph, "paper", 0.02)
        assert answer.success
        count = len(tiny_sequence("paper"))
        assert answer.count == count
        wait(lambda: len(arrived) == 2 + count, "all triggers")
        for name in ("../outside", "outside", "/etc/passwd", str(outside), "mine/../../outside"):
            refused = project(graph, name)
            assert (refused.success, refused.count) == (False, 0)
            assert "no sequence is called" in refused.message
    messages = [m for _, m in arrived[2:]]
    assert [m.index for m in messages] == list(range(count))
    assert {(m.scan_id, m.count, m.sequence) for m in messages} == {
        (answer.scan_id, count, "paper")
    }
    stamps = [stamp_from_msg(m.header.stamp) for m in messages]
    assert np.diff(stamps).tolist() == [20_000_000] * (count - 1)
    assert all(at_ns >= stamp for (at_ns, _), stamp in zip(arrived[2:], stamps, strict=True))


def tiny_projector(make: Callable[[], FakeProjector], **options: object) -> ProjectorNode:
    """A projector node whose DMD has the size of `tiny_scans`."""
    node = ProjectorNode(make, **options)
    node._model = FakeProjector().model
    return node


def test_a_projector_that_is_missing_is_told_and_found_when_it_comes() -> None:
    with ros_graph.graph() as graph:
        driver = FakeProjector()
        driver.gone = True
        node = graph.add(tiny_projector, lambda: driver)
        answer = project(graph)
        assert not answer.success
        assert "not connected" in answer.message
        assert node.health().level == "error"
        driver.gone = False
        wait(lambda: node.health().level == "ok", "the projector")
        assert project(graph).success
        driver.gone = True
        wait(lambda: node.health().level == "error", "the loss to be noticed")
        driver.gone = False
        wait(lambda: project(graph).success, "the projector to be back")
        driver.fault = DeviceError("sequencer abort")
        answer = project(graph)
        assert (answer.success, answer.message) == (False, "sequencer abort")
        driver.fault = None
        assert project(graph).success


def test_trigger_outputs_are_as_the_parameters_say(tmp_path: Path) -> None:
    dmd = Dlpc900Emulator()
    server = UsbSocketServer(str(tmp_path / "usb"), EmulatedUsb(dmd))
    with ros_graph.graph() as graph:
        node = graph.add(
            ProjectorNode, device=f"socket:{tmp_path}/usb",
            trigger_out_rising_delay_s=[1e-3, -20e-6], trigger_out_inverted=[True, False],
        )  # fmt: skip
        wait(lambda: node.health().level == "ok", "the projector")
        for command, inverted, rising_us in ((0x1A1D, 1, 1000), (0x1A1E, 0, -20)):
            (reply,) = dmd.receive(struct.pack("<BBHH", 0xC0, 1, 2, command))
            assert struct.unpack_from("<Bhh", reply, 4) == (inverted, rising_us, 0)
        with pytest.raises(ConfigError, match="two outputs"):
            graph.add(ProjectorNode, trigger_out_rising_delay_s=[0.0])
    server.close()


def test_a_busy_projector_refuses_and_stop_ends_what_it_shows() -> None:
    with ros_graph.graph() as graph:
        driver = FakeProjector()
        graph.add(tiny_projector, lambda: driver)
        wait(lambda: driver.opened, "the projector")
        request = Project.Request(sequence="paper", exposure_s=5.0)
        first = graph.call_async(topics.PROJECT, request)
        wait(lambda: driver._info, "the first projection")
        busy = project(graph)
        assert not busy.success
        assert "busy" in busy.message
        assert graph.call(topics.STOP_PROJECTOR, Trigger.Request()).success
        wait(first.done, "the first projection's end")
        assert not first.result().success
        assert project(graph).success
        for exposure_s in (-1.0, math.nan, 1e9):
            assert "exposure" in project(graph, exposure_s=exposure_s).message


# -- camera ---------------------------------------------------------------------------------------


def test_the_camera_publishes_whole_frames_with_their_info_and_comes_back() -> None:
    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 4096, (HEIGHT, WIDTH), dtype=np.uint16)
    with ros_graph.graph() as graph:
        driver = FakeCamera()
        driver.gone = True
        node = graph.add(CameraNode, lambda: driver)
        images = graph.collect(topics.IMAGE)
        infos = graph.collect(topics.CAMERA_INFO)
        driver.gone = False
        wait(lambda: driver.armed == 1, "the camera")
        driver.frames.put(Frame(pixels, 1, 10**18, 0.01, FrameStatus.INCOMPLETE))
        driver.frames.put(Frame(pixels, 2, 10**18 + 7, 0.01))
        driver.frames.put(DeviceLost("unplugged"))
        wait(lambda: driver.armed == 2, "the camera to be found again")
        driver.frames.put(Frame(pixels, 1, 10**18 + 9, 0.01))
        wait(lambda: len(images) == 2 and len(infos) == 2, "two images")
        assert [stamp_from_msg(m.header.stamp) for m in images] == [10**18 + 7, 10**18 + 9]
        assert [m.header for m in infos] == [m.header for m in images]
        image = images[0]
        assert (image.height, image.width, image.step) == (HEIGHT, WIDTH, 2 * WIDTH)
        assert (image.encoding, image.header.frame_id) == ("mono16", "sl_camera_optical")
        assert bytes(image.data) == pixels.astype("<u2").tobytes()
        assert list(infos[0].k) == [0.0] * 9  # no calibration: "uncalibrated" (CameraInfo.msg)
        assert node.health().values["times lost"] == 1


def test_exposure_is_a_parameter_and_what_the_camera_cannot_is_refused() -> None:
    with ros_graph.graph() as graph:
        driver = FakeCamera()
        graph.add(CameraNode, lambda: driver)
        wait(lambda: driver.armed, "the camera")

        def set_exposure(value: float) -> tuple[bool, str]:
            parameter = Parameter("exposure_s", value=value).to_parameter_msg()
            request = SetParameters.Request(parameters=[parameter])
            result = graph.call(set_parameters("camera"), request).results[0]
            return result.successful, result.reason

        assert set_exposure(0.02)[0]
        assert driver.settings is not None
        assert driver.settings.exposure_s == 0.02
        successful, reason = set_exposure(2.0)
        assert not successful
        assert "1 s at most" in reason
        assert not set_exposure(-1.0)[0]
        assert driver.settings.exposure_s == 0.02
        armed = driver.armed
        assert set_exposure(0.03)[0]
        assert driver.armed > armed


def test_a_software_triggered_camera_follows_the_projector() -> None:
    """Frames get the stamp of the pattern in which they were exposed wholly, or are thrown away."""
    with ros_graph.graph() as graph:
        driver = FakeCamera()
        node = graph.add(CameraNode, lambda: driver, trigger="software", exposure_s=0.01)
        images = graph.collect(topics.IMAGE)
        wait(lambda: driver.armed, "the camera")
        triggers = graph.publisher(topics.TRIGGER)

        def show(pattern_s: float) -> int:
            message = PatternTrigger(exposure_s=pattern_s)
            stamp_ns = time.time_ns()
            message.header.stamp = stamp_to_msg(stamp_ns)
            triggers.publish(message)
            return stamp_ns

        def expose(start_ns: int) -> None:
            driver.frames.put(Frame(np.zeros((4, 4), np.uint8), 1, start_ns, 0.01))

        first_ns = show(5.0)
        wait(lambda: driver.triggered == 1, "a software trigger")
        expose(first_ns + 300_000_000)
        wait(lambda: images, "the image")
        assert stamp_from_msg(images[0].header.stamp) == first_ns
        assert graph.call(topics.TRIGGER_CAMERA, Trigger.Request()).success
        assert driver.triggered == 2

        second_ns = show(5.0)
        wait(lambda: driver.triggered == 3, "a software trigger")
        expose(second_ns + 4_995_000_000)  # ends 5 ms after its pattern
        wait(lambda: "ended" in node.last_error, "the complaint")
        show(0.012)  # 5 ms to settle and 10 ms of exposure do not fit
        wait(lambda: "needs 0.015 s" in node.last_error, "the complaint")
        assert (driver.triggered, len(images)) == (3, 1)


def test_another_makers_driver_serves_by_remapping_its_image() -> None:
    """A node of its own namespace and frame, best it can: stamps 3 ms late, rows padded."""
    from rclpy.node import Node

    with ros_graph.graph() as graph:
        graph.add(SynchronizerNode, timeout_s=0.4, require_pose=False)
        driver = Node(
            "pylon", namespace="maker", context=graph.context,
            cli_args=["--ros-args", "-r", "~/image_raw:=/sl/camera/image_raw"],
        )  # fmt: skip
        publisher = driver.create_publisher(Image, "~/image_raw", 30)
        assert publisher.topic_name == "/sl/camera/image_raw"
        stacks = graph.collect(topics.STACK)
        verdicts = graph.collect(topics.FRAME)
        triggers = graph.publisher(topics.TRIGGER)
        wait(publisher.get_subscription_count, "the synchroniser")
        pixels = np.random.default_rng(8).integers(0, 256, (len(SEQUENCE), 6, 7), np.uint8)

        def scan(scan_id: int, images: list[int]) -> None:
            start_ns = time.time_ns()
            for i in range(len(SEQUENCE)):
                stamp_ns = start_ns + i * PERIOD_NS
                triggers.publish(trigger_to_msg(SEQUENCE, i, scan_id, stamp_ns, 0.019))
            for i in images:
                padded = np.zeros((6, 10), np.uint8)
                padded[:, :7] = pixels[i]
                message = Image(height=6, width=7, step=10, encoding="mono8")
                message.data = padded.ravel().tobytes()
                message.header.stamp = stamp_to_msg(start_ns + i * PERIOD_NS + 3_000_000)
                message.header.frame_id = "pylon_camera"
                publisher.publish(message)

        scan(1, list(range(len(SEQUENCE))))
        stack = wait(lambda: stacks and stacks[0], "the stack")
        assert bytes(stack.data) == pixels.tobytes()
        scan(2, [0, 1, *range(3, len(SEQUENCE))])
        refused = (2, MatchedFrame.STACK_REFUSED)
        wait(lambda: [f for f in verdicts if (f.scan_id, f.status) == refused], "a refusal")
        assert len(stacks) == 1
        driver.destroy_node()


# -- stage ----------------------------------------------------------------------------------------


def test_the_stage_moves_within_its_limits_and_tells_where_it_is() -> None:
    with ros_graph.graph() as graph:
        driver = FakeStage()
        node = graph.add(StageNode, lambda: driver, home_at_start=True)
        poses = graph.collect(topics.POSE)
        wait(lambda: poses, "a pose")
        assert driver.homed == 1

        def move(x_m: float, relative: bool = False) -> MoveStage.Response:
            request = MoveStage.Request(target=Point(x=x_m), relative=relative)
            return graph.call(topics.MOVE_STAGE, request)

        answer = move(0.004)
        assert answer.success
        assert answer.pose.pose.position.x == 0.004
        assert answer.pose.header.frame_id == "sl_world"
        assert move(0.001, relative=True).pose.pose.position.x == pytest.approx(0.005)
        for target in (1.0, math.nan, math.inf):
            refused = move(target)
            assert not refused.success
            assert "soft limit" in refused.message
        asked_ns = time.time_ns()
        later = wait(lambda: [p for p in poses if stamp_from_msg(p.header.stamp) > asked_ns], "one")
        assert later[0].pose.position.x == pytest.approx(0.005)
        driver.kind = "alarm"
        wait(lambda: node.health().level == "error", "the alarm")
        assert graph.call(topics.CLEAR_STAGE, Trigger.Request()).success
        wait(lambda: node.health().level == "ok", "the end of the alarm")


def test_a_stage_that_is_missing_is_told_and_found_when_it_comes() -> None:
    with ros_graph.graph() as graph:
        driver = FakeStage()
        driver.gone = True
        node = graph.add(StageNode, lambda: driver)
        refused = graph.call(topics.HOME_STAGE, Trigger.Request())
        assert not refused.success
        assert "not connected" in refused.message
        driver.gone = False
        wait(lambda: node.health().level == "ok", "the stage")
        driver.gone = True
        wait(lambda: node.health().level == "error", "the loss to be noticed")
        driver.gone = False
        wait(lambda: node.health().level == "ok", "the stage to be back")


# -- scans ----------------------------------------------------------------------------------------


class Rig:
    """The whole graph on drivers without devices."""

    def __init__(self, graph: Graph, calibration: Path) -> None:
        self.graph = graph
        self.pair = WiredPair(lambda sequence: frames(sequence.name))
        graph.add(tiny_projector, lambda: self.pair.projector, exposure_s=0.01)
        graph.add(CameraNode, lambda: self.pair.camera)
        graph.add(StageNode, FakeStage, pose_rate_hz=50.0)
        graph.add(SynchronizerNode, timeout_s=0.4)
        calibrated_by(graph, calibration)
        self.node = graph.add(ReconstructNode)
        self.clouds = graph.collect(topics.POINTS)
        wait(lambda: self.pair.camera.armed and self.pair.projector.opened, "the devices")
        wait(lambda: self.node.health().level == "ok", "the kernels", 200.0)

    def scan(self, max_repeats: int = 2, sequence: str = "precise") -> Scan.Response:
        self.clouds.clear()
        self.pair.runs = 0
        request = Scan.Request(sequence=sequence, max_repeats=max_repeats)
        return self.graph.call(topics.SCAN, request, 60.0)

    def expect_good(self, answer: Scan.Response) -> None:
        assert answer.success, answer.message
        cloud = wait(lambda: self.clouds and self.clouds[0], "the cloud")
        assert_plane(cloud)
        points = cloud_from_msg(cloud)
        report = answer.report
        assert report.points == np.isfinite(points["z"]).sum()
        assert report.points + sum(r.count for r in report.refused) == report.lit_positions
        assert (report.rows, report.columns) == points.shape
        assert report.cloud_hash == cloud_hash(points)
        assert report.calibration_hash == rig_hash(tiny_rig())
        assert report.median_sigma_m == pytest.approx(float(np.nanmedian(points["sigma"])))


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    save_calibration(path, tiny_rig())
    with ros_graph.graph() as graph:
        yield Rig(graph, path)


def test_a_scan_from_trigger_to_cloud(rig: Rig) -> None:
    answer = rig.scan()
    rig.expect_good(answer)
    assert (answer.report.attempts, answer.report.attempt_messages) == (1, [])


def test_a_dropped_frame_repeats_the_scan_and_is_told(rig: Rig) -> None:
    rig.pair.drop = {0: {5}}
    answer = rig.scan()
    rig.pair.drop = {}
    rig.expect_good(answer)
    assert answer.report.attempts == 2
    assert "image" in answer.report.attempt_messages[0]
    assert len(rig.clouds) == 1


def test_exchanged_content_never_becomes_a_cloud(rig: Rig) -> None:
    rig.pair.swap = {0: 4}
    answer = rig.scan()
    rig.pair.swap = {}
    rig.expect_good(answer)
    assert answer.report.attempts == 2
    assert len(rig.clouds) == 1


def test_a_doubled_trigger_repeats_the_scan(rig: Rig) -> None:
    rig.pair.twice = {0: {7}}
    answer = rig.scan()
    rig.pair.twice = {}
    rig.expect_good(answer)
    assert answer.report.attempts == 2
    assert "twice" in answer.report.attempt_messages[0]


@pytest.mark.parametrize("index", [0, 1, 3, 12])
def test_a_frame_that_is_white_all_over_never_becomes_wrong_points(rig: Rig, index: int) -> None:
    """White, black, a code and a fine pattern: refused, or the points that are left are right."""
    rig.pair.white = {0: index}
    answer = rig.scan(max_repeats=0)
    rig.pair.white = {}
    if answer.success:
        assert_plane(wait(lambda: rig.clouds and rig.clouds[0], "the cloud"))
    else:
        assert answer.message
    rig.expect_good(rig.scan())


def test_a_scan_that_is_always_spoilt_is_refused_with_its_reason(rig: Rig) -> None:
    rig.pair.drop = {run: {0} for run in range(9)}
    answer = rig.scan(max_repeats=1)
    rig.pair.drop = {}
    assert not answer.success
    assert "2 times" in answer.message
    assert len(answer.report.attempt_messages) == 1
    assert not rig.clouds
    rig.expect_good(rig.scan())


def test_unknown_sequences_and_bad_exposures_are_refused_at_once(rig: Rig) -> None:
    assert "no sequence is called 'nix'" in rig.scan(sequence="nix").message
    for exposure_s in (-1.0, math.nan, 1e9):
        request = Scan.Request(exposure_s=exposure_s)
        assert "exposure_s" in rig.graph.call(topics.SCAN, request).message


def test_the_action_tells_progress_and_a_second_scan_is_refused(rig: Rig) -> None:
    rig.clouds.clear()
    told: list[ScanAction.Feedback] = []
    client = rig.graph.tester.action_client(topics.SCAN_ACTION)
    assert client.wait_for_server(patience(PATIENCE_S))
    goal = ScanAction.Goal(sequence="precise", max_repeats=255)
    sent = client.send_goal_async(goal, lambda m: told.append(m.feedback))
    wait(sent.done, "the goal to be accepted")
    wait(lambda: told, "the first feedback")
    second = rig.graph.call(topics.SCAN, Scan.Request())
    assert not second.success
    assert "running already" in second.message
    result = sent.result().get_result_async()
    wait(result.done, "the scan's end")
    assert result.result().result.success
    assert {m.stage for m in told} >= {"match", "publish"}
    assert told[-1].progress == 1.0
    client.destroy()


def test_a_scan_can_be_cancelled_and_the_next_one_is_right(rig: Rig) -> None:
    client = rig.graph.tester.action_client(topics.SCAN_ACTION)
    assert client.wait_for_server(patience(PATIENCE_S))
    goal = ScanAction.Goal(sequence="precise", exposure_s=10.0, max_repeats=0)
    sent = client.send_goal_async(goal)
    wait(sent.done, "the goal to be accepted")
    time.sleep(0.1)
    result = sent.result().get_result_async()
    sent.result().cancel_goal_async()
    wait(result.done, "the cancelled scan's end")
    assert result.result().status == 5  # action_msgs/GoalStatus.STATUS_CANCELED
    assert not result.result().result.success
    client.destroy()
    wait(lambda: rig.scan(max_repeats=0).success, "the projector to be free", 20.0)


def test_a_graph_without_a_camera_says_so(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    save_calibration(path, tiny_rig())
    with ros_graph.graph() as graph:
        graph.add(tiny_projector, FakeProjector)
        calibrated_by(graph, path)
        graph.add(ReconstructNode, silence_timeout_s=1.0)
        answer = graph.call(topics.SCAN, Scan.Request())
        assert not answer.success
        assert "is the camera node running" in answer.message
