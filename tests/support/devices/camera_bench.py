"""Cameras for tests: each kind of driver with something at its other end."""

from __future__ import annotations

import fcntl
import importlib.util
import itertools
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from sl_bench.camera.camera_emulator import CameraEmulator, Exposure
from sl_bench.camera.endpoint import Execute
from sl_bench.camera.gige_camera import GigeCamera
from sl_bringup.bag.bag_writer import new_bag
from sl_camera.camera.camera import CameraDriver
from sl_camera.drivers.aravis_camera import AravisCamera
from sl_camera.drivers.aravis_library import load_aravis
from sl_camera.drivers.camera_drivers import make_camera
from sl_camera.drivers.replay_camera import ReplayCamera
from sl_camera.drivers.socket_camera import SocketCamera
from sl_camera.drivers.uvc_camera import UvcCamera, UvcOptions
from sl_common.errors import DeviceError

WIDTH, HEIGHT = 64, 48
SERIAL = "SLRIG"
FAKE_CAMERA = "arv-fake-gv-camera-0.8"
DEBIAN_GI = Path("/usr/lib/python3/dist-packages/gi")


@dataclass
class Made:
    """A driver, and what a test may ask of its kind.

    Parameters
    ----------
    driver : CameraDriver
        Closed.
    unplug : callable or None
        Takes the camera away.
    region : tuple of int or None
        A region for the tests, where the whole sensor would take too long.
    regions : bool
        Whether it can do regions.
    """

    driver: CameraDriver
    region: tuple[int, int, int, int] | None = None
    regions: bool = True


# -- the bench's camera on its emulator -----------------------------------------------------------


def count_frames(exposure: Exposure) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), exposure.number % 256, np.uint8)


@contextmanager
def emulated(tmp_path: Path) -> Iterator[Made]:
    emulator = CameraEmulator(
        tmp_path / "camera.sock", count_frames, (WIDTH, HEIGHT), max_rate_hz=1000.0, readout_s=0.0
    )
    emulator.start()
    try:
        yield Made(SocketCamera(tmp_path / "camera.sock"))
    finally:
        emulator.close()


# -- a recording ----------------------------------------------------------------------------------


def write_bag(path: Path, images: np.ndarray, start_ns: int = 1_700_000_000_000_000_000) -> Path:
    """A recording of these frames, 10 ms apart."""
    with new_bag(path) as bag:
        for i, image in enumerate(images):
            stamp_ns = start_ns + i * 10_000_000
            bag.image(image, stamp_ns, stamp_ns + 5_000_000)
    return path


@contextmanager
def recorded(tmp_path: Path) -> Iterator[Made]:
    images = np.broadcast_to(np.arange(20, dtype=np.uint8)[:, None, None], (20, HEIGHT, WIDTH))
    yield Made(ReplayCamera(write_bag(tmp_path / "bag", images)), regions=False)


# -- a webcam -------------------------------------------------------------------------------------


class FakeCapture:
    """What `cv2.VideoCapture` is to the driver: runs free, has an old frame in its buffer."""

    PERIOD_S = 0.01

    def __init__(self, longest_exposure_s: float = 1.0) -> None:
        self.properties = {
            cv2.CAP_PROP_FRAME_WIDTH: float(WIDTH),
            cv2.CAP_PROP_FRAME_HEIGHT: float(HEIGHT),
            cv2.CAP_PROP_FPS: 1.0 / self.PERIOD_S,
            cv2.CAP_PROP_EXPOSURE: 50.0,
            cv2.CAP_PROP_AUTO_EXPOSURE: 3.0,
        }
        self.longest = longest_exposure_s * 1e4
        self.there = True
        self.frames = 0
        self.released = 0

    def isOpened(self) -> bool:  # noqa: N802
        return self.there

    def get(self, prop: int) -> float:
        return self.properties.get(prop, 0.0)

    def set(self, prop: int, value: float) -> bool:
        if prop == cv2.CAP_PROP_EXPOSURE:
            value = min(value, self.longest)
        known = prop in self.properties
        if known:
            self.properties[prop] = value
        return known

    def read(self) -> tuple[bool, np.ndarray]:
        if not self.there:
            return False, np.empty(0, np.uint8)
        time.sleep(self.PERIOD_S)
        self.frames += 1
        return True, np.full((HEIGHT, WIDTH, 3), self.frames % 256, np.uint8)

    def release(self) -> None:
        self.released += 1


