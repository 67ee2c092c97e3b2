"""A graph of your own: measure a new plane in a calibrated cell, with its uncertainty.

The cell was calibrated on planes 1 and 2; then a fixture (plane 3) came, and a few spots were taken
on it. The unknowns are the new plane and, with what is known of them as a joint prior, the camera
and the beam: so the plane's sigma contains the uncertainty of the old calibration too.
"""

from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, K, L, P
from lasercal_factors import BeamFrame, LaserSpotFactor, custom_factor

import lasercal_gtsam as lc

capture = lc.load_capture(Path(__file__).parent / "capture")
observations = capture.observations()
new = observations.plane == "3"
old = lc.calibrate(observations[~new], options=capture.options())
camera, beam = old.cell.cameras["camera"], old.cell.lasers["laser"]

# --- the variables: camera pose, intrinsics, beam (slopes and offsets about a frame), plane ---
frame = BeamFrame.from_line(beam.direction_hand, beam.point_hand)
pose, intrinsics = gtsam.Pose3(camera.T_base_camera), camera.intrinsics.to_gtsam()
values = gtsam.Values()
values.insert(C(0), pose)
values.insert(K(0), intrinsics)
values.insert(L(0), np.zeros(4))  # on the frame itself
# a start for the plane: the best one through the crossings of beam and camera ray (eq. 14)
points = lc.spot_triangulated(old.cell, observations.uv[new], observations.T_base_hand[new])
normal_to_points = np.linalg.svd(points - points.mean(axis=0))[2][-1]
start = lc.Plane.from_point(normal_to_points, points.mean(axis=0))
# GTSAM writes a plane n.x + d = 0, we write n.x = d
values.insert(P(3), gtsam.OrientedPlane3(gtsam.Unit3(start.normal_base), -start.distance))

# --- what the old calibration knows about camera and beam, correlations and all ---
of_interest = [i for i, label in enumerate(old.labels) if not label.startswith("plane")]
joint = old.covariance[np.ix_(of_interest, of_interest)]


def away(values: gtsam.Values) -> np.ndarray:
    return np.concatenate(
        [
            pose.localCoordinates(values.atPose3(C(0))),
            values.atCal3DS2(K(0)).vector() - intrinsics.vector(),
            values.atVector(L(0)),
        ]
    )


def away_with_jacobians(values: gtsam.Values) -> tuple[np.ndarray, list[np.ndarray]]:
    blocks = np.split(np.eye(19), [6, 15], axis=1)  # of small steps from the prior
    return away(values), blocks


graph = gtsam.NonlinearFactorGraph()
graph.add(
    custom_factor(
        "the old calibration",
        gtsam.noiseModel.Gaussian.Covariance(joint),
        (C(0), K(0), L(0)),
        (6, 9, 4),
        away,
        away_with_jacobians,
    )
)
for spot in np.flatnonzero(new):
    graph.add(
        LaserSpotFactor(
            C(0),
            K(0),
            L(0),
            P(3),
            observations.uv[spot],
            observations.T_base_hand[spot],
            frame,
            observations.cov_uv[spot],
        )
    )

result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
plane = result.atOrientedPlane3(P(3))
normal, distance = plane.normal().point3(), -plane.distance()
covariance = gtsam.Marginals(graph, result).marginalCovariance(P(3))
tilt = np.rad2deg(np.sqrt(np.trace(covariance[:2, :2])))
print(f"{new.sum()} spots on the new plane, error {graph.error(result):.2f}")
print(f"normal {normal.round(4).tolist()}, good to {tilt:.3f} deg")
print(f"distance {1000 * distance:.2f} +- {1000 * np.sqrt(covariance[2, 2]):.2f} mm")

# --- for comparison: everything in one calibration ---
whole = lc.calibrate(observations, options=capture.options()).cell.planes["3"]
angle = np.rad2deg(np.arccos(np.clip(normal @ whole.normal_base, -1, 1)))
print(f"from all spots at once: {1000 * whole.distance:.2f} mm, {angle:.3f} deg away")
