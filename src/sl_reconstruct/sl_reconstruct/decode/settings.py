"""Settings of the reconstruction: what a user may choose, with units in the names."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args

from sl_common.errors import ConfigError

Estimator = Literal["matched", "cubic"]


@dataclass(frozen=True)
class Settings:
    """How a stack becomes a cloud.

    Parameters
    ----------
    estimator : {"matched", "cubic"}
        "matched": zero crossing of the pattern after a matched filter. "cubic": the paper's
        third-order fit with secant, and BR8 (Eq. 6) for the centres.
    edge_blur_px : float, optional
        Standard deviation of an edge's blur, camera pixels. None measures it in each stack.
    min_contrast_dn : float, optional
        Least difference between lit and unlit at an edge. None is 3 % of the full scale.
    saturation_dn : int, optional
        Values from here on are saturated. None is the full scale of the stack: 255 for 8 bits;
        for 16-bit images that of the fewest bits (10, 12, 14, 16) that hold every value.
    max_jump_px : float
        An edge is refused when it lies further than this from where its neighbours on either
        side lead: at a depth step the blur mixes two surfaces. Camera pixels.
    min_spacing : float
        An edge is refused when the next boundary is nearer than this part of their usual
        distance: behind a wall that the camera does not see, boundaries crowd.
    min_slope, max_slope : float
        Bounds of an edge's slope over the slope that the blur makes expect.
    min_light : float
        Least light under an edge as a fraction of the light on its brighter side.
    max_gap_px : float, optional
        With rows: refuse points whose camera and projector rays miss each other by more than so
        many pixels. None refuses none.
    max_light_change : float
        A stack is refused when an image is brighter or darker than others of the same stripes by
        more than this part; twice that is allowed to one without such, four times to white and
        black, which move no edge. See ``frame_light``.

    Raises
    ------
    ConfigError
        When a value is out of its range.
    """

    estimator: Estimator = "matched"
    edge_blur_px: float | None = None
    min_contrast_dn: float | None = None
    saturation_dn: int | None = None
    max_jump_px: float = 0.7
    min_spacing: float = 0.3
    min_slope: float = 0.5
    max_slope: float = 1.7
    min_light: float = 0.25
    max_gap_px: float | None = None
    max_light_change: float = 0.03

    def __post_init__(self) -> None:
        if self.estimator not in get_args(Estimator):
            raise ConfigError(
                f"estimator={self.estimator!r}; expected one of {get_args(Estimator)}"
            )
        for name in ("edge_blur_px", "min_contrast_dn", "saturation_dn", "max_gap_px"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ConfigError(f"{name}={value}; expected a positive number or nothing")
        if not (0 <= self.min_slope < self.max_slope and self.max_jump_px > 0):
            raise ConfigError(
                f"min_slope={self.min_slope}, max_slope={self.max_slope}, "
                f"max_jump_px={self.max_jump_px}; expected 0 <= min < max and a positive jump"
            )
        if not self.max_light_change > 0:
            raise ConfigError(f"max_light_change={self.max_light_change}; expected more than 0")
        for name in ("min_light", "min_spacing"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"{name}={getattr(self, name)}; expected 0 <= {name} < 1")

    def to_dict(self) -> dict[str, Any]:
        """Plain values by name, for files."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Settings:
        """Return the settings of ``to_dict``; missing ones keep their defaults.

        Raises
        ------
        ConfigError
            When a name is unknown or a value cannot be used.
        """
        unknown = sorted(set(values) - {f.name for f in fields(cls)})
        if unknown:
            raise ConfigError(
                f"unknown settings {unknown}; expected some of {[f.name for f in fields(cls)]}"
            )
        try:
            return cls(**values)
        except TypeError as error:
            raise ConfigError(f"a setting has the wrong type: {error}") from error

    def hash(self) -> str:
        """Hexadecimal SHA-256 of the settings."""
        text = json.dumps(self.to_dict(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()
