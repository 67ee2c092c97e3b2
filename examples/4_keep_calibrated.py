"""Keep a cell calibrated: spots arrive one by one, and one day somebody bumps the camera.

The cell is simulated, so that the truth is known. 120 spots calibrate it; each further spot updates
the calibration in well under a millisecond. After 60 of them the camera is turned by half a degree
and pushed by 2 mm.
"""

import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.simulate import Noise, simulate

NOISE_PX, START, BUMP_AT = 0.3, 120, 180

simulation = simulate("paper", seed=4, groups=10, noise=Noise(NOISE_PX))
rng = np.random.default_rng(0)
spots = simulation.observations[rng.permutation(len(simulation.observations))]


def seen_after_the_bump(spot: lc.Observations) -> lc.Observations:
    """The same hand pose, seen by the camera where it is after the bump."""
    camera = simulation.truth.cameras["camera"]
    T = camera.T_base_camera.copy()
    angle = np.deg2rad(0.5)
    c, s = np.cos(angle), np.sin(angle)
    T[:3, :3] = T[:3, :3] @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    T[:3, 3] += [0.0, 0.002, 0.0]
    moved = lc.Camera(camera.intrinsics, T, camera.image_size)
    cell = lc.Cell({"camera": moved}, simulation.truth.lasers, simulation.truth.planes)
    uv = lc.project(cell, spot.T_base_hand, plane=spot.plane.tolist())
    return lc.Observations.from_arrays(
        uv + NOISE_PX * rng.standard_normal(uv.shape),
        spot.T_base_hand,
        plane=spot.plane.tolist(),
        image_size=camera.image_size,
        id=spot.id,
    )


first = lc.calibrate(spots[:START], options=lc.CalibrationOptions(distortion="none"))
print(f"start: {first.fit.status}")

# automatic=True frees what has moved as soon as the cause is beyond doubt; without it you are told
# and decide: calibrator.reset(camera="camera"), or calibrator.dismiss()
calibrator = lc.IncrementalCalibrator(first, automatic=True)
for k in range(START, len(spots)):
    spot = spots[k : k + 1]
    if k >= BUMP_AT:
        spot = seen_after_the_bump(spot)
    update = calibrator.add(spot)
    for event in update.events:
        print(f"spot {event.spots} ({spot.id[0]}): {event.kind}: {event.words}")

print(f"end: {update.words}")
print()
print("after   camera z (mm)   sigma   f_u (px)   sigma")
for row in calibrator.history:
    if row.events or row.spots in (START, BUMP_AT, len(spots)):
        values = {p.name: p for p in row.parameters}
        Tz, fu = values["Tz"], values["fu"]
        print(
            f"{row.spots:5d} {Tz.refined:15.3f} {Tz.sigma:7.3f} {fu.refined:10.2f} {fu.sigma:7.2f}"
        )
