"""The joint covariance is that of GTSAM's marginals; what is held has none."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from lasercal_factors.batch import Loss

import lasercal_gtsam as lc
from lasercal_gtsam.graph import CELL_KEY, make_batch, make_graph
from lasercal_gtsam.holds import resolve_holds
from lasercal_gtsam.simulate import Noise, simulate
from lasercal_gtsam.solve import solve
from lasercal_gtsam.uncertainty import estimate_uncertainty, report_notes


@pytest.mark.parametrize(
    ("preset", "options"),
    [
        ("paper", {}),
        ("paper", {"known": {"skew": 0, "principal_point": (320, 240)}, "fixed": ("plane:2",)}),
        ("tool-z-2", {"priors": {"Tz": (330.0, 5.0), "k1": (0.0, 0.2)}}),
    ],
)
def test_covariance_is_that_of_the_marginals(preset: str, options: dict[str, object]) -> None:
    made = simulate(preset, 2, Noise(pixel_px=0.5))
    asked = lc.CalibrationOptions(sigma_px=0.5, **options)  # type: ignore[arg-type]
    holds = resolve_holds(made.observations, asked, made.truth)
    batch = make_batch(made.observations, asked.sigma_px)
    solution = solve(make_graph(made.observations, batch, holds, made.truth, Loss()))
    uncertainty = estimate_uncertainty(solution)
    problem = solution.problem.anchored(solution.cell)
    marginals = gtsam.Marginals(problem.graph, problem.start_values())
    scale = uncertainty.sigma0 / problem.scale
    expected = scale**2 * marginals.marginalCovariance(CELL_KEY)
    free = problem.free
    sigma = np.sqrt(np.diag(expected))[free]
    found = uncertainty.covariance[np.ix_(free, free)]
    np.testing.assert_allclose(
        found / np.outer(sigma, sigma), expected[np.ix_(free, free)] / np.outer(sigma, sigma),
        rtol=0, atol=1e-6,
    )  # fmt: skip
    assert not uncertainty.covariance[~free].any()


def test_a_plane_near_the_base_origin_gets_a_remark() -> None:
    made = simulate("paper", 2, Noise(pixel_px=0.5))
    calibration = lc.calibrate(made.observations, initial=made.truth)
    assert not any("base origin" in note for note in calibration.observability.notes)
    solution = solve(
        make_graph(
            made.observations,
            make_batch(made.observations, None),
            resolve_holds(made.observations, lc.CalibrationOptions(), made.truth),
            made.truth,
        )
    )
    uncertainty = estimate_uncertainty(solution)
    near = dict(solution.cell.planes)
    near["3"] = lc.Plane(near["3"].normal_base, 1e-4)
    (note,) = report_notes(solution.cell.with_planes(near), uncertainty)
    assert "plane '3' passes the base origin at 0.10 +- 0.86 mm" in note
