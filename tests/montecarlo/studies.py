"""Monte Carlo studies of the calibration, to be called by tests or run by hand.

``python tests/montecarlo/studies.py sigmas paper --pixel 1 --seeds 300`` prints, for every row of
the table, how (estimate - truth) / sigma scatters; ``... success table2-1 --seeds 200`` prints how
often the data alone lead to the optimum that a start at the truth finds, and which seeds do not.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.report_map import BeamChart, row_names, row_values
from lasercal_gtsam.simulate import PRESETS, Noise, Simulation, simulate

# a start succeeds if its cost is at most this many times the cost reached from the truth
SUCCESS = 1.001


@dataclass
class Scatter:
    """Scores (estimate - truth) / sigma, one row a seed; what is held has no column."""

    names: tuple[str, ...]
    scores: np.ndarray
    skipped: dict[int, str] = field(default_factory=dict)

    @property
    def std(self) -> np.ndarray:
        return np.asarray(self.scores.std(axis=0, ddof=1))

    @property
    def robust_std(self) -> np.ndarray:
        """Half the width that holds 68.3 % of the scores: what a sigma promises."""
        low, high = np.quantile(self.scores, [0.1587, 0.8413], axis=0)
        return np.asarray(0.5 * (high - low))

    def outside(self, low: float = 0.9, high: float = 1.1) -> dict[str, float]:
        """Rows whose scores scatter too little or too much."""
        std = self.std
        return {
            n: round(float(s), 3)
            for n, s in zip(self.names, std, strict=True)
            if not low < s < high
        }


@dataclass
class Success:
    """How often the data alone lead to the optimum.

    ``missed``: seed -> why; ``silent``: seeds with a worse answer that is called converged;
    ``errors``: relative errors of f_u, R (Frobenius, over sqrt 3) and T, one row a seed solved.
    """

    seeds: int
    reached: int
    missed: dict[int, str]
    silent: list[int]
    better: int
    errors: np.ndarray

    @property
    def rate(self) -> float:
        return self.reached / self.seeds


def sigma_study(
    preset: str,
    noise: Noise,
    seeds: Sequence[int],
    options: lc.CalibrationOptions | None = None,
    started: bool = True,
) -> Scatter:
    """Scatter of the scores of every free row over captures with that noise."""
    rows: list[dict[str, float]] = []
    skipped: dict[int, str] = {}
    for seed in seeds:
        made = simulate(preset, seed, noise)
        try:
            result = lc.calibrate(
                made.observations, initial=made.truth if started else None, options=options
            )
        except lc.LasercalError as error:
            skipped[seed] = str(error)[:100]
            continue
        if not result.fit.converged:
            skipped[seed] = result.fit.status[:100]
            continue
        truth = _rows(made.truth, result.cell)
        rows.append(
            {
                p.name: _difference(p.refined, truth[p.name], p.unit) / p.sigma
                for p in result.parameters
                if p.sigma > 0
            }
        )
    names = tuple(name for name in rows[0] if all(name in row for row in rows))
    scores = np.array([[row[name] for name in names] for row in rows])
    return Scatter(names, scores, skipped)


def success_study(
    preset: str,
    noise: Noise,
    seeds: Sequence[int],
    options: lc.CalibrationOptions | None = None,
    known: bool = True,
) -> Success:
    """Compare calibrations without a start to ones that start at the truth.

    ``known``: with one plane, hold what cannot be found at its true value (principal point, skew).
    """
    options = options or lc.CalibrationOptions(robust="none")
    missed: dict[int, str] = {}
    silent: list[int] = []
    errors: list[tuple[float, float, float]] = []
    reached = better = 0
    for seed in seeds:
        made = simulate(preset, seed, noise)
        chosen = _with_known(options, made) if known else options
        from_truth = lc.calibrate(made.observations, initial=made.truth, options=chosen)
        try:
            result = lc.calibrate(made.observations, options=chosen)
        except lc.LasercalError as error:
            missed[seed] = f"{type(error).__name__}: {str(error)[:90]}"
            continue
        errors.append(_errors(result.cell, made.truth))
        ratio = (result.fit.rms_px / from_truth.fit.rms_px) ** 2
        if result.fit.converged and ratio <= SUCCESS:
            reached += 1
            better += ratio < 1 / SUCCESS
            continue
        missed[seed] = f"cost x {ratio:.4f}: {result.fit.status[:90]}"
        if not from_truth.fit.converged:
            missed[seed] += f" (from the truth: {from_truth.fit.status[:60]})"
        if result.fit.converged:
            silent.append(seed)
    return Success(len(seeds), reached, missed, silent, better, np.array(errors))


def _with_known(options: lc.CalibrationOptions, made: Simulation) -> lc.CalibrationOptions:
    from dataclasses import replace

    return replace(options, known={**made.known, **options.known})


def _rows(cell: lc.Cell, like: lc.Cell) -> dict[str, float]:
    charts = {name: BeamChart.of(beam) for name, beam in like.lasers.items()}
    names = [name for name, _ in row_names(cell, charts)]
    return dict(zip(names, row_values(cell, charts).tolist(), strict=True))


def _difference(a: float, b: float, unit: str) -> float:
    return (a - b + 180.0) % 360.0 - 180.0 if unit == "deg" else a - b


def _errors(found: lc.Cell, truth: lc.Cell) -> tuple[float, float, float]:
    a, b = found.cameras["camera"], truth.cameras["camera"]
    A, B = a.T_base_camera, b.T_base_camera
    return (
        abs(a.intrinsics.fu / b.intrinsics.fu - 1.0),
        float(np.linalg.norm(A[:3, :3] - B[:3, :3]) / np.sqrt(3.0)),
        float(np.linalg.norm(A[:3, 3] - B[:3, 3]) / np.linalg.norm(B[:3, 3])),
    )


def print_scatter(found: Scatter) -> None:
    """One line for every row of the table."""
    print(f"{len(found.scores)} captures, {len(found.skipped)} without an answer {found.skipped}")
    print(f"{'row':12} {'mean':>7} {'std':>7} {'68 %':>7}")
    numbers = zip(found.names, found.scores.mean(axis=0), found.std, found.robust_std, strict=True)
    for name, mean, std, robust in numbers:
        mark = "" if 0.9 < std < 1.1 else "  <--"
        print(f"{name:12} {mean:7.3f} {std:7.3f} {robust:7.3f}{mark}")
    print(f"std {found.std.min():.3f} to {found.std.max():.3f}, mean {found.std.mean():.3f}")


def print_success(found: Success) -> None:
    """Rate, mean errors and the seeds that were missed."""
    f, R, T = 100 * found.errors.mean(axis=0)
    print(
        f"reached {found.reached} of {found.seeds} ({100 * found.rate:.1f} %), {found.better} of "
        f"them below the cost from the truth, worse and silent {found.silent}; mean errors "
        f"f_u {f:.2f} %, R {R:.2f} %, T {T:.2f} %"
    )
    for seed, why in found.missed.items():
        print(f"  seed {seed}: {why}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=["sigmas", "success"])
    parser.add_argument("preset", choices=list(PRESETS))
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--pixel", type=float, help="px; default: the preset's own noise")
    parser.add_argument("--table1", type=float, help="level of the paper's Table 1 noise")
    parser.add_argument("--distortion", default="all", help="all, none or names with commas")
    parser.add_argument("--robust", default="none", choices=["auto", "none"])
    parser.add_argument("--no-start", action="store_true", help="sigmas: from the data alone")
    given = parser.parse_args()
    noise = PRESETS[given.preset].noise
    if given.table1 is not None:
        noise = Noise.table1(given.table1)
    if given.pixel is not None:
        noise = Noise(pixel_px=given.pixel)
    terms = given.distortion
    distortion = terms if terms in ("all", "none") else tuple(terms.split(","))
    options = lc.CalibrationOptions(robust=given.robust, distortion=distortion)
    seeds = range(given.first, given.first + given.seeds)
    print(given.preset, noise, f"distortion {terms}")
    if given.study == "sigmas":
        print_scatter(sigma_study(given.preset, noise, seeds, options, not given.no_start))
    else:
        print_success(success_study(given.preset, noise, seeds, options))


if __name__ == "__main__":
    main()
