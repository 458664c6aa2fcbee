"""The GenICam description of the bench's GigE Vision camera.

Names are SFNC 2.7's; registers below 0x8000 are GigE Vision's own (bootstrap registers), the
others are this camera's choice.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from xml.sax.saxutils import escape


class Reg(IntEnum):
    """Addresses of the registers that mean something to the emulator."""

    VERSION = 0x0000
    DEVICE_MODE = 0x0004
    IP_ADDRESS = 0x0024
    SUBNET_MASK = 0x0034
    MANUFACTURER = 0x0048
    MODEL = 0x0068
    DEVICE_VERSION = 0x0088
    MANUFACTURER_INFO = 0x00A8
    SERIAL = 0x00D8
    XML_URL = 0x0200
    N_INTERFACES = 0x0600
    N_STREAMS = 0x0904
    CAPABILITY = 0x0934
    HEARTBEAT_MS = 0x0938
    TICK_FREQUENCY = 0x093C
    TIMESTAMP_CONTROL = 0x0944
    TIMESTAMP = 0x0948
    PRIVILEGE = 0x0A00
    STREAM_PORT = 0x0D00
    PACKET_SIZE = 0x0D04
    STREAM_ADDRESS = 0x0D18
    WIDTH = 0x8000
    HEIGHT = 0x8004
    OFFSET_X = 0x8008
    OFFSET_Y = 0x800C
    SENSOR_WIDTH = 0x8010
    SENSOR_HEIGHT = 0x8014
    PIXEL_FORMAT = 0x8018
    PAYLOAD = 0x801C
    ACQUISITION_MODE = 0x8020
    ACQUISITION_START = 0x8024
    ACQUISITION_STOP = 0x8028
    TRIGGER_SELECTOR = 0x802C
    TRIGGER_MODE = 0x8030
    TRIGGER_SOURCE = 0x8034
    TRIGGER_ACTIVATION = 0x8038
    TRIGGER_SOFTWARE = 0x803C
    EXPOSURE = 0x8040
    GAIN = 0x8048
    CHUNK_MODE = 0x8050
    CHUNK_SELECTOR = 0x8054
    CHUNK_ENABLE = 0x8058
    XML = 0x10000


SOURCES = {"Software": 0, "Line0": 1, "Line1": 2}
CHUNK_IDS = {"FrameID": 0xA5A50001, "Timestamp": 0xA5A50002, "ExposureTime": 0xA5A50003}
IMAGE_CHUNK = 0xA5A50000
EXPOSURE_US = (10.0, 10e6)
GAIN_DB = (0.0, 24.0)

_HEAD = """<?xml version="1.0" encoding="utf-8"?>
<RegisterDescription ModelName="SlrigBench" VendorName="slrig" StandardNameSpace="GEV"
 SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" MajorVersion="1"
 MinorVersion="0" SubMinorVersion="0" ToolTip="The bench's camera"
 ProductGuid="5d7e1d5e-0000-4000-8000-000000000001"
 VersionGuid="5d7e1d5e-0000-4000-8000-000000000002"
 xmlns="http://www.genicam.org/GenApi/Version_1_1">
