"""What other tools read of a rig: OpenCV's lens, quaternions, frames."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support import ros_graph

ros_graph.require_ros()

from sl_bench.world.reference_rig import reference_rig  # noqa: E402
from sl_common.messages import stamp_from_msg, stamp_to_msg  # noqa: E402
from sl_projector.sequence.messages import rigid_to_msg  # noqa: E402
from sl_reconstruct.messages import camera_info, frames_of, quaternion_xyzw  # noqa: E402
from sl_reconstruct.model.opencv_lens import plumb_bob  # noqa: E402
from sl_reconstruct.model.rig import BrownConrady, Device  # noqa: E402


@pytest.mark.parametrize("name", ["camera", "projector"])
def test_opencv_projects_with_the_published_numbers_as_the_rig_does(name: str) -> None:
    device: Device = getattr(reference_rig(), name)
    info = camera_info(device, "frame", 5)
    assert info.distortion_model == "plumb_bob"
    rng = np.random.default_rng(2)
    # In front of the devices, over the field of 12 x 9 mm and 4 mm of height.
    points = rng.uniform([-6e-3, -4.5e-3, -2e-3], [6e-3, 4.5e-3, 2e-3], (500, 3))
    seen, _ = cv2.projectPoints(
        points, cv2.Rodrigues(device.rotation)[0], device.translation_m,
        np.array(info.k).reshape(3, 3), np.array(info.d),
    )  # fmt: skip
    # The fit's own figure (0.0001 px camera, 0.0075 px projector) holds on its grid; between and a
    # little outside of it, twice that.
    _, worst_px = plumb_bob(device)
    assert worst_px < 0.01
    assert np.abs(seen.reshape(-1, 2) - device.project(points)).max() < max(2 * worst_px, 1e-3)


def test_a_lens_of_opencv_is_published_as_it_is() -> None:
    camera = reference_rig().camera
    lens = BrownConrady((0.1, -0.2, 1e-3, -2e-3, 0.05))
    device = Device(
        camera.image_size, (1000.0, 1100.0), camera.image_centre_px, camera.pixel_pitch_m,
        camera.rotation, camera.translation_m, lens,
    )  # fmt: skip
    assert plumb_bob(device) == (lens, 0.0)
    assert list(camera_info(device, "f", 0).d) == list(lens.coefficients)


def test_quaternions_are_scipys_for_every_kind_of_rotation() -> None:
    rotations = [
        *Rotation.random(50, random_state=4).as_matrix(),
        *Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix(),
        np.eye(3),
        reference_rig().camera.rotation,
    ]
    for matrix in rotations:
        ours = np.array(quaternion_xyzw(matrix))
        assert ours[3] >= 0
        assert np.allclose(Rotation.from_quat(ours).as_matrix(), matrix, atol=1e-12)
        assert np.linalg.norm(ours) == pytest.approx(1.0, abs=1e-14)


def test_a_pose_maps_world_points_and_a_frame_is_its_inverse() -> None:
    rig = reference_rig()
    message = rigid_to_msg(rig.camera.translation_m, quaternion_xyzw(rig.camera.rotation))
    q = message.orientation
    turn = Rotation.from_quat([q.x, q.y, q.z, q.w])
    shift = np.array([message.position.x, message.position.y, message.position.z])
    frame = frames_of(rig)[0]
    assert (frame.header.frame_id, frame.child_frame_id) == ("sl_world", "sl_camera_optical")
    r, t = frame.transform.rotation, frame.transform.translation
    back = Rotation.from_quat([r.x, r.y, r.z, r.w])
    point = np.array([1e-3, -2e-3, 3e-4])
    in_camera = turn.apply(point) + shift
    assert np.allclose(
        in_camera, rig.camera.rotation @ point + rig.camera.translation_m, atol=1e-15
    )
    assert np.allclose(back.apply(in_camera) + np.array([t.x, t.y, t.z]), point, atol=1e-15)


def test_stamps_keep_their_nanoseconds() -> None:
    for stamp_ns in (0, 1, 999_999_999, 1_795_329_758_123_456_789):
        assert stamp_from_msg(stamp_to_msg(stamp_ns)) == stamp_ns
    assert stamp_from_msg(stamp_to_msg(-5)) == 0
