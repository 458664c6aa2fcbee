"""The bench's section of the configuration file: `/sl/bench: ros__parameters:`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from sl_bench.world.mounting import Triple
from sl_bench.world.optics import Optics, check_ranges
from sl_bench.world.reference_rig import reference_rig
from sl_bench.world.true_rig import read_rig
from sl_common.documents import (
    Fields,
    a_flag,
    a_number,
    a_whole_number,
    describe,
    numbers,
    read_document,
)
from sl_common.errors import ConfigError
from sl_projector.dlpc.dmd import DEFAULT_MODEL, DmdModel, dmd_model
from sl_reconstruct.model.rig import Rig

SECTION = "/sl/bench"


@dataclass(frozen=True)
class BenchSettings:
    """What the simulated bench is made of.

    Parameters
    ----------
    surface, surface_parameters, finish : str, mapping, str
        The part: `sl_bench.world.surfaces.make_surface`, `sl_bench.world.optics.make_finish`.
    rig : str
        "reference", or a calibration file (format 1), relative to the configuration file.
    optics : mapping
        Fields of `sl_bench.world.optics.Optics` but the seed.
    seed : int
        Of all noise and chance.
    dmd_model : str
        TI's part number; its size must be that of the rig's projector.
    camera_frame_rate_hz, camera_readout_s : float
        Fastest frame rate; time from the end of an exposure to the frame's delivery.
    camera_gige : str
        Serve the camera as a GigE Vision device on this network address (127.0.0.1, the driver's
        address is then ``aravis:BENCH``); empty: on a local socket.
    stage_travel_m : tuple of float
        Travel of x, y, z; zero is in the middle.
    stage_homed : bool
        Start homed at zero; otherwise the controller is locked as after power-up.
    stage_scale, stage_squareness_rad, plate_tilt_rad, part_offset_m : tuple of float
        See `Mounting`.
    runtime_dir : str
        Where the endpoints are: `usb.sock`, `camera.sock`, `stage`, `control.sock`.
    niceness : int
        Rendering leaves the processor to the nodes: added to the process's nice value.
    """

    surface: str = "groove"
    surface_parameters: Mapping[str, Any] = field(default_factory=dict)
    finish: str = "matt"
    rig: str = "reference"
    optics: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    dmd_model: str = DEFAULT_MODEL
    camera_frame_rate_hz: float = 30.0
    camera_gige: str = ""
    camera_readout_s: float = 0.004
    stage_travel_m: Triple = (0.05, 0.05, 0.02)
    stage_homed: bool = True
    stage_scale: Triple = (1.0, 1.0, 1.0)
    stage_squareness_rad: Triple = (0.0, 0.0, 0.0)
    plate_tilt_rad: Triple = (0.0, 0.0, 0.0)
    part_offset_m: Triple = (0.0, 0.0, 0.0)
    runtime_dir: str = ""
    niceness: int = 5

    def __post_init__(self) -> None:
        for name, default in _DEFAULTS.items():
            value = _read_like(default, getattr(self, name), f"{SECTION}: {name}")
            object.__setattr__(self, name, value)
        check_ranges(self, SECTION, camera_frame_rate_hz=(0.01, 1e4), camera_readout_s=(0.0, 10.0))
        if not all(0.001 <= travel <= 1 for travel in self.stage_travel_m):
            raise ConfigError(f"stage_travel_m={self.stage_travel_m}; expected 0.001 to 1 each")

    def make_rig(self) -> Rig:
        """Return the true rig.

        Raises
        ------
        CalibrationError
            When its file cannot be used.
        """
        return reference_rig() if self.rig == "reference" else read_rig(self.rig)

    def make_optics(self) -> Optics:
        """Return light, blur and sensor."""
        try:
            return Optics(**{**self.optics, "seed": self.seed})
        except TypeError as error:
            raise ConfigError(f"optics: {error}") from None

    def make_model(self, rig: Rig) -> DmdModel:
        """Return the DMD, checked against the rig's projector."""
        model = dmd_model(self.dmd_model)
        if model.size != rig.projector.image_size:
            raise ConfigError(
                f"dmd_model {model.name} has {model.size} mirrors, the rig's projector "
                f"{rig.projector.image_size}; expected the same"
            )
        return model


_DEFAULTS: dict[str, Any] = {
    option.name: {} if option.default is MISSING else option.default
    for option in fields(BenchSettings)
}


def _read_like(default: Any, value: Any, where: str) -> Any:
    """Value of a setting, checked to be of the default's type."""
    if isinstance(default, tuple):
        items = list(value) if isinstance(value, tuple) else value
        return tuple(numbers(len(default))(items, where, ConfigError))
    if isinstance(default, bool):
        return a_flag(value, where, ConfigError)
    if isinstance(default, int):
        return a_whole_number(value, where, ConfigError)
    if isinstance(default, float):
        return a_number(value, where, ConfigError)
    if not isinstance(value, str if isinstance(default, str) else Mapping):
        raise ConfigError(f"{where} is {describe(value)}; expected such as {default!r}")
    return value


def read_settings(path: str | Path) -> BenchSettings:
    """Read the bench's section of a ROS parameter file; the rest of the file is not looked at.

    Raises
    ------
    ConfigError
        When the file cannot be read, or a key is unknown or out of range.
    """
    path = Path(path)
    document = read_document(path, ConfigError)
    section = document.get(SECTION, {}) if isinstance(document, dict) else None
    parameters = section.get("ros__parameters", {}) if isinstance(section, dict) else None
    Fields(parameters, f"{path}: {SECTION}: ros__parameters", ConfigError, list(_DEFAULTS))
    assert isinstance(parameters, dict)
    settings = BenchSettings(**parameters)
    if settings.rig != "reference":
        settings = replace(settings, rig=str(path.parent / settings.rig))
    return settings
