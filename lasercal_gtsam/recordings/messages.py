"""What is taken out of ROS messages; they are objects with the fields of their definition."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lasercal_gtsam.io.pictures import Picture
from lasercal_gtsam.recordings.encodings import picture_from_compressed, picture_from_raw


@dataclass(frozen=True)
class CameraInfo:
    """What a ``camera_info`` topic says of a camera: shown to the user, never used unasked."""

    topic: str
    width: int
    height: int
    distortion_model: str
    K: tuple[float, ...]
    D: tuple[float, ...]


def pose_numbers(message: Any) -> tuple[float, ...]:
    """x, y, z, qx, qy, qz, qw of a pose or transform message."""
    if hasattr(message, "transform"):
        v, q = message.transform.translation, message.transform.rotation
    else:
        pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
        v, q = pose.position, pose.orientation
    return v.x, v.y, v.z, q.x, q.y, q.z, q.w


def picture_of(message: Any) -> Picture:
    """The picture of an Image or CompressedImage message; `DataError` where it holds none."""
    if hasattr(message, "format"):
        return picture_from_compressed(message.data, str(message.format))
    return picture_from_raw(
        message.data,
        height=int(message.height),
        width=int(message.width),
        step=int(message.step),
        encoding=str(message.encoding),
        big_endian=bool(message.is_bigendian),
    )


def camera_info_of(topic: str, message: Any) -> CameraInfo:
    """What a CameraInfo message says; ROS 1 spells its fields K and D, ROS 2 k and d."""
    K, D = (getattr(message, name.lower(), getattr(message, name, ())) for name in "KD")
    return CameraInfo(
        topic=topic,
        width=int(message.width),
        height=int(message.height),
        distortion_model=str(message.distortion_model),
        K=tuple(map(float, K)),
        D=tuple(map(float, D)),
    )
