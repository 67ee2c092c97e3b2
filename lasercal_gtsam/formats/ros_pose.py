"""``geometry_msgs/PoseWithCovarianceStamped`` as YAML.

The form that ``rostopic pub -f`` and ``ros2 topic pub`` take; the stamp is left out, as what stands
still has none. The covariance is 6 x 6 by rows, in the order x, y, z, rotation about X, Y, Z, the
axes fixed: those of the parent frame (`pose_covariance`).
"""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.fields import decoded, silent_yaml_1_1
from lasercal_gtsam.formats.held import Held, Written
from lasercal_gtsam.formats.pose_covariance import fixed_axes_covariance, tangent_covariance
from lasercal_gtsam.formats.ros_camera_info import quoted
from lasercal_gtsam.formats.ros_transform import held_pose, pose_numbers, pose_of_numbers
from lasercal_gtsam.formats.source import Source
from lasercal_gtsam.formats.text import comment, number, numbers
from lasercal_gtsam.report_map import CAMERA_TANGENT

_POSE_LABELS = CAMERA_TANGENT[:6]


def write_pose(source: Source) -> Written:
    """The camera's pose with its covariance."""
    T, tangent = source.only_camera.T_base_camera, source.pose_covariance
    covariance = fixed_axes_covariance(tangent, T[:3, :3])
    x, y, z, qx, qy, qz, qw = map(number, pose_numbers(T))
    rows = ",\n     ".join(numbers(row) for row in covariance)
    text = (
        f"{comment(source.remarks)}"
        f"# pose of {source.child} in the frame of the header\n"
        f"header:\n  frame_id: {quoted(source.parent)}\n"
        f"pose:\n  pose:\n    position: {{x: {x}, y: {y}, z: {z}}}\n"
        f"    orientation: {{x: {qx}, y: {qy}, z: {qz}, w: {qw}}}\n"
        "  # x y z (m), then rotations about the fixed axes X Y Z of the parent frame (rad)\n"
        f"  covariance:\n    [{rows}]\n"
    )
    held = held_pose(source)
    wanted = Held(
        poses={"": held.poses[source.child]},
        frames=(source.parent, ""),
        covariance=tangent,
        labels=_POSE_LABELS,
    )
    notes: tuple[str, ...] = ()
    if not np.any(tangent):
        notes = (
            "the pose was held in the calibration: its covariance is written as zero, which some "
            "programs take for unknown",
        )
    return Written(text.encode(), wanted, notes)


def read_pose(content: bytes) -> Held:
    """Read the message; the covariance in our tangent coordinates."""
    message = silent_yaml_1_1(decoded(content, "pose"))
    pose, covariance = message["pose"]["pose"], message["pose"]["covariance"]
    p, q = pose["position"], pose["orientation"]
    if len(covariance) != 36:
        raise DataError(f"covariance: expected 36 numbers, got {len(covariance)}")
    # a plain key y is a truth value to YAML 1.1 by the letter; ROS' own readers take it for a name
    p, q = ({"y" if key is True else key: value for key, value in m.items()} for m in (p, q))
    T = pose_of_numbers([p["x"], p["y"], p["z"], q["x"], q["y"], q["z"], q["w"]])
    return Held(
        poses={"": T},
        frames=(message["header"]["frame_id"], ""),
        covariance=tangent_covariance(np.array(covariance).reshape(6, 6), T[:3, :3]),
        labels=_POSE_LABELS,
    )
