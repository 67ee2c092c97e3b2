"""Whether a check of the sigmas finds what is wrong with them, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from core_cases import simulated
from scipy import stats
from stream_cases import bumped, start, stream

import lasercal_gtsam as lc
from lasercal_gtsam.incremental import IncrementalCalibrator
from lasercal_gtsam.rotations import make_pose, rotation_exp
from lasercal_gtsam.sigma_check import study
from lasercal_gtsam.sigma_check.judge import judged
from lasercal_gtsam.sigma_check.redraw import redraw_of
from lasercal_gtsam.sigma_check.statistics import Trials, coverage, nees_check
from lasercal_gtsam.simulate import Noise, simulate, simulate_cell


@cache
def paper(**options) -> lc.Calibration:
    made = simulated("paper", 1, 1.0)
    asked = lc.CalibrationOptions(**({"distortion": "none"} | options))
    return lc.calibrate(made.observations, initial=made.truth, options=asked)


@cache
def checked() -> lc.SigmaCheck:
    return lc.check_sigma(paper(), trials=100)


def shrunk(calibration: lc.Calibration, factor: float, only: str | None = None):
    """Sigmas times a factor, in the table and in the joint covariance."""
    scale = np.array([factor if only in (None, x) else 1.0 for x in calibration.labels])
    parameters = tuple(
        replace(p, sigma=p.sigma * (factor if only is None or only.endswith("." + p.name) else 1))
        for p in calibration.parameters
    )
    covariance = calibration.covariance * np.outer(scale, scale)
    return replace(calibration, covariance=covariance, parameters=parameters)


def trials_of(calibration, monkeypatch, **asked) -> Trials:
    """The raw outcome behind a check."""
    kept = []
    monkeypatch.setattr(study, "judged", lambda run: kept.append(run) or judged(run))
    lc.check_sigma(calibration, **asked)
    return kept[0]


# --- good calibrations --------------------------------------------------------------------------


def test_good_sigmas_pass():
    found = checked()
    assert found.holds, found.problems
    assert found.verdict.startswith("The sigmas hold")
    assert [row.name for row in found.rows] == [p.name for p in paper().parameters if p.sigma > 0]
    assert (found.trials, found.solved, found.failures) == (100, 100, {})
    assert found.spots == 90
    assert found.nees.dimension == 24
    assert found.nees.low < found.nees.mean < found.nees.high
    assert found.noise_px == pytest.approx(paper().fit.sigma0)
    assert np.mean([row.coverage_95.share for row in found.rows]) == pytest.approx(0.95, abs=0.02)
    assert np.mean([row.coverage_68.share for row in found.rows]) == pytest.approx(0.68, abs=0.04)
    for row in found.rows:
        assert row.sigma == paper()[row.name].sigma
        assert row.ratio == row.scatter / row.sigma
        assert row.own_sigma == pytest.approx(row.sigma, rel=0.05)


def test_a_trial_does_not_depend_on_their_number(monkeypatch):
    few = trials_of(paper(), monkeypatch, trials=20)
    more = trials_of(paper(), monkeypatch, trials=25)
    np.testing.assert_array_equal(few.errors, more.errors[:20])
    np.testing.assert_array_equal(few.whitened, more.whitened[:20])
    other = trials_of(paper(), monkeypatch, trials=20, seed=1)
    assert (np.abs(other.errors - few.errors) > 0).all()


def test_the_errors_are_those_of_the_table(monkeypatch):
    run = trials_of(paper(), monkeypatch, trials=20)
    drawn = redraw_of(paper(), False).draw(study.stream(0, study.NOISE, 7))
    again = lc.calibrate(drawn.observations, initial=paper().cell, options=paper().inputs.options)
    free = [p for p in paper().parameters if p.sigma > 0]
    error = [again[p.name].refined - p.refined for p in free]
    np.testing.assert_allclose(run.errors[7], error, rtol=1e-6, atol=1e-9)
    own = [again[p.name].sigma for p in free]
    np.testing.assert_allclose(run.own_sigma[7], own, rtol=1e-6)


def test_progress_and_determinism():
    told = []
    first = lc.check_sigma(paper(), trials=20, seed=3, progress=lambda *at: told.append(at))
    assert told == [(k + 1, 20) for k in range(20)]
    assert first == lc.check_sigma(paper(), trials=20, seed=3)


def test_from_the_data_alone_gives_the_same_optimum(monkeypatch):
    made = simulate("paper-2", 1, Noise(pixel_px=0.5), groups=3, shots=5)
    result = lc.calibrate(made.observations, initial=made.truth, options=paper().inputs.options)
    started = trials_of(result, monkeypatch, trials=20)
    alone = trials_of(result, monkeypatch, trials=20, from_data=True)
    same = np.abs(alone.errors - started.errors) < 1e-3 * started.sigma
    assert same.all(axis=1).mean() > 0.9


# --- sigmas that do not hold --------------------------------------------------------------------


def test_a_covariance_that_is_too_small_is_caught():
    found = lc.check_sigma(shrunk(paper(), 0.6), trials=60)
    assert not found.holds
    file, together = found.problems
    assert file.startswith("all 24 rows: the stated sigma is not what the calibration's spots give")
    assert "that is 1.67 times as large" in file
    assert together.startswith("all rows together")
    assert "that is 2.78 times as large" in together
    assert found.nees.mean == pytest.approx(found.nees.dimension / 0.6**2, rel=0.15)
    expected = 2 * stats.norm.cdf(0.6 * 1.96) - 1
    share = np.mean([row.coverage_95.share for row in found.rows])
    assert share == pytest.approx(expected, abs=0.03)
    assert np.mean([row.ratio for row in found.rows]) == pytest.approx(1 / 0.6, rel=0.1)
    # the trials' own intervals do not come from the file
    assert np.mean([row.own_coverage_95.share for row in found.rows]) > 0.92


def test_one_sigma_that_is_too_small_is_named_alone():
    found = lc.check_sigma(shrunk(paper(), 0.5, "camera.v0"), trials=60)
    assert found.problems[0].startswith("v0: the stated sigma is not")
    assert found["v0"].coverage_95.share < 0.85
    assert all("v0" in words for words in found.problems)


def test_a_covariance_alone_that_is_too_small_is_caught():
    wrong = replace(paper(), covariance=0.6 * paper().covariance)
    found = lc.check_sigma(wrong, trials=40)
    (together,) = found.problems
    assert together.startswith("no row alone, but all together")
    assert "that is 1.67 times as large. Calibrate anew" in together


def test_sigmas_that_are_too_large_are_no_good_either():
    found = lc.check_sigma(shrunk(paper(), 2.0), trials=40)
    assert "that is 0.50 times as large" in found.problems[0]
    assert np.mean([row.coverage_95.share for row in found.rows]) > 0.99


def test_a_problem_that_bends_is_told_from_a_wrong_file():
    """36 spots and all distortion terms: k1 and k2 scatter by more than a linear problem does."""
    made = simulate("paper-distorted", 2, Noise(pixel_px=1.0), groups=3, shots=4)
    found = lc.check_sigma(lc.calibrate(made.observations, initial=made.truth), trials=100)
    assert not found.holds
    text = " ".join(found.problems)
    assert "Calibrate anew" not in text
    assert "from about" in text
    assert abs(found["fu"].own_sigma / found["fu"].sigma - 1) < 0.2


# --- what is drawn ------------------------------------------------------------------------------


def test_noise_is_that_of_each_spot_times_sigma0():
    made = simulated("paper", 1, 1.0)
    rng = np.random.default_rng(0)
    A = rng.normal(size=(90, 2, 2))
    cov = A @ np.swapaxes(A, 1, 2) + 0.2 * np.eye(2)
    seen = replace(made.observations, cov_uv=cov)
    result = lc.calibrate(seen, initial=made.truth, options=paper().inputs.options)
    redraw = redraw_of(result, False)
    exact = lc.project(result.cell, seen.T_base_hand, plane=seen.plane.tolist())
    noise = np.array([redraw.draw(rng).observations.uv - exact for _ in range(700)])
    found = np.einsum("kni,knj->nij", noise, noise) / len(noise)
    expected = result.fit.sigma0**2 * cov
    error = np.abs(found - expected).max(axis=(1, 2)) / np.trace(expected, axis1=1, axis2=2)
    assert error.max() < 0.25
    assert np.mean(found / expected, axis=0)[[0, 1], [0, 1]] == pytest.approx([1, 1], abs=0.03)
    # what the estimator is told is what it was told before
    np.testing.assert_array_equal(redraw.draw(rng).observations.cov_uv, cov)


HAND = {"hand_sigma_m": 1e-3, "hand_sigma_rad": float(np.radians(0.05))}


@cache
def noisy_robot(sigma_px: float | None) -> lc.Calibration:
    made = simulate("paper", 1, Noise(0.3, HAND["hand_sigma_m"], HAND["hand_sigma_rad"]))
    options = lc.CalibrationOptions(distortion="none", sigma_px=sigma_px, **HAND)
    return lc.calibrate(made.observations, initial=made.truth, options=options)


@pytest.mark.parametrize("sigma_px", [0.3, None], ids=["pixel sigma given", "found"])
def test_the_hand_moves_where_its_noise_is_declared(sigma_px):
    """Variance of the first spots against hand poses moved by hand, one axis after the other."""
    result = noisy_robot(sigma_px)
    redraw, seen = redraw_of(result, False), result.inputs.observations
    s0 = result.fit.sigma0
    pixel, factor = (0.3 * s0, s0) if sigma_px else (s0, 1.0)

    def at(T):
        return lc.project(result.cell, T, plane=seen.plane.tolist())

    variance = np.full((90, 2), pixel**2)
    for axis in np.eye(3):
        moved = np.array([make_pose(T[:3, :3], T[:3, 3] + 1e-6 * axis) for T in seen.T_base_hand])
        J = (at(moved) - at(seen.T_base_hand)) / 1e-6
        variance += (factor * HAND["hand_sigma_m"] * J) ** 2
        turn = rotation_exp(1e-6 * axis)
        moved = np.array([make_pose(T[:3, :3] @ turn, T[:3, 3]) for T in seen.T_base_hand])
        J = (at(moved) - at(seen.T_base_hand)) / 1e-6
        variance += (factor * HAND["hand_sigma_rad"] * J) ** 2
    rng = np.random.default_rng(1)
    drawn = np.array([redraw.draw(rng).observations.uv for _ in range(400)])
    np.testing.assert_allclose(drawn.var(axis=0) / variance, 1.0, atol=0.4)
    assert np.mean(drawn.var(axis=0) / variance) == pytest.approx(1.0, abs=0.03)


def test_sigmas_with_a_noisy_robot_hold():
    found = lc.check_sigma(noisy_robot(0.3), trials=30)
    assert found.holds, found.problems
    assert 0.85 < np.mean([row.ratio for row in found.rows]) < 1.15


def test_spots_that_cannot_be_are_drawn_again():
    """So noisy a hand turns the beam away from the plane now and then."""
    redraw = redraw_of(paper(), False)
    wild = replace(redraw, hand=Noise(0.0, 0.0, np.radians(25.0)))
    drawn = wild.draw(np.random.default_rng(0))
    assert drawn.redrawn > 0
    assert np.isfinite(drawn.observations.uv).all()


def test_rejected_spots_are_not_simulated():
    made = simulated("paper", 1, 1.0)
    uv = made.observations.uv.copy()
    uv[[4, 50]] += 60.0
    result = lc.calibrate(
        replace(made.observations, uv=uv), initial=made.truth, options=paper().inputs.options
    )
    assert result.fit.n_rejected == 2
    found = lc.check_sigma(result, trials=20)
    assert (found.spots, found.left_out) == (88, 2)


def test_outliers_of_an_m_estimate_stay_as_far_off():
    made = simulated("paper", 1, 1.0)
    uv = made.observations.uv.copy()
    uv[[4, 50]] += 60.0
    result = lc.calibrate(
        replace(made.observations, uv=uv),
        initial=made.truth,
        options=replace(paper().inputs.options, robust="cauchy"),
    )
    redraw = redraw_of(result, False)
    assert np.flatnonzero(redraw.outliers).tolist() == [4, 50]
    exact = lc.project(
        result.cell, made.observations.T_base_hand, plane=made.observations.plane.tolist()
    )
    rng = np.random.default_rng(0)
    noise = np.array([redraw.draw(rng).observations.uv - exact for _ in range(50)])
    far = np.linalg.norm(noise[:, [4, 50]], axis=2)
    np.testing.assert_allclose(far, np.tile(far[0], (50, 1)))
    assert far[0] == pytest.approx([60 * 2**0.5] * 2, abs=8)
    assert np.abs(noise[:, 4].mean(axis=0)).max() < 0.5 * far[0, 0]


# --- one plane, priors --------------------------------------------------------------------------


@cache
def one_plane() -> lc.Calibration:
    """The prior on k1 says ten times more than the spots do."""
    made = simulate("table2-2", 1, Noise(pixel_px=0.2))
    options = lc.CalibrationOptions(
        distortion=("k1", "k2"), known=made.known, priors={"k1": (-0.5, 0.0005)}
    )
    return lc.calibrate(made.observations, initial=made.truth, options=options)


def test_priors_are_drawn_anew():
    found = lc.check_sigma(one_plane(), trials=40)
    row = found["k1"]
    assert one_plane()["k1"].sigma == pytest.approx(0.0005, rel=0.05)
    # at a fixed prior mean the estimate would hardly move at all
    assert row.ratio == pytest.approx(1.0, abs=0.35)
    assert row.coverage_95.share > 0.85
    assert "u0" not in [row.name for row in found.rows]
    assert "each trial draws anew what the priors say" in found.notes[0]
    for name in ("aspect", "k1", "k2"):
        assert name in found.notes[0]


def test_what_was_held_stays_held_from_the_data_alone():
    options = redraw_of(one_plane(), True).options
    cell = one_plane().cell.cameras["camera"].intrinsics
    for name in ("u0", "v0", "skew", "p1", "p2"):
        assert options.known[f"camera.{name}"] == getattr(cell, name)
    assert set(options.priors) == {"aspect", "k1", "k2"}


def test_terms_that_a_fit_gave_up_stay_held():
    """As where the fallback to fewer distortion terms was needed: zero rows in the covariance."""
    result = paper(distortion="all")
    gone = [result.labels.index(f"camera.{name}") for name in ("k2", "p1", "p2")]
    covariance = result.covariance.copy()
    covariance[gone], covariance[:, gone] = 0.0, 0.0
    parameters = tuple(
        replace(p, sigma=0.0) if p.name in ("k2", "p1", "p2") else p for p in result.parameters
    )
    kept = replace(result, covariance=covariance, parameters=parameters)
    found = lc.check_sigma(kept, trials=20)
    assert [r.name for r in found.rows if r.name in ("k1", "k2", "p1", "p2")] == ["k1"]
    assert found.nees.dimension == 25


def test_tied_focal_lengths_are_one_unknown():
    made = simulated("paper", 1, 1.0)
    options = replace(paper().inputs.options, known={"aspect": 1.0})
    result = lc.calibrate(made.observations, initial=made.truth, options=options)
    found = lc.check_sigma(result, trials=30)
    assert found.nees.dimension == 23
    assert len(found.rows) == 24
    assert found["fu"].scatter == pytest.approx(found["fv"].scatter)
    assert found.nees.mean == pytest.approx(23, rel=0.25)


# --- geometry of the table ----------------------------------------------------------------------


def turned(made, angle: float):
    """Everything turned about the base's z axis (radians)."""
    T = make_pose(rotation_exp(np.array([0.0, 0.0, angle])), np.zeros(3))
    cell = made.truth
    camera = cell.cameras["camera"]
    planes = {n: lc.Plane(T[:3, :3] @ p.normal_base, p.distance) for n, p in cell.planes.items()}
    moved = lc.Camera(camera.intrinsics, T @ camera.T_base_camera, camera.image_size)
    truth = lc.Cell({"camera": moved}, cell.lasers, planes)
    return replace(made.observations, T_base_hand=T @ made.observations.T_base_hand), truth


