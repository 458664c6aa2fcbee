"""``slrig calibrate --from BAG``: a calibration that was recorded, solved again without the graph.

The stacks come from the matcher of the live graph, the views and the solution from the code that
the calibration's node runs: same recording, same bits.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from sl_bringup.bag.bag_matching import decisions
from sl_bringup.bag.bags import Bag, open_bag
from sl_bringup.bag.recorded_settings import read_settings
from sl_calibration.data.observations import Observations, View, save_observations
from sl_calibration.data.run_store import OBSERVATIONS
from sl_calibration.data.session import CalibrationRequest
from sl_calibration.data.view_extraction import observe
from sl_calibration.solve.acceptance import Limits
from sl_calibration.target.plate import DEFAULT_PLATE
from sl_calibration.workflow.conclusion import Outcome, conclude
from sl_calibration.workflow.run_record import Pitches, RunRecord, made_from_request
from sl_camera.sync.match_events import Status
from sl_camera.sync.matching import StackMatcher
from sl_common.errors import CalibrationError
from sl_common.topics import CALIBRATION_RUN
from sl_projector.sequence.stack import Stack

Look = Callable[[Stack, CalibrationRequest], View]
Tell = Callable[[str], None]


def solve_recorded(
    path: Path, output: Path, look: Look = observe, tell: Tell = lambda _: None
) -> tuple[Outcome, list[str]]:
    """Solve the last calibration in a recording again; nothing is put in force.

    Parameters
    ----------
    path : Path
        The recording.
    output : Path
        For observations, calibration and report.
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
        run = _recorded_run(bag) or _assumed()
        observations = _observations(bag, run, look, tell)
        notes = list(bag.lost)
    output.mkdir(parents=True, exist_ok=True)
    save_observations(output / OBSERVATIONS, observations)
    outcome = conclude(observations, run.limits, output)
    return outcome, [*_compared(run, outcome), *notes]


def _recorded_run(bag: Bag) -> RunRecord | None:
    """Last run that the calibration's node published; None where there is none."""
    found = bag.messages(CALIBRATION_RUN, quick=True) if bag.has(CALIBRATION_RUN) else ()
    texts = [recorded.message.data for recorded in found]
    if not texts:
        return None
    try:
        run = RunRecord.of_plain(json.loads(texts[-1]))
        _ = run.request
        return run
    except (ValueError, TypeError, KeyError) as error:
        raise CalibrationError(
            f"{bag.path}: {CALIBRATION_RUN.name} cannot be used ({error!r}); expected what the "
            "calibration's node publishes"
        ) from error


def _assumed() -> RunRecord:
    """Run of a recording without one: the default plate in every stack with both coordinates."""
    request = CalibrationRequest("both", (0.0,), DEFAULT_PLATE, "precise-rows", least=1)
    made_from = {**made_from_request(request), "heights_m": []}
    return RunRecord((), made_from, Pitches(1e-5, 1e-5), Limits())


def _observations(bag: Bag, run: RunRecord, look: Look, tell: Tell) -> Observations:
    views: dict[int, View] = {}
    sizes = (0, 0), (0, 0)
    for stack in _stacks(bag, run):
        sizes = stack.image_size, stack.sequence.dmd_size
        views[stack.scan_id] = look(stack, run.request)
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
    ordered = [views[number] for number in run.scan_ids or sorted(views)]
    heights = run.made_from.get("heights_m") or sorted({view.height_m for view in ordered})
    run = replace(run, made_from={**run.made_from, "heights_m": heights})
    return run.observations(ordered, *sizes)


def _stacks(bag: Bag, run: RunRecord) -> Iterator[Stack]:
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


def _compared(run: RunRecord, outcome: Outcome) -> list[str]:
    if not run.scan_ids:
        return ["the recording does not tell of a calibration: all its stacks were taken"]
    if not run.hash:
        return ["the live run gave no calibration"]
    same = outcome.hash == run.hash
    return [f"the live run gave {'the same bits' if same else f'another rig ({run.hash[:12]})'}"]
