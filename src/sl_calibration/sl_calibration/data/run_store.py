"""The folder of calibrations: one folder per run, and which of them is in force.

A rejected run stays beside the others, as evidence; the pointer file ``current`` names accepted
runs only. The file ``camera`` names the run of a camera that was calibrated alone, until a rig is
put in force.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

from sl_common.documents import read_text, write_text
from sl_common.errors import CalibrationError

CALIBRATION, OBSERVATIONS = "calibration.yaml", "observations.npz"
REPORT, PAGE = "report.json", "report.html"
#: Of a camera that was calibrated without a projector.
CAMERA, CAMERA_REPORT, CAMERA_PAGE = "camera.yaml", "camera_report.json", "camera_report.html"
_POINTER = "current"
_CAMERA_POINTER = "camera"


def default_directory() -> Path:
    """Return the user's folder of calibrations."""
    base = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    return Path(base) / "slrig" / "calibrations"


@dataclass(frozen=True)
class Store:
    """Calibrations below one directory.

    Parameters
    ----------
    directory : Path
        Made when the first run is stored.
    """

    directory: Path

    def new_run(self, kind: str = "run") -> Path:
        """Make a folder of its own for a run, named by its date."""
        stamp = time.strftime("%Y-%m-%d_%H%M%S", time.gmtime())
        for number in range(1000):
            folder = self.directory / (f"{stamp}_{kind}" + (f"_{number}" if number else ""))
            try:
                folder.mkdir(parents=True)
            except FileExistsError:
                continue
            except OSError as error:
                raise CalibrationError(
                    f"no folder can be made in {self.directory} ({error}); expected a writable "
                    "store_dir"
                ) from error
            return folder
        raise CalibrationError(f"{self.directory} holds 1000 runs of {stamp}; expected one")

    def put_in_force(self, run: Path) -> None:
        """Name a run as the one in force, in one step.

        Raises
        ------
        CalibrationError
            When it is no run of this folder with a calibration.
        """
        self._checked(run.name, CALIBRATION)
        write_text(self.directory / _POINTER, run.name + "\n")
        (self.directory / _CAMERA_POINTER).unlink(missing_ok=True)

    def put_camera(self, run: Path) -> None:
        """Name the run of a camera that waits for its projector; errors as `put_in_force`."""
        self._checked(run.name, CAMERA)
        write_text(self.directory / _CAMERA_POINTER, run.name + "\n")

    def camera(self) -> Path | None:
        """Return the file of the camera that waits for its projector; errors as `current`."""
        return self._named_by(_CAMERA_POINTER, CAMERA)

    def current(self) -> Path | None:
        """Return the calibration file in force, None when there never was one.

        Raises
        ------
        CalibrationError
            When the pointer names a run that is not here.
        """
        return self._named_by(_POINTER, CALIBRATION)

    def in_force_since_ns(self) -> int:
        """When the pointer was last changed; 0 when there is none."""
        pointer = self.directory / _POINTER
        return pointer.stat().st_mtime_ns if pointer.exists() else 0

    def _named_by(self, pointer: str, kind: str) -> Path | None:
        """Calibration of the run that a pointer names; None without a pointer."""
        file = self.directory / pointer
        if not file.exists():
            return None
        return self._checked(read_text(file, CalibrationError).strip(), kind)

    def _checked(self, name: str, kind: str) -> Path:
        """Calibration of a run; a name never leads out of the directory."""
        file = self.directory / name / kind
        if not name or Path(name).name != name or name in (".", "..") or not file.is_file():
            raise CalibrationError(
                f"{self.directory} has no run {name!r} with a {kind}; expected one"
            )
        return file
