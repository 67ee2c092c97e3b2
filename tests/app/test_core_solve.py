"""The whole calibration: against another solver, the truth, another order, another process."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from core_cases import OtherSolver, distance_in_sigmas, rows_of, shuffled, simulated

import lasercal_gtsam as lc
from lasercal_gtsam.simulate import PRESETS, Noise, simulate

# how near the optimum a solve ends (sigmas): where the error no longer falls by more than rounding
REACHED = 1e-5


def with_covariances(observations, seed=5):
    """The same spots with a covariance of their own each."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((len(observations), 2, 2))
    cov = 0.3 * np.eye(2) + 0.4 * A @ np.swapaxes(A, 1, 2)
    return lc.Observations.from_arrays(
        observations.uv, observations.T_base_hand, plane=observations.plane, cov_uv=cov,
        image_size=observations.image_size,
    )  # fmt: skip


@pytest.mark.parametrize("preset", ["paper", "table2-4"])
@pytest.mark.parametrize("own", [False, True], ids=["one sigma", "own covariances"])
def test_optimum_and_covariance_are_those_of_another_solver(preset, own):
    simulation = simulated(preset, 3, 1.0)
    seen = with_covariances(simulation.observations) if own else simulation.observations
    result = lc.calibrate(seen, options=lc.CalibrationOptions(robust="none"))
    assert result.fit.converged, result.fit.status
    other = OtherSolver.about(seen, simulation.truth).solve()
    assert distance_in_sigmas(result, other.cell) < REACHED
    dof = 2 * len(seen) - other.unknowns
    sigma0 = np.sqrt(other.cost / dof)
    assert result.fit.dof == dof
    assert result.fit.sigma0 == pytest.approx(sigma0, rel=1e-9)
    sigmas = np.array([row.sigma for row in result.parameters])
    np.testing.assert_allclose(sigmas, sigma0 * np.sqrt(np.diag(other.covariance)), rtol=1e-4)
    # Table 2's RMS: the length of a residual, in pixels whatever the covariances
    error = lc.project(other.cell, seen.T_base_hand, plane=seen.plane) - seen.uv
    assert result.fit.rms_px == pytest.approx(np.sqrt((error**2).sum(axis=1).mean()), rel=1e-7)
    np.testing.assert_allclose(result.spots.residual_px, error, atol=1e-6)


def test_the_joint_covariance_is_that_of_the_tangent_coordinates():
    simulation = simulated("paper", 3, 1.0)
    result = lc.calibrate(simulation.observations)
    assert len(result.labels) == len(result.covariance) == 28
    assert (np.linalg.eigvalsh(result.covariance) > 0).all()
    # the camera's block in mm against the rows: T in the base is R times the step in the camera
    where = [result.labels.index(f"camera.trans_{a}") for a in "xyz"]
    block = 1e6 * result.covariance[np.ix_(where, where)]
    R = result.cell.cameras["camera"].T_base_camera[:3, :3]
    expected = np.sqrt(np.diag(R @ block @ R.T))
    np.testing.assert_allclose([result[f"T{a}"].sigma for a in "xyz"], expected, rtol=1e-9)
    assert result["fu"].sigma ** 2 == pytest.approx(
        result.covariance[result.labels.index("camera.fu"), result.labels.index("camera.fu")]
    )


@pytest.mark.parametrize("preset", PRESETS)
def test_exact_pixels_give_the_truth(preset):
    simulation = simulated(preset, 1)
    options = lc.CalibrationOptions(known=simulation.known)
    result = lc.calibrate(simulation.observations, options=options)
    assert result.fit.converged, result.fit.status
    assert result.fit.n_rejected == 0
    planes = len(simulation.observations.planes)
    truth = rows_of(simulation.truth, result.cell)
    for row in result.parameters:
        wanted = truth[row.name]
        # a row that is zero is compared with what is usual for it: 1 for px and 1, 100 mm, 10 deg
        usual = {"px": 1.0, "1": 1e-2, "mm": 100.0, "deg": 10.0}[row.unit]
        tolerance = 1e-8 if planes == 1 else 1e-9
        assert abs(row.refined - wanted) <= tolerance * max(abs(wanted), usual), row


def test_the_order_of_the_spots_does_not_matter():
    for preset in ("paper", "table2-2"):
        simulation = simulated(preset, 2, 1.0)
        options = lc.CalibrationOptions(known=simulation.known)
        first = lc.calibrate(simulation.observations, options=options)
        again = lc.calibrate(shuffled(simulation.observations), options=options)
        assert first.fit.converged
        assert distance_in_sigmas(first, again) < REACHED
        assert [p.name for p in again.parameters] == [p.name for p in first.parameters]
        for a, b in zip(first.parameters, again.parameters, strict=True):
            assert b.sigma == pytest.approx(a.sigma, rel=1e-5)
        by_id = {spot.id: spot for spot in again.spots}
        for spot in first.spots:
            np.testing.assert_allclose(by_id[spot.id].residual_px, spot.residual_px, atol=1e-4)