def test_angles_are_compared_on_the_circle():
    made = simulated("paper", 1, 1.0)
    near_180 = np.radians(-90.0 - paper()["theta"].refined - 90.0)
    observations, truth = turned(made, near_180)
    result = lc.calibrate(observations, initial=truth, options=paper().inputs.options)
    assert abs(abs(result["theta"].refined) - 180) < result["theta"].sigma
    found = lc.check_sigma(result, trials=20)
    assert found["theta"].ratio < 2


def test_the_beam_keeps_its_parameterisation(monkeypatch):
    """At u_x = 0.3 the table changes from the crossing with x = 0 to another."""
    cell = simulated("paper", 1).truth
    u = np.array([0.3002, 0.55, 0.0])
    u[2] = np.sqrt(1 - u @ u)
    cell = lc.Cell(cell.cameras, {"laser": lc.Beam(u, np.array([0.0, -0.01, 0.03]))}, cell.planes)
    made = simulate_cell(cell, seed=1, noise=Noise(pixel_px=1.0))
    result = lc.calibrate(made.observations, initial=cell, options=paper().inputs.options)
    run = trials_of(result, monkeypatch, trials=30)
    assert {"laser_x", "laser_z"} <= set(run.names) or {"laser_y", "laser_z"} <= set(run.names)
    found = judged(run)
    assert max(r.ratio for r in found.rows if r.name.startswith("laser")) < 1.5