@contextmanager
def webcam(tmp_path: Path) -> Iterator[Made]:
    yield Made(UvcCamera("0", UvcOptions(), lambda device: FakeCapture()))


# -- Aravis ---------------------------------------------------------------------------------------


def require_gi() -> None:
    """Skip without Aravis; Debian's `gi` serves any Python of the same binary interface."""
    if importlib.util.find_spec("gi") is None:
        suffix = sysconfig.get_config_var("EXT_SUFFIX")
        if not (DEBIAN_GI / f"_gi{suffix}").is_file():
            pytest.skip(f"no gi for this Python ({suffix}); see docs/cameras.md")
        # The package alone: its neighbours are the system's, not this environment's.
        place = Path(tempfile.gettempdir()) / f"slrig-test-gi-{sysconfig.get_python_version()}"
        place.mkdir(exist_ok=True)
        link = place / "gi"
        if not link.is_symlink():
            link.symlink_to(DEBIAN_GI)
        sys.path.append(str(place))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # old PyGObject on this Python: not ours to mend
        try:
            load_aravis()
        except DeviceError as error:
            pytest.skip(str(error))


@contextmanager
def gvcp_port() -> Iterator[None]:
    """GigE Vision has one port on a machine: whoever serves a camera there holds it alone."""
    with (Path(tempfile.gettempdir()) / "slrig-test-gvcp.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextmanager
def fake_gige(*options: str) -> Iterator[Callable[[], None]]:
    """Run the GigE Vision camera that Aravis ships; yields what unplugs it."""
    require_gi()
    program = shutil.which(FAKE_CAMERA)
    if program is None:
        pytest.skip(f"no {FAKE_CAMERA}; apt install aravis-tools")
    with gvcp_port():
        command = [program, "-i", "127.0.0.1", "-s", SERIAL, *options]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            time.sleep(0.3)
            assert process.poll() is None, f"{FAKE_CAMERA} ended at once"
            yield process.kill
        finally:
            process.kill()
            process.wait()


@contextmanager
def aravis(tmp_path: Path) -> Iterator[Made]:
    with fake_gige():
        yield Made(AravisCamera("127.0.0.1"), (0, 0, 320, 240))


@contextmanager
def gige_bench(
    bits: int = 8, first: int = 1, size: tuple[int, int] = (WIDTH, HEIGHT)
) -> Iterator[tuple[CameraEmulator, GigeCamera]]:
    """The bench's camera served by GigE Vision; pixel values are the frame's number."""
    require_gi()
    made: list[GigeCamera] = []

    def endpoint(execute: Execute) -> GigeCamera:
        made.append(GigeCamera(execute, size, bits))
        return made[0]

    def render(exposure: Exposure) -> np.ndarray:
        dtype = np.uint8 if bits == 8 else np.uint16
        image = np.full((size[1], size[0]), exposure.number % (1 << bits), dtype)
        image[0] = np.arange(size[0])
        return image

    with gvcp_port():
        emulator = CameraEmulator(
            endpoint, render, size, max_rate_hz=1000.0, readout_s=0.0,
            pixel_format="mono8" if bits == 8 else "mono16",
        )  # fmt: skip
        emulator._frame_ids = itertools.count(first)
        emulator.start()
        try:
            yield emulator, made[0]
        finally:
            emulator.close()


@contextmanager
def gige(tmp_path: Path) -> Iterator[Made]:
    with gige_bench():
        yield Made(AravisCamera("127.0.0.1"))


@contextmanager
def real(address: str) -> Iterator[Made]:
    if address.startswith("aravis:"):
        require_gi()  # imports it past the warnings of an old PyGObject, which are errors here
    yield Made(make_camera(address), regions=not address.startswith("bag:"))


KINDS = {"socket": emulated, "bag": recorded, "uvc": webcam, "aravis": aravis, "gige": gige}
