"""Which calibration holds for a recorded stack: a file that was named, or the bag's own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sl_bringup.bags import CALIBRATION, Bag
from sl_camera.matching import MatchedStack
from sl_projector.errors import CalibrationError
from sl_reconstruct.calibration_file import Calibration, load_calibration, parse_calibration


@dataclass(frozen=True)
class InForce:
    """A calibration and where it comes from; ``received_ns`` is when it came into force."""

    calibration: Calibration
    source: str
    received_ns: int = 0


class Calibrations:
    """Which calibration holds for a stack: the file that was named, else the bag's at the time.

    Parameters
    ----------
    bag : Bag
        The recording.
    file : Path or None
        Named by the user.

    Raises
    ------
    CalibrationError
        When there is none, or the bag's cannot be used.
    """

    def __init__(self, bag: Bag, file: Path | None) -> None:
        self._file = file
        self._read: dict[tuple[tuple[int, int], tuple[int, int]], InForce] = {}
        self.recorded = [] if file else _recorded_calibrations(bag)
        if file is None and not self.recorded:
            raise CalibrationError(
                f"{bag.path} holds no calibration and none is named; expected "
                f"{bag.namespace}/{CALIBRATION.name} in the bag, or --calibration FILE"
            )

    def of(self, stack: MatchedStack) -> InForce:
        """Calibration of a stack; a file may need the sizes that only the stack knows."""
        if self._file is None:
            start_ns = stack.image_stamps_ns[0]
            known = [c for c in self.recorded if c.received_ns <= start_ns]
            return known[-1] if known else self.recorded[0]
        _, height, width = stack.data.shape
        sizes = ((width, height), stack.sequence.dmd_size)
        if sizes not in self._read:
            found = load_calibration(self._file, *sizes)
            self._read[sizes] = InForce(found, str(self._file))
        return self._read[sizes]


def _recorded_calibrations(bag: Bag) -> list[InForce]:
    found = []
    for recorded in bag.messages(CALIBRATION, quick=True):
        message = recorded.message
        calibration = parse_calibration(message.yaml, f"{bag.path}: {CALIBRATION.name}")
        if message.hash and message.hash != calibration.hash:
            raise CalibrationError(
                f"{bag.path}: the calibration in the bag says hash {message.hash[:12]}... but has "
                f"{calibration.hash[:12]}..."
            )
        source = f"{bag.path.name} (recorded from {message.source or 'an unnamed source'})"
        found.append(InForce(calibration, source, recorded.received_ns))
    return sorted(found, key=lambda c: c.received_ns)
