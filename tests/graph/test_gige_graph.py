"""GigE Vision in the graph: the node on Aravis' fake camera, whole scans on the bench's."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from support import ros_graph

ros_graph.require_ros()

from sl_interfaces.msg import PatternTrigger  # noqa: E402

from sl_bench.process.bench import Bench  # noqa: E402
from sl_bench.process.bench_settings import BenchSettings  # noqa: E402
from sl_bench.world.reference_rig import reference_rig  # noqa: E402
from sl_bench.world.surfaces import flat  # noqa: E402
from sl_bench.world.world import World  # noqa: E402
from sl_camera.camera.camera import CameraSettings  # noqa: E402
from sl_camera.camera_node import CameraNode  # noqa: E402
from sl_camera.drivers.aravis_camera import AravisCamera  # noqa: E402
from sl_camera.sync.match_events import (  # noqa: E402
    FrameDecision,
    ImageEvent,
    MatcherSettings,
    Status,
    TriggerEvent,
)
from sl_camera.sync.matching import StackMatcher  # noqa: E402
from sl_common import topics  # noqa: E402
from sl_common.messages import stamp_from_msg, stamp_to_msg  # noqa: E402
from sl_projector.dlpc.dlpc900_driver import Dlpc900  # noqa: E402
from sl_projector.dlpc.dmd import Timing  # noqa: E402
from sl_projector.sequence.pattern_sequence import named  # noqa: E402
from support.devices.camera_bench import fake_gige, gige_bench, gvcp_port, require_gi  # noqa: E402
from support.patience import wait  # noqa: E402

PAPER = named("paper")
TIMING = Timing(0.034)
EXPOSURE_S = 0.033


def test_two_hundred_software_triggered_frames_through_the_node_without_loss() -> None:
    with fake_gige(), ros_graph.graph() as graph:
        node = graph.add(
            CameraNode, address="aravis:127.0.0.1", trigger="software", exposure_s=0.003,
            region=[0, 0, 64, 48], settle_s=0.0,
        )  # fmt: skip
        images = graph.collect(topics.IMAGE)
        wait(lambda: node.health().level == "ok", "the camera")
        triggers = graph.publisher(topics.TRIGGER)
        stamps = []
        for i in range(200):
            message = PatternTrigger(exposure_s=5.0)
            stamps.append(time.time_ns())
            message.header.stamp = stamp_to_msg(stamps[-1])
            triggers.publish(message)
            wait(lambda wanted=i + 1: len(images) == wanted, f"image {i}")
        assert [stamp_from_msg(m.header.stamp) for m in images] == stamps
        assert {(m.width, m.height, m.encoding) for m in images} == {(64, 48, "mono8")}
        values = node.health().values
        assert (values["frames"], values["frames lost"], values["frames incomplete"]) == (200, 0, 0)
        assert values["times lost"] == 0


def test_packet_loss_and_an_unplugged_cable_are_told_and_over_when_they_are_over() -> None:
    mirrors = np.ones((2, 2), np.bool_)
    with gige_bench() as (emulator, gige), ros_graph.graph() as graph:
        node = graph.add(CameraNode, address="aravis:127.0.0.1", exposure_s=0.003)
        images = graph.collect(topics.IMAGE)
        wait(lambda: node.health().level == "ok", "the camera")

        def edges(count: int) -> None:
            for i in range(count):
                emulator.on_exposure(mirrors, i, time.time_ns(), 0.01)
                time.sleep(0.01)

        edges(5)
        wait(lambda: len(images) == 5, "five images")
        gige.stream.lose, gige.stream.resend = 1.0, False
        edges(2)
        gige.stream.lose = 0.0
        time.sleep(0.3)
        edges(1)
        wait(lambda: len(images) == 6, "the frame after the loss")
        wait(lambda: node._link.device().statistics().lost == 2, "the loss to be counted")
        health = node.health()
        assert (health.level, health.values["frames lost"]) == ("warn", 2)
        assert "2 frames lost" in health.message
        assert node.health().level == "ok"  # told once

        gige.disconnect(1.0)
        wait(lambda: node.health().level == "error", "the loss to be told", 20.0)
        assert "gone" in node.health().message
        wait(lambda: node.health().level == "ok", "the camera to be back", 20.0)
        edges(3)
        wait(lambda: len(images) == 9, "images again")
        assert node.health().values["times lost"] >= 1


def run_scan(projector: Dlpc900, camera: AravisCamera, scan_id: int) -> list[FrameDecision]:
    """Project `paper`, match what comes until there is a verdict."""
    matcher = StackMatcher(MatcherSettings(require_pose=False))
    decisions: list[FrameDecision] = []
    projector.load(PAPER, TIMING)
    run = projector.run(TIMING)
    for i, pattern in enumerate(PAPER.patterns):
        stamp_ns = run.start_ns + round(i * run.timing.period_s * 1e9)
        event = TriggerEvent(scan_id, "paper", PAPER.dmd_size, i, 11, pattern, stamp_ns, 0.034)
        decisions += matcher.trigger(event, time.monotonic_ns())
    while matcher.busy:
        frame = camera.read(0.005)
        if frame is not None:
            height, width = frame.image.shape
            image = ImageEvent(frame.stamp_ns, height, width, frame.encoding, frame.image.tobytes())
            decisions += matcher.image(image, time.monotonic_ns())
        decisions += matcher.tick(time.monotonic_ns())
    projector.wait()
    return decisions


def test_a_whole_scan_through_gige_vision_and_its_trigger_line(tmp_path: Path) -> None:
    """Every pixel arrives as the world shows it, with 1 % of the packets lost on the way."""
    require_gi()
    settings = BenchSettings(surface="flat", seed=11, camera_gige="127.0.0.1", niceness=0)
    with gvcp_port(), Bench(settings, tmp_path) as bench:
        projector, camera = Dlpc900(f"socket:{tmp_path / 'usb.sock'}"), AravisCamera("127.0.0.1")
        projector.open()
        camera.open()
        camera.configure(CameraSettings(exposure_s=EXPOSURE_S))
        camera.arm()
        try:
            bench.execute({"fault": {"camera": {"lose_packets": 0.01}}})
            stack = run_scan(projector, camera, 1)[-1].stack
            assert stack is not None
            world = World(reference_rig(), flat(), settings.make_optics())
            for i in (0, 10):
                expected = world.expose([(PAPER.frame(i), EXPOSURE_S)], EXPOSURE_S, i + 1)
                # Not bit by bit: nanoseconds of the exposure may tip a pixel over.
                assert np.mean(stack.images[i] != expected) < 1e-4
            assert camera.packets()["resent_packets"] > 0

            bench.execute({"fault": {"camera": {"at": {"drop": [4]}}}})
            verdict = run_scan(projector, camera, 2)[-1]
            assert verdict.status is Status.STACK_REFUSED
            assert "image 5 of 11 did not come" in verdict.reason
            bench.execute({"fault": {}})
            assert run_scan(projector, camera, 3)[-1].status is Status.STACK_COMPLETE
        finally:
            camera.close()
            projector.close()
