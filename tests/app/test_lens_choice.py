"""``distortion="auto"``: the terms that the spots can carry, and the reason."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from core_cases import distance_in_sigmas, moved_intrinsics, simulated

import lasercal_gtsam as lc
from lasercal_gtsam.lens_choice import corrected_akaike
from lasercal_gtsam.simulate import Noise, simulate, simulate_cell

TERMS = ("k1", "k2", "p1", "p2")


def estimated(result, prefix=""):
    return tuple(t for t in TERMS if result[prefix + t].sigma > 0)


def note_of(result):
    return next(n for n in result.observability.notes if n.startswith("distortion"))


def auto(observations, initial=None, **options):
    return lc.calibrate(
        observations, initial=initial, options=lc.CalibrationOptions(distortion="auto", **options)
    )


def lens(preset, seed, pixel_px, **terms):
    """A preset with another lens, its spots made by that lens."""
    made = simulate(preset, seed, Noise(pixel_px=pixel_px))
    cell = moved_intrinsics(made.truth, **{t: terms.get(t, 0.0) for t in TERMS})
    count = len(made.observations) // (10 * len(cell.planes))
    return simulate_cell(cell, groups=count, seed=seed, noise=Noise(pixel_px=pixel_px))


def test_the_criterion_is_that_of_the_textbook():
    """Against the sum of log likelihood and penalty, written out for a normal sample."""
    rng = np.random.default_rng(0)
    e = rng.standard_normal(40)
    n, p, S = len(e), 3, float(e @ e)
    log_likelihood = -0.5 * n * (math.log(2 * math.pi * S / n) + 1)
    k = p + 1
    textbook = -2 * log_likelihood + 2 * k + 2 * k * (k + 1) / (n - k - 1)
    ours = corrected_akaike(S, n, p)
    other = corrected_akaike(1.2 * S, n, 1)
    k = 2
    log_likelihood -= 0.5 * n * math.log(1.2)
    textbook_other = -2 * log_likelihood + 2 * k + 2 * k * (k + 1) / (n - k - 1)
    assert ours - other == pytest.approx(textbook - textbook_other, abs=1e-9)
    assert corrected_akaike(S, 10, 8) == math.inf


@pytest.mark.parametrize(
    ("terms", "expected"),
    [
        ({}, ()),
        ({"k1": -0.3}, ("k1",)),
        ({"k1": -0.55, "k2": 1.1}, ("k1", "k2")),
        ({"k1": -0.3, "p1": 0.02, "p2": -0.02}, ("k1", "p1", "p2")),
        ({"k1": -0.55, "k2": 1.1, "p1": 0.02, "p2": -0.02}, TERMS),
    ],
)
def test_clear_terms_are_chosen_and_the_others_left_out(terms, expected):
    made = lens("paper", 4, 0.1, **terms)
    result = auto(made.observations)
    assert result.fit.converged
    assert estimated(result) == expected
    for term in set(TERMS) - set(expected):
        assert (result[term].refined, result[term].sigma) == (0.0, 0.0)
    name = " ".join(expected) or "no term"
    assert note_of(result).startswith(f"distortion: {name} chosen, with the least AICc")
    assert ("left out" in note_of(result)) == (expected != TERMS)
    # what comes out is the fit of those terms, to the last digits
    direct = lc.calibrate(
        made.observations, options=lc.CalibrationOptions(distortion=expected or "none")
    )
    assert distance_in_sigmas(result, direct) < 1e-3
    assert result.fit.dof == direct.fit.dof
    assert result.inputs.options.distortion == "auto"


def test_exact_spots_choose_the_lens_that_made_them():
    for preset, expected in (("paper", ()), ("paper-distorted", ("k1", "k2"))):
        made = simulated(preset, 1)
        result = auto(made.observations)
        assert estimated(result) == expected
        assert result["fu"].refined == pytest.approx(550.0, abs=1e-6)


def test_one_plane_drops_the_priors_of_the_terms_left_out():
    straight = moved_intrinsics(simulated("tool-z").truth, k1=0.0, k2=0.0)
    made = simulate_cell(straight, groups=6, design="table", seed=0, noise=Noise(pixel_px=0.5))
    result = auto(made.observations)
    assert estimated(result) == ()
    direct = lc.calibrate(made.observations, options=lc.CalibrationOptions(distortion="none"))
    assert distance_in_sigmas(result, direct) < 1e-3


@pytest.mark.parametrize("robust", ["none", "huber", "gnc-tls"])
def test_every_way_with_outliers_chooses_on_the_spots_that_fit(robust):
    made = lens("paper", 5, 0.3, k1=-0.3)
    uv = made.observations.uv.copy()
    if robust != "none":
        uv[[3, 40, 77]] = [[20.0, 30.0], [600.0, 20.0], [300.0, 470.0]]
    result = auto(replace(made.observations, uv=uv), robust=robust)
    assert estimated(result) == ("k1",)
    if robust == "gnc-tls":
        assert [k for k, spot in enumerate(result.spots) if spot.rejected] == [3, 40, 77]


def test_a_noisy_robot_is_taken_for_one():
    truth = moved_intrinsics(simulated("paper", 6).truth, k1=-0.3)
    noise = Noise(pixel_px=0.3, hand_translation_m=3e-4, hand_rotation_rad=3e-4)
    made = simulate_cell(truth, groups=3, seed=6, noise=noise)
    result = auto(
        made.observations, sigma_px=0.3, hand_sigma_m=3e-4, hand_sigma_rad=3e-4, robust="none"
    )
    assert estimated(result) == ("k1",)
    assert 0.8 < result.fit.sigma0 < 1.2


def test_what_is_known_fixed_or_has_a_prior_is_no_matter_of_choice():
    made = lens("paper", 7, 0.3, k1=-0.3)
    known = auto(made.observations, known={"k1": -0.3})
    assert known["k1"].refined == -0.3
    assert "none" not in note_of(known) and "k1" not in note_of(known).split("chosen")[0]
    prior = auto(made.observations, priors={"k2": (0.0, 0.2)})
    assert set(estimated(prior)) == {"k1", "k2"}
    assert any(word.startswith("prior k2") for word in prior.observability.held)
    fixed = auto(made.observations, initial=made.truth, fixed=("distortion",))
    assert estimated(fixed) == ()
    assert fixed["k1"].refined == -0.3
    assert not [n for n in fixed.observability.notes if n.startswith("distortion")]


def test_terms_left_out_stay_at_the_given_start():
    made = lens("paper", 8, 0.3, k1=-0.3)
    result = auto(made.observations, initial=made.truth)
    assert result["k1"].refined == -0.3
    assert estimated(result) == ()


def test_every_camera_chooses_for_itself():
    base = simulated("paper", 9).truth
    camera = base.cameras["camera"]
    bent = replace(camera, intrinsics=replace(camera.intrinsics, k1=-0.4))
    straight = simulate_cell(base, groups=3, seed=9, noise=Noise(pixel_px=0.3)).observations
    cell = replace(base, cameras={"camera": bent})
    other = simulate_cell(cell, groups=3, seed=10, noise=Noise(pixel_px=0.3)).observations
    seen = lc.Observations.from_arrays(
        np.concatenate([straight.uv, other.uv]),
        np.concatenate([straight.T_base_hand, other.T_base_hand]),
        plane=[*straight.plane.tolist(), *other.plane.tolist()],
        camera=["left"] * len(straight) + ["right"] * len(other),
        image_size={"left": (640, 480), "right": (640, 480)},
    )
    result = auto(seen)
    assert estimated(result, "left.") == ()
    assert estimated(result, "right.") == ("k1",)
    notes = [n for n in result.observability.notes if n.startswith("distortion of camera")]
    assert len(notes) == 2


def test_too_few_spots_for_all_terms_still_get_an_answer():
    """All four terms leave no degrees of freedom to judge by; fewer do."""
    made = lens("paper-2", 11, 0.2)
    rows = np.linspace(0, len(made.observations) - 1, 15).astype(int)
    seen = made.observations[rows]
    result = auto(seen, initial=made.truth, robust="none")
    assert result.fit.converged
    assert set(estimated(result)) < set(TERMS)


def test_the_result_can_be_checked_saved_and_continued(tmp_path):
    made = lens("paper", 12, 0.5, k1=-0.3)
    result = auto(made.observations)
    result.save(tmp_path / "c.json")
    again = lc.load_calibration(tmp_path / "c.json")
    assert again.observability == result.observability
    assert again.options_used.distortion == "all"
    assert again.options_used.known == {f"camera.{t}": 0.0 for t in ("k2", "p1", "p2")}
    verdict = lc.judge(again)
    assert "weak-distortion" not in [reason.code for reason in verdict.reasons]
    check = lc.check_sigma(again, trials=20)
    assert {row.name for row in check.rows} >= {"fu", "k1"}
    assert "k2" not in {row.name for row in check.rows}
    # a running calibration keeps the terms that it began with
    options = lc.CalibrationOptions(distortion="auto")
    calibrator = lc.IncrementalCalibrator(None, options)
    order = np.random.default_rng(0).permutation(len(made.observations))
    calibrator.add(made.observations[order])
    assert estimated(calibrator.calibration) == ("k1",)
    more = simulate_cell(made.truth, groups=3, seed=13, noise=Noise(pixel_px=0.5), prefix="m")
    calibrator.add(more.observations)
    assert estimated(calibrator.calibration) == ("k1",)
    assert calibrator.calibration.fit.converged
