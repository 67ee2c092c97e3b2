"""Our solver against Ceres with automatic differentiation, in alternation, on the paper's cell.

Prints one row for each problem size: Ceres's solve time, ours (graph, optimisation and joint
covariance), their ratio, and how far the two answers are apart. See README.md beside this file.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import ceres_problem
import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.graph import make_batch, make_graph
from lasercal_gtsam.holds import resolve_holds
from lasercal_gtsam.report_map import BeamChart, row_values
from lasercal_gtsam.rotations import make_pose, rotation_exp
from lasercal_gtsam.simulate import Noise, simulate
from lasercal_gtsam.solve import Solution, solve
from lasercal_gtsam.uncertainty import Uncertainty, estimate_uncertainty, table_parameters

# number of spots: (hand rotations per plane, poses per rotation) on three planes
SIZES = {90: (3, 10), 900: (10, 30), 9_000: (30, 100), 90_000: (100, 300)}
SOLVERS = ("DENSE_NORMAL_CHOLESKY", "DENSE_QR", "DENSE_SCHUR", "SPARSE_NORMAL_CHOLESKY")
OPTIONS = lc.CalibrationOptions(sigma_px=1.0, robust="none")
ALLOWANCE = 0.4  # seconds of solving in a round for either side


@dataclass(frozen=True)
class Row:
    """Medians over the rounds; seconds."""

    spots: int
    seed: int
    solver: str
    ceres: float
    ours: float
    ratio: float
    ratio_range: tuple[float, float]
    iterations: tuple[int, int]
    cost_difference: float
    sigmas_apart: float


def start_near(truth: lc.Cell, seed: int) -> lc.Cell:
    """A cell a few percent off: focal length 3 %, 2 deg, 10 mm, beam and planes 1.5 deg, 3 mm."""
    rng = np.random.default_rng(seed)
    cameras, lasers, planes = {}, {}, {}
    for name, camera in truth.cameras.items():
        intrinsics = camera.intrinsics.vector
        intrinsics[:2] *= 1 + 0.03 * rng.uniform(-1, 1, 2)
        intrinsics[3:5] += rng.uniform(-8, 8, 2)
        T = camera.T_base_camera
        R = T[:3, :3] @ rotation_exp(rng.normal(0, 0.02, 3))
        pose = make_pose(R, T[:3, 3] + rng.normal(0, 0.006, 3))
        cameras[name] = lc.Camera(lc.Intrinsics.from_vector(intrinsics), pose, camera.image_size)
    for name, beam in truth.lasers.items():
        lasers[name] = lc.Beam(
            beam.direction_hand + rng.normal(0, 0.02, 3), beam.point_hand + rng.normal(0, 0.002, 3)
        )
    for name, plane in truth.planes.items():
        normal = plane.normal_base + rng.normal(0, 0.02, 3)
        planes[name] = lc.Plane(normal, plane.distance + rng.normal(0, 0.003))
    return lc.Cell(cameras, lasers, planes)


def solve_ours(observations: lc.Observations, start: lc.Cell) -> tuple[Solution, Uncertainty]:
    """What is timed: whitening, graph, optimisation with its checks, joint covariance."""
    holds = resolve_holds(observations, OPTIONS, start)
    batch = make_batch(observations, OPTIONS.sigma_px)
    solution = solve(make_graph(observations, batch, holds, start))
    return solution, estimate_uncertainty(solution)


def median_time(task: Callable[[], object], repeats: int) -> float:
    """Median seconds of a task."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        task()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


