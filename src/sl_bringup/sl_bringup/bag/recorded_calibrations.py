"""Which calibration holds for a recorded stack: a file that was named, or the bag's own."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path

from sl_bringup.bag.bags import Bag, Recorded
from sl_common.errors import CalibrationError, SlError
from sl_common.topics import CALIBRATION
from sl_projector.sequence.stack import Stack
from sl_reconstruct.model.calibration_file import Calibration, load_calibration, parse_calibration


@dataclass(frozen=True)
class InForce:
    """A calibration and where it comes from.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    source : str
        Where it comes from.
    received_ns : int
        When it came into force.
    mismatch : str
        What speaks against it: the bag holds another one. Empty when nothing does.
    """

    calibration: Calibration
    source: str
    received_ns: int = 0
    mismatch: str = ""


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
        self._read: dict[tuple[tuple[int, int], tuple[int, int]], Calibration] = {}
        self._lock = threading.Lock()
        self.recorded = _recorded_hashes(bag) if file else _recorded_calibrations(bag)
        if file is None and not self.recorded:
            raise CalibrationError(
                f"{bag.path} holds no calibration and none is named; expected "
                f"{bag.namespace}/{CALIBRATION.name} in the bag, or --calibration FILE"
            )

    def of(self, stack: Stack) -> InForce:
        """Calibration of a stack; a file may need the sizes that only the stack knows."""
        recorded = self._recorded_at(stack.stamps_ns[0])
        if self._file is None:
            assert recorded is not None
            return recorded
        found = self._from_file(self._file, stack.image_size, stack.sequence.dmd_size)
        differs = recorded is not None and recorded.calibration.hash != found.hash
        mismatch = (
            f"{self._file} ({found.hash[:12]}) is used, though the bag holds another calibration "
            f"({recorded.calibration.hash[:12]}, {recorded.source})"
            if recorded is not None and differs
            else ""
        )
        return InForce(found, str(self._file), mismatch=mismatch)

    def _recorded_at(self, stamp_ns: int) -> InForce | None:
        known = [c for c in self.recorded if c.received_ns <= stamp_ns]
        return known[-1] if known else next(iter(self.recorded), None)

    def _from_file(
        self, file: Path, image_size: tuple[int, int], dmd_size: tuple[int, int]
    ) -> Calibration:
        with self._lock:
            key = (image_size, dmd_size)
            if key not in self._read:
                self._read[key] = load_calibration(file, image_size, dmd_size)
            return self._read[key]


def _recorded_hashes(bag: Bag) -> list[InForce]:
    """Calibrations of the bag to compare with; a bag's bad one does no harm beside a good file."""
    try:
        return _recorded_calibrations(bag)
    except SlError:
        return []


def _recorded_calibrations(bag: Bag) -> list[InForce]:
    """Usable calibrations of the bag; unusable ones are told, and raised when there is no other."""
    found, faults = [], []
    for recorded in bag.messages(CALIBRATION, quick=True):
        try:
            found.append(_recorded_calibration(bag, recorded))
        except SlError as error:
            faults.append(error)
    if faults and not found:
        raise faults[0]
    for fault in faults:
        bag.lose(str(fault))
    return sorted(found, key=lambda c: c.received_ns)


def _recorded_calibration(bag: Bag, recorded: Recorded) -> InForce:
    message = recorded.message
    calibration = parse_calibration(message.yaml, f"{bag.path}: {CALIBRATION.name}")
    if message.hash and message.hash != calibration.hash:
        raise CalibrationError(
            f"{bag.path}: the calibration in the bag says hash {message.hash[:12]}... but has "
            f"{calibration.hash[:12]}..."
        )
    source = f"{bag.path.name} (recorded from {message.source or 'an unnamed source'})"
    return InForce(calibration, source, recorded.received_ns)