def test_several_cameras():
    one = simulated("paper", 1, 1.0)
    cell = one.truth
    camera = cell.cameras["camera"]
    moved = camera.T_base_camera @ make_pose(rotation_exp(np.array([0.0, 0, 0.2])), np.zeros(3))
    both = lc.Cell(
        {"a": camera, "b": lc.Camera(camera.intrinsics, moved, camera.image_size)},
        cell.lasers,
        cell.planes,
    )
    noise = Noise(pixel_px=0.5)
    a = simulate_cell(both, camera="a", seed=1, noise=noise, prefix="a")
    b = simulate_cell(both, camera="b", seed=2, noise=noise, prefix="b")
    result = lc.calibrate(
        a.observations + b.observations, initial=both, options=paper().inputs.options
    )
    found = lc.check_sigma(result, trials=25)
    assert {"a.fu", "b.fu"} <= {row.name for row in found.rows}
    assert found.nees.mean == pytest.approx(found.nees.dimension, rel=0.2)


def test_a_running_calibration_can_be_checked():
    calibrator = IncrementalCalibrator(start())
    calibrator.add(stream()[300:320])
    found = lc.check_sigma(calibrator.calibration, trials=20)
    assert found.spots + found.left_out == 320
    for row in found.rows:
        assert row.expected_sigma == pytest.approx(row.sigma, rel=0.05)


