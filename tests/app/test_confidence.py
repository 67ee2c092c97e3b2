"""Intervals from the likelihood: against fits with the row held, and against other solvers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from core_cases import OtherSolver, rows_of, simulated
from scipy.stats import t as student

import lasercal_gtsam as lc
from lasercal_gtsam.calibration import measured
from lasercal_gtsam.confidence import likelihood_of
from lasercal_gtsam.graph import cell_from_state
from lasercal_gtsam.profile import RowProfile
from lasercal_gtsam.report_map import BeamChart, row_names, row_values
from lasercal_gtsam.simulate import Noise, simulate, simulate_cell
from lasercal_gtsam.table_row import TableRow

PLAIN = lc.CalibrationOptions(robust="none")


def solved(preset, seed, pixel_px, **options):
    made = simulated(preset, seed, pixel_px)
    chosen = replace(PLAIN, known=made.known, **options)
    return made, lc.calibrate(made.observations, initial=made.truth, options=chosen)


# --- rows as functions of the chart -------------------------------------------------------------


@pytest.mark.parametrize("preset", ["paper", "tool-z-2"])
def test_every_row_and_its_gradient(preset):
    """Values against the table of the moved cell, gradients against differences."""
    _, result = solved(preset, 0, 1.0)
    problem = likelihood_of(result).problem
    charts = {name: BeamChart.of(beam) for name, beam in problem.start.lasers.items()}
    z = 1e-3 * np.random.default_rng(0).standard_normal(problem.chart.n)
    moved = cell_from_state(problem.chart.state(z), problem.start)
    values = row_values(moved, charts)
    for (name, unit), value in zip(row_names(problem.start, charts), values, strict=True):
        row = TableRow.named(name, problem.start, problem.chart, charts)
        assert (row.name, row.unit) == (name, unit)
        assert row.value(z) == pytest.approx(value, abs=1e-9)
        gradient = row.gradient(z)
        for k in range(problem.chart.n):
            h = np.zeros(problem.chart.n)
            h[k] = 1e-6
            slope = row.difference(row.value(z + h), row.value(z - h)) / 2e-6
            assert gradient[k] == pytest.approx(slope, rel=1e-5, abs=1e-4)
            if k not in row.bending:
                np.testing.assert_allclose(row.gradient(z + 100 * h), gradient, rtol=1e-9)


# --- the root -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "by"), [("k2", 2.0), ("k1", -1.5), ("u0", 2.2), ("fv", -2.0)])
def test_the_root_is_what_holding_the_row_costs(name, by):
    """Against a calibration with that value known, another way through the code."""
    made, result = solved("paper", 1, 1.0)
    row = result[name]
    value = row.refined + by * row.sigma
    held = lc.calibrate(
        made.observations, initial=result.cell, options=replace(PLAIN, known={name: value})
    )
    rise = held.fit.sigma0**2 * held.fit.dof - result.fit.sigma0**2 * result.fit.dof
    expected = -math.copysign(math.sqrt(rise) / result.fit.sigma0, by)
    found = RowProfile.of(likelihood_of(result), name).standing(value)
    assert found.root == pytest.approx(expected, abs=2e-4)


def test_the_root_of_an_angle_against_another_solver():
    """A row that is no coordinate, held by a heavy weight in a solver of its own."""
    made, result = solved("paper", 2, 1.0, distortion=("k1",))
    row = result["phi"]
    value = row.refined + 2.0 * row.sigma
    other = OtherSolver.about(made.observations, result.cell, ("k2", "p1", "p2"))
    weight = 1e4 / row.sigma
    held = other.solve(extra=lambda cell: np.array([weight * (rows_of(cell)["phi"] - value)]))
    free = result.fit.sigma0**2 * result.fit.dof
    expected = -math.sqrt(held.cost - free) / result.fit.sigma0
    found = RowProfile.of(likelihood_of(result), "phi").standing(value)
    assert found.root == pytest.approx(expected, abs=1e-3)


# --- intervals ----------------------------------------------------------------------------------


def test_where_nothing_bends_an_interval_is_estimate_and_sigma():
    _, result = solved("paper", 3, 0.01, distortion=("k1",))
    limit = student.ppf(0.975, result.fit.dof)
    found = lc.intervals(result)
    assert set(found) == {p.name for p in result.parameters if p.sigma > 0}
    for name, (low, high) in found.items():
        row = result[name]
        assert (row.refined - low) / row.sigma == pytest.approx(limit, rel=0.01)
        assert (high - row.refined) / row.sigma == pytest.approx(limit, rel=0.01)


def test_where_it_bends_both_ends_stand_as_they_should():
    _, result = solved("table2-4", 0, 1.98)
    likelihood = likelihood_of(result)
    limit = student.ppf(0.975, result.fit.dof)
    low, high = result.interval("k1")
    profile = RowProfile.of(likelihood, "k1")
    assert profile.standing(low).adjusted == pytest.approx(limit, abs=0.01)
    assert profile.standing(high).adjusted == pytest.approx(-limit, abs=0.01)
    row = result["k1"]
    # the side on which the distortion grows is the longer one
    assert (high - row.refined) > 1.2 * (row.refined - low) > 0
    narrow = lc.intervals(result, ["k1"], level=0.8)["k1"]
    assert low < narrow[0] < row.refined < narrow[1] < high


def test_priors_and_a_noisy_robot_count():
    made = simulate("tool-z", 1, Noise(pixel_px=0.5, hand_translation_m=2e-4))
    options = lc.CalibrationOptions(known=made.known, sigma_px=0.5, hand_sigma_m=2e-4)
    result = lc.calibrate(made.observations, initial=made.truth, options=options)
    limit = student.ppf(0.975, result.fit.dof)
    for name in ("p2", "Tz", "laser_y"):
        low, high = result.interval(name)
        row = result[name]
        assert 0.8 * limit < (high - row.refined) / row.sigma < 1.25 * limit
        assert 0.8 * limit < (row.refined - low) / row.sigma < 1.25 * limit


def test_spots_left_out_stay_out(tmp_path):
    made = simulated("paper", 4, 0.5)
    uv = made.observations.uv.copy()
    uv[7] = [600.0, 20.0]
    result = lc.calibrate(replace(made.observations, uv=uv), options=lc.CalibrationOptions())
    assert result.spots[7].rejected
    kept = np.arange(len(uv)) != 7
    clean = lc.calibrate(made.observations[kept], options=PLAIN, initial=result.cell)
    assert result.interval("fu") == pytest.approx(clean.interval("fu"), rel=1e-4)
    result.save(tmp_path / "c.json")
    assert lc.load_calibration(tmp_path / "c.json").interval("fu") == pytest.approx(
        result.interval("fu"), rel=1e-6
    )


@pytest.mark.parametrize(
    ("names", "level", "words"),
    [(["f"], 0.95, "unknown row 'f'"), (["k2"], 0.95, "k2 is held"), (["fu"], 1.0, "level")],
)
def test_what_has_no_interval_is_refused(names, level, words):
    _, result = solved("paper", 5, 0.5, distortion=("k1",))
    with pytest.raises(lc.DataError, match=words):
        lc.intervals(result, names, level=level)


def test_a_loss_is_no_likelihood():
    made = simulated("paper", 5, 0.5)
    result = lc.calibrate(made.observations, options=lc.CalibrationOptions(robust="cauchy"))
    with pytest.raises(lc.DataError, match="no likelihood"):
        result.interval("fu")


@pytest.mark.slow
def test_intervals_cover_where_sigmas_do_not():
    """300 captures of the cell that bends most; `coverage_study` has all rows and cells."""
    from coverage_study import capture_study, coverages

    names = ("k1", "k2", "v0", "fu", "a_1_x")
    lines = [capture_study("table2-4", 1.98, seed, names=names) for seed in range(300)]
    found = coverages(lines)
    for n, _, _, interval, lost in found.values():
        assert n >= 290
        assert lost <= 2
        assert 0.95 - 3 * math.sqrt(0.95 * 0.05 / n) < interval
    assert found["k2"][1] < 0.90 < 0.92 < found["k2"][3]


# --- numbers and priors -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (203.4, 73.2, "203 +- 73"),
        (0.1234, 0.0456, "0.123 +- 0.046"),
        (2034.0, 1234.0, "2000 +- 1200"),
        (-0.004, 0.99, "0.00 +- 0.99"),
        (5.0, 0.0996, "5.00 +- 0.10"),
        (7.123456, 0.0, "7.123 +- 0"),
        (7.123456, math.nan, "7.123 +- unknown"),
    ],
)
def test_a_length_is_printed_with_its_sigma(value, sigma, text):
    assert measured(value, sigma) == text


@pytest.mark.parametrize("side", [-0.5, 0.5])
def test_a_prior_keeps_its_meaning_when_the_beam_is_written_otherwise(side):
    """About 5.7 deg from the hand's z axis the table goes over to tilts; priors on angles stay."""
    base = simulated("tool-z-2").truth
    polar = np.deg2rad(5.74 + side)
    u = [np.sin(polar) * np.cos(0.4), np.sin(polar) * np.sin(0.4), np.cos(polar)]
    cell = replace(base, lasers={"laser": lc.Beam(np.array(u), np.zeros(3))})
    made = simulate_cell(cell, groups=3, design="table", seed=1, noise=Noise(pixel_px=0.3))
    options = replace(PLAIN, priors={"laser_theta": (np.rad2deg(0.4), 1e-3)})
    result = lc.calibrate(made.observations, options=options)
    assert result.fit.converged
    direction = result.cell.lasers["laser"].direction_hand
    theta = np.rad2deg(np.arctan2(direction[1], direction[0]))
    assert theta == pytest.approx(np.rad2deg(0.4), abs=0.01)
    tilts = replace(PLAIN, priors={"laser_tilt_x": (np.rad2deg(np.arctan(u[0] / u[2])), 1e-3)})
    again = lc.calibrate(made.observations, options=tilts).cell.lasers["laser"].direction_hand
    assert again[0] / again[2] == pytest.approx(u[0] / u[2], abs=1e-4)


