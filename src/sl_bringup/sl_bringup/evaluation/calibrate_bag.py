"""``slrig calibrate --from BAG``: a calibration that was recorded, solved again without the graph.

The stacks come from the matcher of the live graph, the views and the solution from the code that
the calibration's node runs: same recording, same bits.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sl_bringup.bag.bag_matching import decisions
from sl_bringup.bag.bags import Bag, open_bag
from sl_bringup.bag.recorded_settings import read_settings
from sl_calibration.data.run_store import OBSERVATIONS
from sl_calibration.data.session import CalibrationRequest, Taken
from sl_calibration.data.view_extraction import observe
from sl_calibration.data.views import Observations, View, save_observations
from sl_calibration.solve.uncertainty import Limits
from sl_calibration.target.plate import DEFAULT_PLATE, Plate
from sl_calibration.workflow.calibrator import Pitches, made_from_order
from sl_calibration.workflow.conclude import Outcome, conclude
from sl_camera.sync.matching import MatchedStack, StackMatcher, Status
from sl_common.errors import CalibrationError
from sl_common.topics import CALIBRATION_RUN

Look = Callable[[Taken, CalibrationRequest], View]
Tell = Callable[[str], None]


@dataclass(frozen=True)
class Run:
    """What a recording says about a calibration in it.

    Parameters
    ----------
    scan_ids : tuple of int
        Its stacks in order; empty: all that show both coordinates.
    made_from : mapping
        As the live run's calibration has it.
    order : CalibrationRequest
        What its views were taken for.
    pitches : Pitches
        Of the chips.
    limits : Limits
        Acceptance gate.
    hash : str
        Of the live run's calibration; empty where there was none.
    """

    scan_ids: tuple[int, ...]
    made_from: Mapping[str, Any]
    order: CalibrationRequest
    pitches: Pitches
    limits: Limits
    hash: str = ""


def _order(made_from: Mapping[str, Any]) -> CalibrationRequest:
    """What the views of a run were taken for."""
    plate = dict(made_from["plate"])
    plate["origin_id"] = tuple(plate["origin_id"])
    target = str(made_from.get("target", "both"))
    patterns = target != "camera" or "kept" in made_from
    sequence = str(made_from["sequence"])
    return CalibrationRequest(target, (0.0,), Plate(**plate), sequence, patterns=patterns, least=1)


def solve_recorded(
    path: Path, output: Path, plate: Plate | None = None, look: Look = observe,
    tell: Tell = lambda _: None,
) -> tuple[Outcome, list[str]]:  # fmt: skip
    """Solve the last calibration in a recording again; nothing is put in force.

    Parameters
    ----------
    path : Path
        The recording.
    output : Path
        For observations, calibration and report.
    plate : Plate, optional
        Where the recording does not say what plate it was.
    look : callable
        Makes a view of a stack.
    tell : callable
        Called with a line for each view.

    Returns
    -------
    outcome : Outcome
        As the service's.
    notes : list of str
        Whether the live run gave the same; what the recording lacks.

    Raises
    ------
    BagError
        When it cannot be read.
    CalibrationError
        When it holds no calibration, not all its stacks, or they do not determine a rig.
    """
    with open_bag(path) as bag:
        run = recorded_run(bag) or _assumed(plate or DEFAULT_PLATE)
        observations = _observations(bag, run, look, tell)
        notes = list(bag.lost)
    output.mkdir(parents=True, exist_ok=True)
    save_observations(output / OBSERVATIONS, observations)
    outcome = conclude(observations, run.limits, output)
    return outcome, [*_compared(run, outcome), *notes]


def recorded_run(bag: Bag) -> Run | None:
    """Return the last run that the calibration's node told of; None where it told of none.

    Raises
    ------
    CalibrationError
        When it is not told as expected.
    """
    if not bag.has(CALIBRATION_RUN):
        return None
    texts = [recorded.message.data for recorded in bag.messages(CALIBRATION_RUN, quick=True)]
    if not texts:
        return None
    try:
        told = json.loads(texts[-1])
        return Run(
            tuple(int(number) for number in told["scan_ids"]), told["made_from"],
            _order(told["made_from"]), Pitches(**told["pitches"]), Limits(**told["limits"]),
            str(told["hash"]),
        )  # fmt: skip
    except (ValueError, TypeError, KeyError) as error:
        raise CalibrationError(
            f"{bag.path}: what {CALIBRATION_RUN.name} tells cannot be used ({error!r}); expected "
            "what the calibration's node publishes"
        ) from error


def _assumed(plate: Plate) -> Run:
    """Run of a recording that tells of none: everything in it that shows both coordinates."""
    order = CalibrationRequest("both", (0.0,), plate, "precise-rows", least=1)
    made_from = {**made_from_order(order), "heights_m": []}
    return Run((), made_from, order, Pitches(1e-5, 1e-5), Limits())


def _observations(bag: Bag, run: Run, look: Look, tell: Tell) -> Observations:
    views: dict[int, View] = {}
    sizes = (0, 0), (0, 0)
    for stack in _stacks(bag, run):
        sizes = image_size(stack), stack.sequence.dmd_size
        views[stack.scan_id] = look(_taken(stack), run.order)
        tell(f"scan {stack.scan_id}: {len(views[stack.scan_id].hole_ids)} holes")
    if missing := [number for number in run.scan_ids if number not in views]:
        raise CalibrationError(
            f"{bag.path} lacks the stacks of scans {missing} of the calibration in it; expected "
            f"all of {list(run.scan_ids)} whole"
        )
    if not views:
        raise CalibrationError(
            f"{bag.path} holds no stack with columns and rows; expected a recorded calibration"
        )
    ordered = tuple(views[number] for number in run.scan_ids or sorted(views))
    made_from = dict(run.made_from)
    made_from["heights_m"] = made_from.get("heights_m") or sorted({v.height_m for v in ordered})
    pitches = run.pitches
    return Observations(ordered, *sizes, pitches.camera_m, pitches.projector_m, made_from)


def _stacks(bag: Bag, run: Run) -> Iterator[MatchedStack]:
    """Yield the stacks of a run; their memory is used again afterwards."""
    matcher = StackMatcher(read_settings(bag).matching)
    for decision in decisions(bag, matcher):
        if decision.status != Status.STACK_COMPLETE or decision.stack is None:
            continue
        wanted = decision.scan_id in run.scan_ids or (
            not run.scan_ids and len(decision.stack.sequence.axes()) == 2
        )
        if wanted:
            yield decision.stack
        matcher.recycle(decision.stack)


def image_size(stack: MatchedStack) -> tuple[int, int]:
    """(width, height) of a stack's images."""
    _, height, width = stack.data.shape
    return width, height


def _taken(stack: MatchedStack) -> Taken:
    if stack.pose is None:
        raise CalibrationError(
            f"scan {stack.scan_id} has no stage pose; expected one with every stack"
        )
    x, y, z = stack.pose.position_m
    return Taken(stack.data, stack.sequence, z, (x, y), stack.scan_id)


def _compared(run: Run, outcome: Outcome) -> list[str]:
    if not run.scan_ids:
        return ["the recording does not tell of a calibration: all its stacks were taken"]
    if not run.hash:
        return ["the live run gave no calibration"]
    same = outcome.hash == run.hash
    return [f"the live run gave {'the same bits' if same else f'another rig ({run.hash[:12]})'}"]
