"""Plan a calibration before the cell is built: which sigmas will it have?

Describe the cell as it is drawn, simulate captures with more and more hand orientations, and look
at the sigmas of what matters: here the camera's position in the base and the focal length.
"""

import sys
from pathlib import Path

import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.simulate import MotionDesign, Noise, simulate_cell, write_simulation

OUT = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "output"

# A camera 0.9 m above the table, looking down and 20 deg to the side; metres, camera to base.
tilt = np.deg2rad(20.0)
T_base_camera = np.eye(4)
T_base_camera[:3, :3] = [
    [1.0, 0.0, 0.0],
    [0.0, -np.cos(tilt), np.sin(tilt)],
    [0.0, -np.sin(tilt), -np.cos(tilt)],
]
T_base_camera[:3, 3] = [0.50, -0.30, 0.90]

cell = lc.Cell(
    cameras={
        "camera": lc.Camera(
            lc.Intrinsics(fu=1400.0, fv=1400.0, u0=640.0, v0=512.0), T_base_camera, (1280, 1024)
        )
    },
    # clamped to the hand, tilted a little against the tool's z axis
    lasers={"laser": lc.Beam(direction_hand=[0.25, 0.10, 1.0], point_hand=[0.04, 0.0, 0.02])},
    planes={
        "table": lc.Plane(normal_base=[0.0, 0.0, 1.0], distance=0.05),
        "wedge": lc.Plane.from_point([0.0, -0.5, 0.866], [0.50, 0.05, 0.10]),
    },
)

# how far the hand may be from the surface and how far it moves; the rest as in the paper
motions = MotionDesign(
    beam_length=(0.15, 0.30), longest=0.20, shortest=0.08, depth=(0.6, 1.2), margin_px=30
)

# what the robot and the detection are good for: 1 sigma per coordinate
noise = Noise(pixel_px=0.2, hand_translation_m=0.05e-3, hand_rotation_rad=np.deg2rad(0.005))
options = lc.CalibrationOptions(
    sigma_px=noise.pixel_px,
    hand_sigma_m=noise.hand_translation_m,
    hand_sigma_rad=noise.hand_rotation_rad,
)

print("orientations  spots  sigma of fu (px)  sigma of Tx, Ty, Tz (mm)")
for orientations in (2, 3, 4, 6):
    simulation = simulate_cell(cell, groups=orientations, shots=8, noise=noise, design=motions)
    calibration = lc.calibrate(simulation.observations, options=options)
    tx, ty, tz = (calibration[name].sigma for name in ("Tx", "Ty", "Tz"))
    print(
        f"{orientations:>12}  {len(simulation.observations):>5}  {calibration['fu'].sigma:>16.2f}  "
        f"{tx:.2f}, {ty:.2f}, {tz:.2f}"
    )

# the last one as a capture on disk, to see what the files look like
folder = OUT / "planned-capture"
if not folder.exists():
    write_simulation(folder, simulation, rotation="kuka")
print(f"the poses of the last one: {folder / 'poses.csv'}")
