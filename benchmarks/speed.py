"""Our solver against Ceres with automatic differentiation, in alternation, on the paper's cell.

Prints one row for each problem: Ceres's solve time, three times of ours with their ratios to it,
and how far the two answers are apart. README.md beside this file explains the columns.
"""

from __future__ import annotations

import os

# read when numpy is imported
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import ceres_problem
import gtsam
import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import CELL_KEY, make_batch, make_graph
from lasercal_gtsam.holds import resolve_holds
from lasercal_gtsam.report_map import BeamChart, row_values
from lasercal_gtsam.rotations import make_pose, rotation_exp
from lasercal_gtsam.simulate import Noise, simulate
from lasercal_gtsam.solve import Solution, solve
from lasercal_gtsam.uncertainty import Uncertainty, estimate_uncertainty, table_parameters

# number of spots: (hand rotations per plane, poses per rotation) on three planes
SIZES = {90: (3, 10), 900: (10, 30), 9_000: (30, 100), 90_000: (100, 300)}
STAGES = ("core", "checked", "whole")
OPTIONS = lc.CalibrationOptions(sigma_px=1.0, robust="none")
ALLOWANCE = 0.4  # seconds of solving in a round for either side


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


class Case:
    """One capture and start, written for Ceres and ready for us."""

    def __init__(
        self,
        programs: tuple[Path, Path],
        folder: Path,
        spots: int,
        seed: int,
        tolerance: float,
        solver: str,
    ) -> None:
        groups, shots = SIZES[spots]
        made = simulate("paper", seed, Noise(pixel_px=1.0), groups=groups, shots=shots)
        self.observations, self.start = made.observations, start_near(made.truth, seed)
        self.tolerance, self.solver = tolerance, solver
        self.tuned, self.plain = programs
        self.holds = resolve_holds(self.observations, OPTIONS, self.start)
        self.batch = make_batch(self.observations, OPTIONS.sigma_px)
        self.file = folder / f"{spots}-{seed}.bin"
        ceres_problem.write(self.file, self.observations, self.start)

    def ceres(self, program: Path, repeats: int) -> ceres_problem.CeresRun:
        """Solve with Ceres, in its own process."""
        return ceres_problem.run(
            program, self.file, self.observations, self.start,
            solver=self.solver, repeats=repeats, tolerance=self.tolerance,
        )  # fmt: skip

    def core(self) -> tuple[float, Array]:
        """Graph, Levenberg-Marquardt, joint covariance; returns the final cost and the latter."""
        problem = make_graph(self.observations, self.batch, self.holds, self.start)
        params = gtsam.LevenbergMarquardtParams()
        params.setRelativeErrorTol(self.tolerance)
        params.setAbsoluteErrorTol(0.0)
        optimizer = gtsam.LevenbergMarquardtOptimizer(problem.graph, problem.start_values(), params)
        marginals = gtsam.Marginals(problem.graph, optimizer.optimize())
        joint = marginals.marginalCovariance(CELL_KEY)
        return optimizer.error(), joint

    def checked(self) -> tuple[Solution, Uncertainty]:
        """The solver as `calibrate` calls it: from observations, with polish, checks and scale."""
        holds = resolve_holds(self.observations, OPTIONS, self.start)
        batch = make_batch(self.observations, OPTIONS.sigma_px)
        solution = solve(make_graph(self.observations, batch, holds, self.start))
        return solution, estimate_uncertainty(solution)

    def whole(self) -> str:
        """What a user calls, with default options."""
        return lc.calibrate(self.observations, initial=self.start).table()

    def row(self, rounds: int) -> dict[str, str | float]:
        """Times in alternation, and the agreement of the answers."""
        tasks = [self.core, self.checked, self.whole]
        repeats = _repeats(self.ceres(self.tuned, 2).solve_median)
        task_repeats = [_repeats(median_time(task, 2, warm_up=True)) for task in tasks]
        times = np.empty((rounds, 5))
        for r in range(rounds):
            times[r, 0] = self.ceres(self.tuned, repeats).solve_median
            times[r, 1] = self.ceres(self.plain, repeats).solve_median
            times[r, 2:] = [median_time(t, n) for t, n in zip(tasks, task_repeats, strict=True)]
        tuned, plain = (np.median(times[:, [i]] / times[:, 2:], axis=0) for i in (0, 1))
        theirs = self.ceres(self.tuned, 1)
        solution, uncertainty = self.checked()
        milliseconds = zip(("Ceres", "plain", *STAGES), 1e3 * np.median(times, axis=0), strict=True)
        return {
            "spots": len(self.observations),
            **{f"{name} ms": value for name, value in milliseconds},
            **{f"Ceres/{name}": value for name, value in zip(STAGES, tuned, strict=True)},
            **{f"plain/{name}": value for name, value in zip(STAGES, plain, strict=True)},
            "iterations": f"{theirs.iterations}, {solution.iterations}",
            "cost": abs(theirs.final_cost / self.core()[0] - 1),
            "sigmas": _sigmas_apart(theirs.cell, solution, uncertainty),
        }


def median_time(task: Callable[[], object], repeats: int, warm_up: bool = False) -> float:
    """Median seconds of a task."""
    times = []
    for _ in range(repeats + warm_up):
        begin = time.perf_counter()
        task()
        times.append(time.perf_counter() - begin)
    return statistics.median(times[warm_up:])


def _repeats(seconds: float) -> int:
    return max(2, round(ALLOWANCE / seconds))


def _sigmas_apart(cell: lc.Cell, solution: Solution, uncertainty: Uncertainty) -> float:
    """Largest difference of a row of the result table between two answers, in its sigmas."""
    charts = {name: BeamChart.of(beam) for name, beam in solution.cell.lasers.items()}
    rows = table_parameters(solution.cell, solution.cell, uncertainty)
    refined, sigma = np.array([(p.refined, p.sigma) for p in rows]).T
    return float(np.max(np.abs(row_values(cell, charts) - refined) / sigma))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), choices=list(SIZES))
    parser.add_argument("--seeds", type=int, default=5, help="captures of 90 spots; one of others")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--tolerance", type=float, default=1e-10, help="of Ceres and of core")
    parser.add_argument("--solver", default="DENSE_NORMAL_CHOLESKY", help="Ceres's linear solver")
    parser.add_argument("--build", type=Path, default=ceres_problem.SOURCE / "build")
    args = parser.parse_args()
    programs = ceres_problem.build(args.build)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for spots in args.sizes:
            for seed in range(args.seeds if spots == 90 else 1):
                case = Case(programs, Path(folder), spots, seed, args.tolerance, args.solver)
                row = case.row(args.rounds)
                if not rows:
                    print("| " + " | ".join(row) + " |\n|" + " --- |" * len(row))
                rows.append(row)
                print("| " + " | ".join(map(_cell_text, row.values())) + " |", flush=True)
    for spots in args.sizes:
        same = [row for row in rows if row["spots"] == spots]
        ratios = [f"{name} {_median(same, name):.2f}" for name in rows[0] if "/" in name]
        print(f"{spots} spots, medians: {', '.join(ratios)}")


def _median(rows: list[dict[str, str | float]], name: str) -> float:
    return statistics.median(float(row[name]) for row in rows)


def _cell_text(value: str | float) -> str:
    if isinstance(value, str | int):
        return str(value)
    return f"{value:.0e}" if value < 1e-3 else f"{value:.3g}"


if __name__ == "__main__":
    main()
