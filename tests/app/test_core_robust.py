"""Gross outliers are found, named and left out; clean data stay as they are."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from core_cases import distance_in_sigmas, simulated

import lasercal_gtsam as lc
from lasercal_gtsam.random_parts import parts_of
from lasercal_gtsam.robust import FALSE_ALARM, rejection_length, robust_scale
from lasercal_gtsam.simulate import Noise, simulate


def spoiled(observations, wrong, how="anywhere", seed=0):
    """The spots ``wrong`` (indices) moved: anywhere in the picture, or all by the same step."""
    rng = np.random.default_rng(seed)
    uv = observations.uv.copy()
    if how == "anywhere":
        uv[wrong] = rng.uniform([0, 0], [639, 479], (len(wrong), 2))
    else:
        uv[wrong] += [60.0, -25.0]
    return replace(observations, uv=uv)


def choose(count, share, seed):
    number = max(1, round(share * count))
    return np.sort(np.random.default_rng(100 + seed).choice(count, number, replace=False))


def test_parts_of_few_spots_leave_out_every_spot_equally_often():
    """So a lonely outlier is outside of some part, however few spots there are."""
    simulation = simulate("paper-1", 0, groups=3, shots=4)
    seen = []

    def closed_form(part):
        seen.append(part.id)
        return simulation.truth

    sizes = [size for _, size in islice(parts_of(simulation.observations, closed_form, 0), 12)]
    assert sizes == [10] * 12
    for first in (0, 6):
        inside = np.concatenate(seen[first : first + 6])
        names, times = np.unique(inside, return_counts=True)
        assert len(names) == 12
        assert set(times) == {5}


def without(observations, wrong):
    return observations[np.setdiff1d(np.arange(len(observations)), wrong)]


def assert_as_without(result, clean, wrong):
    assert result.fit.converged, result.fit.status
    named = [k for k, spot in enumerate(result.spots) if spot.rejected]
    assert named == wrong.tolist()
    assert distance_in_sigmas(clean, result) < 1e-4
    assert result.fit.n_rejected == len(wrong)
    assert result.fit.n_spots == len(result.spots) - len(wrong)
    assert result.fit.rms_px == pytest.approx(clean.fit.rms_px, rel=1e-6)
    assert result.fit.sigma0 == pytest.approx(clean.fit.sigma0, rel=1e-6)
    sigmas = [[p.sigma for p in one.parameters] for one in (result, clean)]
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=1e-4)
    for k, spot in enumerate(result.spots):
        assert spot.weight == (0.0 if k in named else 1.0)
        assert (
            spot.rejected is None or "sigma, limit" in spot.rejected or "no spot" in spot.rejected
        )
    assert f"{len(wrong)} rejected as outliers" in result.fit.status


@pytest.mark.parametrize("share", [0.01, 0.05, 0.1, 0.2, 0.3])
@pytest.mark.parametrize("preset", ["paper", "table2-4", "no-groups"])
def test_with_a_start_the_rest_is_as_if_they_had_not_been_there(preset, share):
    simulation = simulated(preset, 4, 0.5)
    wrong = choose(len(simulation.observations), share, 1)
    result = lc.calibrate(spoiled(simulation.observations, wrong), initial=simulation.truth)
    clean = lc.calibrate(
        without(simulation.observations, wrong),
        initial=simulation.truth,
        options=lc.CalibrationOptions(robust="none"),
    )
    assert_as_without(result, clean, wrong)


@pytest.mark.parametrize(
    ("preset", "share"), [("paper", 0.04), ("paper-2", 0.1), ("table2-2", 0.05)]
)
def test_without_a_start_too(preset, share):
    simulation = simulated(preset, 4, 0.5)
    wrong = choose(len(simulation.observations), share, 2)
    known = {"known": simulation.known}
    result = lc.calibrate(
        spoiled(simulation.observations, wrong), options=lc.CalibrationOptions(**known)
    )
    clean = lc.calibrate(
        without(simulation.observations, wrong),
        options=lc.CalibrationOptions(robust="none", **known),
    )
    assert_as_without(result, clean, wrong)


@pytest.mark.parametrize("kind", ["gross", "ghost"])
def test_two_fifths_of_outliers_without_a_start(kind):
    """Anywhere, or the same reflection again and again; every one named, no other."""
    simulation = simulated("paper", 4, 1.0)
    wrong = choose(90, 0.4, 2)
    seen = simulation.observations
    if kind == "ghost":
        uv = seen.uv.copy()
        uv[wrong] = np.random.default_rng(1).normal([210.0, 330.0], 1.0, (len(wrong), 2))
        seen = replace(seen, uv=uv)
    else:
        seen = spoiled(seen, wrong)
    clean = lc.calibrate(
        without(simulation.observations, wrong),
        initial=simulation.truth,
        options=lc.CalibrationOptions(robust="none"),
    )
    assert_as_without(lc.calibrate(seen), clean, wrong)


@pytest.mark.parametrize(("share", "started"), [(0.1, True), (0.2, True), (0.2, False)])
def test_ghosts_that_agree_with_each_other_do_not_win(share, started):
    """No residual stands out of the plain fit, but they are not as residuals are."""
    simulation = simulated("paper", 6, 0.5)
    wrong = choose(90, share, 3)
    seen = spoiled(simulation.observations, wrong, "same step")
    result = lc.calibrate(seen, initial=simulation.truth if started else None)
    assert [k for k, spot in enumerate(result.spots) if spot.rejected] == wrong.tolist()
    assert result.fit.rms_px < 1.0


def test_small_outliers_are_found_where_the_noise_is_small():
    simulation = simulated("paper", 6, 0.1)
    uv = simulation.observations.uv.copy()
    uv[[3, 40]] += [[1.5, 0.0], [0.0, -2.0]]
    result = lc.calibrate(replace(simulation.observations, uv=uv), initial=simulation.truth)
    assert [k for k, spot in enumerate(result.spots) if spot.rejected] == [3, 40]
    assert all("sigma" in (result.spots[k].rejected or "") for k in (3, 40))


def test_clean_data_are_not_touched():
    for preset, seed, pixel in (("paper", 5, 1.0), ("table2-4", 5, 2.0), ("no-groups", 5, 0.3)):
        simulation = simulated(preset, seed, pixel)
        auto = lc.calibrate(simulation.observations)
        none = lc.calibrate(simulation.observations, options=lc.CalibrationOptions(robust="none"))
        assert auto.cell == none.cell
        assert auto.parameters == none.parameters
        assert auto.fit == none.fit
        np.testing.assert_array_equal(auto.covariance, none.covariance)
        assert not any(spot.rejected for spot in auto.spots)


def test_good_spots_are_rarely_rejected():
    """Promised: once in a thousand captures; 40 captures of 90 and of 30 spots."""
    rejected = 0
    for seed in range(40):
        for preset in ("paper", "paper-1"):
            simulation = simulate(preset, seed, Noise(pixel_px=1.0))
            options = lc.CalibrationOptions(known=simulation.known, distortion="none")
            result = lc.calibrate(
                simulation.observations, initial=simulation.truth, options=options
            )
            rejected += result.fit.n_rejected
    assert rejected <= 1


def test_the_limit_is_a_quantile_of_the_longest_residual():
    rng = np.random.default_rng(0)
    for count in (30, 90, 900):
        lengths = np.linalg.norm(rng.standard_normal((4000, count, 2)), axis=-1)
        scales = np.array([robust_scale(x, 0) for x in lengths])
        assert scales.mean() == pytest.approx(1.0, abs=0.02)
        alarms = np.mean(lengths.max(axis=1) > rejection_length(count) * scales)
        assert alarms <= 4 * FALSE_ALARM
        # and not so wide that nothing is found
        assert rejection_length(count) < 6.5


def test_robust_none_keeps_every_spot():
    simulation = simulated("paper", 4, 0.5)
    wrong = choose(90, 0.02, 1)
    result = lc.calibrate(
        spoiled(simulation.observations, wrong),
        initial=simulation.truth,
        options=lc.CalibrationOptions(robust="none", distortion="none"),
    )
    assert result.fit.n_rejected == 0
    assert result.fit.rms_px > 5.0


def test_a_plane_of_which_nothing_fits_is_named():
    simulation = simulated("paper", 4, 0.5)
    seen = simulation.observations
    wrong = np.flatnonzero(seen.plane == "2")
    with pytest.raises(lc.DegenerateError, match=r"plane '2'.*30 spots do not fit the rest"):
        lc.calibrate(spoiled(seen, wrong), initial=simulation.truth)


def test_spots_said_to_be_on_the_wrong_plane_are_found():
    simulation = simulated("paper", 4, 0.5)
    plane = simulation.observations.plane.copy()
    plane[[0, 1, 2, 3]] = "2"
    result = lc.calibrate(replace(simulation.observations, plane=plane), initial=simulation.truth)
    assert [k for k, spot in enumerate(result.spots) if spot.rejected] == [0, 1, 2, 3]


def test_where_no_half_fits_it_is_said():
    simulation = simulated("paper", 4, 0.5)
    rng = np.random.default_rng(0)
    uv = rng.uniform([0, 0], [639, 479], (90, 2))
    seen = replace(simulation.observations, uv=uv)
    try:
        result = lc.calibrate(seen, initial=simulation.truth)
    except lc.LasercalError as error:
        assert str(error)
    else:
        assert not result.fit.converged
        assert "no cell was found that half of the 90 spots fit" in result.fit.status


def test_outliers_beside_a_noisy_robot():
    """The lengths are judged with pixel and hand noise together."""
    noise = Noise(pixel_px=0.3, hand_translation_m=1e-3, hand_rotation_rad=np.radians(0.05))
    simulation = simulate("paper", 8, noise)
    options = {
        "sigma_px": 0.3, "hand_sigma_m": 1e-3, "hand_sigma_rad": float(np.radians(0.05)),
    }  # fmt: skip
    wrong = choose(90, 0.1, 4)
    result = lc.calibrate(
        spoiled(simulation.observations, wrong),
        initial=simulation.truth,
        options=lc.CalibrationOptions(**options),
    )
    clean = lc.calibrate(
        without(simulation.observations, wrong),
        initial=simulation.truth,
        options=lc.CalibrationOptions(robust="none", **options),
    )
    assert_as_without(result, clean, wrong)
    assert result.fit.sigma0 == pytest.approx(1.0, abs=0.25)


def test_outliers_found_without_a_start_are_the_same_every_time():
    simulation = simulated("paper-2", 4, 0.5)
    seen = spoiled(simulation.observations, choose(60, 0.03, 2))
    first, second = (lc.calibrate(seen) for _ in range(2))
    assert first == second


def test_held_distortion_is_freed_once_the_outliers_are_gone():
    """Outliers may make the full distortion implausible; the answer must not keep that."""
    simulation = simulated("table2-2", 2, 0.5)
    wrong = choose(60, 0.1, 5)
    options = lc.CalibrationOptions(known=simulation.known)
    result = lc.calibrate(spoiled(simulation.observations, wrong), options=options)
    assert result["k2"].sigma > 0
    assert not any("held at zero" in words for words in result.observability.held)
