"""Static transforms for tf2, as a command and as a launch file.

ROS 1 (`tf2_ros static_transform_publisher`) takes numbers by place: ``x y z qx qy qz qw parent
child``; with three angles instead of the quaternion they would be yaw, pitch, roll. ROS 2 (Humble
or newer) takes named options, and a quaternion here, too. Both take the pose of the child in the
parent, metres.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from xml.etree import ElementTree

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.held import Held, Written
from lasercal_gtsam.formats.source import Source
from lasercal_gtsam.formats.text import comment, number, xml_comment
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.io.conventions import columns_from_rotations
from lasercal_gtsam.rotations import make_pose

_PACKAGE, _PROGRAM = "tf2_ros", "static_transform_publisher"
_FLAGS = ("x", "y", "z", "qx", "qy", "qz", "qw")


def write_ros1_command(source: Source) -> Written:
    """``rosrun tf2_ros static_transform_publisher ...``."""
    return _command(source, ["rosrun", _PACKAGE, _PROGRAM, *_by_place(source)])


def write_ros2_command(source: Source) -> Written:
    """``ros2 run tf2_ros static_transform_publisher ...``."""
    return _command(source, ["ros2", "run", _PACKAGE, _PROGRAM, *_by_name(source)])


def write_ros1_launch(source: Source) -> Written:
    """A launch file of ROS 1."""
    return _launch(source, "type", _by_place(source))


def write_ros2_launch(source: Source) -> Written:
    """An XML launch file of ROS 2."""
    return _launch(source, "exec", _by_name(source))


def read_ros1_command(content: bytes) -> Held:
    """Read the command as ROS 1 does."""
    return _read_by_place(_words(content)[3:])


def read_ros2_command(content: bytes) -> Held:
    """Read the command as ROS 2 does."""
    return _read_by_name(_words(content)[4:])


def read_ros1_launch(content: bytes) -> Held:
    """Read the launch file as ROS 1 does."""
    return _read_by_place(_launched(content, "type"))


def read_ros2_launch(content: bytes) -> Held:
    """Read the launch file as ROS 2 does."""
    return _read_by_name(_launched(content, "exec"))


def pose_numbers(T: Array) -> list[float]:
    """``x y z qx qy qz qw`` of a transform (4, 4)."""
    quaternion = columns_from_rotations("quat_xyzw", T[None, :3, :3])[0]
    return [*T[:3, 3].tolist(), *quaternion.tolist()]


def pose_of_numbers(values: Sequence[float]) -> Array:
    """Transform (4, 4) of ``x y z qx qy qz qw``."""
    from scipy.spatial.transform import Rotation

    return make_pose(Rotation.from_quat(values[3:7]).as_matrix(), np.array(values[:3]))


def held_pose(source: Source) -> Held:
    """What every file with a single pose must hold."""
    poses = {source.child: source.only_camera.T_base_camera}
    return Held(poses=poses, frames=(source.parent, source.child))


def _by_place(source: Source) -> list[str]:
    values = pose_numbers(source.only_camera.T_base_camera)
    return [*map(number, values), source.parent, source.child]


def _by_name(source: Source) -> list[str]:
    values = pose_numbers(source.only_camera.T_base_camera)
    words = [w for flag, x in zip(_FLAGS, values, strict=True) for w in (f"--{flag}", number(x))]
    return [*words, "--frame-id", source.parent, "--child-frame-id", source.child]


def _command(source: Source, words: list[str]) -> Written:
    text = "#!/bin/sh\n" + comment(source.remarks) + "exec " + shlex.join(words) + "\n"
    return Written(text.encode(), held_pose(source))


def _launch(source: Source, program: str, arguments: list[str]) -> Written:
    node = ElementTree.Element("node", {
        "pkg": _PACKAGE,
        program: _PROGRAM,
        "name": re.sub(r"\W", "_", f"{source.child}_in_{source.parent}"),
        "args": " ".join(arguments),
    })  # fmt: skip
    xml = ElementTree.tostring(node, encoding="unicode")
    text = f"{xml_comment(source.remarks)}<launch>\n  {xml}\n</launch>\n"
    return Written(text.encode(), held_pose(source))


def _words(content: bytes) -> list[str]:
    return shlex.split(content.decode(), comments=True)[1:]


def _launched(content: bytes, program: str) -> list[str]:
    node = ElementTree.fromstring(content).find("node")
    if node is None or (node.get("pkg"), node.get(program)) != (_PACKAGE, _PROGRAM):
        raise DataError(f"launch file: there is no node of {_PACKAGE} {_PROGRAM}")
    return (node.get("args") or "").split()


def _read_by_place(words: list[str]) -> Held:
    if len(words) != len(_FLAGS) + 2:
        raise DataError(f"transform: expected x y z qx qy qz qw parent child, got {words}")
    return _held([float(word) for word in words[:-2]], words[-2], words[-1])


def _read_by_name(words: list[str]) -> Held:
    given = dict(zip(words[::2], words[1::2], strict=True))
    values = [float(given[f"--{flag}"]) for flag in _FLAGS]
    return _held(values, given["--frame-id"], given["--child-frame-id"])


def _held(values: list[float], parent: str, child: str) -> Held:
    return Held(poses={child: pose_of_numbers(values)}, frames=(parent, child))
