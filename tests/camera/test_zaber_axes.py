"""A stage of a single Zaber device: the axes that it lacks stand at zero."""

from __future__ import annotations

import pytest

from sl_bench.stage.zaber_emulator import ZaberEmulator
from sl_camera.stage.zaber.zaber_stage import ZaberAxis, ZaberStage
from sl_common.errors import DeviceRefused


def test_a_single_device_is_a_stage_of_one_axis() -> None:
    with ZaberEmulator(travel_m=(0.05, 0.05, 0.004), homed=True) as emulator:
        stage = ZaberStage(emulator.port, [ZaberAxis(0), ZaberAxis(0), ZaberAxis(3)])
        stage.open()
        assert stage.state().kind == "idle"
        limits = stage.limits_m()
        assert (limits.low_m[:2], limits.high_m[:2]) == ((0.0, 0.0), (0.0, 0.0))
        assert limits.high_m[2] == pytest.approx(0.002, abs=5e-8)  # a microstep
        stage.move_to(0.0, 0.0, 0.0005)
        x, y, z = stage.position_m()
        assert (x, y) == (0.0, 0.0)
        assert z == pytest.approx(0.0005, abs=5e-8)
        with pytest.raises(DeviceRefused):
            stage.move_to(0.0001, 0.0, 0.0)
        stage.home()
        stage.close()
