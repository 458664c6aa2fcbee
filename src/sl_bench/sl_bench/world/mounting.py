"""How the part stands on the stage, and what the stage's axes really do."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import ConfigError

Array = NDArray[np.float64]
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Mounting:
    """Stage position to part pose.

    Parameters
    ----------
    scale : tuple of float
        True travel of x, y, z per metre that the controller believes in; 1 is right.
    squareness_rad : tuple of float
        Angles by which y leans towards x, z towards x, z towards y; 0 is square.
    tilt_rad : tuple of float
        The plate is turned about world x, then y, then z.
    offset_m : tuple of float
        Where the part's origin stands in the world with the stage at zero, metres.

    Raises
    ------
    ConfigError
        When a number is not finite or a scale not positive.
    """

    scale: Triple = (1.0, 1.0, 1.0)
    squareness_rad: Triple = (0.0, 0.0, 0.0)
    tilt_rad: Triple = (0.0, 0.0, 0.0)
    offset_m: Triple = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("scale", "squareness_rad", "tilt_rad", "offset_m"):
            value = getattr(self, name)
            if len(value) != 3 or not all(map(math.isfinite, value)):
                raise ConfigError(f"{name}={value}; expected three numbers")
        if min(self.scale) <= 0:
            raise ConfigError(f"scale={self.scale}; expected positive numbers")

    @property
    def axes(self) -> Array:
        """Where the stage's axes really go, (3, 3), one axis per column."""
        yx, zx, zy = self.squareness_rad
        lean = np.array(
            [[1.0, math.sin(yx), math.sin(zx)], [0, math.cos(yx), math.sin(zy)], [0, 0, 1]]
        )
        return np.asarray(lean * np.array(self.scale))

    @property
    def rotation(self) -> Array:
        """world_from_part rotation, (3, 3)."""
        (cx, sx), (cy, sy), (cz, sz) = ((math.cos(a), math.sin(a)) for a in self.tilt_rad)
        about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        return np.asarray(about_z @ about_y @ about_x)

    def pose(self, stage_m: Triple) -> tuple[Array, Array]:
        """world_from_part with the stage at a position: rotation (3, 3), translation (3,)."""
        return self.rotation, np.asarray(self.offset_m + self.axes @ np.array(stage_m))
