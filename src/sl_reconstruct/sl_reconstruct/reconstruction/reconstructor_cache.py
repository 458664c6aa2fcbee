"""The calibration in force, the settings, and a reconstructor for every sequence that comes."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_common.errors import CalibrationError
from sl_common.kernel_cache import compiled_mark
from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence, named
from sl_reconstruct.cloud.cloud import Cloud, median
from sl_reconstruct.decode.settings import Settings
from sl_reconstruct.model.calibration_file import Calibration
from sl_reconstruct.model.rig import Device, Division, Rig
from sl_reconstruct.reconstruction.reconstructor import Reconstructor

#: Sequences whose reconstructor, with its scratch memory, is kept.
MAX_SEQUENCES = 1
_TINY_CAMERA, _TINY_DMD = (64, 16), (32, 24)


class Product(NamedTuple):
    """A cloud and what it was made with."""

    cloud: Cloud
    calibration_hash: str
    settings_hash: str


class Workshop:
    """Makes clouds of stacks; calibration and stacks may come from different threads.

    Parameters
    ----------
    settings : Settings
        How a stack becomes a cloud.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.settings_hash = settings.hash()
        self._lock = threading.Lock()
        self._calibration: Calibration | None = None
        self._hash = ""
        self._made: OrderedDict[tuple[object, ...], Reconstructor] = OrderedDict()

    @property
    def calibration_hash(self) -> str:
        """Hash of the calibration in force; empty when there is none."""
        return self._hash

    def calibrate(self, calibration: Calibration) -> None:
        """Put a calibration in force, from the next stack on."""
        with self._lock:
            self._calibration, self._hash = calibration, calibration.hash
            self._made.clear()

    def __call__(
        self,
        images: NDArray[np.uint8] | NDArray[np.uint16],
        sequence: PatternSequence,
        saturation_dn: int | None = None,
    ) -> Product:
        """Make a cloud.

        Parameters
        ----------
        images : ndarray, (N, H, W), uint8 or uint16
            In pattern order.
        sequence : PatternSequence
            What was projected.
        saturation_dn : int, optional
            What `saturation_of` says of them, where it was asked already.

        Raises
        ------
        CalibrationError
            When no calibration is in force.
        StackError
            When the images fit neither the sequence nor the calibration.
        """
        with self._lock:
            reconstructor, used = self._reconstructor(sequence), self._hash
        return Product(reconstructor(images, saturation_dn), used, self.settings_hash)

    def _reconstructor(self, sequence: PatternSequence) -> Reconstructor:
        if self._calibration is None:
            raise CalibrationError("no calibration is in force; expected one before a stack")
        key: tuple[tuple[int, int], tuple[Pattern, ...]] = (sequence.dmd_size, sequence.patterns)
        if key not in self._made:
            self._made[key] = Reconstructor(self._calibration.rig, sequence, self.settings)
        self._made.move_to_end(key)
        while len(self._made) > MAX_SEQUENCES:
            self._made.popitem(last=False)
        return self._made[key]


def warm_up(rest: bool = False) -> None:
    """Compile, or load from the cache, what the first stack would wait for.

    Parameters
    ----------
    rest : bool
        What most rigs do not need at once: row patterns and 16-bit images.
    """
    kinds = [("precise-rows", np.uint8), ("precise-rows", np.uint16)] if rest else []
    for name, dtype in kinds or [("precise", np.uint8)]:
        sequence = named(name, _TINY_DMD)
        stack = np.zeros((len(sequence), *_TINY_CAMERA[::-1]), dtype)
        cloud = Reconstructor(tiny_rig(), sequence)(stack)
        for values in (cloud.points["sigma"], cloud.gap_m):
            if values is not None:
                median(values)
    with contextlib.suppress(OSError):
        _mark(rest).touch()


def compiled(rest: bool = False) -> bool:
    """Tell whether `warm_up` ran before on the sources as they are."""
    return _mark(rest).exists()


def _mark(rest: bool) -> Path:
    return compiled_mark("sl_reconstruct", "row_patterns" if rest else "column_patterns")


def compile_apart(rest: bool = False) -> subprocess.Popen[bytes]:
    """Start another process that does `warm_up`, into numba's cache.

    The compiler leaves 230 MB behind in the process that it ran in, for as long as that lives.
    """
    return subprocess.Popen(
        [
            sys.executable,
            "-m",
            "sl_reconstruct.reconstruction.reconstructor_cache",
            *(["rest"] if rest else []),
        ],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def tiny_rig() -> Rig:
    """Return a rig of few pixels, two devices side by side above the world's plane."""

    def device(size: tuple[int, int], x_m: float) -> Device:
        centre: Any = ((size[0] - 1) / 2, (size[1] - 1) / 2)
        down = np.diag([1.0, -1.0, -1.0])
        return Device(size, (400.0, 400.0), centre, 1e-5, down, np.array([x_m, 0, 0.1]), Division())

    return Rig(device(_TINY_CAMERA, 0.02), device(_TINY_DMD, -0.02))


if __name__ == "__main__":
    if "rest" in sys.argv[1:]:
        os.nice(19)
    warm_up("rest" in sys.argv[1:])
