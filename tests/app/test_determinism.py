"""The same input gives the same output to the last digit, wherever its arrays lie in memory."""

from __future__ import annotations

import numpy as np

import lasercal_gtsam as lc
from lasercal_gtsam.simulate import Noise, simulate


def test_memory_does_not_decide_the_last_digits():
    simulation = simulate("paper-2", 0, Noise(pixel_px=1.0))
    seen, rng = simulation.observations, np.random.default_rng(0)
    kept, results = [], set()
    for _ in range(60):
        kept.append(np.empty(rng.integers(1, 2000)))  # arrays come to lie elsewhere each time
        del kept[: rng.integers(0, 2)]
        moved = lc.Observations.from_arrays(
            seen.uv.copy(),
            seen.T_base_hand.copy(),
            plane=seen.plane.tolist(),
            image_size=seen.image_size,
            sigma_px=1.0,
        )
        result = lc.calibrate(moved, initial=simulation.truth)
        numbers = [number for row in result.parameters for number in (row.refined, row.sigma)]
        results.add(np.array(numbers).tobytes())
    assert len(results) == 1
