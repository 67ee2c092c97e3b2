"""Does the start from the data alone lead to the optimum that a start at the truth finds?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

import lasercal_gtsam as lc
from lasercal_gtsam.holds import ONE_PLANE_PRIORS
from lasercal_gtsam.simulate import PRESETS, Noise, Simulation, simulate

LIMIT = 1.001


@dataclass
class Tally:
    """What became of the seeds; ``errors``: relative errors of fu, R and T, one row a seed."""

    reached: int
    refused: list[int]
    missed: list[int]
    errors: np.ndarray


def cost(result: lc.Calibration, scale: float) -> float:
    """Squared residuals and, with one plane, the squared deviations from the weak priors (px^2)."""
    used = result.spots.weight > 0
    total = float((result.spots.residual_px[used] ** 2).sum())
    if len(result.cell.planes) == 1:
        for name, (mean, sigma) in ONE_PLANE_PRIORS.items():
            fu, fv = result["fu"].refined, result["fv"].refined
            value = fu / fv if name == "aspect" else result[name].refined
            total += (scale * (value - mean) / sigma) ** 2
    return total


def errors(result: lc.Calibration, made: Simulation) -> tuple[float, float, float]:
    """Relative errors of fu, R (Frobenius norm; that of R itself is sqrt 3) and T."""
    found, truth = result.cell.cameras["camera"], made.truth.cameras["camera"]
    A, B = found.T_base_camera, truth.T_base_camera
    return (
        abs(found.intrinsics.fu / truth.intrinsics.fu - 1),
        float(np.linalg.norm(A[:3, :3] - B[:3, :3]) / np.sqrt(3)),
        float(np.linalg.norm(A[:3, 3] - B[:3, 3]) / np.linalg.norm(B[:3, 3])),
    )


def run(preset: str, noise: Noise, seeds: int, distortion: str = "all") -> Tally:
    options = lc.CalibrationOptions(distortion=distortion)
    tally = Tally(0, [], [], np.full((seeds, 3), np.nan))
    for seed in range(seeds):
        made = simulate(preset, seed, noise)
        best = lc.calibrate(made.observations, initial=made.truth, options=options)
        try:
            result = lc.calibrate(made.observations, options=options)
        except lc.DegenerateError:
            tally.refused.append(seed)
            continue
        scale = best.fit.sigma0
        same = result.spots.rejected == best.spots.rejected
        if result.fit.converged and same and cost(result, scale) <= LIMIT * cost(best, scale):
            tally.reached += 1
        else:
            tally.missed.append(seed)
        tally.errors[seed] = errors(result, made)
    mean = 100 * np.nanmean(tally.errors, axis=0)
    print(
        f"{preset}, {distortion}: reached {tally.reached} of {seeds}, refused {tally.refused}, "
        f"missed {tally.missed}; mean errors fu {mean[0]:.2f} %, R {mean[1]:.2f} %, "
        f"T {mean[2]:.2f} %"
    )
    return tally


@pytest.mark.slow
def test_the_papers_cell_at_its_largest_noise():
    tally = run("paper", Noise.table1(1.0), 100, distortion="none")
    assert tally.reached >= 99
    fu, R, T = np.nanmean(tally.errors, axis=0)
    assert fu < 0.016
    assert R < 0.023
    assert T < 0.009


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "seeds", "share"),
    [
        ("paper-distorted", 60, 0.99),
        ("table2-4", 50, 0.98),
        ("table2-3", 50, 0.98),
        ("table2-2", 50, 0.95),
        ("table2-1", 50, 0.95),
    ],
)
def test_distorted_cells(preset, seeds, share):
    tally = run(preset, PRESETS[preset].noise, seeds)
    assert tally.reached >= share * seeds
