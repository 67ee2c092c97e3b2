"""Where to drive the hand: 40 poses for a cell known from drawings, against the paper's procedure.

Then the cell is calibrated from the planned poses (simulated), and asked for the next best pose.
"""

import sys
from pathlib import Path

import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.io.cell_file import load_cell
from lasercal_gtsam.plan import Limits, next_poses, plan, procedure

here = Path(__file__).parent
out = Path(sys.argv[1]) if len(sys.argv) > 1 else here / "output"
cell = load_cell(here / "drawings.json")  # rough: so the spots keep away from the picture's edge
limits = Limits(margin_px=90.0, reach=(0.1, 1.0), clearance=0.03)

planned = plan(cell, 36, limits=limits)
paper = procedure(cell, 1, limits=limits)
for name in cell.planes:
    print(
        f"plane {name}: {1e3 * planned.after[name]:.2f} mm from {len(planned)} planned poses, "
        f"{1e3 * paper.after[name]:.2f} mm from {len(paper)} of the paper's procedure"
    )
planned.save(out / "plan", rotation="kuka", transform="T_base_hand", length="mm")
print(f"{out / 'plan'} waits for its pictures; drive there, then: lasercal calibrate")

# --- what comes back from the cell (here: simulated, 0.5 px) ---
truth = load_cell(here / "capture" / "truth.json")
rng = np.random.default_rng(0)
seen = planned.observations()
uv = lc.project(truth, seen.T_base_hand, plane=seen.plane.tolist())
inside = np.all((uv > 0) & (uv < np.array(truth.cameras["camera"].image_size)), axis=1)
uv = uv + 0.5 * rng.standard_normal(uv.shape)
taken = lc.Observations.from_arrays(
    uv[inside],
    seen.T_base_hand[inside],
    plane=seen.plane[inside].tolist(),
    image_size=truth.cameras["camera"].image_size,
)
calibration = lc.calibrate(taken)
print(f"{len(taken)} of {len(seen)} spots were in view: {calibration.fit.status}")

more = next_poses(calibration, 3)
for name in more.after:
    print(f"plane {name}: three more would take {1e3 * more.before[name]:.3f} mm", end=" ")
    print(f"to {1e3 * more.after[name]:.3f} mm")
