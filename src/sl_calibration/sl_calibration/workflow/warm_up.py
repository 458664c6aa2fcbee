"""Compile what the first calibration would wait for, in a process of its own.

The compiler leaves much memory behind in the process that it ran in; numba's cache on disk is
shared, so the node starts this module as a process of its own.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys

from sl_common.kernel_cache import compiled_mark

_MARK = ("sl_calibration", "first_calibration")
_DMD, _CAMERA = (64, 48), (96, 64)
_HOLES, _STEP_PX, _RADIUS_PX = 6, 32, 8
#: The nodes' own work comes first.
_NICENESS = 10


def warm_up() -> None:
    """Find a drawn plate, and decode a stack without anything in it."""
    # Imported late: if everything is compiled, the process ends without a second of imports.
    import numpy as np

    from sl_calibration.target.hole_detection import find_plate
    from sl_calibration.target.plate import Plate
    from sl_projector.sequence.pattern_sequence import named
    from sl_reconstruct.reconstruction.correspondence import correspondences

    side = _HOLES * _STEP_PX
    v, u = np.mgrid[:side, :side]
    off = np.hypot(u % _STEP_PX - _STEP_PX / 2, v % _STEP_PX - _STEP_PX / 2)
    image = (20.0 + 160.0 * np.clip(off - _RADIUS_PX + 0.5, 0.0, 1.0)).astype(np.float32)
    find_plate(image, Plate(_HOLES, _HOLES), 255.0)
    sequence = named("precise-rows", _DMD)
    correspondences(np.zeros((len(sequence), *_CAMERA[::-1]), np.uint8), sequence)
    with contextlib.suppress(OSError):
        compiled_mark(*_MARK).touch()


def warm_up_apart() -> subprocess.Popen[bytes]:
    """Start another process that runs `warm_up` and fills numba's cache."""
    return subprocess.Popen(
        [sys.executable, "-m", "sl_calibration.workflow.warm_up"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


if __name__ == "__main__" and not compiled_mark(*_MARK).exists():
    os.nice(_NICENESS)
    warm_up()