# --- refusals -----------------------------------------------------------------------------------


def refused(calibration, words, **asked):
    with pytest.raises(lc.DataError) as caught:
        lc.check_sigma(calibration, **({"trials": 20} | asked))
    assert words in str(caught.value)


def test_an_open_alarm_is_refused():
    calibrator = IncrementalCalibrator(start())
    for spot in range(40):
        moved = bumped(stream()[300:])
        calibrator.add(moved[spot : spot + 1])
        if calibrator.alarm:
            break
    assert calibrator.alarm
    refused(calibrator.calibration, "not to be trusted")


def test_a_calibration_without_its_spots_is_refused():
    few = IncrementalCalibrator(start(), max_spots=100)
    few.add(stream()[300:340])
    refused(few.calibration, "the others live on as prior knowledge only")


def test_no_sigmas_no_check():
    fit = replace(paper().fit, dof=0.0, sigma0=float("nan"))
    refused(replace(paper(), fit=fit), "states no sigmas")
    refused(replace(paper(), fit=replace(paper().fit, sigma0=1e-9)), "zero to rounding")


def test_files_that_contradict_themselves_are_refused():
    indefinite = paper().covariance.copy()
    i, j = (paper().labels.index(f"camera.{name}") for name in ("fu", "fv"))
    indefinite[i, j] = indefinite[j, i] = 2 * np.sqrt(indefinite[i, i] * indefinite[j, j])
    refused(replace(paper(), covariance=indefinite), "not positive definite")
    labels = ("other.fu", *paper().labels[1:])
    refused(replace(paper(), labels=labels), "not that of the parts that have spots (other.fu")
    free = replace(paper().inputs, options=lc.CalibrationOptions(fixed=("laser:laser",)))
    refused(replace(paper(), inputs=free), "estimates laser.slope_a, by its options it holds it")
    away = replace(paper().cell.lasers["laser"], direction_hand=[0, 0, -1])
    cell = lc.Cell(paper().cell.cameras, {"laser": away}, paper().cell.planes)
    refused(replace(paper(), cell=cell), "cannot be seen")