class Case:
    """One capture and start, written for Ceres and ready for us."""

    def __init__(self, binary: Path, folder: Path, spots: int, seed: int, tolerance: float) -> None:
        groups, shots = SIZES[spots]
        made = simulate("paper", seed, Noise(pixel_px=1.0), groups=groups, shots=shots)
        self.spots, self.seed, self.tolerance, self.binary = spots, seed, tolerance, binary
        self.observations, self.start = made.observations, start_near(made.truth, seed)
        self.file = folder / f"{spots}-{seed}.bin"
        ceres_problem.write(self.file, self.observations, self.start)
        trials = max(3, 9_000 // spots)
        self.solver = min(SOLVERS, key=lambda name: self.run_ceres(trials, name).solve_min)

    def run_ceres(self, repeats: int, solver: str | None = None) -> ceres_problem.CeresRun:
        """Solve with Ceres, in its own process."""
        return ceres_problem.run(
            self.binary, self.file, self.observations, self.start,
            solver=solver or self.solver, repeats=repeats, tolerance=self.tolerance,
        )  # fmt: skip

    def compare(self, rounds: int, task: Callable[[], object]) -> tuple[list[float], list[float]]:
        """Median seconds of Ceres's solve and of ``task`` in each round, taken in turns."""
        task()
        repeats_ceres = _repeats(self.run_ceres(2).solve_median)
        repeats_ours = _repeats(median_time(task, 2))
        ceres, ours = [], []
        for _ in range(rounds):
            ceres.append(self.run_ceres(repeats_ceres).solve_median)
            ours.append(median_time(task, repeats_ours))
        return ceres, ours

    def row(self, rounds: int, task: Callable[[], object]) -> Row:
        """Compare times and answers."""
        ceres, ours = self.compare(rounds, task)
        ratios = [a / b for a, b in zip(ceres, ours, strict=True)]
        theirs = self.run_ceres(1)
        solution, uncertainty = solve_ours(self.observations, self.start)
        return Row(
            spots=self.spots,
            seed=self.seed,
            solver=self.solver,
            ceres=statistics.median(ceres),
            ours=statistics.median(ours),
            ratio=statistics.median(ratios),
            ratio_range=(min(ratios), max(ratios)),
            iterations=(theirs.iterations, solution.iterations),
            cost_difference=abs(2 * theirs.final_cost / solution.cost - 1),
            sigmas_apart=_sigmas_apart(theirs.cell, solution, uncertainty),
        )


def _repeats(seconds: float) -> int:
    return max(2, round(ALLOWANCE / seconds))


def _sigmas_apart(cell: lc.Cell, solution: Solution, uncertainty: Uncertainty) -> float:
    """Largest difference of a row of the result table between two answers, in its sigmas."""
    charts = {name: BeamChart.of(beam) for name, beam in solution.cell.lasers.items()}
    rows = table_parameters(solution.cell, solution.cell, uncertainty, solution.problem)
    refined, sigma = np.array([(p.refined, p.sigma) for p in rows]).T
    return float(np.max(np.abs(row_values(cell, charts) - refined) / sigma))


def print_rows(title: str, rows: list[Row]) -> None:
    """Print a Markdown table, and the median ratio of each size."""
    print(f"\n{title}\n")
    print("| spots | seed | Ceres ms | ours ms | ratio (range) | iterations | cost | sigmas | by |")
    print("|" + " --- |" * 9)
    for r in rows:
        low, high = r.ratio_range
        print(
            f"| {r.spots} | {r.seed} | {1e3 * r.ceres:.3g} | {1e3 * r.ours:.3g} "
            f"| {r.ratio:.2f} ({low:.2f}-{high:.2f}) | {r.iterations[0]}, {r.iterations[1]} "
            f"| {r.cost_difference:.0e} | {r.sigmas_apart:.0e} | {r.solver} |"
        )
    for spots in sorted({r.spots for r in rows}):
        ratios = [r.ratio for r in rows if r.spots == spots]
        print(f"\n{spots} spots: Ceres / ours = {statistics.median(ratios):.2f} (median)", end="")
    print()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), choices=list(SIZES))
    parser.add_argument("--seeds", type=int, default=5, help="captures of 90 spots; one of others")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--tolerance", type=float, default=1e-10, help="all three of Ceres's")
    parser.add_argument("--build", type=Path, default=ceres_problem.SOURCE / "build")
    args = parser.parse_args()
    binary = ceres_problem.build(args.build)
    graph_rows, whole_rows = [], []
    with tempfile.TemporaryDirectory() as folder:
        for spots in args.sizes:
            for seed in range(args.seeds if spots == 90 else 1):
                case = Case(binary, Path(folder), spots, seed, args.tolerance)
                data, start = case.observations, case.start
                graph_rows.append(case.row(args.rounds, lambda d=data, s=start: solve_ours(d, s)))
                if spots == 90:
                    whole_rows.append(
                        case.row(
                            args.rounds, lambda d=data, s=start: lc.calibrate(d, initial=s).table()
                        )
                    )
    print_rows("Graph, optimisation and joint covariance against Ceres's solve", graph_rows)
    if whole_rows:
        print_rows("Whole calibrate() with its table against Ceres's solve", whole_rows)


if __name__ == "__main__":
    main()
