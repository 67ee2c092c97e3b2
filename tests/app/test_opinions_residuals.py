"""Tests of the residuals and of faults: their size without a fault and their power with one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from opinion_cases import FAULTS, SCALE, calibrated
from scipy import stats

from lasercal_gtsam.opinions.bench import lay_out
from lasercal_gtsam.opinions.chances import anderson_darling, chi2_above, f_above, holm
from lasercal_gtsam.opinions.residual_tests import question_residuals
from lasercal_gtsam.opinions.suspects import accuse, culprit, rivals
from lasercal_gtsam.simulate.noise import Noise


@pytest.fixture(scope="module")
def bench():
    return lay_out(calibrated("paper", 1))


def with_noise(bench, noise):
    """The bench with residuals of this noise (2 N,) instead of its own."""
    return replace(bench, r=noise - bench.Q @ (bench.Q.T @ noise))


def test_chances_are_those_of_scipy():
    rng = np.random.default_rng(5)
    assert f_above(2.3, 4, 37) == pytest.approx(stats.f.sf(2.3, 4, 37))
    assert chi2_above(9.0, 4) == pytest.approx(stats.chi2.sf(9.0, 4))
    x = rng.standard_normal(60)
    z = np.sort((x - x.mean()) / x.std(ddof=1))
    i = np.arange(1, 61)
    logs = stats.norm.logcdf(z) + stats.norm.logsf(z[::-1])
    plain = -60 - np.mean((2 * i - 1) * logs)
    assert anderson_darling(x)[0] == pytest.approx(plain * (1 + 0.75 / 60 + 2.25 / 3600))


def test_holm_is_bonferroni_for_the_smallest_and_never_falls():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.9, 0.8]) == pytest.approx([1.0, 1.0])


def test_noise_passes_as_often_as_it_should(bench):
    rng = np.random.default_rng(11)
    draws = 400
    found = [
        question_residuals(with_noise(bench, rng.standard_normal(len(bench.r))))
        for _ in range(draws)
    ]
    for k, test in enumerate(found[0]):
        below = np.mean([x[k].chance < 0.05 for x in found])
        # 0.05 +- 4 sigma
        assert 0.01 < below < 0.095, (test.name, below)
    assert np.mean([min(t.corrected for t in x) < 0.05 for x in found]) < 0.09


def test_each_departure_is_found_by_its_test(bench):
    rng = np.random.default_rng(12)
    seen, count = bench.observations, len(bench)
    uv = (seen.uv - seen.uv.mean(axis=0)) / seen.uv.std(axis=0)
    # finer than any polynomial of the lens
    waves = np.stack([np.sin(5 * uv[:, 0]), np.cos(5 * uv[:, 1])], axis=1)
    drift = np.repeat(np.sin(np.arange(count) * 2 * np.pi / 5)[:, None], 2, axis=1)
    effects = {
        "neighbours": 2.0 * waves,
        "order": 1.5 * drift,
        "groups": 1.5 * rng.standard_normal((bench.group.max() + 1, 2))[bench.group],
    }
    for name, effect in effects.items():
        hits = 0
        for _ in range(20):
            noise = effect.ravel() + rng.standard_normal(2 * count)
            tests = {t.name: t for t in question_residuals(with_noise(bench, noise))}
            hits += tests[name].corrected < 0.01
        assert hits >= 16, (name, hits)
    hits = 0
    for _ in range(20):
        noise = rng.standard_t(2.0, 2 * count)
        tests = {t.name: t for t in question_residuals(with_noise(bench, noise))}
        hits += tests["normal"].corrected < 0.01
    assert hits >= 16


def test_noise_is_hardly_ever_blamed_on_anything(bench):
    rng = np.random.default_rng(13)
    smallest = []
    for _ in range(150):
        findings = accuse(with_noise(bench, rng.standard_normal(len(bench.r))))
        smallest.append(min(f.chance for f in findings))
        assert culprit(findings) is None
    # Bonferroni holds the whole family's chance at most at its level
    assert np.mean(np.array(smallest) < 0.05) < 0.1


@pytest.mark.parametrize("fault", sorted(set(FAULTS) - {"joint"}))
def test_the_right_part_is_named(fault):
    named = []
    for seed in range(5):
        findings = accuse(lay_out(calibrated("table2-3", seed, fault)))
        found = culprit(findings)
        named.append(None if found is None else (found.part, found.fault))
    right = sum(x == FAULTS[fault] for x in named)
    assert right >= (2 if fault == "bent" else 4), named
    assert sum(x not in (None, FAULTS[fault]) for x in named) <= 1, named


def test_a_joint_that_is_off_is_the_robots():
    for seed in range(5):
        findings = accuse(lay_out(calibrated("table2-3", seed, "joint")))
        kinds = {(f.part, f.fault) for f in (culprit(findings), *rivals(findings))}
        assert FAULTS["joint"] in kinds


def test_how_far_a_plane_moved_is_told():
    shifts = []
    for seed in range(4):
        named = culprit(accuse(lay_out(calibrated("tool-z-2", seed, "moved"))))
        if named is not None and named.unknowns == 1:
            shifts.append(named.shift_mm)
            assert named.name == "2"
    assert len(shifts) >= 2
    assert np.allclose(shifts, 2.0, atol=0.5), shifts


def test_the_scale_of_the_robot_as_a_whole_cannot_be_seen():
    """A cell of another size explains the same pictures, the beam's place in the hand included."""
    quiet = Noise(pixel_px=1e-3)
    plain, scaled = (calibrated("table2-3", 1, f, quiet) for f in (None, "scale"))
    assert scaled.fit.rms_px == pytest.approx(plain.fit.rms_px, rel=0.05)
    assert culprit(accuse(lay_out(scaled))) is None
    ratio = scaled.cell.planes["1"].distance / plain.cell.planes["1"].distance
    assert ratio == pytest.approx(1 / SCALE, rel=2e-4)
