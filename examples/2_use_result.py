"""Use a calibration: pixel to base, base to pixel (OpenCV, GTSAM), and where the beam will hit.

Needs the ``calibration.json`` that 1_calibrate.py saves.
"""

import sys
from pathlib import Path

import cv2
import gtsam
import numpy as np

import lasercal_gtsam as lc

HERE = Path(__file__).parent
OUT = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "output"

calibration = lc.load_calibration(OUT / "calibration.json")
cell = calibration.cell
camera = cell.cameras["camera"]

# --- a pixel that somebody clicked, in the base: where its ray meets the working plane ---
clicked = np.array([[350.0, 200.0]])
point_base = lc.spot_on_ray(cell, clicked, plane="1")
x, y, z = 1000 * point_base[0]
print(f"pixel {clicked[0].tolist()} on plane 1 is at {x:.2f}, {y:.2f}, {z:.2f} mm in the base")

# --- and back to the pixel, by OpenCV ---
T_camera_base = np.linalg.inv(camera.T_base_camera)
rotation_vector, _ = cv2.Rodrigues(T_camera_base[:3, :3])
K, distortion = camera.intrinsics.K, camera.intrinsics.dist_coeffs
if abs(camera.intrinsics.skew) > 1e-9:
    raise SystemExit("OpenCV has no skew: calibrate with known={'skew': 0}")
by_opencv, _ = cv2.projectPoints(point_base, rotation_vector, T_camera_base[:3, 3], K, distortion)
print(f"back by OpenCV: {by_opencv.ravel().round(6).tolist()}")

# --- and by GTSAM ---
pinhole = gtsam.PinholeCameraCal3DS2(
    gtsam.Pose3(camera.T_base_camera), camera.intrinsics.to_gtsam()
)
print(f"back by GTSAM:  {pinhole.project(point_base[0]).round(6).tolist()}")

# --- where will the beam hit, and where will the camera see it? ---
T_base_hand = calibration.inputs.observations.T_base_hand[0]
spot_base = lc.spot_on_beam(cell, T_base_hand, plane="1")
seen = lc.project(cell, T_base_hand, plane="1")
print(f"with the hand at its first pose the spot is seen at {seen[0].round(2).tolist()}")

# --- put the spot on the clicked pixel: without turning the hand, the spot moves with it ---
T_goal = T_base_hand.copy()
T_goal[:3, 3] += (point_base - spot_base)[0]
move = 1000 * (point_base - spot_base)[0]
print(f"move the hand by {move.round(2).tolist()} mm (base axes, no rotation)")
reached = lc.project(cell, T_goal, plane="1")
print(f"then it is seen at {reached[0].round(6).tolist()}")
