"""Noise levels that nobody stated: restricted maximum likelihood, against dense formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cli_support import Cli
from core_cases import distance_in_sigmas
from scipy.optimize import minimize

import lasercal_gtsam as lc
from lasercal_gtsam.calibration import NoiseLevel
from lasercal_gtsam.hand_noise.components import Block, Prior, variance_components
from lasercal_gtsam.io.capture_writer import write_capture
from lasercal_gtsam.options import HAND_NOISE_NAMES
from lasercal_gtsam.report.words import noise_sentence
from lasercal_gtsam.simulate import Noise, simulate

NOISE = Noise(1.0, 1e-3, float(np.radians(0.3)))
REAL = {"sigma_px": 1.0, "hand_sigma_m": 1e-3, "hand_sigma_rad": float(np.radians(0.3))}


def options(**changes):
    asked = {"robust": "none", "distortion": "none", "estimate_noise": HAND_NOISE_NAMES}
    return lc.CalibrationOptions(**(asked | changes))


def blocks(
    rng: np.random.Generator, theta: np.ndarray, counts: tuple[int, int] = (60, 25)
) -> list[Block]:
    """Stops of one and of three spots, with noise drawn of known components."""
    out, m = [], 5
    z = rng.standard_normal(m)
    for count, d in zip(counts, (2, 6), strict=True):
        parts = np.empty((3, count, d, d))
        parts[0] = np.eye(d)
        for j in (1, 2):
            B = rng.standard_normal((count, d, 3))
            parts[j] = B @ np.swapaxes(B, 1, 2)
        fixed = np.tile(0.05 * np.eye(d), (count, 1, 1))
        A = rng.standard_normal((count, d, m))
        L = np.linalg.cholesky(fixed + np.einsum("j,jgab->gab", theta, parts))
        e = (L @ rng.standard_normal((count, d, 1)))[..., 0]
        out.append(Block(A @ z + e, A, fixed, parts))
    return out


def dense(blocks: list[Block]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Residuals, derivative, fixed covariance and parts, as one big system."""
    from scipy.linalg import block_diag

    r = np.concatenate([b.r.ravel() for b in blocks])
    A = np.concatenate([b.A.reshape(-1, b.A.shape[2]) for b in blocks])
    fixed = block_diag(*(x for b in blocks for x in b.fixed))
    parts = np.array([block_diag(*(x for b in blocks for x in b.parts[j])) for j in range(3)])
    return r, A, fixed, parts


def deviance(theta, r, A, fixed, parts, prior=None) -> float:
    """-2 log of the likelihood of the residual contrasts, from any basis of them.

    With priors, of everything: then the unknowns are random.
    """
    V = fixed + np.einsum("j,jab->ab", theta, parts)
    if prior is None:
        K = np.linalg.svd(A)[0][:, A.shape[1] :]
        V, r = K.T @ V @ K, K.T @ r
    else:
        C = np.linalg.inv(prior.J.T @ prior.J)
        V = V + A @ C @ A.T
        r = r - A @ C @ prior.J.T @ prior.e
    return float(np.linalg.slogdet(V)[1] + r @ np.linalg.solve(V, r))


@pytest.mark.parametrize("with_prior", [False, True])
def test_components_maximise_the_restricted_likelihood(with_prior):
    theta = np.array([0.5, 0.2, 0.8])
    rng = np.random.default_rng(1)
    made = blocks(rng, theta, (15, 6))
    prior = None
    if with_prior:
        prior = Prior(np.diag([1.0, 2.0, 0.5, 3.0, 1.0]), 0.1 * rng.standard_normal(5))
    found = variance_components(made, np.ones(3), prior)
    assert found.settled
    system = dense(made)
    best = minimize(
        lambda x: deviance(np.exp(x), *system, prior), np.log(found.theta * 1.1),
        method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-10, "maxiter": 2000},
    )  # fmt: skip
    np.testing.assert_allclose(found.theta, np.exp(best.x), rtol=1e-4)
    # information against second differences of the likelihood, on the average over the noise
    A, V = system[1], system[2] + np.einsum("j,jab->ab", found.theta, system[3])
    information = A.T @ np.linalg.solve(V, A)
    if prior is not None:
        information += prior.J.T @ prior.J
    P = np.linalg.inv(V)
    P -= P @ A @ np.linalg.solve(information, A.T @ P)
    F = 0.5 * np.einsum("jab,kba->jk", P @ system[3], P @ system[3], optimize=True)
    np.testing.assert_allclose(found.information, F, rtol=1e-8)


