"""A device that comes and goes: connected when it is there, told when it is not, given back."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from sl_common.device_link import DeviceLink
from sl_common.errors import DeviceLost
from support.patience import Deadline


class Thing:
    def __init__(self) -> None:
        self.closed = 0

    def close(self) -> None:
        self.closed += 1
        raise DeviceLost("closing a device that is gone")


class Plug:
    """Opens a new thing while it is in."""

    def __init__(self, inside: bool) -> None:
        self.inside = inside
        self.tries = 0
        self.things: list[Thing] = []

    def __call__(self) -> Thing:
        self.tries += 1
        if not self.inside:
            raise DeviceLost("no such port")
        self.things.append(Thing())
        return self.things[-1]


def wait(done: Callable[[], bool]) -> None:
    deadline = Deadline()
    while not done():
        assert not deadline.is_over, "nothing happened"
        time.sleep(0.005)


def test_a_device_is_found_lost_and_found_again_and_given_back() -> None:
    plug, told = Plug(inside=True), []
    link = DeviceLink("stage", plug, told.append)
    link.start()
    wait(lambda: link.connected)
    first = link.device()
    plug.inside = False
    link.lost(first, DeviceLost("cable pulled"))
    link.lost(first, DeviceLost("said twice"))
    assert (link.losses, first.closed) == (1, 1)
    with pytest.raises(DeviceLost, match="stage is not connected"):
        link.device()
    plug.inside = True
    wait(lambda: link.connected)
    assert link.device() is not first
    link.close()
    assert plug.things[-1].closed == 1
    assert not link.connected
    assert told[:2] == ["stage connected", "stage lost: cable pulled"]
    assert told[-1] == "stage connected"


def test_a_device_that_is_missing_is_told_once_and_tried_again() -> None:
    plug, told = Plug(inside=False), []
    link = DeviceLink("camera", plug, told.append)
    link.start()
    wait(lambda: plug.tries >= 2)
    assert told == ["camera not connected: no such port"]
    assert "no such port" in link.reason
    link.close()