def test_a_start_that_is_needed_is_asked_for():
    made = simulated("paper", 1, 1.0)
    options = replace(paper().inputs.options, fixed=("T_base_camera", "fu"))
    result = lc.calibrate(made.observations, initial=made.truth, options=options)
    refused(result, "T_base_camera was held at the value of a given start", from_data=True)
    assert lc.check_sigma(result, trials=20).nees.dimension == 24 - 7


@pytest.mark.parametrize("trials", [19, 0, -1, 20.5, True, "many"])
def test_bad_numbers_of_trials(trials):
    refused(paper(), "trials: expected", trials=trials)


@pytest.mark.parametrize("seed", [-1, 0.5, None])
def test_bad_seeds(seed):
    refused(paper(), "seed", seed=seed)


def test_solves_that_fail_are_counted_and_told(monkeypatch):
    real, calls = study.calibrate, []

    def now_and_then(*args, **kwargs):
        calls.append(0)
        if len(calls) in (4, 8):  # the first solves the calibration's own spots
            raise lc.SolveError("no way")
        return real(*args, **kwargs)

    monkeypatch.setattr(study, "calibrate", now_and_then)
    found = lc.check_sigma(paper(), trials=20)
    assert (found.solved, set(found.failures)) == (18, {2, 6})
    assert not found.holds
    assert "2 of 20 solves failed, which no sigma tells (trial 2: no way)" in found.problems[-1]


