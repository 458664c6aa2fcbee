"""What the emulated camera does wrong on request."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields

from sl_common.errors import ConfigError


@dataclass
class CameraFaults:
    """Faults by chance, with a seed, and at certain frames.

    Frames are counted from 0 when the faults are set, one per edge that the camera takes.

    Parameters
    ----------
    seed : int
        Of the chance.
    drop, duplicate, swap, delay, stamp, lost_trigger, wrong_size, saturate, incomplete : float
        Probability, per frame, that it is taken but never delivered, is delivered twice, comes
        after the next one, comes ``delay_s`` late, is stamped ``stamp_s`` late, is never exposed,
        has a quarter of its size, is white all over, lacks half its bytes.
    delay_s, stamp_s : float
        Seconds.
    at : dict of str to list of int
        The same faults at certain frames: ``{"drop": [3]}``.

    Raises
    ------
    ConfigError
        When a probability is not between 0 and 1, or ``at`` names no fault.
    """

    seed: int = 0
    drop: float = 0.0
    duplicate: float = 0.0
    swap: float = 0.0
    delay: float = 0.0
    stamp: float = 0.0
    lost_trigger: float = 0.0
    wrong_size: float = 0.0
    saturate: float = 0.0
    incomplete: float = 0.0
    delay_s: float = 0.25
    stamp_s: float = 0.02
    at: Mapping[str, Sequence[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)
        self._frame = -1
        for kind in KINDS:
            if not 0.0 <= getattr(self, kind) <= 1.0:
                raise ConfigError(f"camera fault {kind}={getattr(self, kind)}; expected 0 to 1")
        unknown = set(self.at) - set(KINDS)
        if unknown:
            raise ConfigError(f"no camera fault is called {sorted(unknown)}; expected {KINDS}")

    def next_frame(self) -> frozenset[str]:
        """Faults of the next frame."""
        self._frame += 1
        # Every kind draws every time: the same seed gives the same drops whatever else is asked.
        chance = {kind: self._random.random() for kind in KINDS}
        return frozenset(
            kind
            for kind in KINDS
            if chance[kind] < getattr(self, kind) or self._frame in self.at.get(kind, ())
        )


#: Every fault that may happen to a frame.
KINDS = tuple(f.name for f in fields(CameraFaults) if f.default == 0.0 and f.name != "seed")
