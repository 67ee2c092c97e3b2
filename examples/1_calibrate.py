"""Calibrate: from a capture on disk, and from arrays of your own."""

import sys
from pathlib import Path

import lasercal_gtsam as lc

HERE = Path(__file__).parent
OUT = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "output"
OUT.mkdir(parents=True, exist_ok=True)

# --- from a capture: hand poses and pictures ---
capture = lc.load_capture(HERE / "capture")
account = capture.detections()  # one line for each row: the spot, or why there is none
print(f"{len(capture)} pictures: {dict(account.counts)}")
for row_id, why in account.skipped.items():
    print(f"  {row_id} left out, {why}")

observations = capture.observations(account=account)
# what capture.yaml says about the noise, and what is decided here
options = capture.options(known={"skew": 0.0})
calibration = lc.calibrate(observations, options=options)

print(calibration.table())
print(calibration.fit.status)
if not calibration.fit.converged:
    raise SystemExit("the answer cannot be trusted; see the status")
for spot in calibration.spots:
    if spot.rejected:
        print(f"  spot {spot.id} rejected: {spot.rejected}")
for direction in calibration.observability.weak:
    print(f"  hardly determined: {direction.words}")
calibration.save(OUT / "calibration.json")

# --- from arrays: pixels (N, 2), poses (N, 4, 4) in metres, the plane of each spot ---
uv, T_base_hand, plane = observations.uv, observations.T_base_hand, observations.plane
own = lc.Observations.from_arrays(
    uv,
    T_base_hand,
    plane=plane.tolist(),
    image_size=(640, 480),
    cov_uv=observations.cov_uv,  # or sigma_px=0.2; or nothing: then it is estimated
)
again = lc.calibrate(own, options=options, initial=calibration.cell)
print(
    f"from arrays: fu = {again['fu'].refined:.2f} px, from pictures {calibration['fu'].refined:.2f}"
)
