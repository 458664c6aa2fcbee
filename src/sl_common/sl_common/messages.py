"""ROS messages made by type name, from rclpy's classes or any other source of classes.

The graph's messages are rclpy's, a recording's are made by rosbags without ROS; their fields are
the same. What writes messages takes a `MakeMessage` and serves both; what reads them looks at
fields only. Nothing of ROS is imported before a message is made.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from typing import Any

import numpy as np

#: Makes a message of a type (``package/msg/Type``) from all its fields, given by name; arrays of
#: numbers are ndarrays.
MakeMessage = Callable[..., Any]

_NS_PER_S = 1_000_000_000


@functools.cache
def interface_class(name: str) -> Any:
    """Rclpy's class of ``package/msg/Type`` (or ``srv``, ``action``)."""
    package, kind, member = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), member)


def ros_message(msgtype: str, **fields: Any) -> Any:
    """Make a message of rclpy's; see `MakeMessage`.

    Bytes are not copied: rclpy's setter of ``uint8[]`` copies into an ``array.array`` (0.15 s for
    an image), but its serialisation takes anything with a buffer, so the storage is set directly.

    Parameters
    ----------
    msgtype : str
        ``package/msg/Type``.
    **fields
        Its fields; those left out have the type's default.
    """
    message = interface_class(msgtype)()
    for name, value in fields.items():
        if not isinstance(value, np.ndarray):
            setattr(message, name, value)
        elif value.dtype == np.uint8:
            setattr(message, f"_{name}", value)
        else:
            setattr(message, name, value.tolist())
    return message


def stamp_to_msg(stamp_ns: int, make: MakeMessage = ros_message) -> Any:
    """Make a ``builtin_interfaces/Time``.

    Parameters
    ----------
    stamp_ns : int
        Nanoseconds since the epoch; times before it become zero.
    make : MakeMessage
        Where messages come from.
    """
    sec, nanosec = divmod(max(0, stamp_ns), _NS_PER_S)
    return make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def stamp_from_msg(message: Any) -> int:
    """Nanoseconds since the epoch."""
    return int(message.sec) * _NS_PER_S + int(message.nanosec)


def header(stamp_ns: int, frame_id: str, make: MakeMessage = ros_message) -> Any:
    """Make a ``std_msgs/Header``.

    Parameters
    ----------
    stamp_ns : int
        Nanoseconds since the epoch.
    frame_id : str
        Frame of the data.
    make : MakeMessage
        Where messages come from.
    """
    return make("std_msgs/msg/Header", stamp=stamp_to_msg(stamp_ns, make), frame_id=frame_id)
