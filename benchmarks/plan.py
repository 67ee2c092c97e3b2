"""What planned poses gain over the paper's procedure: 40 of each, in random cells.

``python benchmarks/plan.py --cells 50`` prints, for each cell, the error of `locate` on each plane
(root mean square over what the camera sees of it, mm at 1 px) as both promise it, and the ratio.
``--simulate K`` also calibrates K simulated captures of each from their data alone, and prints the
errors that really came out.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.plan import Limits, Plan, plan, procedure
from lasercal_gtsam.plan.design import Problem

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "app"))
from test_plan import random_cell


def in_view(made: Plan) -> bool:
    """Whether every spot is in the picture."""
    width, height = made.cell.cameras[made.camera].image_size
    return bool(np.all((made.uv >= 0) & (made.uv <= (width - 1, height - 1))))


def simulated(made: Plan, runs: int, seed: int) -> tuple[dict[str, float], int]:
    """Root mean square errors of `locate` that came out, mm, and captures without an answer."""
    cell = made.cell
    problem = Problem.of(cell, made.camera, made.laser, np.eye(25), Limits())
    camera = cell.cameras[made.camera]
    K, T = camera.intrinsics.K, camera.T_base_camera
    squares: dict[str, list[float]] = {name: [] for name in cell.planes}
    failed = 0
    for run in range(runs):
        rng = np.random.default_rng([seed, run])
        seen = made.observations()
        noisy = replace(seen, uv=seen.uv + rng.standard_normal(seen.uv.shape))
        try:
            found = lc.calibrate(noisy)
        except lc.LasercalError:
            failed += 1
            continue
        for name, points in problem.places.items():
            image = ((points - T[:3, 3]) @ T[:3, :3]) @ K.T
            located, _ = found.locate(image[:, :2] / image[:, 2:], plane=name)
            squares[name].append(float(np.nanmean(np.sum((located - points) ** 2, axis=1))))
    rms = {n: 1e3 * float(np.sqrt(np.mean(v))) if v else np.nan for n, v in squares.items()}
    return rms, failed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=50)
    parser.add_argument("--simulate", type=int, default=0, metavar="K")
    args = parser.parse_args()
    ratios = []
    for seed in range(args.cells):
        cell = random_cell(seed)
        ours, papers = plan(cell, 40, seed=seed), procedure(cell, 2, seed=seed)
        assert in_view(ours)
        assert in_view(papers)
        ratio = [ours.after[n] / papers.after[n] for n in cell.planes]
        ratios.append(np.mean(ratio))
        text = ", ".join(
            f"plane {n}: {1e3 * ours.after[n]:.2f} / {1e3 * papers.after[n]:.2f} mm"
            for n in cell.planes
        )
        print(f"{seed:3d}  {text}  ratio {ratios[-1]:.3f}", flush=True)
        if args.simulate:
            for name, made in (("planned", ours), ("procedure", papers)):
                rms, failed = simulated(made, args.simulate, seed)
                came = ", ".join(f"plane {n}: {v:.2f} mm" for n, v in rms.items())
                print(f"     {name} came out as {came}; {failed} without an answer", flush=True)
    print(
        f"ratio (mean over planes) of {args.cells} cells: mean {np.mean(ratios):.3f}, "
        f"largest {np.max(ratios):.3f}"
    )


if __name__ == "__main__":
    main()
