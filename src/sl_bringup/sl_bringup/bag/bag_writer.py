"""Writing a recording, without ROS, so that the stock ``ros2 bag play`` plays it.

Every topic carries its complete QoS: the player publishes with what the bag says, and a depth
below the length of a burst would lose the burst's end.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from scipy.spatial.transform import Rotation

from sl_bringup.bag.bags import message_class, typestore
from sl_common.errors import BagError
from sl_common.topics import (
    CALIBRATION,
    CAMERA_FRAME,
    IMAGE,
    NAMESPACE,
    POSE,
    PROJECTOR_FRAME,
    TRIGGER,
    WORLD_FRAME,
    Topic,
)
from sl_projector.sequence.pattern_sequence import PatternSequence
from sl_reconstruct.model.calibration_file import Calibration, dump_calibration
from sl_reconstruct.model.opencv_lens import plumb_bob
from sl_reconstruct.model.rig import Device

Storage = Literal["mcap", "sqlite3"]

#: A whole sequence fits (the longest named one has 50 patterns).
QOS_DEPTH = 64
_FOREVER = QosTime(9223372036, 854775807)


def topic_qos(topic: Topic) -> Qos:
    """What a player shall offer: all reliable, deep enough for a whole sequence."""
    return Qos(
        QosHistory.KEEP_LAST,
        1 if topic.latched else QOS_DEPTH,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if topic.latched else QosDurability.VOLATILE,
        _FOREVER,
        _FOREVER,
        QosLiveliness.AUTOMATIC,
        _FOREVER,
        False,
    )


class BagWriter:
    """Writes the graph's topics into an open rosbag2; made by `new_bag`."""

    def __init__(self, writer: Writer, namespace: str) -> None:
        self._writer = writer
        self._namespace = namespace
        self._connections: dict[Topic, Connection] = {}

    def write(self, topic: Topic, stamp_ns: int, message: Any) -> None:
        """Write one message, recorded at ``stamp_ns``."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                f"{self._namespace}/{topic.name}",
                topic.msgtype,
                typestore=typestore(),
                offered_qos_profiles=[topic_qos(topic)],
            )
        data = typestore().serialize_cdr(message, topic.msgtype)
        self._writer.write(self._connections[topic], stamp_ns, data)

    def trigger(
        self, sequence: PatternSequence, index: int, scan_id: int, stamp_ns: int, exposure_s: float
    ) -> None:
        """Write that pattern ``index`` began to be exposed at ``stamp_ns``."""
        pattern = sequence.patterns[index]
        message = message_class(TRIGGER.msgtype)(
            header=header(stamp_ns, PROJECTOR_FRAME),
            scan_id=scan_id,
            sequence=sequence.name,
            dmd_columns=sequence.dmd_size[0],
            dmd_rows=sequence.dmd_size[1],
            index=index,
            count=len(sequence),
            pattern=message_class("sl_interfaces/msg/Pattern")(
                kind=pattern.kind,
                axis=pattern.axis,
                bit=pattern.bit,
                bits=pattern.bits,
                division_px=pattern.division_px,
                shift_px=pattern.shift_px,
                inverted=pattern.inverted,
            ),
            exposure_s=exposure_s,
        )
        self.write(TRIGGER, stamp_ns, message)

    def image(self, image: NDArray[Any], stamp_ns: int, received_ns: int) -> None:
        """Write a camera frame, (H, W) uint8 or uint16, exposed from ``stamp_ns`` on."""
        wide = image.dtype == np.uint16
        message = message_class(IMAGE.msgtype)(
            header=header(stamp_ns, CAMERA_FRAME),
            height=image.shape[0],
            width=image.shape[1],
            encoding="mono16" if wide else "mono8",
            is_bigendian=0,
            step=image.shape[1] * image.itemsize,
            data=np.ascontiguousarray(image).view(np.uint8).reshape(-1),
        )
        self.write(IMAGE, received_ns, message)

    def pose(self, position_m: tuple[float, float, float], stamp_ns: int) -> None:
        """Write where the stage stood at ``stamp_ns``, metres in the world."""
        x, y, z = position_m
        message = message_class(POSE.msgtype)(
            header=header(stamp_ns, WORLD_FRAME), pose=_pose((x, y, z), (0.0, 0.0, 0.0, 1.0))
        )
        self.write(POSE, stamp_ns, message)

    def calibration(self, calibration: Calibration, source: str, stamp_ns: int) -> None:
        """Write the calibration in force, as the graph latches it."""
        rig = calibration.rig
        message = message_class(CALIBRATION.msgtype)(
            header=header(stamp_ns, WORLD_FRAME),
            hash=calibration.hash,
            source=source,
            yaml=dump_calibration(calibration),
            camera=_camera_info(rig.camera, CAMERA_FRAME, stamp_ns),
            projector=_camera_info(rig.projector, PROJECTOR_FRAME, stamp_ns),
            camera_from_world=_pose(rig.camera.translation_m, _quaternion(rig.camera)),
            projector_from_world=_pose(rig.projector.translation_m, _quaternion(rig.projector)),
        )
        self.write(CALIBRATION, stamp_ns, message)


def header(stamp_ns: int, frame_id: str) -> Any:
    """Build a std_msgs/Header."""
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    stamp = message_class("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)
    return message_class("std_msgs/msg/Header")(stamp=stamp, frame_id=frame_id)


def _pose(position_m: Any, quaternion: Any) -> Any:
    x, y, z = (float(v) for v in position_m)
    qx, qy, qz, qw = (float(v) for v in quaternion)
    return message_class("geometry_msgs/msg/Pose")(
        position=message_class("geometry_msgs/msg/Point")(x=x, y=y, z=z),
        orientation=message_class("geometry_msgs/msg/Quaternion")(x=qx, y=qy, z=qz, w=qw),
    )


def _quaternion(device: Device) -> Any:
    return Rotation.from_matrix(device.rotation).as_quat()


def _camera_info(device: Device, frame_id: str, stamp_ns: int) -> Any:
    """CameraInfo, with the nearest lens that OpenCV has a name for."""
    lens, _ = plumb_bob(device)
    k = device.camera_matrix
    return message_class("sensor_msgs/msg/CameraInfo")(
        header=header(stamp_ns, frame_id),
        width=device.image_size[0],
        height=device.image_size[1],
        distortion_model="plumb_bob",
        d=np.array(lens.coefficients),
        k=k.reshape(-1),
        r=np.eye(3).reshape(-1),
        p=np.hstack([k, np.zeros((3, 1))]).reshape(-1),
        binning_x=0,
        binning_y=0,
        roi=message_class("sensor_msgs/msg/RegionOfInterest")(
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        ),
    )


@contextmanager
def new_bag(
    path: str | Path,
    storage: Storage = "mcap",
    namespace: str = NAMESPACE,
    notes: dict[str, str] | None = None,
) -> Iterator[BagWriter]:
    """Write a new rosbag2 directory; it appears under its name only when it is complete.

    Parameters
    ----------
    path : path
        The directory; it must not exist.
    storage : {"mcap", "sqlite3"}
        Storage plug-in.
    namespace : str
        Namespace of the topics.
    notes : dict, optional
        Custom data for the bag's metadata.

    Raises
    ------
    BagError
        When the path is taken or cannot be written.
    """
    path = Path(path)
    if path.exists():
        raise BagError(f"{path} exists already; expected a name that is free")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # rosbags names the files after the directory, so the name is right and the place is not.
        partial = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    except OSError as exc:
        raise BagError(f"cannot write {path}: {exc.strerror or exc}") from None
    try:
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        writer = Writer(partial / path.name, version=9, storage_plugin=plugin)
        for key, value in (notes or {}).items():
            writer.set_custom_data(key, value)
        with writer:
            yield BagWriter(writer, namespace)
        (partial / path.name).replace(path)
    except OSError as exc:
        raise BagError(f"cannot write {path}: {exc.strerror or exc}") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
