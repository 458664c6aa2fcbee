"""Every fault that the emulators can make, on live nodes: a clear state, recovery, no wrong stack.

The table of `docs/faults.md`; the drivers' own tests go deeper (`test_dlpc900_driver.py`,
`test_dlpc350.py`, `test_stage_faults.py`, `test_camera_emulator.py`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from support import ros_graph
from support.patience import Deadline

ros_graph.require_ros()

from sl_interfaces.msg import MatchedFrame  # noqa: E402

from sl_bench.camera.camera_faults import CameraFaults  # noqa: E402
from sl_common import topics  # noqa: E402
from support import fault_cell  # noqa: E402
from support.fault_cell import Cell  # noqa: E402
from support.patience import wait  # noqa: E402


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    with fault_cell.cell(tmp_path_factory.mktemp("cell")) as made:
        yield made


# -- projector and camera ---------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A fault, how it is asked for, and what `/diagnostics` says then (nothing: it is borne).

    One that does not surely spoil may be over, by itself, before the patterns are shown.
    """

    name: str
    ask: Callable[[Cell], object]
    told: str
    spoils: bool = True


def dmd(name: str, told: str, spoils: bool = True, **faults: object) -> Case:
    def ask(cell: Cell) -> None:
        for field, value in faults.items():
            setattr(cell.dmd.faults, field, value)

    return Case(name, ask, told, spoils)


def camera(told: str, **at: int) -> Case:
    def ask(cell: Cell) -> None:
        faults = {kind: [frame] for kind, frame in at.items()}
        cell.camera.faults = CameraFaults(at=faults, delay_s=3.0, stamp_s=0.01)

    return Case(next(iter(at)), ask, told)


def taken(cell: Cell) -> None:
    cell.dmd.faults.taken = True
    cell.usb.unplug()
    cell.usb.plug_in()


def kernel_driver(cell: Cell) -> None:
    cell.dmd.faults.kernel_driver = True
    cell.usb.unplug()
    cell.usb.plug_in()


SPOILING = [
    dmd("refused", r"error 8, out of memory", False, refuse=1, refuse_code=8),
    dmd("silent", r"no answer|did not answer", lose_replies=1000),
    dmd("short reports", r"did not answer|no answer", short_replies=1000),
    dmd("stalled", "stalled again", stalls=1000),
    dmd("abort", "abort", abort_at=4),
    dmd("edge lost", "image 4 of 11 did not come", lost_edges={3}),
    Case("unplugged", lambda cell: cell.usb.unplug(), "gone|no USB device"),
    Case("power cycle", lambda cell: cell.usb.power_cycle(), "gone|no USB device", False),
    Case("reset", lambda cell: cell.dmd.power_cycle(), "the device was reset"),
    Case("taken", taken, "another program"),
    Case("kernel driver", kernel_driver, "gone", False),
    camera("image 4 of 11 did not come", drop=3),
    camera("image 4 of 11 came twice", duplicate=3),
    camera("image 4 of 11 did not come before", swap=3),
    camera("image 4 of 11 did not come", delay=3),
    camera("no trigger explains|image 4 of 11", stamp=3),
    camera("image 4 of 11 did not come", lost_trigger=3),
    camera("image 4 of 11", wrong_size=3),
    camera("came incomplete", incomplete=3),
    Case("camera unplugged", lambda cell: cell.camera.disconnect(1e6), "camera .* gone|no camera"),
]


@pytest.mark.parametrize("case", SPOILING, ids=lambda case: case.name)
def test_a_fault_that_spoils_is_told_and_mended_without_a_restart(cell: Cell, case: Case) -> None:
    deadline = Deadline(fault_cell.PATIENCE_S)
    while True:
        cell.diagnostics.clear()
        case.ask(cell)
        _, verdict = cell.project()
        if case.spoils:
            assert verdict is None or verdict.status == MatchedFrame.STACK_REFUSED
        assert cell.check_stacks() == 0 or not case.spoils
        said_otherwise = cell.told(case.told, 3.0)
        cell.heal()
        cell.recover()
        if not said_otherwise:
            return
        # A machine that is too slow for the exposures spoils scans by itself, in its own way.
        assert not deadline.is_over, said_otherwise


BORNE = [
    dmd("reply lost", "", lose_replies=1),
    dmd("reply late", "", late_replies=1, late_s=0.4),
    dmd("reply stale", "", stale_replies=2),
    dmd("report short", "", short_replies=1),
    dmd("reply without data", "", empty_replies=2),
    dmd("stall", "", stalls=1),
    dmd("edge doubled", "", doubled_edges={3}),
]


@pytest.mark.parametrize("case", BORNE, ids=lambda case: case.name)
def test_a_fault_that_can_be_borne_never_makes_a_wrong_stack(cell: Cell, case: Case) -> None:
    """Asked again, or (an edge while the camera exposes) ignored as cameras do."""
    case.ask(cell)
    cell.project()
    cell.check_stacks()  # of what came, none is wrong
    cell.heal()
    cell.recover()


def test_a_saturated_frame_is_matched_as_it_is(cell: Cell) -> None:
    """The stack holds what the camera saw; reconstruction refuses it (`test_scan_graph.py`)."""
    verdict = None
    while verdict is None or verdict.status != MatchedFrame.STACK_COMPLETE:
        cell.camera.faults = CameraFaults(at={"saturate": [3]})
        _, verdict = cell.project()
    stack = wait(lambda: cell.stacks and cell.stacks.pop(), "the stack")
    size = stack.height * stack.width
    assert set(bytes(stack.data)[3 * size : 4 * size]) == {255}
    cell.heal()
    cell.recover()


