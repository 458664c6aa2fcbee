"""The library Aravis, by GObject introspection: loading it, finding cameras, reading its errors."""

from __future__ import annotations

import ipaddress
from typing import Any

from sl_common.errors import DeviceError, DeviceLost

INSTALL = (
    "Debian, Ubuntu: sudo apt install gir1.2-aravis-0.8 python3-gi; in a virtual environment see "
    "docs/cameras.md"
)
#: Errors of Aravis (by name) that mean that the camera is gone or another program controls it.
_GONE = ["NOT_FOUND", "NOT_CONNECTED", "NOT_CONTROLLER", "TIMEOUT", "TRANSFER_ERROR"]
_GONE.append("PROTOCOL_ERROR_ACCESS_DENIED")


def load_aravis() -> Any:
    """Return the module Aravis.

    Raises
    ------
    DeviceError
        When it is not installed; the message says the command that installs it.
    """
    try:
        import gi

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis
    except (ImportError, ValueError) as error:
        raise DeviceError(f"Aravis is missing ({error}); {INSTALL}") from error
    return Aravis


def list_cameras() -> list[str]:
    """Ids, addresses and protocols of all cameras that answer, one line each."""
    aravis = load_aravis()
    aravis.update_device_list()
    return [
        f"{aravis.get_device_id(i)} at {aravis.get_device_address(i)} "
        f"({aravis.get_device_protocol(i)})"
        for i in range(aravis.get_n_devices())
    ]


def find_camera(aravis: Any, wanted: str) -> str:
    """Return the id of the camera with this id, serial number or address; "" is the first.

    An address is returned as it is: asking there directly spares a second of discovery.

    Parameters
    ----------
    aravis : module
        The loaded library.
    wanted : str
        Id, serial number or address; empty for the first camera.

    Raises
    ------
    DeviceLost
        When it does not answer.
    """
    if _is_address(wanted):
        return wanted
    aravis.update_device_list()
    found = []
    for i in range(aravis.get_n_devices()):
        name = str(aravis.get_device_id(i))
        names = (name, aravis.get_device_serial_nbr(i), aravis.get_device_address(i))
        if wanted in ("", *names):
            return name
        found.append(name)
    raise DeviceLost(
        f"no GenICam camera {wanted or 'at all'}; found {', '.join(found) or 'none'}; is it "
        "powered, in this machine's network, and not behind a firewall?"
    )


def is_gone(aravis: Any, error: Exception) -> bool:
    """Whether an error of Aravis means that the camera is gone, or another program's.

    Parameters
    ----------
    aravis : module
        The loaded library.
    error : Exception
        What it raised.
    """
    if getattr(error, "domain", "") != "arv-device-error-quark":
        return False
    code = getattr(error, "code", None)
    return code in [int(getattr(aravis.DeviceError, name)) for name in _GONE]


def words_of(error: Exception) -> str:
    """One line of an error's text."""
    text = str(getattr(error, "message", "") or error)
    return " ".join(text.split()) or type(error).__name__


def _is_address(text: str) -> bool:
    try:
        ipaddress.IPv4Address(text)
    except ValueError:
        return False
    return True
