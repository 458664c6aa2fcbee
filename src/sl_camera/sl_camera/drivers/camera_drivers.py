"""Which driver an address means. `camera_node` asks here; so may tests and tools."""

from __future__ import annotations

from sl_camera.camera.camera import CameraDriver
from sl_camera.drivers.aravis_camera import AravisCamera, AravisOptions
from sl_camera.drivers.replay_camera import ReplayCamera
from sl_camera.drivers.socket_camera import SocketCamera
from sl_camera.drivers.uvc_camera import UvcCamera, UvcOptions
from sl_common.errors import ConfigError

ADDRESSES = (
    "aravis:SERIAL (GigE Vision, USB3 Vision; aravis: alone is the first found), uvc:INDEX, "
    "bag:PATH (a recording), socket:PATH or /PATH (served by another process)"
)


def make_camera(
    address: str, aravis: AravisOptions | None = None, uvc: UvcOptions | None = None
) -> CameraDriver:
    """Return the (closed) driver of the camera at an address.

    Parameters
    ----------
    address : str
        ``aravis:`` with an id, serial number or network address, ``uvc:`` with an index or device
        file, ``bag:`` with a recording, ``socket:`` with a path, or a bare path.
    aravis, uvc : optional
        Settings that only such cameras have.

    Raises
    ------
    ConfigError
        When the address is none of these.
    """
    kind, colon, rest = address.partition(":")
    if kind == "aravis" and colon:
        return AravisCamera(rest, aravis)
    if not rest and not address.startswith("/"):
        raise ConfigError(f"address={address!r}; expected {ADDRESSES}")
    if kind == "uvc":
        return UvcCamera(rest, uvc)
    if kind == "bag":
        return ReplayCamera(rest)
    if kind == "socket" or address.startswith("/"):
        return SocketCamera(rest if kind == "socket" else address)
    raise ConfigError(f"address={address!r}; expected {ADDRESSES}")