def test_components_are_unbiased_and_their_errors_right():
    theta = np.array([0.5, 0.2, 0.8])
    found = [
        variance_components(blocks(np.random.default_rng(1000 + seed), theta), np.ones(3))
        for seed in range(100)
    ]
    assert all(x.settled for x in found)
    estimates = np.array([x.theta for x in found])
    np.testing.assert_allclose(estimates.mean(axis=0), theta, rtol=0.12)
    stated = np.sqrt(np.mean([x.standard_errors**2 for x in found], axis=0))
    np.testing.assert_allclose(stated, estimates.std(axis=0, ddof=1), rtol=0.25)


def test_a_component_that_is_not_there_is_zero():
    zero = 0
    for seed in range(20):
        made = blocks(np.random.default_rng(seed), np.array([0.5, 0.0, 0.8]))
        found = variance_components(made, np.ones(3))
        assert found.settled
        assert found.theta[1] < 3 * found.standard_errors[1]
        zero += found.theta[1] == 0.0
    assert 3 <= zero <= 17  # half of them, were it not bounded, would be negative


def test_components_that_look_the_same_have_no_errors_of_their_own():
    made = [
        replace(b, parts=b.parts[[0, 1, 1]]) for b in blocks(np.random.default_rng(3), np.ones(3))
    ]
    found = variance_components(made, np.ones(3))
    assert np.isfinite(found.standard_errors[0])
    assert np.isinf(found.standard_errors[1:]).all()


def test_levels_are_found_and_the_answer_is_that_of_stated_ones():
    made = simulate("paper", 2, NOISE, groups=4, shots=20)
    seen, truth = made.observations, made.truth
    found = lc.calibrate(seen, initial=truth, options=options())
    assert found.fit.converged
    assert [level.name for level in found.fit.noise] == list(REAL)
    for level in found.fit.noise:
        assert level.low <= REAL[level.name] <= level.high
        assert level.low <= level.value <= level.high
    px, m, rad = (level.value for level in found.fit.noise)
    assert found.fit.sigma0 == pytest.approx(px, rel=1e-3)
    told = lc.calibrate(
        seen, initial=truth,
        options=options(estimate_noise=(), sigma_px=px, hand_sigma_m=m, hand_sigma_rad=rad),
    )  # fmt: skip
    assert told.fit.sigma0 == pytest.approx(1.0, abs=1e-3)
    assert distance_in_sigmas(told, found) < 1e-3
    for a, b in zip(told.parameters, found.parameters, strict=True):
        assert b.sigma == pytest.approx(a.sigma, rel=2e-3)
    used = found.options_used
    assert (used.hand_sigma_m, used.hand_sigma_rad, used.estimate_noise) == (m, rad, ())
    assert found.inputs.options.estimate_noise == HAND_NOISE_NAMES
    sentence = noise_sentence(found)
    assert "hand position" in sentence and "mm (" in sentence and "95 % intervals" in sentence


def test_what_is_stated_stays():
    made = simulate("paper", 4, NOISE)
    asked = options(
        estimate_noise=("hand_sigma_m",), sigma_px=1.0, hand_sigma_rad=REAL["hand_sigma_rad"]
    )
    found = lc.calibrate(made.observations, initial=made.truth, options=asked)
    assert [level.name for level in found.fit.noise] == ["hand_sigma_m"]
    assert found.options_used.hand_sigma_rad == REAL["hand_sigma_rad"]
    assert found.fit.noise[0].value == pytest.approx(1e-3, rel=0.4)
    # the pixels' own covariances are stated too
    own = replace(made.observations, cov_uv=np.tile(np.eye(2), (90, 1, 1)))
    same = lc.calibrate(own, initial=made.truth, options=replace(asked, sigma_px=None))
    assert same.fit.noise[0].value == pytest.approx(found.fit.noise[0].value, rel=1e-3)


