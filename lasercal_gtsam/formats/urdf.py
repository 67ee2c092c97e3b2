"""URDF: the camera as a fixed joint.

``origin`` has ``xyz`` in metres and ``rpy`` in radians, rotations about the fixed axes x, y, z in
this order: ``R = Rz(y) Ry(p) Rx(r)`` (ROS wiki, urdf/XML/joint). At a pitch of 90 deg only the sum
or difference of roll and yaw matters; the angles are chosen so that their product is exact there.
"""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.held import Held, Written
from lasercal_gtsam.formats.ros_transform import held_pose
from lasercal_gtsam.formats.source import Source
from lasercal_gtsam.formats.text import numbers, xml_comment
from lasercal_gtsam.io.conventions import columns_from_rotations
from lasercal_gtsam.rotations import make_pose

_XACRO = "http://www.ros.org/wiki/xacro"


def write_urdf(source: Source) -> Written:
    """A robot of two links and the joint between them."""
    links = "".join(f"  <link name={_attribute(n)}/>\n" for n in (source.parent, source.child))
    name = re.sub(r"\W", "_", f"{source.child}_in_{source.parent}")
    return _written(source, f"<robot name={_attribute(name)}>\n{links}{_joint(source)}</robot>\n")


def write_xacro(source: Source) -> Written:
    """The camera's link and joint; the robot that includes them has the parent link."""
    link = f"  <link name={_attribute(source.child)}/>\n"
    return _written(source, f'<robot xmlns:xacro="{_XACRO}">\n{link}{_joint(source)}</robot>\n')


def read_urdf(content: bytes) -> Held:
    """Read the only joint."""
    from scipy.spatial.transform import Rotation

    robot = ElementTree.fromstring(content)
    joint = robot.find("joint")
    parts = {} if joint is None else {part.tag: part for part in joint}
    if (
        joint is None
        or joint.get("type") != "fixed"
        or not {"origin", "parent", "child"} <= {*parts}
    ):
        raise DataError("URDF: there is no fixed joint with origin, parent and child")
    xyz, rpy = (
        [float(word) for word in (parts["origin"].get(name) or "").split()]
        for name in ("xyz", "rpy")
    )
    parent, child = (parts[tag].get("link") or "" for tag in ("parent", "child"))
    T = make_pose(Rotation.from_euler("xyz", rpy).as_matrix(), np.array(xyz))
    return Held(poses={child: T}, frames=(parent, child))


read_xacro = read_urdf


def _joint(source: Source) -> str:
    T = source.only_camera.T_base_camera
    rpy = columns_from_rotations("euler:xyz:rad", T[None, :3, :3])[0]
    name = re.sub(r"\W", "_", f"{source.parent}_to_{source.child}")
    return (
        f'  <joint name={_attribute(name)} type="fixed">\n'
        f'    <origin xyz="{numbers(T[:3, 3], " ")}" rpy="{numbers(rpy, " ")}"/>\n'
        f"    <parent link={_attribute(source.parent)}/>\n"
        f"    <child link={_attribute(source.child)}/>\n"
        "  </joint>\n"
    )


def _written(source: Source, body: str) -> Written:
    text = f'<?xml version="1.0"?>\n{xml_comment(source.remarks)}{body}'
    return Written(text.encode(), held_pose(source))


def _attribute(text: str) -> str:
    from xml.sax.saxutils import quoteattr

    return quoteattr(text)
