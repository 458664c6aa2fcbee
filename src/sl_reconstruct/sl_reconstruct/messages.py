"""Stacks, clouds and rigs as ROS messages and back; what comes in is checked.

Pixels and points are not copied here: a stack is a view into its message, and a cloud's message
shares the cloud's memory until it is published (rclpy serialises anything with a buffer).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose, Quaternion, TransformStamped, Vector3
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField
from sl_interfaces.msg import PatternStack, RefusalCount, RigCalibration, ScanReport

from sl_common.errors import SequenceError, StackError
from sl_common.topics import CAMERA_FRAME, PROJECTOR_FRAME, WORLD_FRAME
from sl_projector.sequence.messages import sequence_from_msgs, stamp_from_msg, stamp_to_msg
from sl_projector.sequence.pattern_sequence import PatternSequence
from sl_reconstruct.cloud.cloud_writer import cloud_hash
from sl_reconstruct.model.calibration_file import Calibration, dump_calibration
from sl_reconstruct.model.opencv_lens import plumb_bob
from sl_reconstruct.model.rig import Device, Rig
from sl_reconstruct.reconstruction.reconstructor_cache import Product

Array = NDArray[np.float64]

_PIXELS: dict[str, np.dtype[Any]] = {"mono8": np.dtype(np.uint8), "mono16": np.dtype("<u2")}


@dataclass
class Stack:
    """All images of one scan.

    Parameters
    ----------
    scan_id : int
        The scan.
    sequence : PatternSequence
        One pattern per image.
    images : ndarray, (N, H, W), uint8 or uint16, or None
        View into the message; None once they were taken.
    stamps_ns : tuple of int
        Start of each exposure.
    exposure_s : float
        Exposure of each pattern, seconds.
    """

    scan_id: int
    sequence: PatternSequence
    images: NDArray[Any] | None
    stamps_ns: tuple[int, ...]
    exposure_s: float

    def take_images(self) -> NDArray[Any]:
        """Hand the images over: their memory is free as soon as the taker drops them."""
        images, self.images = self.images, None
        if images is None:
            raise StackError(f"the images of scan {self.scan_id} were taken already")
        return images


def stack_from_msg(message: PatternStack) -> Stack:
    """Check a stack message and return what is in it, without a copy of its pixels.

    Raises
    ------
    StackError
        When encoding, size, number of images, stamps or patterns do not fit each other.
    """
    try:
        size = (message.dmd_columns, message.dmd_rows)
        sequence = sequence_from_msgs(message.sequence, size, message.patterns)
    except SequenceError as error:
        raise StackError(f"stack of scan {message.scan_id}: {error}") from error
    stamps_ns = tuple(stamp_from_msg(stamp) for stamp in message.stamps)
    if len(stamps_ns) != len(sequence):
        raise StackError(
            f"stack of scan {message.scan_id} has {len(stamps_ns)} stamps for {len(sequence)} "
            "patterns; expected one each"
        )
    if any(b <= a for a, b in pairwise(stamps_ns)):
        raise StackError(f"stack of scan {message.scan_id}: its stamps do not increase")
    return Stack(
        message.scan_id, sequence, _images(message, len(sequence)), stamps_ns, message.exposure_s
    )


def _images(message: PatternStack, count: int) -> NDArray[Any]:
    if message.encoding not in _PIXELS:
        raise StackError(
            f"stack of scan {message.scan_id} has the encoding {message.encoding!r}; expected one "
            f"of {sorted(_PIXELS)}"
        )
    dtype = _PIXELS[message.encoding]
    expected = count * message.height * message.width * dtype.itemsize
    if expected == 0 or len(message.data) != expected:
        raise StackError(
            f"stack of scan {message.scan_id} has {len(message.data)} bytes; expected {count} "
            f"images of {message.width} x {message.height} {message.encoding} = {expected} (not 0)"
        )
    flat: NDArray[Any] = np.frombuffer(message.data, dtype)
    return flat.reshape(count, message.height, message.width)


def cloud_to_msg(points: NDArray[Any], stamp_ns: int, frame_id: str) -> PointCloud2:
    """One organised cloud as a message that shares its memory until it is published.

    Parameters
    ----------
    points : ndarray, (rows, columns), structured float32
        Fields x, y, z, sigma in metres and intensity; NaN where there is no point.
    stamp_ns : int
        Start of the scan's first exposure.
    frame_id : str
        Frame of x, y, z.
    """
    layout: dict[str, Any] = dict(points.dtype.fields or {})
    rows, columns = points.shape
    message = PointCloud2(
        height=rows,
        width=columns,
        fields=[
            PointField(name=name, offset=place[1], datatype=PointField.FLOAT32, count=1)
            for name, place in layout.items()
        ],
        is_bigendian=False,
        point_step=points.itemsize,
        row_step=points.itemsize * columns,
        is_dense=False,
    )
    message.header.stamp = stamp_to_msg(stamp_ns)
    message.header.frame_id = frame_id
    message._data = np.ascontiguousarray(points).reshape(-1).view(np.uint8)
    return message


def refusals_to_msg(reason: NDArray[np.uint8], stamp_ns: int, frame_id: str) -> Image:
    """Why each position of an organised cloud holds no point, as an image of `Reason` codes.

    Parameters
    ----------
    reason : ndarray, (rows, columns), uint8
        A code for each position of the cloud.
    stamp_ns : int
        The cloud's stamp.
    frame_id : str
        Frame of the camera, whose rows these are; columns are the cloud's.
    """
    rows, columns = reason.shape
    message = Image(height=rows, width=columns, encoding="mono8", step=columns)
    message.header.stamp = stamp_to_msg(stamp_ns)
    message.header.frame_id = frame_id
    message._data = np.ascontiguousarray(reason).reshape(-1)
    return message


def refusals_from_msg(message: Image) -> NDArray[np.uint8]:
    """Codes of `Reason`, (rows, columns); a view into the message.

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


