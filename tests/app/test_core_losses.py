"""Losses of the user's choice: against an independent solver, on clean data, with outliers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from core_cases import OtherSolver, differences, distance_in_sigmas, rows_of, simulated
from lasercal_factors import kernels
from lasercal_factors.batch import LOSSES, Loss
from scipy.integrate import quad
from scipy.stats import norm

import lasercal_gtsam as lc
from lasercal_gtsam.losses import (
    THRESHOLDS,
    efficient_loss,
    loss_weights,
    sensitivity_and_spread,
    truncated_weights,
    weight_slopes,
)
from lasercal_gtsam.simulate import Noise, simulate

M_ESTIMATES = ("huber", "cauchy", "geman-mcclure")
HELD = ("k1", "k2", "p1", "p2")

# the losses as they are in the literature, rho of the length r with threshold c
RHO = {
    "huber": lambda r, c: r**2 if r <= c else 2 * c * r - c**2,
    "cauchy": lambda r, c: c**2 * np.log(1 + r**2 / c**2),
    "geman-mcclure": lambda r, c: c**2 * r**2 / (c**2 + r**2),
}


def spoiled(seed=4, share=0.2, preset="paper", pixel_px=0.5, kind="uniform"):
    """Observations, and which are outliers; a "ghost" is one pixel of the picture."""
    simulation = simulated(preset, seed, pixel_px)
    seen = simulation.observations
    rng = np.random.default_rng(1000 + seed)
    far = np.linalg.norm(seen.uv - [420.0, 150.0], axis=1) > 10.0
    wrong = np.sort(rng.choice(np.flatnonzero(far), round(share * len(seen)), replace=False))
    uv = seen.uv.copy()
    if kind == "ghost":
        uv[wrong] = np.array([420.0, 150.0]) + rng.uniform(-1, 1, (len(wrong), 2))
    else:
        uv[wrong] = rng.uniform([0, 0], [639, 479], (len(wrong), 2))
    return simulation, replace(seen, uv=uv), wrong


@cache
def solved(robust, share=0.2, preset="paper", kind="uniform", **options):
    simulation, seen, _ = spoiled(share=share, preset=preset, kind=kind)
    return lc.calibrate(
        seen,
        initial=simulation.truth,
        options=lc.CalibrationOptions(robust=robust, known=simulation.known, **options),
    )


@pytest.mark.parametrize("name", M_ESTIMATES)
def test_formulas_are_the_kernels_and_derivatives_of_each_other(name):
    loss = efficient_loss(name)
    for r in (0.05, 0.8, 1.4, 1.6, 3.0, 20.0, 500.0):
        h = 1e-4 * r
        rho = [RHO[name](np.sqrt(r**2 + d), loss.threshold) for d in (-h, h)]
        m = np.array([r**2])
        assert kernels.loss_value(LOSSES[name], loss.threshold, r**2) == pytest.approx(
            RHO[name](r, loss.threshold), rel=1e-12
        )
        assert loss_weights(loss, m)[0] == pytest.approx((rho[1] - rho[0]) / (2 * h), rel=1e-6)
        assert loss_weights(loss, m)[0] == pytest.approx(
            kernels.loss_weight(LOSSES[name], loss.threshold, r**2), rel=1e-12
        )
        w = [loss_weights(loss, m + d)[0] for d in (-h, h)]
        assert weight_slopes(loss, m)[0] == pytest.approx((w[1] - w[0]) / (2 * h), rel=1e-5)


@pytest.mark.parametrize("name", M_ESTIMATES)
def test_thresholds_are_95_percent_efficient_in_the_plane(name):
    """By integrals over one coordinate of psi and its divergence, Gaussian in both directions."""
    c = THRESHOLDS[name]

    def weight(r):
        h = 1e-5
        return (RHO[name](r + h, c) - RHO[name](max(r - h, 0.0), c)) / (h + min(r, h)) / (2 * r)

    def mean(f):
        def inside(r):
            return f(r) * r * np.exp(-(r**2) / 2)

        return sum(quad(inside, *part, limit=200)[0] for part in ((1e-3, c), (c, 12.0)))

    # Stein: E[psi'] of one coordinate is E[psi . r] / 2
    sensitivity = mean(lambda r: weight(r) * r**2 / 2)
    spread = mean(lambda r: (weight(r) * r) ** 2 / 2)
    assert sensitivity**2 / spread == pytest.approx(0.95, abs=1e-3)


def reweighted(seen, truth, loss, kept):
    """Iteratively reweighted least squares in NumPy, scale by the median: no code of ours."""
    solver = OtherSolver.about(seen, truth, HELD)
    free, start = solver.free, solver.start()

    def residuals(y):
        x = start.copy()
        x[free] = y
        return solver.residuals(x)

    y = start[free]
    for _ in range(80):
        r = residuals(y).reshape(-1, 2)
        length = np.hypot(*r.T)
        dof = 2 * kept.sum() - len(y)
        scale = np.median(length[kept]) / np.sqrt(2 * np.log(2)) * np.sqrt(2 * kept.sum() / dof)
        u = length / scale
        c = loss.threshold
        w = {
            "huber": np.where(u <= c, 1.0, c / u),
            "cauchy": 1 / (1 + (u / c) ** 2),
            "geman-mcclure": 1 / (1 + (u / c) ** 2) ** 2,
        }[loss.name]
        root = np.repeat(np.sqrt(w), 2)
        J = differences(residuals, y)
        step = np.linalg.lstsq(root[:, None] * J, root * r.ravel(), rcond=None)[0]
        y = y - step
        if np.linalg.norm(J @ step) < 1e-7 * scale:
            break
    x = start.copy()
    x[free] = y
    return solver.cell(x), scale, w, root[:, None] * J


@pytest.mark.parametrize("name", M_ESTIMATES)
@pytest.mark.parametrize("share", [0.0, 0.2])
def test_estimate_scale_weights_and_leverage_against_another_solver(name, share):
    simulation, seen, wrong = spoiled(share=share)
    result = solved(name, share=share, distortion="none")
    kept = ~np.isin(np.arange(len(seen)), wrong)
    cell, scale, w, rows = reweighted(seen, simulation.truth, efficient_loss(name), kept)
    assert result.fit.converged
    assert distance_in_sigmas(result, cell) < 2e-3
    assert result.fit.sigma0 == pytest.approx(scale, rel=1e-4)
    np.testing.assert_allclose(result.spots.weight, w, atol=2e-4)
    Q = np.linalg.qr(rows)[0]
    hat = (Q**2).sum(axis=1).reshape(-1, 2).sum(axis=1)
    np.testing.assert_allclose(result.spots.leverage, hat, atol=1e-3)
    assert result.spots.leverage.sum() == pytest.approx(24.0)


def test_leverage_of_the_others_is_their_hat_matrix():
    simulation, seen, wrong = spoiled()
    result = solved("auto", distortion="none")
    good = np.setdiff1d(np.arange(len(seen)), wrong)
    solver = OtherSolver.about(seen[good], result.cell, HELD)
    start = solver.start()

    def residuals(y):
        x = start.copy()
        x[solver.free] = y
        return solver.residuals(x)

    Q = np.linalg.qr(differences(residuals, start[solver.free]))[0]
    hat = (Q**2).sum(axis=1).reshape(-1, 2).sum(axis=1)
    np.testing.assert_allclose(result.spots.leverage[good], hat, atol=1e-6)
    assert not result.spots.leverage[wrong].any()
    assert result.spots[int(good[3])].leverage == pytest.approx(hat[3], abs=1e-6)
    assert 0 < hat.min() < hat.max() < 2
    assert simulation.truth.planes


@pytest.mark.parametrize("preset", ["paper", "table2-1", "no-groups"])
def test_clean_data_stay_least_squares_where_outliers_are_named(preset):
    plain = solved("none", share=0.0, preset=preset)
    for robust in ("auto", "gnc-tls"):
        result = solved(robust, share=0.0, preset=preset)
        assert result.cell == plain.cell
        assert result.fit == plain.fit
        np.testing.assert_array_equal(result.covariance, plain.covariance)


@pytest.mark.parametrize("name", M_ESTIMATES)
def test_clean_data_move_as_far_as_the_efficiency_says(name):
    """Variance 1 / 0.95: rms distance from least squares sqrt(1 / 0.95 - 1) = 0.23 sigma."""
    scores = []
    for seed in range(12):
        made = simulate("paper", seed, Noise(pixel_px=0.5))
        both = [
            lc.calibrate(
                made.observations,
                initial=made.truth,
                options=lc.CalibrationOptions(robust=robust, distortion="none"),
            )
            for robust in ("none", name)
        ]
        other = rows_of(both[1].cell, both[0].cell)
        scores += [(other[p.name] - p.refined) / p.sigma for p in both[0].parameters if p.sigma]
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(0.23, abs=0.08)


@pytest.mark.parametrize("kind", ["uniform", "ghost"])
@pytest.mark.parametrize("robust", ["auto", "gnc-tls"])
def test_a_fifth_of_outliers_is_named(robust, kind):
    right = wrong_ones = planted = 0
    for seed in range(20):
        simulation, seen, wrong = spoiled(seed, kind=kind)
        result = lc.calibrate(
            seen,
            initial=simulation.truth,
            options=lc.CalibrationOptions(robust=robust, distortion="none"),
        )
        assert result.fit.converged
        named = {k for k, spot in enumerate(result.spots) if spot.rejected}
        right += len(named & set(wrong.tolist()))
        wrong_ones += len(named - set(wrong.tolist()))
        planted += len(wrong)
    assert right / planted >= 0.98
    assert right / (right + wrong_ones) >= 0.98


def test_truncated_least_squares_agrees_with_the_default_on_who_is_out():
    _, _, wrong = spoiled()
    result, auto = solved("gnc-tls"), solved("auto")
    assert [k for k, spot in enumerate(result.spots) if spot.rejected] == wrong.tolist()
    assert distance_in_sigmas(auto, result) < 1e-3
    assert set(result.spots.weight) == {0.0, 1.0}


def test_truncated_weights_are_the_surrogates_derivative():
    """Yang et al. 2020: rho_mu is smooth; continued to its ends it is r^2 and c^2."""
    c, mu = 3.0, 0.4

    def rho(r):
        if r**2 <= mu / (mu + 1) * c**2:
            return r**2
        if r**2 >= (mu + 1) / mu * c**2:
            return c**2
        return 2 * c * r * np.sqrt(mu * (mu + 1)) - mu * (c**2 + r**2)

    for r in (0.5, 1.5, 1.7, 3.0, 5.0, 5.7, 8.0):
        h = 1e-6
        slope = (rho(r + h) - rho(r - h)) / (4 * h * r)
        assert truncated_weights(np.array([r]), c, mu)[0] == pytest.approx(slope, abs=1e-5)
    assert truncated_weights(np.array([np.inf]), c, mu)[0] == 0.0


@pytest.mark.parametrize("name", M_ESTIMATES)
def test_huber_s_covariance_holds_in_a_linear_problem(name):
    """Scores of 400 estimates of twelve unknowns from 60 points, a fifth of them far outliers."""
    rng, loss = np.random.default_rng(7), efficient_loss(name)
    scores = []
    for _ in range(400):
        J = rng.standard_normal((60, 2, 12))
        seen = rng.standard_normal((60, 2))
        seen[:12] += rng.uniform(-80, 80, (12, 2))
        x = np.zeros(12)
        for _ in range(60):
            r = seen - J @ x
            w = loss_weights(loss, (r**2).sum(axis=1))[:, None]
            A, b = (w[..., None] * J).reshape(-1, 12), r.ravel()
            step = np.linalg.solve(A.T @ J.reshape(-1, 12), A.T @ b)
            x += step
            if np.abs(step).max() < 1e-9:
                break
        a, spread = sensitivity_and_spread(loss, seen - J @ x, 12)
        information = J.reshape(-1, 12).T @ J.reshape(-1, 12)
        scores.append(x / np.sqrt(np.diag(spread / a**2 * np.linalg.inv(information))))
    assert np.std(scores) == pytest.approx(1.0, abs=0.08)


def test_without_a_loss_it_is_the_a_posteriori_variance():
    r = np.random.default_rng(0).standard_normal((40, 2))
    a, b = sensitivity_and_spread(Loss(), r, 10)
    assert a == 1.0
    assert b == pytest.approx((r**2).sum() / 70)


@pytest.mark.parametrize("name", M_ESTIMATES)
def test_sigmas_hold_with_outliers(name):
    """Coverage of the 90 % interval over 16 captures of 24 rows, from a fifth of outliers."""
    inside = []
    for seed in range(16):
        simulation, seen, _ = spoiled(seed)
        options = lc.CalibrationOptions(robust=name, distortion="none")
        result = lc.calibrate(seen, initial=simulation.truth, options=options)
        assert result.fit.converged
        inside += [
            abs(p.refined - p.initial) <= norm.ppf(0.95) * p.sigma
            for p in result.parameters
            if p.sigma
        ]
    # rows of one capture are correlated: an effective number of about 100
    assert 0.80 <= np.mean(inside) <= 0.97


@pytest.mark.parametrize("robust", M_ESTIMATES)
def test_every_spot_has_its_account(robust):
    _, seen, wrong = spoiled()
    result = solved(robust)
    good = np.setdiff1d(np.arange(len(seen)), wrong)
    assert all(spot.rejected is None for spot in result.spots)
    assert result.fit.n_spots == len(seen)
    assert result.spots.weight[wrong].max() < 0.15
    assert np.median(result.spots.weight[good]) > 0.7
    assert "with a weight below 0.1" in result.fit.status
    if robust != "huber":
        assert result.fit.rms_px < 1.5


@pytest.mark.parametrize("robust", [*M_ESTIMATES, "gnc-tls"])
def test_the_order_of_spots_does_not_matter(robust):
    simulation, seen, _ = spoiled(share=0.1)
    order = np.random.default_rng(0).permutation(len(seen))
    options = lc.CalibrationOptions(robust=robust)
    a = lc.calibrate(seen, initial=simulation.truth, options=options)
    b = lc.calibrate(seen[order], initial=simulation.truth, options=options)
    assert distance_in_sigmas(a, b) < 2e-3
    np.testing.assert_allclose(a.spots.weight[order], b.spots.weight, atol=1e-3)
    np.testing.assert_allclose(a.spots.leverage[order], b.spots.leverage, atol=1e-3)


@pytest.mark.parametrize("robust", [*M_ESTIMATES, "gnc-tls"])
def test_beside_a_noisy_robot(robust):
    """Pixel and hand noise weigh together; the result is close to that without outliers."""
    noise = Noise(pixel_px=0.3, hand_translation_m=1e-3, hand_rotation_rad=np.radians(0.05))
    simulation = simulate("paper", 8, noise)
    known = {"hand_sigma_m": 1e-3, "hand_sigma_rad": float(np.radians(0.05)), "distortion": "none"}
    seen, truth = simulation.observations, simulation.truth
    wrong = np.arange(4, 90, 10)
    uv = seen.uv.copy()
    uv[wrong] = np.random.default_rng(2).uniform([0, 0], [639, 479], (len(wrong), 2))
    for stated in ({}, {"sigma_px": 0.3}):
        options = lc.CalibrationOptions(robust=robust, **known, **stated)
        result = lc.calibrate(replace(seen, uv=uv), initial=truth, options=options)
        clean = lc.calibrate(
            seen[np.setdiff1d(np.arange(90), wrong)],
            initial=truth,
            options=replace(options, robust="none"),
        )
        assert result.fit.converged, result.fit.status
        assert distance_in_sigmas(clean, result) < (2.0 if robust == "huber" else 1.2)
        ratio = [
            p.sigma / q.sigma for p, q in zip(result.parameters, clean.parameters, strict=True)
            if q.sigma
        ]  # fmt: skip
        assert 0.7 < min(ratio) <= max(ratio) < 1.6


def test_a_file_without_leverage_is_read(tmp_path):
    import json

    result = solved("cauchy")
    result.save(tmp_path / "new.json")
    assert lc.load_calibration(tmp_path / "new.json") == result
    data = json.loads((tmp_path / "new.json").read_text(encoding="utf-8"))
    assert data["version"] == 1
    assert data["spots"][0]["leverage"] == result.spots.leverage[0]
    for spot in data["spots"]:
        del spot["leverage"]
    (tmp_path / "old.json").write_text(json.dumps(data), encoding="utf-8")
    old = lc.load_calibration(tmp_path / "old.json")
    assert np.isnan(old.spots.leverage).all()
    assert np.isnan(old.spots[0].leverage)
    np.testing.assert_array_equal(old.spots.weight, result.spots.weight)
