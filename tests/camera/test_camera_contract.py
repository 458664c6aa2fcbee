"""What every camera driver promises (`CameraDriver`), on every driver.

On a real camera as well: ``pytest tests/test_camera_contract.py --hardware camera=aravis:SERIAL``
(or ``camera=uvc:0``, ``camera=bag:PATH``). It must deliver mono8 and obey a software trigger.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from sl_camera.camera.camera import CameraDriver, CameraSettings, Frame, FrameStatus
from sl_common.errors import DeviceError, DeviceRefused
from support.devices.camera_bench import KINDS, Made, real
from support.patience import Deadline

HARDWARE = "camera="
EXPOSURE_S = 0.004
#: A camera that only pretends to expose (Aravis' fake one) answers up to an exposure too early.
CLOCK_NS = 5_000_000


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    asked = metafunc.config.getoption("--hardware")
    kinds = [*KINDS, *(kind for kind in asked if kind.startswith(HARDWARE))]
    metafunc.parametrize("made", kinds, indirect=True)


@pytest.fixture
def made(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Made]:
    kind = request.param
    context = (
        real(kind.removeprefix(HARDWARE)) if kind.startswith(HARDWARE) else KINDS[kind](tmp_path)
    )
    with context as made:
        made.driver.open()
        yield made
        made.driver.close()


@pytest.fixture
def camera(made: Made) -> CameraDriver:
    made.driver.configure(settings(made))
    made.driver.arm()
    return made.driver


def settings(made: Made, **changes: object) -> CameraSettings:
    fields = {"exposure_s": EXPOSURE_S, "trigger": "software", "region": made.region, **changes}
    return CameraSettings(**fields)  # type: ignore[arg-type]


def take(camera: CameraDriver, patience_s: float = 2.0) -> Frame:
    """Trigger one frame and wait for it."""
    camera.software_trigger()
    deadline = Deadline(patience_s)
    while not deadline.is_over:
        if (frame := camera.read(0.1)) is not None:
            return frame
    pytest.fail("no frame after a software trigger")


def test_has_every_method_of_the_protocol(made: Made) -> None:
    wanted = {name for name in vars(CameraDriver) if not name.startswith("_")}
    assert wanted <= set(dir(made.driver))


def test_one_frame_per_trigger_numbered_and_of_the_size_it_says(camera: CameraDriver) -> None:
    width, height = camera.image_size
    assert width > 0
    frames = [take(camera) for _ in range(5)]
    assert camera.read(0.1) is None
    assert {f.image.shape for f in frames} == {(height, width)}
    assert {(f.image.dtype, f.encoding, f.full_scale_dn) for f in frames} == {
        (np.dtype(np.uint8), "mono8", 255)
    }
    assert {f.status for f in frames} == {FrameStatus.OK}
    # Numbers of 16 bits wrap from 65535 to 1 (GigE Vision 2.0).
    steps = {(b.frame_id - a.frame_id) % 65535 for a, b in pairwise(frames)}
    assert steps == {1}
    counts = camera.statistics()
    assert (counts.received, counts.lost, counts.incomplete) == (5, 0, 0)
    counts.received = 0
    assert camera.statistics().received == 5


def test_stamps_are_the_start_of_an_exposure_after_the_trigger(camera: CameraDriver) -> None:
    for _ in range(3):
        before_ns = time.time_ns()
        frame = take(camera)
        assert frame.exposure_s == pytest.approx(EXPOSURE_S, rel=0.1)
        assert before_ns - CLOCK_NS <= frame.stamp_ns
        assert frame.stamp_ns + frame.exposure_s * 1e9 <= time.time_ns() + CLOCK_NS
        assert frame.stamp_ns - before_ns < (camera.latency_s + 0.1) * 1e9


def test_no_frame_without_a_trigger_and_none_of_before_arming(camera: CameraDriver) -> None:
    began = time.monotonic()
    assert camera.read(0.2) is None
    assert time.monotonic() - began >= 0.15
    camera.software_trigger()
    time.sleep(0.1)  # the frame is there, nobody has read it
    camera.arm()
    assert camera.read(0.1) is None
    take(camera)


def test_disarmed_it_delivers_nothing_new(camera: CameraDriver) -> None:
    take(camera)
    camera.disarm()
    camera.disarm()
    assert camera.read(0.1) is None
    camera.arm()
    take(camera)


def test_free_run_delivers_in_order(made: Made) -> None:
    made.driver.configure(settings(made, trigger="free"))
    made.driver.arm()
    deadline, stamps = Deadline(5.0), []
    while len(stamps) < 5 and not deadline.is_over:
        if (frame := made.driver.read(0.2)) is not None:
            stamps.append(frame.stamp_ns)
    assert len(stamps) == 5
    assert stamps == sorted(stamps)


def test_region_is_what_was_asked_for_or_refused(made: Made) -> None:
    if not made.regions:
        with pytest.raises(DeviceRefused):
            made.driver.configure(settings(made, region=(0, 0, 32, 16)))
        return
    made.driver.configure(settings(made, region=(16, 8, 32, 16)))
    assert made.driver.image_size == (32, 16)
    made.driver.arm()
    assert take(made.driver).image.shape == (16, 32)


@pytest.mark.parametrize(
    "changes",
    [{"region": (0, 0, 100_000, 10)}, {"pixel_format": "mono12p"}, {"gain": 900.0}],
    ids=["region", "format", "gain"],
)
def test_what_it_cannot_is_refused_and_it_stays_as_it_was(
    made: Made, camera: CameraDriver, changes: dict[str, object]
) -> None:
    kind = type(camera).__name__
    if "gain" in changes and kind in ("SocketCamera", "ReplayCamera"):
        pytest.skip("a simulated gain has no bounds, a recorded one is over")
    size = camera.image_size
    with pytest.raises(DeviceRefused, match=next(iter(changes))):
        camera.configure(settings(made, **changes))
    assert camera.image_size == size
    camera.arm()
    frame = take(camera)
    assert frame.image.shape == (size[1], size[0])
    assert frame.exposure_s == pytest.approx(EXPOSURE_S, rel=0.1)


def test_closed_it_refuses_until_opened(made: Made, camera: CameraDriver) -> None:
    camera.close()
    camera.close()
    with pytest.raises(DeviceError):
        camera.software_trigger()
    camera.open()
    assert camera.statistics().received == 0
    camera.configure(settings(made))
    camera.arm()
    take(camera)


def test_opening_again_starts_afresh(made: Made, camera: CameraDriver) -> None:
    take(camera)
    camera.open()
    camera.configure(settings(made))
    camera.arm()
    assert take(camera).status is FrameStatus.OK
    assert camera.statistics().received == 1
