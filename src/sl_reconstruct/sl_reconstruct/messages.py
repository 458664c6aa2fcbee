"""Clouds, reports and rigs as ROS messages and back; what comes in is checked.

Points are not copied: a cloud's message shares the cloud's memory until it is published. The rig is
written for rclpy and for rosbags alike (``make``, see `sl_common.messages`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sl_common.errors import StackError
from sl_common.messages import MakeMessage, header, ros_message
from sl_common.topics import (
    CALIBRATION,
    CAMERA_FRAME,
    CAMERA_INFO,
    POINTS,
    PROJECTOR_FRAME,
    REPORT,
    WORLD_FRAME,
)
from sl_projector.sequence.messages import flat_bytes, rigid_to_msg
from sl_reconstruct.model.calibration_file import Calibration, dump_calibration
from sl_reconstruct.model.opencv_lens import plumb_bob
from sl_reconstruct.model.rig import Device, Rig
from sl_reconstruct.scan.scan_summary import ScanSummary

#: sensor_msgs/PointField's numbers for types.
_FLOAT32, _FLOAT64 = 7, 8
#: Quality figures that a report's message has.
EDGE_FIGURES = ("edge_sigma_px", "edge_bound_px", "edge_blur_px")
#: Fields of a report's message that a summary has under the same name, always.
_REPORT_FIELDS = (
    *("scan_id", "sequence", "rows", "columns", "points", "lit_positions", "median_sigma_m"),
    *("calibration_hash", "settings_hash", "cloud_hash"),
)


def cloud_to_msg(points: NDArray[Any], stamp_ns: int) -> Any:
    """One organised cloud in the world as a ``sensor_msgs/PointCloud2``.

    Parameters
    ----------
    points : ndarray, (rows, columns), structured float32
        Fields x, y, z, sigma in metres and intensity; NaN where there is no point.
    stamp_ns : int
        Start of the scan's first exposure.
    """
    layout: dict[str, Any] = dict(points.dtype.fields or {})
    rows, columns = points.shape
    return ros_message(
        POINTS.msgtype,
        header=header(stamp_ns, WORLD_FRAME),
        height=rows,
        width=columns,
        fields=[
            ros_message(
                "sensor_msgs/msg/PointField", name=name, offset=place[1], datatype=_FLOAT32, count=1
            )
            for name, place in layout.items()
        ],
        point_step=points.itemsize,
        row_step=points.itemsize * columns,
        data=flat_bytes(points),
    )


def refusals_from_msg(message: Any) -> NDArray[np.uint8]:
    """Why each position of a cloud holds no point: codes of `Reason`, a view into the message.

    Raises
    ------
    StackError
        When it is not an image of bytes.
    """
    codes = np.frombuffer(message.data, np.uint8)
    if message.encoding != "mono8" or codes.size != message.height * message.width:
        raise StackError(
            f"refusals of {message.height} x {message.width} with {codes.size} bytes as "
            f"{message.encoding!r}; expected mono8, a byte for each"
        )
    return codes.reshape(message.height, message.width)


def report_to_msg(summary: ScanSummary, make: MakeMessage = ros_message) -> Any:
    """Make a ``sl_interfaces/ScanReport``; what is not known is zero in it.

    Parameters
    ----------
    summary : ScanSummary
        The scan.
    make : MakeMessage
        Where messages come from.
    """
    refused = [
        make("sl_interfaces/msg/RefusalCount", reason=reason, count=count)
        for reason, count in sorted(summary.refused.items())
    ]
    return make(
        REPORT.msgtype,
        **{name: getattr(summary, name) for name in _REPORT_FIELDS},
        **{name: summary.figures.get(name, 0.0) for name in EDGE_FIGURES},
        refused=refused,
        attempts=summary.attempts or 0,
        attempt_messages=list(summary.attempt_messages or ()),
        acquisition_s=summary.acquisition_s or 0.0,
        processing_s=summary.processing_s or 0.0,
    )


def report_from_msg(message: Any) -> ScanSummary:
    """Read a ``sl_interfaces/ScanReport``."""
    figures = {name: getattr(message, name) for name in EDGE_FIGURES}
    if message.edge_bound_px > 0:
        figures["bound_ratio"] = message.edge_sigma_px / message.edge_bound_px
    live = ("attempts", "acquisition_s", "processing_s")
    return ScanSummary(
        **{name: getattr(message, name) for name in (*_REPORT_FIELDS, *live)},
        refused={item.reason: item.count for item in message.refused},
        figures=figures,
        attempt_messages=tuple(message.attempt_messages),
    )


def cloud_from_msg(message: Any) -> NDArray[Any]:
    """View of a cloud message as a structured array (rows, columns).

    Raises
    ------
    StackError
        When fields and lengths do not fit each other.
    """
    types = {_FLOAT32: "<f4", _FLOAT64: "<f8"}
    if any(f.datatype not in types for f in message.fields) or message.is_bigendian:
        raise StackError("cloud message: expected little-endian float fields only")
    layout: Any = {
        "names": [f.name for f in message.fields],
        "formats": [types[f.datatype] for f in message.fields],
        "offsets": [f.offset for f in message.fields],
        "itemsize": message.point_step,
    }
    try:
        dtype: np.dtype[Any] = np.dtype(layout)
    except ValueError as error:
        raise StackError(f"cloud message: its fields do not fit a point: {error}") from error
    expected = message.height * message.width * message.point_step
    if len(message.data) != expected:
        raise StackError(f"cloud message has {len(message.data)} bytes; expected {expected}")
    return np.frombuffer(message.data, dtype).reshape(message.height, message.width)


def rig_to_msg(
    calibration: Calibration, source: str, stamp_ns: int, make: MakeMessage = ros_message
) -> Any:
    """Return the calibration in force as a ``sl_interfaces/RigCalibration``.

    Parameters
    ----------
    calibration : Calibration
        Rig and evidence.
    source : str
        Where it was read from.
    stamp_ns : int
        When it came in force.
    make : MakeMessage
        Where messages come from.
    """
    camera, projector = calibration.rig.camera, calibration.rig.projector
    return make(
        CALIBRATION.msgtype,
        header=header(stamp_ns, WORLD_FRAME, make),
        hash=calibration.hash,
        source=source,
        yaml=dump_calibration(calibration),
        camera=camera_info(camera, CAMERA_FRAME, stamp_ns, make),
        projector=camera_info(projector, PROJECTOR_FRAME, stamp_ns, make),
        camera_from_world=_device_from_world(camera, make),
        projector_from_world=_device_from_world(projector, make),
    )


def _device_from_world(device: Device, make: MakeMessage) -> Any:
    return rigid_to_msg(device.translation_m, quaternion_xyzw(device.rotation), make)


def camera_info(
    device: Device, frame_id: str, stamp_ns: int, make: MakeMessage = ros_message
) -> Any:
    """Describe a device to tools that know OpenCV's model; see `plumb_bob` for its error.

    Parameters
    ----------
    device : Device
        Camera or projector.
    frame_id : str
        Its frame.
    stamp_ns : int
        When its calibration came in force.
    make : MakeMessage
        Where messages come from.
    """
    lens, _ = plumb_bob(device)
    width, height = device.image_size
    matrix = device.camera_matrix
    whole = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)
    return make(
        CAMERA_INFO.msgtype,
        header=header(stamp_ns, frame_id, make),
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=np.array(lens.coefficients),
        k=matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([matrix, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=make("sensor_msgs/msg/RegionOfInterest", do_rectify=False, **whole),
    )


def frames_of(rig: Rig) -> list[Any]:
    """Where camera and projector stand in the world, for tf: parent is the world."""
    transforms = []
    for device, name in ((rig.camera, CAMERA_FRAME), (rig.projector, PROJECTOR_FRAME)):
        world_from_device = rigid_to_msg(device.position_m, quaternion_xyzw(device.rotation.T))
        at = world_from_device.position
        transforms.append(
            ros_message(
                "geometry_msgs/msg/TransformStamped",
                header=header(0, WORLD_FRAME),
                child_frame_id=name,
                transform=ros_message(
                    "geometry_msgs/msg/Transform",
                    translation=ros_message("geometry_msgs/msg/Vector3", x=at.x, y=at.y, z=at.z),
                    rotation=world_from_device.orientation,
                ),
            )
        )
    return transforms


def quaternion_xyzw(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternion (4,) of a rotation matrix (3, 3), w >= 0."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat(canonical=True))
