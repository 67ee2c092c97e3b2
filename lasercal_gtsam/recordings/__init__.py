"""Recordings as users have them: bags, pose files and folders of pictures become captures.

with open_bag("run.bag") as bag:
motion = bag.hand_motion("base_link", "tool0")
cameras = [bag.pictures("/camera/image_raw")]
plan = plan_capture(motion, cameras, OnePlane("table"))
write_recording("cell", plan, cameras)
"""

from lasercal_gtsam.recordings.bags import open_bag
from lasercal_gtsam.recordings.picture_folder import open_folder
from lasercal_gtsam.recordings.plan import plan_capture
from lasercal_gtsam.recordings.planes import OnePlane, PlaneIntervals, read_plane_intervals
from lasercal_gtsam.recordings.pose_files import read_pose_file
from lasercal_gtsam.recordings.stops import StillLimits
from lasercal_gtsam.recordings.write import write_recording

__all__ = [
    "OnePlane",
    "PlaneIntervals",
    "StillLimits",
    "open_bag",
    "open_folder",
    "plan_capture",
    "read_plane_intervals",
    "read_pose_file",
    "write_recording",
]
