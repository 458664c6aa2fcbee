"""Every topic, service, action and frame of the graph: name, type and QoS, said once.

Names are relative to the rig's namespace. Plain data without ROS: `base_node` makes QoS profiles
and classes of it, the recordings' reader and writer take names and types.
"""

from __future__ import annotations

from dataclasses import dataclass

#: Namespace of the rig unless the user moves it.
NAMESPACE = "/sl"

#: Frames of coordinates (docs/conventions.md).
WORLD_FRAME = "sl_world"
CAMERA_FRAME = "sl_camera_optical"
PROJECTOR_FRAME = "sl_projector_optical"

#: Depths of queues. Triggers, poses and verdicts are small and never to be missed; images need
#: more than the longest built-in sequence; stacks and clouds have 20 to 100 MB each.
EVENTS, IMAGES, LARGE, LATCHED = 1024, 64, 4, 1


@dataclass(frozen=True)
class Topic:
    """One topic; all are reliable and keep the last messages.

    Parameters
    ----------
    name : str
        Below the rig's namespace, unless it begins with a slash.
    msgtype : str
        Its type, ``package/msg/Type``.
    depth : int
        Messages that may wait on either side.
    latched : bool
        Published once for all who come later (transient local).
    """

    name: str
    msgtype: str
    depth: int = EVENTS
    latched: bool = False

    @property
    def node(self) -> str:
        """Name of the node that publishes it."""
        return self.name.partition("/")[0]


@dataclass(frozen=True)
class Service:
    """One service or action: name below the namespace, and type (``package/srv/Type``)."""

    name: str
    kind: str


def _latched(name: str, msgtype: str) -> Topic:
    return Topic(name, msgtype, LATCHED, latched=True)


# -- what the devices say -------------------------------------------------------------------------
TRIGGER = Topic("projector/trigger", "sl_interfaces/msg/PatternTrigger")
PROJECTOR_INFO = _latched("projector/camera_info", "sensor_msgs/msg/CameraInfo")
IMAGE = Topic("camera/image_raw", "sensor_msgs/msg/Image", IMAGES)
CAMERA_INFO = Topic("camera/camera_info", "sensor_msgs/msg/CameraInfo", IMAGES)
#: How the camera is set, and where its pixels end (JSON).
CAMERA_SETTINGS = _latched("camera/settings", "std_msgs/msg/String")
POSE = Topic("stage/pose", "geometry_msgs/msg/PoseStamped")

# -- what the graph makes of it -------------------------------------------------------------------
FRAME = Topic("synchronizer/frame", "sl_interfaces/msg/MatchedFrame")
STACK = Topic("synchronizer/stack", "sl_interfaces/msg/PatternStack", LARGE)
#: Settings of the matching (JSON).
MATCHING = _latched("synchronizer/settings", "std_msgs/msg/String")
POINTS = Topic("reconstruct/points", "sensor_msgs/msg/PointCloud2", LARGE)
REFUSALS = Topic("reconstruct/refusals", "sensor_msgs/msg/Image", LARGE)
REPORT = Topic("reconstruct/report", "sl_interfaces/msg/ScanReport")
#: Settings of the reconstruction (JSON).
SETTINGS = _latched("reconstruct/settings", "std_msgs/msg/String")
#: The calibration in force. Published by the calibration node alone.
CALIBRATION = _latched("calibration/rig", "sl_interfaces/msg/RigCalibration")
#: What it takes to solve a calibration again (JSON).
CALIBRATION_RUN = Topic("calibration/run", "std_msgs/msg/String")

# -- topics of ROS --------------------------------------------------------------------------------
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", 50)
TF_STATIC = _latched("/tf_static", "tf2_msgs/msg/TFMessage")
CLOCK = Topic("/clock", "rosgraph_msgs/msg/Clock", 10)

#: What an evaluation reads.
EVALUATED_TOPICS = (TRIGGER, IMAGE, POSE, CALIBRATION)
#: What comes from the devices, and what `slrig record` records.
RAW_TOPICS = (TRIGGER, IMAGE, CAMERA_INFO, POSE, CALIBRATION, PROJECTOR_INFO, CAMERA_SETTINGS)
RECORDED_TOPICS = (*RAW_TOPICS, FRAME, REPORT, SETTINGS, MATCHING, CALIBRATION_RUN)

# -- services and actions -------------------------------------------------------------------------
PROJECT = Service("projector/project", "sl_interfaces/srv/Project")
STOP_PROJECTOR = Service("projector/stop", "std_srvs/srv/Trigger")
TRIGGER_CAMERA = Service("camera/trigger", "std_srvs/srv/Trigger")
MOVE_STAGE = Service("stage/move", "sl_interfaces/srv/MoveStage")
HOME_STAGE = Service("stage/home", "std_srvs/srv/Trigger")
STOP_STAGE = Service("stage/stop", "std_srvs/srv/Trigger")
CLEAR_STAGE = Service("stage/clear", "std_srvs/srv/Trigger")
#: Of a stage that is moved by hand.
CONFIRM_STAGE = Service("stage/confirm", "std_srvs/srv/Trigger")
GIVE_UP_STAGE = Service("stage/give_up", "std_srvs/srv/Trigger")
SCAN = Service("scan", "sl_interfaces/srv/Scan")
SCAN_ACTION = Service("scan", "sl_interfaces/action/Scan")
MEASURE = Service("measure", "sl_interfaces/srv/Measure")
CALIBRATE = Service("calibration/calibrate", "sl_interfaces/srv/Calibrate")
CALIBRATE_ACTION = Service("calibration/calibrate", "sl_interfaces/action/Calibrate")
VERIFY = Service("calibration/verify", "sl_interfaces/srv/Verify")
