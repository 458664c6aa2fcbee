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

from sl_bringup.bag.bags import make_message, typestore
from sl_common.errors import BagError
from sl_common.topics import CALIBRATION, IMAGE, NAMESPACE, POSE, TRIGGER, Topic
from sl_projector.sequence.messages import image_to_msg, pose_to_msg, trigger_to_msg
from sl_projector.sequence.pattern_sequence import PatternSequence
from sl_projector.sequence.stack import StagePose
from sl_reconstruct.messages import rig_to_msg
from sl_reconstruct.model.calibration_file import Calibration

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
        """Write one message.

        Parameters
        ----------
        topic : Topic
            Of what topic.
        stamp_ns : int
            When it is said to have been recorded.
        message : object
            Of `make_message`.
        """
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
        """Write that a pattern began to be exposed; see `trigger_to_msg` for the arguments.

        Parameters
        ----------
        sequence : PatternSequence
            What is projected.
        index, scan_id : int
            Number of the pattern, and of the scan.
        stamp_ns : int
            Start of the exposure, nanoseconds.
        exposure_s : float
            Exposure time, seconds.
        """
        message = trigger_to_msg(sequence, index, scan_id, stamp_ns, exposure_s, make_message)
        self.write(TRIGGER, stamp_ns, message)

    def image(self, image: NDArray[Any], stamp_ns: int, received_ns: int) -> None:
        """Write a camera frame.

        Parameters
        ----------
        image : ndarray, (H, W), uint8 or uint16
            The frame.
        stamp_ns, received_ns : int
            Start of its exposure, and when it came.
        """
        self.write(IMAGE, received_ns, image_to_msg(image, stamp_ns, make_message))

    def pose(self, position_m: tuple[float, float, float], stamp_ns: int) -> None:
        """Write where the stage stood.

        Parameters
        ----------
        position_m : tuple of float
            Metres in the world.
        stamp_ns : int
            When.
        """
        self.write(POSE, stamp_ns, pose_to_msg(StagePose(stamp_ns, position_m), make_message))

    def calibration(self, calibration: Calibration, source: str, stamp_ns: int) -> None:
        """Write the calibration in force; see `rig_to_msg` for the arguments.

        Parameters
        ----------
        calibration : Calibration
            The rig and its evidence.
        source : str
            Where it comes from.
        stamp_ns : int
            When it came into force, nanoseconds.
        """
        message = rig_to_msg(calibration, source, stamp_ns, make_message)
        self.write(CALIBRATION, stamp_ns, message)


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
