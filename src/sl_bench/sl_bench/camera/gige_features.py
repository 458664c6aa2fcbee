"""The GenICam description of the bench's GigE Vision camera, made from one table of features.

Names are SFNC 2.7's; registers below 0x8000 are GigE Vision's own (bootstrap registers), the
others are this camera's choice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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


def camera_xml(pixel_formats: Mapping[str, int]) -> bytes:
    """Return the description.

    Parameters
    ----------
    pixel_formats : mapping of str to int
        Names of the pixel formats that the sensor delivers, and their PFNC codes.
    """
    parts = [
        _HEAD, _categories(), _device(), _image(pixel_formats), _acquisition(), _chunks(),
        _transport(), '<Port Name="Device" NameSpace="Standard"/>\n</RegisterDescription>\n',
    ]  # fmt: skip
    return "".join(parts).encode()


def _categories() -> str:
    groups = {
        "DeviceControl": ("DeviceVendorName", "DeviceModelName", "DeviceID"),
        "ImageFormatControl": (
            "SensorWidth", "SensorHeight", "OffsetX", "OffsetY", "Width", "Height", "PixelFormat",
        ),
        "AcquisitionControl": (
            "AcquisitionMode", "AcquisitionStart", "AcquisitionStop", "TriggerSelector",
            "TriggerMode", "TriggerSource", "TriggerActivation", "TriggerSoftware", "ExposureTime",
        ),
        "AnalogControl": ("Gain",),
        "ChunkDataControl": (
            "ChunkModeActive", "ChunkSelector", "ChunkEnable", "ChunkFrameID", "ChunkTimestamp",
            "ChunkExposureTime",
        ),
        "TransportLayerControl": (
            "PayloadSize", "GevTimestampTickFrequency", "GevTimestampControlLatch",
            "GevTimestampValue",
        ),
    }  # fmt: skip
    text = _category("Root", tuple(groups))
    return text + "".join(_category(name, features) for name, features in groups.items())


def _category(name: str, features: Sequence[str]) -> str:
    inner = "".join(f"<pFeature>{feature}</pFeature>" for feature in features)
    return f'<Category Name="{name}" NameSpace="Standard">{inner}</Category>\n'


def _device() -> str:
    return "".join(
        f'<StringReg Name="{name}" NameSpace="Standard"><Address>{address:#x}</Address>'
        f"<Length>{length}</Length><AccessMode>RO</AccessMode><pPort>Device</pPort></StringReg>\n"
        for name, address, length in (
            ("DeviceVendorName", Reg.MANUFACTURER, 32),
            ("DeviceModelName", Reg.MODEL, 32),
            ("DeviceVersion", Reg.DEVICE_VERSION, 32),
            ("DeviceManufacturerInfo", Reg.MANUFACTURER_INFO, 48),
            ("DeviceID", Reg.SERIAL, 16),
        )
    )


def _image(pixel_formats: Mapping[str, int]) -> str:
    return (
        _int_reg("SensorWidth", Reg.SENSOR_WIDTH, "RO")
        + _int_reg("SensorHeight", Reg.SENSOR_HEIGHT, "RO")
        + _integer("OffsetX", Reg.OFFSET_X, 0, "SensorWidth")
        + _integer("OffsetY", Reg.OFFSET_Y, 0, "SensorHeight")
        + _integer("Width", Reg.WIDTH, 1, "SensorWidth")
        + _integer("Height", Reg.HEIGHT, 1, "SensorHeight")
        + _enumeration("PixelFormat", Reg.PIXEL_FORMAT, pixel_formats)
    )


def _acquisition() -> str:
    return (
        _enumeration("AcquisitionMode", Reg.ACQUISITION_MODE, {"Continuous": 0})
        + _command("AcquisitionStart", Reg.ACQUISITION_START, 1)
        + _command("AcquisitionStop", Reg.ACQUISITION_STOP, 1)
        + _enumeration("TriggerSelector", Reg.TRIGGER_SELECTOR, {"FrameStart": 0})
        + _enumeration("TriggerMode", Reg.TRIGGER_MODE, {"Off": 0, "On": 1})
        + _enumeration("TriggerSource", Reg.TRIGGER_SOURCE, SOURCES)
        + _enumeration("TriggerActivation", Reg.TRIGGER_ACTIVATION, {"RisingEdge": 0})
        + _command("TriggerSoftware", Reg.TRIGGER_SOFTWARE, 1)
        + _float("ExposureTime", Reg.EXPOSURE, EXPOSURE_US, "us")
        + _float("Gain", Reg.GAIN, GAIN_DB, "dB")
    )


def _chunks() -> str:
    """All chunks share one enabling register: whichever is selected, all come."""
    text = (
        _boolean("ChunkModeActive", Reg.CHUNK_MODE)
        + _enumeration(
            "ChunkSelector", Reg.CHUNK_SELECTOR, {name: i for i, name in enumerate(CHUNK_IDS)}
        )
        + _boolean("ChunkEnable", Reg.CHUNK_ENABLE)
    )
    for name, number in CHUNK_IDS.items():
        port = f"Chunk{name}Port"
        text += f'<Port Name="{port}"><ChunkID>{number:x}</ChunkID></Port>\n'
        if name == "ExposureTime":
            text += _float_reg(f"Chunk{name}", 0, port, "RO")
        else:
            text += _int_reg(f"Chunk{name}", 0, "RO", 8, port)
    return text


def _transport() -> str:
    return (
        _int_reg("PayloadSize", Reg.PAYLOAD, "RO")
        + _int_reg("GevTimestampTickFrequency", Reg.TICK_FREQUENCY, "RO", 8)
        + _command("GevTimestampControlLatch", Reg.TIMESTAMP_CONTROL, 2)
        + _int_reg("GevTimestampValue", Reg.TIMESTAMP, "RO", 8)
    )


# -- nodes ----------------------------------------------------------------------------------------


def _int_reg(name: str, address: int, access: str, length: int = 4, port: str = "Device") -> str:
    return (
        f'<IntReg Name="{name}"><Address>{address:#x}</Address><Length>{length}</Length>'
        f"<AccessMode>{access}</AccessMode><pPort>{port}</pPort><Cachable>NoCache</Cachable>"
        "<Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>\n"
    )


def _float_reg(name: str, address: int, port: str, access: str) -> str:
    return (
        f'<FloatReg Name="{name}"><Address>{address:#x}</Address><Length>8</Length>'
        f"<AccessMode>{access}</AccessMode><pPort>{port}</pPort><Cachable>NoCache</Cachable>"
        "<Endianess>BigEndian</Endianess></FloatReg>\n"
    )


def _integer(name: str, address: int, low: int, high: str) -> str:
    return (
        f'<Integer Name="{name}" NameSpace="Standard"><pValue>{name}Reg</pValue><Min>{low}</Min>'
        f"<pMax>{high}</pMax><Inc>1</Inc></Integer>\n"
    ) + _int_reg(f"{name}Reg", address, "RW")


def _boolean(name: str, address: int) -> str:
    return (
        f'<Boolean Name="{name}" NameSpace="Standard"><pValue>{name}Reg</pValue>'
        "<OnValue>1</OnValue><OffValue>0</OffValue></Boolean>\n"
    ) + _int_reg(f"{name}Reg", address, "RW")


def _enumeration(name: str, address: int, entries: Mapping[str, int]) -> str:
    inner = "".join(
        f'<EnumEntry Name="{escape(entry)}" NameSpace="Standard"><Value>{value}</Value></EnumEntry>'
        for entry, value in entries.items()
    )
    return (
        f'<Enumeration Name="{name}" NameSpace="Standard">{inner}<pValue>{name}Reg</pValue>'
        "</Enumeration>\n"
    ) + _int_reg(f"{name}Reg", address, "RW")


def _command(name: str, address: int, value: int) -> str:
    return (
        f'<Command Name="{name}" NameSpace="Standard"><pValue>{name}Reg</pValue>'
        f"<CommandValue>{value}</CommandValue></Command>\n"
    ) + _int_reg(f"{name}Reg", address, "WO")


def _float(name: str, address: int, bounds: tuple[float, float], unit: str) -> str:
    return (
        f'<Float Name="{name}" NameSpace="Standard"><pValue>{name}Reg</pValue>'
        f"<Min>{bounds[0]}</Min><Max>{bounds[1]}</Max><Unit>{unit}</Unit></Float>\n"
    ) + _float_reg(f"{name}Reg", address, "Device", "RW")
