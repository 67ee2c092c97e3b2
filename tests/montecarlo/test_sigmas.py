"""Are the sigmas honest? Scatter of (estimate - truth) / sigma over many captures of one design."""

from __future__ import annotations

import numpy as np
import pytest

import lasercal_gtsam as lc
from lasercal_gtsam.simulate import Noise, simulate

SEEDS = 300


def scores(preset: str, pixel_px: float, distortion: str) -> dict[str, np.ndarray]:
    """(estimate - truth) / sigma of every free row over the seeds; started at the truth."""
    options = lc.CalibrationOptions(distortion=distortion)
    found: dict[str, list[float]] = {}
    for seed in range(SEEDS):
        made = simulate(preset, seed, Noise(pixel_px=pixel_px))
        result = lc.calibrate(made.observations, initial=made.truth, options=options)
        assert result.fit.converged, (seed, result.fit.status)
        for p in result.parameters:  # the start is the truth
            if p.sigma > 0:
                found.setdefault(p.name, []).append((p.refined - p.initial) / p.sigma)
    return {name: np.array(values) for name, values in found.items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pixel_px", "distortion", "rows", "low", "high"),
    [(1.0, "none", 24, 0.90, 1.10), (0.2, "all", 28, 0.88, 1.12)],
)
def test_errors_scatter_as_the_sigmas_say(pixel_px, distortion, rows, low, high):
    z = scores("paper", pixel_px, distortion)
    assert len(z) == rows
    assert all(len(values) == SEEDS for values in z.values())
    scatter = {name: float(values.std(ddof=1)) for name, values in z.items()}
    print(f"paper, {pixel_px} px, {distortion}: {min(scatter.values()):.3f} to "
          f"{max(scatter.values()):.3f} ({max(scatter, key=scatter.get)})")  # fmt: skip
    outside = {name: value for name, value in scatter.items() if not low < value < high}
    assert not outside
    # no bias either: the mean of 300 scores scatters by 0.06
    means = {name: float(values.mean()) for name, values in z.items()}
    assert not {name: mean for name, mean in means.items() if abs(mean) > 0.25}