def report_to_msg(product: Product, stack: Stack) -> ScanReport:
    """Say what a stack gave: counts, figures and hashes (times and attempts are the node's)."""
    cloud = product.cloud
    rows, columns = cloud.points.shape
    return ScanReport(
        scan_id=stack.scan_id,
        sequence=stack.sequence.name,
        attempts=1,
        rows=rows,
        columns=columns,
        points=cloud.present,
        lit_positions=cloud.lit,
        refused=[RefusalCount(reason=r, count=n) for r, n in sorted(cloud.refused.items())],
        median_sigma_m=cloud.median_sigma_m,
        edge_sigma_px=cloud.figures.edge_sigma_px,
        edge_bound_px=cloud.figures.edge_bound_px,
        edge_blur_px=cloud.figures.edge_blur_px,
        calibration_hash=product.calibration_hash,
        settings_hash=product.settings_hash,
        cloud_hash=cloud_hash(cloud.points),
    )


def cloud_from_msg(message: PointCloud2) -> NDArray[Any]:
    """View of a cloud message as a structured array (rows, columns).

    Raises
    ------
    StackError
        When fields and lengths do not fit each other.
    """
    types = {PointField.FLOAT32: "<f4", PointField.FLOAT64: "<f8"}
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


def rig_to_msg(calibration: Calibration, source: str, stamp_ns: int) -> RigCalibration:
    """Return the calibration in force as a message.

    Parameters
    ----------
    calibration : Calibration
        Rig and evidence.
    source : str
        Where it was read from.
    stamp_ns : int
        When it came in force.
    """
    rig = calibration.rig
    message = RigCalibration(
        hash=calibration.hash,
        source=source,
        yaml=dump_calibration(calibration),
        camera=camera_info(rig.camera, CAMERA_FRAME, stamp_ns),
        projector=camera_info(rig.projector, PROJECTOR_FRAME, stamp_ns),
        camera_from_world=pose(rig.camera.rotation, rig.camera.translation_m),
        projector_from_world=pose(rig.projector.rotation, rig.projector.translation_m),
    )
    message.header.stamp = stamp_to_msg(stamp_ns)
    message.header.frame_id = WORLD_FRAME
    return message


def camera_info(device: Device, frame_id: str, stamp_ns: int) -> CameraInfo:
    """Describe a device to tools that know OpenCV's model; see `plumb_bob` for its error."""
    lens, _ = plumb_bob(device)
    width, height = device.image_size
    matrix = device.camera_matrix
    info = CameraInfo(
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=[float(k) for k in lens.coefficients],
        k=matrix.ravel().tolist(),
        r=np.eye(3).ravel().tolist(),
        p=np.hstack([matrix, np.zeros((3, 1))]).ravel().tolist(),
    )
    info.header.frame_id = frame_id
    info.header.stamp = stamp_to_msg(stamp_ns)
    return info


def pose(rotation: Array, translation_m: Array) -> Pose:
    """Rotation matrix and translation as a message."""
    message = Pose()
    p, q = message.position, message.orientation
    p.x, p.y, p.z = (float(v) for v in translation_m)
    q.x, q.y, q.z, q.w = quaternion_xyzw(rotation)
    return message


def frames_of(rig: Rig) -> list[TransformStamped]:
    """Where camera and projector stand in the world, for tf: parent is the world."""
    transforms = []
    for device, name in ((rig.camera, CAMERA_FRAME), (rig.projector, PROJECTOR_FRAME)):
        transform = TransformStamped(child_frame_id=name)
        transform.header.frame_id = WORLD_FRAME
        x, y, z = (float(v) for v in device.position_m)
        transform.transform.translation = Vector3(x=x, y=y, z=z)
        qx, qy, qz, qw = quaternion_xyzw(device.rotation.T)
        transform.transform.rotation = Quaternion(x=qx, y=qy, z=qz, w=qw)
        transforms.append(transform)
    return transforms


def quaternion_xyzw(rotation: Array) -> tuple[float, float, float, float]:
    """Unit quaternion of a rotation matrix, w >= 0; stable for every angle (Shepperd 1978)."""
    trace = float(np.trace(rotation))
    diagonal = np.append(np.diag(rotation), trace)
    i = int(np.argmax(diagonal))
    q = np.empty(4)
    if i == 3:
        q[:3] = [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0],
                 rotation[1, 0] - rotation[0, 1]]  # fmt: skip
        q[3] = 1 + trace
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1 + 2 * rotation[i, i] - trace
        q[j] = rotation[j, i] + rotation[i, j]
        q[k] = rotation[k, i] + rotation[i, k]
        q[3] = rotation[k, j] - rotation[j, k]
    q *= (1.0 if q[3] >= 0 else -1.0) / np.linalg.norm(q)
    x, y, z, w = (float(v) for v in q)
    return x, y, z, w