PROGRAM = """
import sys
import lasercal_gtsam as lc
from lasercal_gtsam.simulate import Noise, simulate
simulation = simulate("paper-2", 4, Noise.table1(1.0))
options = lc.CalibrationOptions(hand_sigma_m=1e-3, hand_sigma_rad=9e-4)
result = lc.calibrate(simulation.observations, options=options)
print([(p.initial.hex(), p.refined.hex(), p.sigma.hex()) for p in result.parameters])
print(result.fit, result.covariance.tobytes().hex())
"""


def test_another_process_gives_the_same_digits():
    runs = {
        subprocess.run(
            [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
        ).stdout
        for _ in range(2)
    }
    assert len(runs) == 1


def test_two_calls_give_the_same_result():
    simulation = simulate("paper", 7, Noise.table1(1.0))
    first, second = (lc.calibrate(simulation.observations) for _ in range(2))
    assert first == second


def test_a_start_from_drawings_ends_where_the_closed_form_ends():
    simulation = simulated("paper-distorted", 1, 1.0)
    by_closed_form = lc.calibrate(simulation.observations)
    rough = OtherSolver.about(simulation.observations, simulation.truth)
    rng = np.random.default_rng(0)
    x = rough.start()
    x[:3] += np.radians(2.0) * rng.standard_normal(3)
    x[3:6] += 0.01 * rng.standard_normal(3)
    x[6:8] *= 1.05
    x[8:15] = [0, 320, 240, 0, 0, 0, 0]
    x[15:17] += np.radians(1.0) * rng.standard_normal(2)
    x[17:19] += 0.003 * rng.standard_normal(2)
    x[19:] += 0.003 * rng.standard_normal(9)
    drawn = rough.cell(x)
    result = lc.calibrate(simulation.observations, initial=drawn)
    assert result.initial == drawn
    assert distance_in_sigmas(by_closed_form, result) < REACHED
    assert [p.initial for p in result.parameters] == pytest.approx(
        list(rows_of(drawn, result.cell).values())
    )


def test_an_impossible_start_says_why():
    simulation = simulated("paper", 1, 1.0)
    cell = simulation.truth
    beam = cell.lasers["laser"]
    backwards = lc.Beam(-beam.direction_hand, beam.point_hand)
    start = lc.Cell(cell.cameras, {"laser": backwards}, cell.planes)
    with pytest.raises(lc.SolveError, match="start") as caught:
        lc.calibrate(simulation.observations, initial=start)
    assert "beam" in str(caught.value)


def test_parts_that_were_not_observed_stay_as_they_were():
    simulation = simulated("paper", 1, 1.0)
    seen = simulation.observations
    only = seen[np.isin(seen.plane, ["1", "3"])]
    result = lc.calibrate(only, initial=simulation.truth)
    assert result.cell.planes["2"] == simulation.truth.planes["2"]
    names = [p.name for p in result.parameters]
    assert "a_2_x" not in names
    assert "a_3_x" in names


@pytest.mark.parametrize("kind", ["cameras", "lasers", "planes"])
def test_a_start_must_hold_what_was_observed(kind):
    simulation = simulated("paper", 1, 1.0)
    cell = simulation.truth
    parts = {"cameras": cell.cameras, "lasers": cell.lasers, "planes": cell.planes}
    parts[kind] = {k: v for k, v in parts[kind].items() if k in ("1", "2")}
    with pytest.raises(lc.DataError, match=f"initial: {kind[:-1]} "):
        lc.calibrate(simulation.observations, initial=lc.Cell(**parts))


def test_requests_that_make_no_sense_are_refused():
    simulation = simulated("paper", 1, 1.0)
    seen = simulation.observations
    camera = simulation.truth.cameras["camera"]
    larger = lc.Cell(
        {"camera": lc.Camera(camera.intrinsics, camera.T_base_camera, (800, 600))},
        simulation.truth.lasers,
        simulation.truth.planes,
    )
    for call, words in (
        (lambda: lc.calibrate(seen[:0]), "no spots"),
        (lambda: lc.calibrate(seen, initial={"cameras": {}}), "expected a Cell"),
        (lambda: lc.calibrate(seen, initial=larger), "image size"),
    ):
        with pytest.raises(lc.DataError, match=words):
            call()
