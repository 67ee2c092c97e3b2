"""How near detected centres come to the truth, and whether their covariances say so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detect_cases import PLAIN, run

from lasercal_gtsam.detect import DetectionOptions
from lasercal_gtsam.simulate.render import RenderOptions

# limits: what the pipeline's design was measured to reach, with room for the statistics of n = 40
CASES = {
    "sigma 0.5 px": ({"psf_sigma_px": 0.0}, {"sigma": 0.5}, 0.025),
    "sigma 2.5 px": ({}, {}, 0.025),
    "sigma 9 px": ({}, {"sigma": 9.0, "size": (128, 128)}, 0.02),
    "axes 4 to 1": ({}, {"sigma": 1.5, "ratio": 4.0, "size": (96, 96)}, 0.025),
    "weak": ({"spot_level": 0.05}, {}, 0.11),
    "16 bit, weak": ({"spot_level": 0.05, "bits": 16}, {}, 0.11),
    "speckle": (
        {"speckle_contrast": 0.3, "speckle_grain_px": 2.0, "spot_level": 0.35},
        {"sigma": 3.0},
        0.13,
    ),
    "strong speckle": (
        {"speckle_contrast": 0.6, "speckle_grain_px": 2.0, "spot_level": 0.25},
        {},
        0.27,
    ),
    "full speckle": ({"speckle_contrast": 1.0, "spot_level": 0.15}, {}, 0.27),
    "texture": ({"texture": 0.1, "ambient_level": 0.3}, {}, 0.03),
    "ambient gradient": (
        {"ambient_level": 0.3, "ambient_gradient": 0.6},
        {"size": (256, 256)},
        0.03,
    ),
    "flicker and jitter": (
        {"texture": 0.1, "ambient_level": 0.3, "flicker": 0.03, "jitter_px": 0.2},
        {"size": (128, 128)},
        0.04,
    ),
    "shifted skirt": ({"skirt_fraction": 0.1, "skirt_shift": 1.5}, {}, 0.04),
    "3 x saturated": ({"spot_level": 3.0}, {}, 0.03),
    "30 x saturated": ({"spot_level": 30.0}, {}, 0.03),
    "3 x saturated, shifted skirt": (
        {"spot_level": 3.0, "skirt_fraction": 0.1, "skirt_shift": 1.5},
        {"size": (96, 96)},
        0.12,
    ),
    "30 x saturated, shifted skirt": (
        {"spot_level": 30.0, "skirt_fraction": 0.1, "skirt_shift": 1.5},
        {"size": (128, 128)},
        0.25,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_centres_come_as_near_as_measured(name):
    render, spots, limit = CASES[name]
    outcome = run(replace(PLAIN, **render), 40, **spots)
    assert outcome.used.all(), [d.reason for d in outcome.detections if not d.usable]
    assert outcome.rms < limit
    assert outcome.worst < 5 * limit


def test_bright_clean_spot_reaches_the_bound_of_its_photons():
    # Poisson: var = sigma^2 / electrons for a spot without background, in each axis
    options = replace(PLAIN, bits=16, ambient_level=0.0, read_noise_e=1.0, full_well_e=2000.0)
    outcome = run(options, 60, sigma=2.0)
    sigma2 = 2.0**2 + 0.5**2 + 1 / 12
    electrons = 0.6 * 2000 * 2 * np.pi * 2.0**2
    bound = np.sqrt(sigma2 / electrons)
    assert 0.8 * bound < outcome.rms < 1.5 * bound


@pytest.mark.parametrize(
    ("render", "spots"),
    [
        ({"spot_level": 0.05}, {}),
        ({"speckle_contrast": 0.2}, {}),
        ({"speckle_contrast": 0.2, "speckle_grain_px": 2.0}, {}),
        ({"speckle_contrast": 0.4, "spot_level": 0.4}, {}),
        ({"speckle_contrast": 0.4, "spot_level": 0.4, "speckle_grain_px": 2.0}, {}),
        ({"speckle_contrast": 0.4, "spot_level": 0.1}, {}),
        ({"speckle_contrast": 0.4, "spot_level": 0.4}, {"sigma": 2.0, "ratio": 2.5}),
        ({"speckle_contrast": 0.4, "spot_level": 0.4}, {"sigma": 5.0, "size": (96, 96)}),
        (
            {"speckle_contrast": 0.3, "spot_level": 0.4, "texture": 0.1, "ambient_level": 0.25},
            {},
        ),
    ],
)
def test_covariances_are_honest(render, spots):
    outcome = run(replace(PLAIN, **render), 80, **spots)
    assert 0.7 < np.mean(outcome.nees) < 3.5  # 2 is right; heavy tails raise the mean
    assert outcome.inside95 >= 0.86


def test_covariance_has_the_direction_of_an_elongated_spot():
    # speckle: the error along the long axis is larger by about the ratio of the axes
    options = replace(PLAIN, speckle_contrast=0.4, spot_level=0.4)
    outcome = run(options, 40, sigma=2.0, ratio=3.0, size=(96, 96))
    for d in outcome.detections:
        major = np.array([np.cos(d.angle_rad), np.sin(d.angle_rad)])
        minor = np.array([-major[1], major[0]])
        assert major @ d.cov_uv @ major > 2 * minor @ d.cov_uv @ minor
        assert d.sigma_major / d.sigma_minor == pytest.approx(3.0, rel=0.35)


def test_a_clipped_spot_has_a_larger_covariance():
    clear = run(replace(PLAIN, spot_level=0.8), 10)
    clipped = run(replace(PLAIN, spot_level=3.0), 10)
    assert min(d.cov_uv[0, 0] for d in clipped.detections) > 10 * max(
        d.cov_uv[0, 0] for d in clear.detections
    )
    assert all(d.n_saturated > 20 for d in clipped.detections)
    assert all(d.n_saturated == 0 for d in clear.detections)


def test_printed_edge_under_the_spot_is_divided_out():
    from detect_cases import ellipse

    from lasercal_gtsam.detect import detect_spot
    from lasercal_gtsam.simulate.render import Scene, make_scene, render_pair

    options = replace(PLAIN, ambient_level=0.3, bits=16, spot_level=0.4)
    rng = np.random.default_rng(4)
    scene = make_scene((64, 64), options, rng)
    x = np.arange(64) - 32.0
    edge = np.broadcast_to(0.7 - 0.3 * np.tanh(x), (64, 64)).astype(np.float32)
    printed = Scene(edge, scene.ambient * edge, scene.gain)
    errors: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(10):
        uv = np.array([32.0, 32.0]) + rng.uniform(-1, 1, 2)
        on, off = render_pair(uv, ellipse(2.5, 1.0, 0.0), printed, options, rng)
        for divide, found in errors.items():
            d = detect_spot(on, off, DetectionOptions(divide_albedo=divide))
            found.append(float(np.hypot(*(d.uv - uv))))
    assert max(errors[True]) < 0.15
    assert min(errors[False]) > 0.3


@pytest.mark.slow
def test_random_mixture_is_accurate_and_honest():
    rng = np.random.default_rng(12)
    rms, nees = [], []
    for k in range(400):
        options = RenderOptions(
            bits=int(rng.choice([8, 16])),
            spot_level=float(np.exp(rng.uniform(np.log(0.15), np.log(3.0)))),
            speckle_contrast=rng.uniform(0.1, 0.6),
            speckle_grain_px=rng.uniform(1.0, 2.0),
            skirt_fraction=rng.uniform(0.0, 0.06),
            patches=0,
            highlights=0,
            ghost_probability=0.0,
        )
        outcome = run(options, 1, sigma=(1.3, 4.0), ratio=(1.0, 2.0), size=(128, 128), seed=k)
        rms += list(outcome.errors.ravel())
        nees += list(outcome.nees)
    assert len(nees) > 390
    assert np.sqrt(np.mean(np.square(rms))) < 0.17
    assert np.mean(np.array(nees) < 5.991) > 0.92


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "table2-2", "tool-z", "no-groups"])
def test_pictures_of_simulated_cells(preset):
    from lasercal_gtsam.detect import detect_spot
    from lasercal_gtsam.simulate.pictures import render_pictures
    from lasercal_gtsam.simulate.simulation import simulate

    errors, nees, taken, count = [], [], 0, 0
    for seed in range(3):
        for shot in render_pictures(simulate(preset, seed)):
            found = detect_spot(shot.on, shot.off)
            count += 1
            if found.usable:
                taken += 1
                error = found.uv - shot.uv
                errors.append(error)
                nees.append(error @ np.linalg.solve(found.cov_uv, error))
    distances = np.hypot(*np.array(errors).T)
    assert taken > 0.9 * count
    assert np.sqrt(np.mean(distances**2)) < 0.25
    assert distances.max() < 2.0
    assert np.mean(np.array(nees) < 5.991) > 0.85