def test_a_perfect_robot_is_found_to_be_one():
    made = simulate("paper", 5, Noise(0.3))
    found = lc.calibrate(made.observations, initial=made.truth, options=options())
    plain = lc.calibrate(made.observations, initial=made.truth, options=options(estimate_noise=()))
    assert distance_in_sigmas(plain, found) < 0.5
    assert found.fit.sigma0 == pytest.approx(plain.fit.sigma0, rel=0.15)
    assert found.fit.noise[1].low == 0.0 and found.fit.noise[2].low == 0.0
    assert any("hardly determined" in note for note in found.observability.notes)


def test_outliers_do_not_count_as_noise():
    made = simulate("paper", 6, NOISE)
    uv = made.observations.uv.copy()
    uv[[3, 40, 77]] += [[60.0, -40.0], [-70.0, 30.0], [50.0, 50.0]]
    spoiled = replace(made.observations, uv=uv)
    found = lc.calibrate(spoiled, initial=made.truth, options=options(robust="auto"))
    assert [k for k, spot in enumerate(found.spots) if spot.rejected] == [3, 40, 77]
    assert found.fit.noise[1].value == pytest.approx(1e-3, rel=0.4)


def test_one_plane_with_its_weak_priors():
    made = simulate("paper-1", 2, NOISE, groups=6)
    found = lc.calibrate(made.observations, initial=made.truth, options=options(known=made.known))
    assert found.fit.converged
    assert found.fit.noise[1].low <= 1e-3 <= found.fit.noise[1].high


def test_too_few_spots_are_refused():
    made = simulate("paper", 1, NOISE, groups=3, shots=2)
    with pytest.raises(lc.DataError, match="degrees of freedom, too few to estimate 3 noise lev"):
        lc.calibrate(made.observations, initial=made.truth, options=options())


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("hand_sigma_m", r"expected a tuple out of 'hand_sigma_m' .* a single name is written"),
        (("sigma_px",), "expected a tuple out of"),
        (("hand_sigma_m",), "hand_sigma_m is to be estimated, but also stated"),
    ],
)
def test_wrong_options(wrong, message):
    with pytest.raises(lc.DataError, match=message):
        lc.CalibrationOptions(estimate_noise=wrong, hand_sigma_m=1e-3)


def test_levels_go_through_files_and_the_command_line(tmp_path, capsys):
    made = simulate("paper", 7, NOISE)
    write_capture(
        tmp_path, made.observations, transform="T_base_hand", length="mm", rotation="quat_wxyz",
        with_spots=True,
    )  # fmt: skip
    head = tmp_path / "capture.yaml"
    text = head.read_text()
    said = "noise: {hand_translation_mm: 2, estimate: [hand_rotation_deg]}\n"
    head.write_text(text + said)
    stated = lc.load_capture(tmp_path).options()
    assert (stated.hand_sigma_m, stated.estimate_noise) == (0.002, ("hand_sigma_rad",))
    run = Cli(capsys)("calibrate", tmp_path, "--estimate-noise", "--distortion", "none")
    assert run.status == 0, run.err
    assert "Noise from the residuals" in " ".join(run.out.split())
    saved = lc.load_calibration(tmp_path / "calibration.json")
    assert [level.name for level in saved.fit.noise] == list(REAL)
    assert all(isinstance(level, NoiseLevel) for level in saved.fit.noise)
    head.write_text(text + "noise: {hand_translation_mm: 2, estimate: [hand_translation_mm]}\n")
    with pytest.raises(lc.DataError, match=r"noise\.estimate: hand_translation_mm .* also stated"):
        lc.load_capture(tmp_path)
    head.write_text(text + "noise: {estimate: [pixel]}\n")
    with pytest.raises(lc.DataError, match=r"noise\.estimate"):
        lc.load_capture(tmp_path)


def test_a_running_calibration_goes_on_with_the_levels_found():
    made = simulate("paper", 8, NOISE)
    seen = made.observations
    first = lc.calibrate(seen[:60], initial=made.truth, options=options())
    running = lc.IncrementalCalibrator(first)
    running.add(seen[60:])
    told = running.calibration.inputs.options
    assert told.hand_sigma_m == first.fit.noise[1].value and told.estimate_noise == ()
    assert lc.judge(first).grade == "good"
