"""A result into somebody else's system: URDF, ROS, OpenCV, GTSAM, and the report for the people.

Every file is read back by its format's own rules before it is written, and says its frames.
"""

import sys
from pathlib import Path

import gtsam

import lasercal_gtsam as lc

here = Path(__file__).parent
out = Path(sys.argv[1]) if len(sys.argv) > 1 else here / "output"
out.mkdir(parents=True, exist_ok=True)
capture = lc.load_capture(here / "capture")
# OpenCV and ROS have no place for a skew: better not to estimate one than to drop it afterwards
options = capture.options(known={"skew": 0})
calibration = lc.calibrate(capture.observations(), options=options)

for form, name in (
    ("urdf", "cell.urdf"),
    ("ros2-launch", "cell.launch.xml"),
    ("ros-pose", "camera_pose.yaml"),
    ("opencv", "camera.yml"),
    ("json", "cell.json"),
):
    written = lc.export(calibration, form, out / name)
    print(f"{form}: {written.path.name}", *written.notes, sep="\n    ")

# --- the calibration as a prior in a graph of one's own ---
prior = lc.to_gtsam(calibration)
solved = gtsam.LevenbergMarquardtOptimizer(prior.graph, prior.values).optimize()
print(f"GTSAM: {solved.size()} variables, error {prior.graph.error(solved):.3g} at the estimate")

calibration.report(out / "report.html")
print(f"report.html: {(out / 'report.html').stat().st_size / 1e6:.1f} MB, opens without a network")
