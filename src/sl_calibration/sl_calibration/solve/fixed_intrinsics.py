"""One device calibrated, the other with its lens fixed: as an earlier calibration has it.

Only the lens (f, C, kappa) can be fixed. Where both devices stand is measured again: the plate,
which is the world, need not lie where it lay before.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from sl_calibration.bundle.bundle_adjustment import Bundle, solve_bundle
from sl_calibration.bundle.covariance import triangle
from sl_calibration.bundle.parameters import FixedLens, lens_values
from sl_calibration.bundle.rig_problem import RigProblem
from sl_calibration.solve.observability import check_solution
from sl_common.errors import CalibrationError
from sl_reconstruct.model.calibration_file import Calibration, Covariance
from sl_reconstruct.model.rig import Device, Division

Array = NDArray[np.float64]

_NAMES = ("focal_length_px", "image_centre_px.0", "image_centre_px.1", "kappa")


def fixed_lens(name: str, device: Device, covariance: Covariance | None, source: str) -> FixedLens:
    """Take the lens of a calibrated device.

    Parameters
    ----------
    name : {"camera", "projector"}
        Whose it is.
    device : Device
        The calibrated device.
    covariance : Covariance or None
        Of the calibration; the lens counts as exact where it says nothing of it.
    source : str
        Where the calibration comes from.

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
    return FixedLens(name, lens_values(device), _covariance(name, covariance), source)


def fixed_lens_of(calibration: Calibration, name: str, source: str) -> FixedLens:
    """Take the lens of the camera or the projector of a rig.

    Parameters
    ----------
    calibration : Calibration
        The rig and its covariance.
    name, source : str
        As in `fixed_lens`, which also says what is refused.
    """
    device = calibration.rig.camera if name == "camera" else calibration.rig.projector
    return fixed_lens(name, device, calibration.covariance, source)


def _covariance(name: str, covariance: Covariance | None) -> Array:
    wanted = [f"{name}.{parameter}" for parameter in _NAMES]
    if covariance is None or not set(wanted) <= set(covariance.parameters):
        return np.zeros((4, 4))
    rows = [covariance.parameters.index(parameter) for parameter in wanted]
    return np.asarray(covariance.matrix[np.ix_(rows, rows)])


def solve_with_fixed_lens(free: Bundle, lens: FixedLens) -> tuple[Bundle, float]:
    """Solve a rig again with one lens fixed.

    Parameters
    ----------
    free : Bundle
        Of the same observations, both devices free.
    lens : FixedLens
        The lens.

    Returns
    -------
    bundle : Bundle
        With the fixed lens; its covariance holds the lens's own.
    sigmas : float
        How far the fixed lens lies from the one that the observations ask for, in sigmas: the root
        of ``d^T (C_fixed + C_found)^-1 d``. Below 4.3 for 99.9 % of good ones.

    Raises
    ------
    CalibrationError
        When no solution is found with it.
    """
    problem = replace(free.problem, freedom=replace(free.problem.freedom, fixed=lens))
    index = problem.names.index(lens.name)
    devices = list(free.state.devices)
    sigmas = _sigmas(free, lens, devices[index])
    devices[index] = _with_lens(devices[index], lens.values)
    bundle = solve_bundle(problem, free.state._replace(devices=tuple(devices)))
    bundle = _with_lens_uncertainty(bundle, lens)
    check_solution(bundle)
    return bundle, sigmas


def _with_lens(device: Device, values: Array) -> Device:
    focal, u, v, kappa = map(float, values)
    return replace(
        device, focal_length_px=(focal, focal), image_centre_px=(u, v), lens=Division(kappa)
    )


def _lens_columns(problem: RigProblem, name: str) -> slice:
    first = problem.columns[name].start
    return slice(first, first + len(_NAMES))


def _sigmas(free: Bundle, lens: FixedLens, found: Device) -> float:
    columns = _lens_columns(free.problem, lens.name)
    off = lens.values - lens_values(found)
    total = lens.covariance + free.covariance.matrix[columns, columns]
    unit = np.sqrt(np.diag(total))
    scaled = total / np.outer(unit, unit)
    return float(np.sqrt((off / unit) @ np.linalg.solve(scaled, off / unit)))


def _with_lens_uncertainty(bundle: Bundle, lens: FixedLens) -> Bundle:
    """Covariance with the fixed lens's own error carried to all other parameters."""
    problem = bundle.problem
    own = np.zeros(problem.size, dtype=bool)
    own[_lens_columns(problem, lens.name)] = True
    spread = np.zeros((problem.size, len(_NAMES)))
    spread[own], spread[~own] = np.eye(len(_NAMES)), _change_with_lens(bundle, own)
    matrix = bundle.covariance.matrix.copy()
    matrix[own] = matrix[:, own] = 0.0
    matrix += spread @ lens.covariance @ spread.T
    return replace(bundle, covariance=Covariance(bundle.covariance.parameters, matrix))


def _change_with_lens(bundle: Bundle, lens: NDArray[np.bool_]) -> Array:
    """Change of all other parameters with the lens, (P - 4, 4), at the solution."""
    problem = bundle.problem
    jacobian = bundle.linearised().jacobian
    free = replace(problem, freedom=replace(problem.freedom, fixed=None))
    _, priors = free.priors(bundle.state)
    rows = np.concatenate([jacobian[bundle.used].reshape(-1, problem.size), priors])
    size = np.linalg.norm(rows, axis=0)
    rows /= size
    small = triangle(np.column_stack([rows[:, ~lens], rows[:, lens]]))
    count = int(np.sum(~lens))
    change = -solve_triangular(small[:count, :count], small[:count, count:])
    return np.asarray(change / size[~lens, np.newaxis] * size[lens])
