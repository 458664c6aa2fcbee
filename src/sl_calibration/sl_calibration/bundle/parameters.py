"""What a bundle changes, and what is known of it before: stage, flat, and a lens that stays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_calibration.bundle.derivatives import kappa_of
from sl_calibration.bundle.stage_model import StagePrior
from sl_reconstruct.model.rig import Device

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FlatPrior:
    """How well the flat under the patterns is known against the plate, 1-sigma each.

    Parameters
    ----------
    offset_sigma_m : float
        Height of its surface over the plate's, at the world's origin, metres.
    slope_sigma : float
        Slope along x and y, metres per metre.
    """

    offset_sigma_m: float = 1e-3
    slope_sigma: float = 0.05


@dataclass(frozen=True)
class FixedLens:
    """The lens of a device that a solution must not change.

    Parameters
    ----------
    name : {"camera", "projector"}
        The device.
    values : ndarray, (4,)
        Focal length (px), image centre (px, px), kappa (px^-2).
    covariance : ndarray, (4, 4)
        Of these; zero where it is not known.
    source : str
        Where the lens comes from.
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
    def of_plain(cls, values: Mapping[str, Any]) -> FixedLens:
        """Return what `plain` made of one."""
        arrays = {name: np.array(values[name], dtype=float) for name in ("values", "covariance")}
        return cls(name=str(values["name"]), source=str(values["source"]), **arrays)


def lens_values(device: Device) -> Array:
    """Focal length, image centre and kappa (4,) of a device with square pixels."""
    return np.array([device.focal_length_px[0], *device.image_centre_px, kappa_of(device)])


@dataclass(frozen=True)
class Freedom:
    """What the bundle estimates besides the devices.

    Parameters
    ----------
    stage : StagePrior
        How far the stage is trusted.
    flat : FlatPrior or None
        None where the patterns fall on the plate itself.
    square_pixels : bool
        One focal length (the paper's), or fx and fy.
    fixed : FixedLens or None
        The lens that stays as it is; for square pixels only.
    """

    stage: StagePrior = field(default_factory=StagePrior)
    flat: FlatPrior | None = None
    square_pixels: bool = True
    fixed: FixedLens | None = None


class State(NamedTuple):
    """Everything that the bundle changes.

    ``devices``: camera, or camera and projector; ``axes`` (3, 3), the stage's A; ``errors_m``
    (K, 3) of its positions; ``flat``: offset (metres) and slopes along x and y.
    """

    devices: tuple[Device, ...]
    axes: Array
    errors_m: Array
    flat: Array
