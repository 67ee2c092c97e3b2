"""Levels, groups left out and halves: against simulation, and against solving again."""

from __future__ import annotations

import numpy as np
import pytest
from opinion_cases import calibrated, labels_of

from lasercal_gtsam.api import calibrate
from lasercal_gtsam.opinions.bench import lay_out
from lasercal_gtsam.opinions.groups import leave_groups_out
from lasercal_gtsam.opinions.levels import levels
from lasercal_gtsam.opinions.split import halves, split
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.simulate.noise import Noise
from lasercal_gtsam.simulate.simulation import simulate

QUIET = Noise(pixel_px=0.01)


def by_name(preset, seed, fault=None, **given):
    return {x.name: x for x in levels(lay_out(calibrated(preset, seed, fault, **given)))}


def test_what_is_expected_is_what_simulated_noise_leaves():
    found = [by_name("paper", seed, noise=QUIET, sigma_px=0.01) for seed in range(12)]
    for name in ("picture", "ray", "hand", "full"):
        seen = np.mean([x[name].rms_px ** 2 for x in found])
        expected = np.mean([x[name].expected_px ** 2 for x in found])
        # 12 times 71 degrees of freedom or more: 5 % of the variance at one sigma
        assert seen == pytest.approx(expected, rel=0.15), name
        parts = [p for x in found for p in x[name].parts if p.kind == "plane"]
        ratio = np.mean([p.rms_px**2 for p in parts]) / np.mean([p.expected_px**2 for p in parts])
        assert ratio == pytest.approx(1.0, abs=0.15), name


def test_every_level_loses_the_unknowns_it_frees():
    found = by_name("paper", 1)
    assert found["full"].dof == 2 * 90 - (15 + 4 + 9)
    # a length for each spot; the three unknowns of each plane then have nothing left to do
    assert found["ray"].dof == 2 * 90 - 90 - (15 + 4)
    assert {p.kind for p in found["full"].parts} == {"camera", "plane", "group"}
    assert sum(p.spots for p in found["full"].parts if p.kind == "group") == 90


@pytest.mark.parametrize(
    ("preset", "fault", "clean", "dirty"),
    [
        ("table2-3", "moved", {"ray"}, {"full"}),
        ("tool-z-2", "orientations", {"picture", "hand"}, {"full"}),
        ("table2-3", "scale-z", {"picture"}, {"full"}),
    ],
)
def test_the_jump_between_levels_tells_what_is_wrong(preset, fault, clean, dirty):
    found = by_name(preset, 3, fault, sigma_px=0.3)
    ratio = {name: x.rms_px / x.expected_px for name, x in found.items()}
    for name in clean:
        assert ratio[name] < 1.25, (name, ratio)
    for name in dirty:
        assert ratio[name] > 1.5, (name, ratio)
    assert all(found[name].chance < 1e-6 for name in clean)


def test_a_clean_capture_has_no_jump():
    chances = [x.chance for seed in range(5) for x in by_name("tool-z-2", seed).values()]
    assert min(chances) > 1e-3


def test_leaving_a_group_out_is_calibrating_without_it():
    calibration = calibrated("paper", 4, noise=QUIET)
    seen = calibration.inputs.observations
    labels = labels_of(seen)
    for group in leave_groups_out(lay_out(calibration))[::4]:
        rows = labels == labels[seen.id.tolist().index(group.first)]
        again = calibrate(seen[~rows], initial=calibration.cell, options=calibration.inputs.options)
        uv, cov = again.predict(seen.T_base_hand[rows], plane=group.plane)
        error = np.sqrt(np.mean(np.sum((uv - seen.uv[rows]) ** 2, axis=1)))
        assert group.rms_px == pytest.approx(error, rel=0.03)
        at_beam, _ = again.locate(uv, plane=group.plane)
        at_spot, _ = again.locate(seen.uv[rows], plane=group.plane)
        mm = 1000 * np.sqrt(np.mean(np.sum((at_beam - at_spot) ** 2, axis=1)))
        assert group.rms_mm == pytest.approx(mm, rel=0.05)
        noise = (again.fit.sigma0 / calibration.fit.sigma0) ** 2
        variance = np.trace(cov, axis1=1, axis2=2).mean() / noise + 2 * calibration.fit.sigma0**2
        assert group.expected_px == pytest.approx(np.sqrt(variance), rel=0.03)


def test_a_group_left_out_errs_as_expected():
    found = [
        g for seed in range(8) for g in leave_groups_out(lay_out(calibrated("table2-3", seed)))
    ]
    chances = np.array([g.chance for g in found])
    assert 0.35 < np.median(chances) < 0.65
    assert chances.min() > 1e-4
    ratio = np.mean([(g.rms_px / g.expected_px) ** 2 for g in found])
    assert ratio == pytest.approx(1.0, abs=0.35)


def test_halves_share_every_group():
    calibration = calibrated("table2-3", 2)
    seen, first = calibration.inputs.observations, halves(calibration)
    assert first.sum() == 30
    for g in np.unique(labels_of(seen)):
        assert first[labels_of(seen) == g].sum() == 5


def test_differences_of_halves_follow_their_sigmas():
    found = [split(calibrated("paper", seed, noise=QUIET)) for seed in range(10)]
    z = np.array([[row.sigmas for row in x.rows] for x in found])
    assert z.shape == (10, 28)
    assert np.mean(z**2) == pytest.approx(1.0, abs=0.35)
    assert np.mean([x.chi2 / x.dof for x in found]) == pytest.approx(1.0, abs=0.25)
    assert min(x.chance for x in found) > 1e-3
    assert 0.2 < np.median([x.chance for x in found]) < 0.8


def test_halves_of_two_different_cells_disagree():
    calibration = calibrated("table2-3", 2)
    seen, first = calibration.inputs.observations, halves(calibration)
    # the second half of the shots was taken with the picture shifted: no common cell
    uv = seen.uv + np.where(first[:, None], 0.0, [3.0, 0.0])
    other = type(seen).from_arrays(
        uv, seen.T_base_hand, plane=seen.plane.tolist(), image_size=seen.image_size, id=seen.id
    )
    mixed = calibrate(other, initial=calibration.cell, options=calibration.inputs.options)
    assert split(mixed).chance < 1e-12


def test_a_half_that_cannot_be_calibrated_is_said():
    calibration = calibrated("table2-3", 2)
    seen = calibration.inputs.observations
    few = calibrate(seen[::3], initial=calibration.cell, options=calibration.inputs.options)
    found = split(few)
    assert found.failure is not None
    assert "half" in found.failure
    assert found.rows == ()


def test_stated_robot_noise_does_not_fit_itself():
    """A level must not take its derivatives where the residuals have already moved the hand."""
    noise = Noise(0.03, 5e-5, 8.7e-5)
    made = simulate("paper-distorted", 1, noise)
    options = CalibrationOptions(
        sigma_px=noise.pixel_px,
        hand_sigma_m=noise.hand_translation_m,
        hand_sigma_rad=noise.hand_rotation_rad,
    )
    found = levels(lay_out(calibrate(made.observations, initial=made.truth, options=options)))
    plain = levels(lay_out(calibrate(made.observations, initial=made.truth)))
    assert [level.dof for level in found] == [level.dof for level in plain]
    for level in found:
        assert 0.75 < level.rms_px / level.expected_px < 1.25, level.name
        assert level.chance > 0.01, level.name
