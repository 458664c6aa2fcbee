"""All parameters against all observations: one device, or camera and projector together.

Unknown are, of each device, f (or fx, fy), C, kappa, R and T; of the stage, its true directions
and scales (and, where its readings are not trusted, each position); of the flat that patterns
fall on, its offset and slopes against the plate. The world is held by the plate: where it lies
when the stage reads zero, and its pitch, are the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sl_calibration.bundle.covariance import Linearised
from sl_calibration.bundle.derivatives import PARAMETERS, intersect, meet, moved, project
from sl_calibration.bundle.parameters import Freedom, State, lens_values
from sl_calibration.bundle.stage_model import axis_priors, moving_axes
from sl_calibration.data.solver_input import Holes, Targets
from sl_reconstruct.model.rig import Device

Array = NDArray[np.float64]

#: What a fixed lens may move by: millionths of what any calibration can tell.
_FIXED_SIGMA = np.array([1e-5, 1e-5, 1e-5, 1e-16])


@dataclass(frozen=True)
class RigProblem:
    """Residuals and derivatives of holes and targets by all parameters.

    Parameters
    ----------
    names : tuple of str
        The devices', for the parameters' names: camera, or camera and projector.
    holes : Holes
        Seen by the first device.
    targets : Targets
        Named by the first and the second device.
    freedom : Freedom
        What is estimated.
    """

    names: tuple[str, ...]
    holes: Holes
    targets: Targets
    freedom: Freedom

    @property
    def groups(self) -> Sequence[slice]:
        """Holes and targets."""
        holes = len(self.holes.pixels)
        return slice(0, holes), slice(holes, holes + len(self.targets.pixels))

    @property
    def sigma_px(self) -> Array:
        """Stated 1-sigma (M, 2) of holes, then targets."""
        return np.concatenate([self.holes.sigma_px, self.targets.sigma_px])

    @cached_property
    def positions_m(self) -> Array:
        """The stage's positions (K, 3), each once."""
        both = np.concatenate([self.holes.stage_m, self.targets.stage_m])
        return np.unique(both, axis=0)

    @cached_property
    def moving(self) -> tuple[int, ...]:
        """Axes of the stage that are estimated."""
        return () if self.freedom.stage.held else moving_axes(self.positions_m)

    def chosen(self, by_device: Array) -> Array:
        """Derivatives (..., 11) by a device, as its columns have them: f is fx and fy."""
        if not self.freedom.square_pixels:
            return by_device
        focal = by_device[..., :1] + by_device[..., 1:2]
        return np.concatenate([focal, by_device[..., 2:]], axis=-1)

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Where each block of parameters stands."""
        sizes = dict.fromkeys(self.names, PARAMETERS - self.freedom.square_pixels)
        sizes["axes"] = 3 * len(self.moving)
        sizes["errors"] = 3 * len(self.positions_m) * (self.freedom.stage.position_sigma_m > 0)
        sizes["flat"] = 3 * (self.freedom.flat is not None)
        ends = [int(end) for end in np.cumsum(list(sizes.values()))]
        starts = [0, *ends[:-1]]
        return {name: slice(a, b) for name, a, b in zip(sizes, starts, ends, strict=True)}

    @property
    def size(self) -> int:
        """Number of parameters P."""
        return int(self.columns["flat"].stop)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        focal = [""] if self.freedom.square_pixels else [".0", ".1"]
        device = [f"focal_length_px{i}" for i in focal]
        device += [f"image_centre_px.{i}" for i in range(2)] + ["kappa"]
        device += [f"{what}.{i}" for what in ("rotation_rad", "translation_m") for i in range(3)]
        names = [f"{name}.{parameter}" for name in self.names for parameter in device]
        names += [f"stage.{'xyz'[axis]}_axis.{i}" for axis in self.moving for i in range(3)]
        if self.freedom.stage.position_sigma_m > 0:
            count = len(self.positions_m)
            names += [f"stage.position_m.{k}.{i}" for k in range(count) for i in range(3)]
        if self.freedom.flat is not None:
            names += ["flat.offset_m", "flat.slope_x", "flat.slope_y"]
        return tuple(names)

    def moved(self, state: State, step: Array) -> State:
        """Move a state.

        Parameters
        ----------
        state : State
            Where to start from.
        step : ndarray, (P,)
            In the units of the parameters.

        Raises
        ------
        CalibrationError
            When the step leads to no possible state.
        """
        axes = state.axes.copy()
        axes[:, list(self.moving)] += step[self.columns["axes"]].reshape(-1, 3).T
        errors = step[self.columns["errors"]].reshape(-1, 3)
        flat = step[self.columns["flat"]]
        steps = [step[self.columns[name]] for name in self.names]
        if self.freedom.square_pixels:  # f is fx and fy
            steps = [np.concatenate([own[:1], own]) for own in steps]
        devices = tuple(map(moved, state.devices, steps))
        moved_errors = state.errors_m + errors if len(errors) else state.errors_m
        return State(devices, axes, moved_errors, state.flat + flat if len(flat) else state.flat)

    def start(self, *devices: Device) -> State:
        """State with a faultless stage and the patterns on the plate's plane."""
        return State(devices, np.eye(3), np.zeros_like(self.positions_m), np.zeros(3))

    def residuals(self, state: State) -> Array:
        """Residuals (M, 2), predicted less observed, in sigmas."""
        points = self.holes.points_m + self._shift(state, 0)
        parts = [(state.devices[0].project(points) - self.holes.pixels) / self.holes.sigma_px]
        if len(self.targets.pixels):
            normal, height, _ = self.planes(state)
            met = meet(state.devices[0], self.targets.camera_px, normal, height)
            difference = state.devices[1].project(met) - self.targets.pixels
            parts.append(difference / self.targets.sigma_px)
        return np.concatenate(parts)

    def _shift(self, state: State, group: int) -> Array:
        """How far the stage has moved each hole (0) or target (1), (N, 3)."""
        data = (self.holes, self.targets)[group]
        return np.asarray(data.stage_m @ state.axes.T + state.errors_m[self._places[group]])

    def planes(self, state: State) -> tuple[Array, Array, Array]:
        """Normal of the flat (3,), h of each target's plane (N,), and its shift (N, 3)."""
        normal = np.array([-state.flat[1], -state.flat[2], 1.0])
        shift = self._shift(state, 1)
        return normal, state.flat[0] + shift @ normal, shift

    def linearised(self, state: State) -> Linearised:
        """Residuals and derivatives, of the observations and of what is known before."""
        parts = [self._holes(state)]
        if len(self.targets.pixels):
            parts.append(self._targets(state))
        residuals, jacobian = (np.concatenate(part) for part in zip(*parts, strict=True))
        return Linearised(residuals, jacobian, *self.priors(state))

    def _place(self, stage_m: Array) -> NDArray[np.intp]:
        """Index of each row's stage position."""
        apart = np.abs(stage_m[:, np.newaxis] - self.positions_m).sum(axis=2)
        return np.asarray(np.argmin(apart, axis=1), dtype=np.intp)

    @cached_property
    def _places(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        return self._place(self.holes.stage_m), self._place(self.targets.stage_m)

    def _holes(self, state: State) -> tuple[Array, Array]:
        data, place = self.holes, self._places[0]
        seen = project(state.devices[0], data.points_m + self._shift(state, 0))
        jacobian = np.zeros((len(place), 2, self.size))
        jacobian[:, :, self.columns[self.names[0]]] = self.chosen(seen.by_device)
        self._by_shift(jacobian, seen.by_point, data.stage_m, place)
        return _in_sigmas(seen.pixels - data.pixels, jacobian, data.sigma_px)

    def _by_shift(
        self, jacobian: Array, by_shift: Array, stage_m: Array, place: NDArray[np.intp]
    ) -> None:
        """Derivatives by the stage, from those by the shift (N, 2, 3) of the part."""
        first = self.columns["axes"].start
        for i, axis in enumerate(self.moving):
            block = slice(first + 3 * i, first + 3 * i + 3)
            jacobian[:, :, block] = by_shift * stage_m[:, axis, np.newaxis, np.newaxis]
        if self.freedom.stage.position_sigma_m > 0:
            rows = np.arange(len(place))
            for i in range(3):
                jacobian[rows, :, self.columns["errors"].start + 3 * place + i] = by_shift[:, :, i]

    def _targets(self, state: State) -> tuple[Array, Array]:
        data, place = self.targets, self._places[1]
        camera, projector = state.devices
        normal, height, shift = self.planes(state)
        hit = intersect(camera, data.camera_px, normal, height)
        seen = project(projector, hit.points_m)
        by_height = np.einsum("nij,nj->ni", seen.by_point, hit.by_height)
        jacobian = np.zeros((len(shift), 2, self.size))
        by_camera = seen.by_point @ hit.by_device
        jacobian[:, :, self.columns[self.names[0]]] = self.chosen(by_camera)
        jacobian[:, :, self.columns[self.names[1]]] = self.chosen(seen.by_device)
        self._by_shift(jacobian, by_height[:, :, np.newaxis] * normal, data.stage_m, place)
        if self.freedom.flat is not None:
            across = (hit.points_m - shift)[:, np.newaxis, :2]
            level = by_height[:, :, np.newaxis]
            jacobian[:, :, self.columns["flat"]] = np.concatenate([level, level * across], axis=2)
        return _in_sigmas(seen.pixels - data.pixels, jacobian, data.sigma_px)

    def priors(self, state: State) -> tuple[Array, Array]:
        """Residuals (K,) of stage, flat and lens against what is known, derivatives (K, P)."""
        parts: list[tuple[Array, Array, slice]] = []
        stage, flat = self.freedom.stage, self.freedom.flat
        for i, axis in enumerate(self.moving):
            first = self.columns["axes"].start + 3 * i
            parts.append((*axis_priors(state.axes, axis, stage), slice(first, first + 3)))
        if stage.position_sigma_m > 0:
            values = state.errors_m.ravel() / stage.position_sigma_m
            scale = np.eye(len(values)) / stage.position_sigma_m
            parts.append((values, scale, self.columns["errors"]))
        if flat is not None:
            sigma = np.array([flat.offset_sigma_m, flat.slope_sigma, flat.slope_sigma])
            parts.append((state.flat / sigma, np.diag(1 / sigma), self.columns["flat"]))
        if fixed := self.freedom.fixed:
            first = self.columns[fixed.name].start
            off = lens_values(state.devices[self.names.index(fixed.name)]) - fixed.values
            scale = np.diag(1 / _FIXED_SIGMA)
            parts.append((off / _FIXED_SIGMA, scale, slice(first, first + 4)))
        jacobian = np.zeros((sum(len(values) for values, _, _ in parts), self.size))
        row = 0
        for values, block, columns in parts:
            jacobian[row : row + len(values), columns] = block
            row += len(values)
        return np.concatenate([np.empty(0), *(values for values, _, _ in parts)]), jacobian


def _in_sigmas(difference: Array, jacobian: Array, sigma: Array) -> tuple[Array, Array]:
    return difference / sigma, jacobian / sigma[:, :, np.newaxis]