def test_no_solution_at_all_is_an_error(monkeypatch):
    real, calls = study.calibrate, []

    def once(*args, **kwargs):
        calls.append(0)
        if len(calls) > 1:
            raise lc.SolveError("no way")
        return real(*args, **kwargs)

    monkeypatch.setattr(study, "calibrate", once)
    with pytest.raises(lc.SolveError, match=r"20 of 20 trials have no solution.*trial 0: no way"):
        lc.check_sigma(paper(), trials=20)
    refused(paper(), "own spots cannot be solved again from its estimate with its options: no way")


# --- statistics ---------------------------------------------------------------------------------


def drawn_trials(seed: int, n: int = 200, rows: int = 24, factor=1.0, **changes) -> Trials:
    """Gaussian errors as they should be, times ``factor``."""
    rng = np.random.default_rng(seed)
    z = rng.standard_normal((n, rows)) * factor
    run = Trials(
        names=tuple(f"r{i}" for i in range(rows)),
        units=("px",) * rows,
        sigma=np.full(rows, 2.0),
        expected_sigma=np.full(rows, 2.0),
        errors=2.0 * z,
        own_sigma=np.full((n, rows), 2.0),
        whitened=z,
        combinations=np.eye(rows),
        labels=tuple(f"camera.r{i}" for i in range(rows)),
        volume=1.0,
        failures={},
        trials=n,
        seed=seed,
        from_data=False,
        spots=90,
        dof=156.0,
        left_out=0,
        rejected=0,
        redrawn=0,
        noise_px=1.0,
        priors=(),
        outliers=0,
    )
    return replace(run, **changes)


def test_good_trials_are_hardly_ever_blamed():
    blamed = [seed for seed in range(150) if not judged(drawn_trials(seed)).holds]
    assert len(blamed) <= 4, blamed


