"""The stage's node: where the part stands, and services that move it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from geometry_msgs.msg import PoseStamped

from sl_camera.stage.grbl.grbl_stage import GrblStage
from sl_camera.stage.manual_stage import ManualStage
from sl_camera.stage.stage import Position, StageDriver, StageState
from sl_camera.stage.zaber.zaber_stage import ZaberStage, zaber_axes
from sl_common import topics
from sl_common.base_node import Health, RigNode, run
from sl_common.device_link import DeviceLink
from sl_common.errors import (
    ConfigError,
    DeviceError,
    DeviceLost,
    DeviceRefused,
    DeviceTimeout,
    SlError,
)
from sl_projector.sequence.messages import pose_to_msg
from sl_projector.sequence.stack import StagePose

KINDS = ("grbl", "zaber", "manual")

_LEVELS = {"idle": "ok", "moving": "ok", "homing": "ok", "hold": "warn", "not_homed": "warn"}


class StageNode(RigNode):
    """Drives one stage.

    Parameters
    ----------
    make_driver : callable, optional
        Makes the (closed) driver; by default GRBL on the port that the parameters name.
    options
        Passed to `rclpy.node.Node`.
    """

    def __init__(
        self, make_driver: Callable[[], StageDriver] | None = None, **options: Any
    ) -> None:
        super().__init__("stage", **options)
        self._declare_parameters()
        self._make_driver = make_driver or self._make_configured
        self._moves = 0
        self._began_ns = 0  # the last motion; what is read later is not older
        self._state = StageState("lost", "not connected yet")
        self._stop = threading.Event()
        self._poses = self.advertise(topics.POSE)
        self._serve(topics.MOVE_STAGE, self._move)
        self._serve(topics.HOME_STAGE, self._home)
        self._serve(topics.STOP_STAGE, self._halt)
        self._serve(topics.CLEAR_STAGE, self._clear)
        if self._kind == "manual":
            self._serve(topics.CONFIRM_STAGE, self._confirm)
            self._serve(topics.GIVE_UP_STAGE, self._give_up)
        self._link = DeviceLink("stage", self._connect, self.say)
        self._link.start()
        self._poller = threading.Thread(target=self._poll, name="stage pose", daemon=True)
        self._poller.start()

    def _declare_parameters(self) -> None:
        self._kind = self.declare("kind", "grbl", f"driver: one of {KINDS}")
        if self._kind not in KINDS:
            raise ConfigError(f"kind={self._kind!r}; expected one of {KINDS}")
        self._port = self.declare("port", "", "serial port, such as /dev/ttyUSB0")
        self._baud = self.declare("baud", 115200, "bits per second", 1200, 4_000_000)
        self._origin_mm = self.declare(
            "origin_mm", "", "GRBL machine position of the stage's zero, 'x y z' in mm; empty: the "
            "middle of the travel",
        )  # fmt: skip
        self._signs = self.declare(
            "signs", [1, 1, 1], "direction of the stage's axes in machine coordinates, +1 or -1"
        )
        self._speed_m_s = self.declare(
            "speed_m_s", 0.0, "speed of moves, m/s; 0: the controller's limit", 0.0, 1.0
        )
        self._zaber = (
            self.declare("zaber_devices", [1, 2, 3], "addresses of the Zaber devices of x, y, z"),
            self.declare("zaber_axes", [1, 1, 1], "which axis of its device x, y, z each is"),
            self.declare(
                "zaber_microstep_m", [0.047625e-6] * 3, "microstep of x, y, z, m (data sheet)"
            ),
        )
        self._home_at_start = self.declare("home_at_start", False, "home after connecting")
        self._period_s = 1.0 / self.declare("pose_rate_hz", 20.0, "poses a second", 1.0, 100.0)

    def health(self) -> Health:
        """What the stage is doing, in the driver's words."""
        state = self._state
        level = _LEVELS.get(state.kind, "error")
        message = f"{state.kind}: {state.text}" if state.text else state.kind
        if not self._link.connected:
            level, message = "error", self._link.reason
        values: dict[str, object] = {
            "referenced": state.referenced,
            "times lost": self._link.losses,
        }
        return Health(level, message, "stage", self._port, values)

    def close(self) -> None:
        """Stop a running move and give the port back."""
        self._stop.set()
        self._link.close()
        self._poller.join(timeout=5.0)
        super().close()

    def _make_configured(self) -> StageDriver:
        if self._kind == "manual":
            return ManualStage()
        if not self._port:
            raise ConfigError("the parameter port is empty; expected a serial port")
        if self._kind == "zaber":
            return ZaberStage(self._port, zaber_axes(*self._zaber, self._signs), baud=self._baud)
        x, y, z = self._signs
        return GrblStage(
            self._port,
            baud=self._baud,
            origin_mm=parse_origin(self._origin_mm),
            signs=(x, y, z),
            speed_m_s=self._speed_m_s or None,
        )

    def _connect(self) -> StageDriver:
        driver = self._make_driver()
        try:
            driver.open()
            if self._home_at_start and driver.state().kind in ("not_homed", "idle"):
                self.get_logger().info("homing the stage")
                driver.home()
        except SlError:
            driver.close()
            raise
        return driver

    # -- pose -------------------------------------------------------------------------------

    def _poll(self) -> None:
        """Read and publish the pose; a stage that is gone is noticed here."""
        while not self._stop.wait(self._period_s):
            if (driver := self._link.current) is None:
                continue
            try:
                self._publish_pose(driver)
            except DeviceError as error:
                self._check_lost(driver, error)
            except Exception as error:  # nobody else watches the stage
                self._link.lost(driver, error)

    def _publish_pose(self, driver: StageDriver) -> None:
        """No pose in an alarm, while homing or without a device: then it is not known."""
        before_ns, moves = time.time_ns(), self._moves
        self._state = driver.state()
        if self._state.kind == "lost":
            raise DeviceLost(self._state.text)
        if self._state.kind in ("alarm", "homing"):
            return
        position_m = driver.position_m()
        stamp_ns = before_ns
        if moves or self._moves or self._state.kind != "idle":
            # A driver that tells an older reading says of when; others ask each time.
            stamp_ns = min(before_ns, int(getattr(driver, "measured_ns", before_ns)))
        self._poses.publish(self._pose(position_m, max(stamp_ns, self._began_ns)))

    @contextmanager
    def _moving(self, driver: StageDriver) -> Iterator[None]:
        """Tell where the stage stands as it begins to move: from here on it is elsewhere.

        Else a reading that is late might make believe that it stood there before.
        """
        if driver.state().kind == "idle":
            position_m = driver.position_m()
            self._began_ns = time.time_ns()
            self._poses.publish(self._pose(position_m, self._began_ns))
        self._moves += 1
        try:
            yield
        finally:
            self._moves -= 1

    def _pose(self, position_m: Position, stamp_ns: int) -> PoseStamped:
        return pose_to_msg(StagePose(stamp_ns, position_m))

    def _check_lost(self, driver: StageDriver, error: DeviceError) -> None:
        self.note(str(error))
        if isinstance(error, DeviceLost) or driver.state().kind == "lost":
            self._link.lost(driver, error)

    # -- services ---------------------------------------------------------------------------

    def _serve(
        self, service: topics.Service, work: Callable[[StageDriver, Any, Any], None]
    ) -> None:
        def do(request: Any, response: Any) -> None:
            work(self._link.device(), request, response)

        def failed(error: SlError) -> None:
            self.note(f"{service.name} failed: {error}")
            self._notice(error)

        self.serve_work(service, do, failed)

    def _notice(self, error: SlError) -> None:
        """A service that lost the device leaves it to be opened anew."""
        driver = self._link.current
        if driver is None or not isinstance(error, (DeviceLost, DeviceTimeout)):
            return
        if driver.state().kind == "lost":
            self._link.lost(driver, error)

    def _move(self, driver: StageDriver, request: Any, response: Any) -> None:
        target_m = (request.target.x, request.target.y, request.target.z)
        if request.relative:
            x, y, z = (a + b for a, b in zip(driver.position_m(), target_m, strict=True))
            target_m = (x, y, z)
        driver.limits_m().require_inside(target_m)
        if request.check_only:
            response.pose = self._pose(driver.position_m(), time.time_ns())
            response.success, response.message = True, "within the travel"
            return
        with self._moving(driver):
            driver.move_to(*target_m)
        response.pose = self._pose(driver.position_m(), time.time_ns())
        response.success = True
        response.message = "moved to " + ", ".join(f"{1e3 * a:.4f}" for a in target_m) + " mm"

    def _home(self, driver: StageDriver, _request: Any, response: Any) -> None:
        with self._moving(driver):
            driver.home()
        response.success, response.message = True, "homed"

    def _halt(self, driver: StageDriver, _request: Any, response: Any) -> None:
        driver.stop()
        response.success, response.message = True, "stopped"

    def _clear(self, driver: StageDriver, _request: Any, response: Any) -> None:
        driver.clear()
        state = driver.state()
        response.success, response.message = True, f"cleared: {state.kind} {state.text}".rstrip()

    def _confirm(self, driver: StageDriver, _request: Any, response: Any) -> None:
        """Take the operator's word that a manual stage stands where it was asked to."""
        _manual(driver).confirm()
        response.success, response.message = True, "confirmed"

    def _give_up(self, driver: StageDriver, _request: Any, response: Any) -> None:
        _manual(driver).give_up("the operator gave up")
        response.success, response.message = True, "given up; clear when it is safe"


def _manual(driver: StageDriver) -> ManualStage:
    if not isinstance(driver, ManualStage):
        raise DeviceRefused("this stage moves by itself; there is nothing to confirm")
    return driver


def parse_origin(text: str) -> Position | None:
    """Read 'x y z' in millimetres; None for an empty text.

    Raises
    ------
    ConfigError
        When these are not three numbers.
    """
    if not text.strip():
        return None
    try:
        x, y, z = (float(word) for word in text.replace(",", " ").split())
    except ValueError:
        raise ConfigError(f"origin_mm={text!r}; expected three numbers in mm") from None
    return x, y, z


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    run(StageNode, args)


if __name__ == "__main__":
    main()