"""
_TAIL = '<Port Name="Device" NameSpace="Standard"/>\n</RegisterDescription>\n'


#: Nodes by the names of their features.
_Nodes = dict[str, str]


def camera_xml(pixel_formats: Mapping[str, int]) -> bytes:
    """Return the description.

    Parameters
    ----------
    pixel_formats : mapping of str to int
        Names of the pixel formats that the sensor delivers, and their PFNC codes.
    """
    groups = {
        "DeviceControl": _device(),
        "ImageFormatControl": _image(pixel_formats),
        "AcquisitionControl": _acquisition(),
        "AnalogControl": _float("Gain", Reg.GAIN, GAIN_DB, "dB"),
        "ChunkDataControl": _chunks(),
        "TransportLayerControl": _transport(),
    }
    text = _HEAD + _element("Category", "Root", pFeature=list(groups))
    for name, features in groups.items():
        text += _element("Category", name, pFeature=list(features)) + "".join(features.values())
    for name, number in CHUNK_IDS.items():
        text += f'<Port Name="Chunk{name}Port"><ChunkID>{number:x}</ChunkID></Port>\n'
    return (text + _TAIL).encode()


def _device() -> _Nodes:
    return (
        _register("StringReg", "DeviceVendorName", Reg.MANUFACTURER, 32)
        | _register("StringReg", "DeviceModelName", Reg.MODEL, 32)
        | _register("StringReg", "DeviceVersion", Reg.DEVICE_VERSION, 32)
        | _register("StringReg", "DeviceManufacturerInfo", Reg.MANUFACTURER_INFO, 48)
        | _register("StringReg", "DeviceID", Reg.SERIAL, 16)
    )


def _image(pixel_formats: Mapping[str, int]) -> _Nodes:
    return (
        _register("IntReg", "SensorWidth", Reg.SENSOR_WIDTH)
        | _register("IntReg", "SensorHeight", Reg.SENSOR_HEIGHT)
        | _feature("Integer", "OffsetX", Reg.OFFSET_X, Min=0, pMax="SensorWidth", Inc=1)
        | _feature("Integer", "OffsetY", Reg.OFFSET_Y, Min=0, pMax="SensorHeight", Inc=1)
        | _feature("Integer", "Width", Reg.WIDTH, Min=1, pMax="SensorWidth", Inc=1)
        | _feature("Integer", "Height", Reg.HEIGHT, Min=1, pMax="SensorHeight", Inc=1)
        | _enumeration("PixelFormat", Reg.PIXEL_FORMAT, pixel_formats)
    )


def _acquisition() -> _Nodes:
    return (
        _enumeration("AcquisitionMode", Reg.ACQUISITION_MODE, {"Continuous": 0})
        | _command("AcquisitionStart", Reg.ACQUISITION_START, 1)
        | _command("AcquisitionStop", Reg.ACQUISITION_STOP, 1)
        | _enumeration("TriggerSelector", Reg.TRIGGER_SELECTOR, {"FrameStart": 0})
        | _enumeration("TriggerMode", Reg.TRIGGER_MODE, {"Off": 0, "On": 1})
        | _enumeration("TriggerSource", Reg.TRIGGER_SOURCE, SOURCES)
        | _enumeration("TriggerActivation", Reg.TRIGGER_ACTIVATION, {"RisingEdge": 0})
        | _command("TriggerSoftware", Reg.TRIGGER_SOFTWARE, 1)
        | _float("ExposureTime", Reg.EXPOSURE, EXPOSURE_US, "us")
    )


def _chunks() -> _Nodes:
    """All chunks share one enabling register: whichever is selected, all come."""
    nodes = (
        _feature("Boolean", "ChunkModeActive", Reg.CHUNK_MODE, OnValue=1, OffValue=0)
        | _enumeration("ChunkSelector", Reg.CHUNK_SELECTOR, {n: i for i, n in enumerate(CHUNK_IDS)})
        | _feature("Boolean", "ChunkEnable", Reg.CHUNK_ENABLE, OnValue=1, OffValue=0)
    )
    for name in CHUNK_IDS:
        kind = "FloatReg" if name == "ExposureTime" else "IntReg"
        nodes |= _register(kind, f"Chunk{name}", 0, 8, port=f"Chunk{name}Port")
    return nodes


def _transport() -> _Nodes:
    return (
        _register("IntReg", "PayloadSize", Reg.PAYLOAD)
        | _register("IntReg", "GevTimestampTickFrequency", Reg.TICK_FREQUENCY, 8)
        | _command("GevTimestampControlLatch", Reg.TIMESTAMP_CONTROL, 2)
        | _register("IntReg", "GevTimestampValue", Reg.TIMESTAMP, 8)
    )


# -- nodes ----------------------------------------------------------------------------------------


def _element(tag: str, name: str, before: str = "", /, **fields: object) -> str:
    """XML of a node with its fields in order; a list is a field that repeats."""
    inner = before
    for key, value in fields.items():
        for item in value if isinstance(value, list) else [value]:
            inner += f"<{key}>{item}</{key}>"
    return f'<{tag} Name="{name}" NameSpace="Standard">{inner}</{tag}>\n'


def _register(
    tag: str, name: str, address: int, length: int = 4, access: str = "RO", port: str = "Device"
) -> _Nodes:
    """A place in the camera's memory."""
    fields: dict[str, object] = {"Address": f"{address:#x}", "Length": length}
    fields |= {"AccessMode": access, "pPort": port}
    if tag != "StringReg":
        sign = {"Sign": "Unsigned"} if tag == "IntReg" else {}
        fields |= {"Cachable": "NoCache", **sign, "Endianess": "BigEndian"}
    return {name: _element(tag, name, "", **fields)}


def _feature(
    tag: str,
    name: str,
    address: int,
    before: str = "",
    *,
    register: tuple[str, int] = ("IntReg", 4),
    access: str = "RW",
    **fields: object,
) -> _Nodes:
    """A feature with the register that holds its value."""
    (stored,) = _register(register[0], f"{name}Reg", address, register[1], access).values()
    return {name: _element(tag, name, before, pValue=f"{name}Reg", **fields) + stored}


def _enumeration(name: str, address: int, entries: Mapping[str, int]) -> _Nodes:
    inner = "".join(_element("EnumEntry", escape(e), Value=v) for e, v in entries.items())
    return _feature("Enumeration", name, address, inner)


def _command(name: str, address: int, value: int) -> _Nodes:
    return _feature("Command", name, address, access="WO", CommandValue=value)


def _float(name: str, address: int, bounds: tuple[float, float], unit: str) -> _Nodes:
    low, high = bounds
    return _feature("Float", name, address, register=("FloatReg", 8), Min=low, Max=high, Unit=unit)
