"""Height maps as X3P (ISO 25178-72:2017), for metrology programs."""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ElementTree
import zipfile
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from sl_common.documents import written_atomically
from sl_reconstruct.cloud.height_map import HeightMap

NAMESPACE = "http://www.opengps.eu/2008/ISO5436_2"
DATA, CHECKSUM = "bindata/data.bin", "md5checksum.hex"
UNKNOWN = "not available"


def save_x3p(path: str | Path, height: HeightMap, made: datetime | None = None) -> None:
    """Write a height map as X3P: 32-bit heights in metres, NaN where nothing was measured.

    Parameters
    ----------
    path : path
        The file.
    height : HeightMap
        What to write. X3P counts y upwards from the first row, so the row with the smallest y
        comes first.
    made : datetime, optional
        When it was measured; now where left out.
    """
    rows = np.ascontiguousarray(height.z_m[::-1], dtype="<f4").tobytes()
    main = _main_xml(height, hashlib.md5(rows).hexdigest(), made or datetime.now(UTC))
    with (
        written_atomically(Path(path)) as partial,
        zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
    ):
        archive.writestr("main.xml", main)
        archive.writestr(DATA, rows)
        archive.writestr(CHECKSUM, f"{hashlib.md5(main).hexdigest()} *main.xml\n")


def _main_xml(height: HeightMap, checksum: str, made: datetime) -> bytes:
    """Records 1 (axes), 2 (origin), 3 (data) and 4 (checksum) of clause 5 of the standard."""
    root = ElementTree.Element("p:ISO5436_2", {"xmlns:p": NAMESPACE})
    _add(
        root,
        {
            "Record1": {
                "Revision": "ISO5436 - 2000",
                "FeatureType": "SUR",
                "Axes": {
                    "CX": _axis("I", "D", height.step_m, height.extent_m[0]),
                    "CY": _axis("I", "D", height.step_m, height.extent_m[2]),
                    "CZ": _axis("A", "F", 1.0, 0.0),
                },
            },
            "Record2": {
                "Date": made.isoformat(),
                "Instrument": dict.fromkeys(
                    ("Manufacturer", "Model", "Serial", "Version"), UNKNOWN
                ),
                "CalibrationDate": made.isoformat(),
                "ProbingSystem": {"Type": "NonContacting", "Identification": "structured light"},
                "Comment": "slrig; CalibrationDate is not known and the same as Date",
            },
            "Record3": {
                "MatrixDimension": {
                    "SizeX": height.z_m.shape[1],
                    "SizeY": height.z_m.shape[0],
                    "SizeZ": 1,
                },
                "DataLink": {"PointDataLink": DATA, "MD5ChecksumPointData": checksum.upper()},
            },
            "Record4": {"ChecksumFile": CHECKSUM},
        },
    )
    return bytes(ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True))


def _axis(kind: str, dtype: str, increment: float, offset: float) -> dict[str, object]:
    return {
        "AxisType": kind,
        "DataType": dtype,
        "Increment": repr(float(increment)),
        "Offset": repr(float(offset)),
    }


def _add(parent: ElementTree.Element, content: dict[str, object]) -> None:
    """Add elements by name; a mapping becomes the element's children."""
    for name, value in content.items():
        child = ElementTree.SubElement(parent, name)
        if isinstance(value, dict):
            _add(child, value)
        else:
            child.text = str(value)