def test_a_prior_on_an_angle_that_is_not_defined_is_refused():
    made = simulated("tool-z", 0, 0.3)
    options = replace(PLAIN, priors={"laser_theta": (0.0, 1.0)})
    with pytest.raises(lc.DataError, match="give laser_tilt_x"):
        lc.calibrate(made.observations, initial=made.truth, options=options)


@pytest.mark.parametrize(
    ("preset", "pixel_px", "distortion", "bent", "straight"),
    [
        ("table2-4", 1.98, "all", {"k2", "u0", "phi"}, {"Tx", "laser_y", "a_1_x", "fu"}),
        ("paper", 0.2, "all", set(), {"k2", "u0"}),
        ("paper", 1.0, "none", set(), {"u0"}),
    ],
)
def test_rows_that_bend_are_named_and_no_others(preset, pixel_px, distortion, bent, straight):
    """The rows whose intervals by sigma fail in the study of coverage, and those that do not."""
    made = simulated(preset, 2, pixel_px)
    options = replace(PLAIN, known=made.known, distortion=distortion)
    result = lc.calibrate(made.observations, initial=made.truth, options=options)
    notes = [n for n in result.observability.notes if "sigma itself changes" in n]
    named = set(notes[0].partition(":")[0].split(", ")) if notes else set()
    assert bent <= named
    assert not named & straight
    assert bool(notes) == bool(bent)
