"""The project's exceptions: one small tree.

Every message says what was found and what was expected. Library code raises these; a node turns
them into a reply, a command into one line and a non-zero exit status.
"""

from __future__ import annotations


class SlError(Exception):
    """Root of everything this project raises on purpose."""


class SequenceError(SlError, ValueError):
    """A pattern sequence, its name or its file cannot be used."""


class CalibrationError(SlError, ValueError):
    """A calibration or its file cannot be used, or a calibration run cannot be trusted."""


class StackError(SlError, ValueError):
    """The images of a scan do not fit the sequence, each other or the rig."""


class ConfigError(SlError, ValueError):
    """A configuration value is missing, unknown or out of range."""


class BagError(SlError, ValueError):
    """A recording cannot be read or written."""


class DeviceError(SlError):
    """A device refused, failed or does not answer as its protocol says."""


class DeviceRefused(DeviceError):
    """The device answered and said no (NACK, ``error:N``, ``RJ``)."""


class DeviceTimeout(DeviceError, TimeoutError):
    """The device did not answer in time."""


class DeviceLost(DeviceError, ConnectionError):
    """The device is gone: unplugged, powered off, or taken by another program."""