def test_the_numbers_are_those_of_the_textbooks():
    run = drawn_trials(0, n=80)
    row = judged(run).rows[5]
    e = run.errors[:, 5]
    assert row.scatter == pytest.approx(np.std(e, ddof=1))
    assert row.bias == pytest.approx(e.mean() / 2)
    freedom = stats.chi2(79)
    assert row.ratio_low == pytest.approx(row.ratio * np.sqrt(79 / freedom.ppf(0.975)))
    assert row.ratio_high == pytest.approx(row.ratio * np.sqrt(79 / freedom.ppf(0.025)))
    cdf = freedom.cdf(79 * row.ratio**2)
    assert row.ratio_p == pytest.approx(2 * min(cdf, 1 - cdf))
    z = abs(e.mean()) / (e.std(ddof=1) / np.sqrt(80))
    assert row.bias_p == pytest.approx(2 * stats.norm.sf(z))
    assert row.coverage_68.share == pytest.approx(np.mean(np.abs(e) < 2.0))
    assert row.coverage_95.share == pytest.approx(np.mean(np.abs(e) < 1.96 * 2.0))
    found = nees_check((run.whitened**2).sum(axis=1), 24)
    band = stats.chi2(80 * 24)
    assert found.low == pytest.approx(band.ppf(0.005) / 80)
    assert found.high == pytest.approx(band.ppf(0.995) / 80)


@pytest.mark.parametrize("inside", [0, 1, 60, 95, 99, 100])
def test_coverage_is_judged_by_the_binomial(inside):
    found = coverage(inside, 100, 0.95)
    wilson = stats.binomtest(inside, 100).proportion_ci(2 * stats.norm.cdf(1) - 1, method="wilson")
    assert (found.low, found.high) == pytest.approx((wilson.low, wilson.high), abs=1e-12)
    binomial = stats.binom(100, 0.95)
    expected = 2 * min(binomial.cdf(inside), binomial.sf(inside - 1))
    assert found.p_value == pytest.approx(min(1.0, expected), rel=1e-6)


def test_each_kind_of_trouble_has_its_words():
    factor = np.ones(24)
    factor[[5, 6]] = 1.4
    bent = judged(drawn_trials(1, factor=factor)).problems[0]
    assert bent.startswith("r5, r6: spread 1.")
    assert "with 90 spots like these the problem bends within one sigma" in bent
    # 90 (1.4^2 - 1) / (1.1^2 - 1) = 411, from scatters that are known to 5 %
    assert 300 < int(bent.split("from about ")[1].split()[0]) < 700

    run = drawn_trials(2)
    off = run.errors.copy()
    off[:, 3] += 2.0 * 0.5
    (biased,) = judged(replace(run, errors=off)).problems
    assert biased.startswith("biased, in sigmas: r3 by +0.")

    small = run.own_sigma.copy()
    small[:, 8] *= 0.6
    (own,) = judged(replace(run, own_sigma=small)).problems
    assert own.startswith("r8: the 95 % interval that each trial states of itself holds the truth")
    (few,) = judged(replace(run, own_sigma=0.75 * run.own_sigma, dof=6.0)).problems
    assert "6 degrees of freedom only; take 2.45 sigmas for 95 %" in few

    tails = run.errors.copy()
    tails[:, 2] = 0.3 * np.sign(tails[:, 2])
    tails[:12, 2] *= 2 / 0.3 * np.sqrt(200 / 12)
    (heavy,) = judged(replace(run, errors=tails)).problems
    assert heavy.startswith("r2: the 68 % interval holds the truth in 94.0 % of the trials")
    assert "not Gaussian" in heavy


def test_a_bent_combination_is_named():
    run = drawn_trials(3)
    together = run.whitened.copy()
    together[:, 4] *= 3.0
    (words,) = judged(replace(run, whitened=together)).problems
    assert words.startswith("no row alone, but all together")
    assert "a combination of camera.r4, " in words
    assert "The joint covariance holds from about" in words


def test_a_little_is_tolerated_but_said():
    run = drawn_trials(4)
    found = judged(replace(run, whitened=run.whitened * np.sqrt(1.1 / np.mean(run.whitened**2))))
    assert found.holds
    assert found.nees.mean > found.nees.high
    assert "outside its band, but within 10%" in found.notes[0]


def test_rows_are_found_by_name():
    assert checked()["fu"].unit == "px"
    with pytest.raises(KeyError, match="fu, fv"):
        checked()["focal"]
