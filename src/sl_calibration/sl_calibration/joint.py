"""Camera and projector refined together, with one covariance."""

from __future__ import annotations

from collections.abc import Sequence

from sl_calibration.bundle import Bundle, Freedom, RigProblem, solve_bundle
from sl_calibration.camera import DeviceSolution
from sl_calibration.enough import check_determined, check_side
from sl_calibration.samples import Holes, HoleView, Targets, TargetView
from sl_reconstruct.rig import Rig


def solve_joint(
    holes: Sequence[HoleView],
    targets: Sequence[TargetView],
    camera: DeviceSolution,
    projector: DeviceSolution,
    freedom: Freedom | None = None,
) -> Bundle:
    """Refine both devices, the stage and, where wanted, the flat on holes and targets at once.

    Parameters
    ----------
    holes, targets : sequence
        All views.
    camera, projector : DeviceSolution
        Where to start.
    freedom : Freedom
        What is estimated besides the devices.

    Notes
    -----
    Two devices see the stage's travel from two sides: together they determine its scale and both
    leans, which the camera alone does not.

    Raises
    ------
    CalibrationError
        When the views do not determine the parameters.
    """
    problem = RigProblem(
        ("camera", "projector"), Holes.of(holes), Targets.of(targets), freedom or Freedom()
    )
    start = problem.start(camera.device, projector.device)
    bundle = solve_bundle(problem, start._replace(axes=camera.bundle.state.axes))
    check_determined(bundle)
    check_side(bundle)
    return bundle


def rig_of(bundle: Bundle) -> Rig:
    """Return the rig of a joint solution."""
    camera, projector = bundle.state.devices
    return Rig(camera, projector)