# -- stages -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def zaber_cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    with fault_cell.cell(tmp_path_factory.mktemp("cell"), "zaber") as made:
        yield made


def home(cell: Cell) -> None:
    cell.call(topics.CLEAR_STAGE)
    answer = cell.call(topics.HOME_STAGE)
    assert answer.success, answer.message


def unplug(cell: Cell) -> None:
    cell.stage.disconnect()


def open_and_home(cell: Cell) -> None:
    cell.stage.open_switches()
    home(cell)


#: Name, fault while the stage moves, words, what the operator does.
GRBL = [
    ("noise", lambda c: c.stage.noise(), "no answer", None),
    ("reply lost", lambda c: c.stage.lose_replies(1), "no answer", None),
    ("reply late", lambda c: c.stage.delay_replies(1, 3.0), "no answer", None),
    ("jam", lambda c: c.stage.jam(), "stands at MPos", lambda c: c.stage.jam(False)),
    ("silent", lambda c: c.stage.fall_silent(), "no status",
     lambda c: c.stage.fall_silent(False)),
]  # fmt: skip
GRBL_IN_MOTION = [
    ("alarm", lambda c: c.stage.alarm(3), "ALARM:3", home),
    ("limit switch", lambda c: c.stage.close_switch(0), "limit switch", open_and_home),
    ("power cycle", lambda c: c.stage.power_cycle(), "restarted by itself", home),
    ("unplugged", unplug, "gone|cannot open", lambda c: c.stage.reconnect()),
]
ZABER = [
    ("reply lost", lambda c: c.stage.lose_replies(20), "does not answer",
     lambda c: c.stage.lose_replies(0)),
    ("fault", lambda c: c.stage.fault(0), "stalled", lambda c: c.call(topics.CLEAR_STAGE)),
    ("emergency stop", lambda c: c.stage.fault(0, "FH", stays=True), "emergency stop",
     lambda c: (c.stage.release(), c.call(topics.CLEAR_STAGE))),
    ("power cycle", lambda c: c.stage.power_cycle(), "no reference", home),
    ("unplugged", unplug, "gone|cannot open", lambda c: c.stage.reconnect()),
]  # fmt: skip


def stage_fault(
    cell: Cell, ask: Callable[[Cell], object], words: str, mend: Callable[[Cell], object] | None
) -> None:
    """Fail at the start of a move; afterwards the same move works, and ends where it was sent."""
    deadline = Deadline(fault_cell.PATIENCE_S)
    while True:
        cell.diagnostics.clear()
        ask(cell)
        cell.move(0.004)
        # What stays until it is mended is told for sure; else it may have hit another answer.
        if not (said_otherwise := cell.told(words, 60.0 if mend else 3.0)):
            break
        # The noise was before an answer to nobody but the pose.
        assert cell.move(0.0).success, said_otherwise
        assert not deadline.is_over, said_otherwise
    # The scan is refused or rightly matched: the part stands.
    cell.project()
    cell.check_stacks()
    if mend is not None:
        mend(cell)
    cell.diagnostics.clear()
    wait(cell.well, f"all to be well: {cell.diagnostics}", fault_cell.PATIENCE_S)
    answer = cell.move(0.004)
    assert answer.success, answer.message
    assert cell.stage.position_m()[0] == pytest.approx(0.004, abs=1e-6)
    assert cell.move(0.0).success
    cell.recover()


@pytest.mark.parametrize(("name", "ask", "words", "mend"), [*GRBL, *GRBL_IN_MOTION])
def test_a_grbl_stage_that_fails(
    cell: Cell, name: str, ask: Callable[[Cell], object], words: str,
    mend: Callable[[Cell], object] | None,
) -> None:  # fmt: skip
    stage_fault(cell, ask, words, mend)


@pytest.mark.parametrize(("name", "ask", "words", "mend"), ZABER)
def test_a_zaber_stage_that_fails(
    zaber_cell: Cell, name: str, ask: Callable[[Cell], object], words: str,
    mend: Callable[[Cell], object] | None,
) -> None:  # fmt: skip
    stage_fault(zaber_cell, ask, words, mend)


def test_an_alarm_while_the_stage_moves_spoils_the_scan(cell: Cell) -> None:
    """The part was under way during the exposures: no stack, whatever the camera saw."""
    cell.clock.run_at(0.5)
    moved = cell.begin_move(0.02)
    wait(lambda: cell.stage.position_m()[0] > 0.0, "the stage to move")
    cell.stage.alarm(1)
    _, verdict = cell.project()
    assert verdict is None or verdict.status == MatchedFrame.STACK_REFUSED
    assert cell.check_stacks() == 0
    wait(moved.done, "the move's answer")
    assert "ALARM:1" in moved.result().message
    cell.clock.run_at(25.0)
    home(cell)
    assert cell.move(0.0).success
    cell.recover()


def test_a_move_that_begins_with_the_scan_is_never_taken_for_a_stage_at_rest(cell: Cell) -> None:
    """The stage is quick: all but the first, coarse patterns see it where it went."""
    began = threading.Event()
    cell.dmd.on_exposure = lambda *edge: (cell.camera.on_exposure(*edge), began.set())
    for x_m in (0.0005, 0.0, 0.0005, 0.0):
        began.clear()
        moved: list[Any] = []
        mover = threading.Thread(
            target=lambda x=x_m, to=moved: (began.wait(60.0), to.append(cell.begin_move(x)))
        )
        mover.start()
        _, verdict = cell.project()
        mover.join()
        assert verdict is None or verdict.status == MatchedFrame.STACK_REFUSED
        assert cell.check_stacks() == 0
        wait(moved[0].done, "the move")
    cell.dmd.on_exposure = cell.camera.on_exposure
    cell.recover()
