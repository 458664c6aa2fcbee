"""A cell of real nodes and real drivers on emulated devices, in one process and without a world.

The camera sees one row of mirrors, so that every frame shows which pattern it is of.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point
from sl_interfaces.msg import MatchedFrame
from sl_interfaces.srv import MoveStage, Project
from std_srvs.srv import Trigger

from sl_bench.camera.camera_emulator import CameraEmulator, Exposure
from sl_bench.camera.camera_faults import CameraFaults
from sl_bench.dlpc.dlpc900_emulator import Dlpc900Emulator
from sl_bench.dlpc.dlpc_faults import DlpcFaults
from sl_bench.dlpc.usb_server import EmulatedUsb
from sl_bench.stage.grbl_emulator import GrblEmulator
from sl_bench.stage.zaber_emulator import ZaberEmulator
from sl_camera.camera_node import CameraNode
from sl_camera.drivers.socket_camera import SocketCamera
from sl_camera.stage.grbl.grbl_stage import GrblStage
from sl_camera.stage.zaber.zaber_stage import ZaberStage
from sl_camera.stage_node import StageNode
from sl_camera.synchronizer_node import SynchronizerNode
from sl_common import base_node, device_link, topics
from sl_projector.dlpc.dlpc900_driver import Dlpc900, Dlpc900Settings
from sl_projector.hid.usb_socket import LinkBackend
from sl_projector.projector_node import ProjectorNode
from sl_projector.sequence.pattern_sequence import named
from support import ros_graph
from support.devices.stage_bench import Clock
from support.patience import Deadline, wait
from support.ros_graph import Graph

PAPER = named("paper")
PERIOD_S = 0.02
#: Recovery is awaited, never timed; a loaded machine takes its time.
PATIENCE_S = 120.0


class Cell:
    """Projector, camera, stage and synchroniser, and what the user sees of them."""

    def __init__(self, graph: Graph, folder: Path, stage: str) -> None:
        self.graph = graph
        self.dmd = Dlpc900Emulator()
        self.usb = EmulatedUsb(self.dmd)
        self.camera = CameraEmulator(
            folder / "camera.sock", self._render, (PAPER.dmd_size[0], 2), max_rate_hz=60.0,
            readout_s=0.001,
        )  # fmt: skip
        self.dmd.on_exposure = self.camera.on_exposure
        self.clock = Clock()
        self.stage: Any = (
            GrblEmulator(clock=self.clock, homed=True, seed=3) if stage == "grbl"
            else ZaberEmulator(clock=self.clock, homed=True, seed=3)
        )  # fmt: skip
        self._port = str(folder / "stage")
        self._kind = stage
        self._true_rows = np.stack([PAPER.frame(i)[0] for i in range(len(PAPER))])

    def start(self, stack: ExitStack) -> None:
        """Start emulators and nodes."""
        self.camera.start()
        stack.callback(self.camera.close)
        stack.enter_context(self.stage)
        self.stage.link(self._port)
        settings = Dlpc900Settings(reply_timeout_s=0.3)
        self.nodes = [
            self.graph.add(
                ProjectorNode,
                lambda: Dlpc900(settings=settings, backend=LinkBackend(self.usb.connect())),
                sequence="paper", exposure_s=PERIOD_S,
            ),
            self.graph.add(
                CameraNode, lambda: SocketCamera(Path(self._port).parent / "camera.sock"),
                exposure_s=0.9 * PERIOD_S,
            ),
            self.graph.add(StageNode, self._make_stage),
            # On a loaded machine the emulated DMD starts late by part of a period.
            self.graph.add(
                SynchronizerNode, timeout_s=1.0, early_image_s=1.0, tolerance_fraction=0.45,
                jitter_fraction=0.4,
            ),
        ]  # fmt: skip
        self.stacks = self.graph.collect(topics.STACK)
        self.verdicts = self.graph.collect(topics.FRAME)
        self.diagnostics: list[DiagnosticStatus] = []
        self.graph.tester.listen(topics.DIAGNOSTICS, lambda m: self.diagnostics.extend(m.status))
        self.recover()

    def _make_stage(self) -> Any:
        if self._kind == "grbl":
            return GrblStage(self._port, reply_timeout_s=2.0)
        return ZaberStage(self._port, reply_timeout_s=0.3)

    def _render(self, exposure: Exposure) -> np.ndarray[Any, Any]:
        """What the mirrors' first row shows, weighed by time, on both rows of the sensor."""
        light = np.zeros(PAPER.dmd_size[0])
        for mirrors, seconds in exposure.shown:
            light += mirrors[0] * seconds
        row = np.clip(255 * light / exposure.exposure_s, 0, 255).astype(np.uint8)
        return np.stack([row, row])

    # -- what the user does ---------------------------------------------------------------------

    def project(self) -> tuple[Any, MatchedFrame | None]:
        """Project `paper`; the answer, and the synchroniser's verdict where a pattern was shown."""
        self.verdicts.clear()
        answer = self.graph.call(topics.PROJECT, Project.Request(), PATIENCE_S)
        if not answer.count:
            return answer, None
        over = (MatchedFrame.STACK_COMPLETE, MatchedFrame.STACK_REFUSED)

        def verdict() -> MatchedFrame | None:
            mine = [f for f in list(self.verdicts) if f.scan_id == answer.scan_id]
            return next((f for f in mine if f.status in over), None)

        return answer, wait(verdict, "the verdict on a projection", PATIENCE_S)

    def call(self, service: topics.Service) -> Any:
        """Call a service that takes nothing."""
        return self.graph.call(service, Trigger.Request(), PATIENCE_S)

    def move(self, x_m: float) -> Any:
        """Move the stage and wait."""
        request = MoveStage.Request(target=Point(x=x_m))
        return self.graph.call(topics.MOVE_STAGE, request, PATIENCE_S)

    def begin_move(self, x_m: float) -> Any:
        """Move the stage, do not wait."""
        return self.graph.call_async(topics.MOVE_STAGE, MoveStage.Request(target=Point(x=x_m)))

    # -- what the user sees ---------------------------------------------------------------------

    def told(self, words: str, timeout_s: float = PATIENCE_S) -> str:
        """Wait until `/diagnostics` warns in these words; return what it said if it never does."""
        deadline = Deadline(timeout_s)
        while not deadline.is_over:
            said = {s.message for s in list(self.diagnostics) if s.level != DiagnosticStatus.OK}
            if any(re.search(words, message) for message in said):
                return ""
            time.sleep(0.01)
        return f"/diagnostics did not say {words!r} but {said}"

    def well(self) -> bool:
        """Whether every node is, apart from what was refused a moment ago."""
        newest = {status.name: status for status in list(self.diagnostics)}
        return len(newest) >= len(self.nodes) and all(
            s.level == DiagnosticStatus.OK or any(v.key == "passing" for v in s.values)
            for s in newest.values()
        )

    def check_stacks(self) -> int:
        """Every stack so far must show its patterns in order; return how many there were."""
        stacks, self.stacks[:] = list(self.stacks), []
        for stack in stacks:
            images = np.frombuffer(stack.data, np.uint8).reshape(len(PAPER), 2, -1)
            lit = self._true_rows == 255
            # 90 % of the exposure is lit at full; what is not lit stays dark.
            np.testing.assert_array_equal(images[:, 0] > 127, lit)
        return len(stacks)

    def recover(self) -> None:
        """Until a projection becomes a stack again and all nodes are well; nothing is restarted."""
        nodes = [id(node) for node in self.nodes]
        deadline = Deadline(PATIENCE_S)
        while True:
            self.diagnostics.clear()
            wait(self.well, f"all to be well: {self.diagnostics}", PATIENCE_S)
            _, verdict = self.project()
            if verdict is not None and verdict.status == MatchedFrame.STACK_COMPLETE:
                break
            assert not deadline.is_over, verdict
        wait(lambda: self.stacks, "the stack")
        assert self.check_stacks() >= 1
        assert nodes == [id(node) for node in self.nodes]

    def heal(self) -> None:
        """Take all causes away."""
        self.camera.faults = CameraFaults()
        for name, value in vars(DlpcFaults()).items():
            if not name.startswith("_"):
                setattr(self.dmd.faults, name, value)
        self.usb.plug_in()
        self.camera.disconnect(0.0)


@contextmanager
def cell(folder: Path, stage: str = "grbl") -> Iterator[Cell]:
    """A running cell."""
    with (
        mock.patch.object(base_node, "DIAGNOSTICS_S", 0.05),
        mock.patch.object(device_link, "FIRST_RETRY_S", 0.05),
        mock.patch.object(device_link, "LONGEST_RETRY_S", 0.2),
        ExitStack() as stack,
        ros_graph.graph() as graph,
    ):
        made = Cell(graph, folder, stage)
        made.start(stack)
        yield made


Act = Callable[[Cell], object]
