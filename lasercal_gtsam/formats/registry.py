"""Which formats there are and what each holds; importing this costs nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, cast

from lasercal_gtsam.errors import DataError
from lasercal_gtsam.io.wording import did_you_mean

if TYPE_CHECKING:
    from lasercal_gtsam.formats.held import Held, Written
    from lasercal_gtsam.formats.source import Source


@dataclass(frozen=True)
class Format:
    """One kind of file.

    Attributes
    ----------
    name : as on the command line
    summary : what it is, for the list of formats
    holds : what it says of the calibration, and in which form the covariance
    ending : of the file's name
    of : one camera, or the whole cell
    module, stem : where its functions are: ``<module>.write_<stem>`` and ``<module>.read_<stem>``
    has_pose, has_intrinsics, has_skew, has_covariance : whether it has a place for them
    """

    name: str
    summary: str
    holds: str
    ending: str
    of: Literal["camera", "cell"]
    module: str
    stem: str
    has_pose: bool = False
    has_intrinsics: bool = False
    has_skew: bool = False
    has_covariance: bool = False

    @property
    def write(self) -> Callable[[Source], Written]:
        """Make the file's content, and say what it must hold."""
        return cast("Callable[[Source], Written]", self._function("write"))

    @property
    def read(self) -> Callable[[bytes], Held]:
        """Read a content by the format's own definition."""
        return cast("Callable[[bytes], Held]", self._function("read"))

    def _function(self, verb: str) -> object:
        module = import_module(f"lasercal_gtsam.formats.{self.module}")
        return getattr(module, f"{verb}_{self.stem}")


_TRANSFORM = "pose of the camera in the base; no place for a covariance"
_LENS_ONLY = "intrinsics; no place for a skew or a covariance (sigmas in comments)"

FORMATS: Mapping[str, Format] = MappingProxyType(
    {
        form.name: form
        for form in (
            Format(
                "ros-camera-info", "ROS camera_info YAML, plumb_bob (ROS 1 and 2)", _LENS_ONLY,
                ".yaml", "camera", "ros_camera_info", "camera_info", has_intrinsics=True,
            ),
            Format(
                "ros-pose", "geometry_msgs/PoseWithCovarianceStamped as YAML (ROS 1 and 2)",
                "pose with covariance (x y z, then rotations about the axes of the parent frame)",
                ".yaml", "camera", "ros_pose", "pose", has_pose=True, has_covariance=True,
            ),
            Format(
                "ros1-tf", "ROS 1 static transform, command", _TRANSFORM,
                ".sh", "camera", "ros_transform", "ros1_command", has_pose=True,
            ),
            Format(
                "ros1-launch", "ROS 1 static transform, launch file", _TRANSFORM,
                ".launch", "camera", "ros_transform", "ros1_launch", has_pose=True,
            ),
            Format(
                "ros2-tf", "ROS 2 static transform, command (Humble or newer)", _TRANSFORM,
                ".sh", "camera", "ros_transform", "ros2_command", has_pose=True,
            ),
            Format(
                "ros2-launch", "ROS 2 static transform, XML launch file (Humble or newer)",
                _TRANSFORM,
                ".launch.xml", "camera", "ros_transform", "ros2_launch", has_pose=True,
            ),
            Format(
                "urdf", "URDF with the camera as a fixed joint, whole file", _TRANSFORM,
                ".urdf", "camera", "urdf", "urdf", has_pose=True,
            ),
            Format(
                "xacro", "the same joint, to be included by a robot that has the parent link",
                _TRANSFORM,
                ".xacro", "camera", "urdf", "xacro", has_pose=True,
            ),
            Format(
                "kalibr", "Kalibr camchain, pinhole-radtan",
                "intrinsics, and each camera in the one before it; no place for a skew, for the "
                "base or for a covariance (sigmas in comments)",
                ".yaml", "cell", "kalibr", "camchain", has_intrinsics=True,
            ),
            Format(
                "opencv", "OpenCV FileStorage YAML",
                "intrinsics (no skew), pose and their joint covariance",
                ".yaml", "camera", "opencv_storage", "storage",
                has_pose=True, has_intrinsics=True, has_covariance=True,
            ),
            Format(
                "mrcal", "mrcal .cameramodel, LENSMODEL_OPENCV4",
                "intrinsics and pose; no place for a skew or a covariance (sigmas in comments)",
                ".cameramodel", "camera", "mrcal_model", "model",
                has_pose=True, has_intrinsics=True,
            ),
            Format(
                "json", "plain JSON", "everything, with the joint covariance",
                ".json", "cell", "plain_data", "json", has_pose=True,
                has_intrinsics=True, has_skew=True, has_covariance=True,
            ),
            Format(
                "npz", "NumPy arrays", "everything, with the joint covariance",
                ".npz", "cell", "plain_data", "npz", has_pose=True,
                has_intrinsics=True, has_skew=True, has_covariance=True,
            ),
            Format(
                "gtsam", "values and a joint prior for a GTSAM graph (lc.load_gtsam reads it)",
                "everything, with the joint covariance in GTSAM's order and charts",
                ".gtsam.npz", "cell", "gtsam_graph", "gtsam", has_pose=True,
                has_intrinsics=True, has_skew=True, has_covariance=True,
            ),
        )
    }
)  # fmt: skip


def format_named(name: str) -> Format:
    """Look up a format; `DataError` lists them where there is none of that name."""
    if name in FORMATS:
        return FORMATS[name]
    raise DataError(
        f"format: {name!r} is not one of the formats{did_you_mean(name, FORMATS)}; there are "
        f"{', '.join(FORMATS)}"
    )
