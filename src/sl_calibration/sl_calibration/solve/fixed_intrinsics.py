"""One device calibrated, the other kept: its lens stays as an earlier calibration has it.

Only the lens (f, C, kappa) can be kept. Where both devices stand is measured anew: the plate,
which is the world, need not lie where it lay before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from sl_calibration.solve.bundle_adjustment import (
    Bundle,
    HeldLens,
    RigProblem,
    lens_values,
    solve_bundle,
)
from sl_calibration.solve.cross_validation import leave_heights_out
from sl_calibration.solve.observability import check_determined, check_side
from sl_calibration.solve.rig_solution import RigSolution
from sl_calibration.solve.robust_lm import triangle
from sl_common.errors import CalibrationError
from sl_reconstruct.model.calibration_file import Calibration, Covariance
from sl_reconstruct.model.rig import Device, Division

Array = NDArray[np.float64]

_NAMES = ("focal_length_px", "image_centre_px.0", "image_centre_px.1", "kappa")
_OTHER = {"camera": "projector", "projector": "camera"}


@dataclass(frozen=True)
class Kept:
    """A lens to be kept.

    Parameters
    ----------
    name : {"camera", "projector"}
        Whose it is.
    values : ndarray, (4,)
        Focal length (px), image centre (px, px), kappa (px^-2).
    covariance : ndarray, (4, 4)
        Of these; zero where it is not known.
    source : str
        Where it comes from.
    """

    name: str
    values: Array
    covariance: Array
    source: str

    @property
    def plain(self) -> dict[str, Any]:
        """Everything as plain values, exactly."""
        lists = {"values": self.values.tolist(), "covariance": self.covariance.tolist()}
        return {"name": self.name, **lists, "source": self.source}

    @classmethod
    def of_plain(cls, values: Mapping[str, Any]) -> Kept:
        """Return what `plain` made of one."""
        arrays = {name: np.array(values[name], dtype=float) for name in ("values", "covariance")}
        return cls(name=str(values["name"]), source=str(values["source"]), **arrays)


def other_than(target: str) -> str:
    """Name of the device that is kept when ``target`` is calibrated alone."""
    return _OTHER[target]


def keep(name: str, device: Device, covariance: Covariance | None, source: str) -> Kept:
    """Take the lens of a calibrated device.

    Raises
    ------
    CalibrationError
        When its lens is not the paper's, or its pixels are not square.
    """
    fx, fy = device.focal_length_px
    if not isinstance(device.lens, Division) or fx != fy:
        raise CalibrationError(
            f"the {name} of {source} has a {type(device.lens).__name__} lens and focal lengths "
            f"({fx:g}, {fy:g}) px; expected the paper's lens and square pixels to keep: calibrate "
            "both"
        )
    return Kept(name, lens_values(device), _covariance(name, covariance), source)


def keep_of(calibration: Calibration, name: str, source: str) -> Kept:
    """Take the lens of the camera or the projector of a rig; errors as `keep`."""
    device = calibration.rig.camera if name == "camera" else calibration.rig.projector
    return keep(name, device, calibration.covariance, source)


def _covariance(name: str, covariance: Covariance | None) -> Array:
    wanted = [f"{name}.{parameter}" for parameter in _NAMES]
    if covariance is None or not set(wanted) <= set(covariance.parameters):
        return np.zeros((4, 4))
    rows = [covariance.parameters.index(parameter) for parameter in wanted]
    return np.asarray(covariance.matrix[np.ix_(rows, rows)])


def solve_keeping(solution: RigSolution, kept: Kept) -> tuple[RigSolution, float]:
    """Solve a rig again with one lens kept.

    Parameters
    ----------
    solution : RigSolution
        Of the same observations, both devices free.
    kept : Kept
        The lens.

    Returns
    -------
    solution : RigSolution
        With the kept lens; its covariance holds the lens's own.
    sigmas : float
        How far the kept lens lies from the one that the observations ask for, in sigmas: the root
        of ``d^T (C_kept + C_found)^-1 d``. Below 4.3 for 99.9 % of good ones.

    Raises
    ------
    CalibrationError
        When no solution is found with it.
    """
    free = solution.joint
    freedom = replace(free.problem.freedom, held=HeldLens(kept.name, kept.values))
    problem = RigProblem(free.problem.names, free.problem.holes, free.problem.targets, freedom)
    index = problem.names.index(kept.name)
    devices = list(free.state.devices)
    sigmas = _sigmas(free, kept, devices[index])
    devices[index] = _with_lens(devices[index], kept.values)
    held = solve_bundle(problem, free.state._replace(devices=tuple(devices)))
    bundle = _with_lens_uncertainty(held, kept)
    check_determined(bundle)
    check_side(bundle)
    return replace(solution, joint=bundle, left_out=leave_heights_out(bundle)), sigmas


def _with_lens(device: Device, values: Array) -> Device:
    focal, u, v, kappa = map(float, values)
    return replace(
        device, focal_length_px=(focal, focal), image_centre_px=(u, v), lens=Division(kappa)
    )


def _lens_columns(problem: RigProblem, name: str) -> slice:
    first = problem.columns[name].start
    return slice(first, first + len(_NAMES))


def _sigmas(free: Bundle, kept: Kept, found: Device) -> float:
    columns = _lens_columns(free.problem, kept.name)
    off = kept.values - lens_values(found)
    total = kept.covariance + free.covariance.matrix[columns, columns]
    unit = np.sqrt(np.diag(total))
    scaled = total / np.outer(unit, unit)
    return float(np.sqrt((off / unit) @ np.linalg.solve(scaled, off / unit)))


def _with_lens_uncertainty(bundle: Bundle, kept: Kept) -> Bundle:
    """Covariance with the kept lens's own error carried to all other parameters."""
    problem = bundle.problem
    lens = np.zeros(problem.size, dtype=bool)
    lens[_lens_columns(problem, kept.name)] = True
    follows = _follows(bundle, lens)
    spread = np.zeros((problem.size, len(_NAMES)))
    spread[lens], spread[~lens] = np.eye(len(_NAMES)), follows
    matrix = bundle.covariance.matrix.copy()
    matrix[lens] = matrix[:, lens] = 0.0
    matrix += spread @ kept.covariance @ spread.T
    return replace(bundle, covariance=Covariance(bundle.covariance.parameters, matrix))


def _follows(bundle: Bundle, lens: NDArray[np.bool_]) -> Array:
    """Change of all other parameters with the lens, (P - 4, 4), at the solution."""
    problem = bundle.problem
    _, jacobian = problem.evaluate(bundle.state)
    for group, scale in zip(problem.groups, bundle.scales, strict=True):
        jacobian[group] /= scale
    free = replace(problem, freedom=replace(problem.freedom, held=None))
    _, priors = free.priors(bundle.state)
    rows = np.concatenate([jacobian[bundle.used].reshape(-1, problem.size), priors])
    size = np.linalg.norm(rows, axis=0)
    rows /= size
    small = triangle(np.column_stack([rows[:, ~lens], rows[:, lens]]))
    count = int(np.sum(~lens))
    change = -solve_triangular(small[:count, :count], small[:count, count:])
    return np.asarray(change / size[~lens, np.newaxis] * size[lens])
