"""The detector's parts against formulas of their own."""

from __future__ import annotations

import numpy as np
import pytest

from lasercal_gtsam.detect import gaussian
from lasercal_gtsam.detect.candidates import find_candidates
from lasercal_gtsam.detect.centre import cut_window, fit_spot
from lasercal_gtsam.detect.covariance import estimate_speckle, fit_covariance
from lasercal_gtsam.detect.difference import (
    Difference,
    clipped_sigma,
    noise_sigma,
    pair_difference,
    smooth_background,
)
from lasercal_gtsam.detect.region import Region, find_region

SHAPE = np.array([[6.0, 1.5], [1.5, 3.0]])
UV = np.array([20.3, 17.8])


def gaussian_light(uv, shape, amplitude, size):
    v, u = np.mgrid[: size[1], : size[0]].astype(float)
    d = np.stack([u - uv[0], v - uv[1]], axis=-1)
    return amplitude * np.exp(-0.5 * np.einsum("...i,ij,...j", d, np.linalg.inv(shape), d))


def region_of(uv, shape):
    return Region((0, 0, 1, 1), np.ones((1, 1), dtype=bool), 1, np.asarray(uv), shape)


@pytest.mark.parametrize("shape", [SHAPE, 0.4 * np.eye(2), np.diag([50.0, 2.0])])
def test_gaussian_is_the_quadratic_form_and_its_jacobian_the_difference_quotient(shape):
    p = gaussian.parameters(80.0, UV, shape, 3.0)
    np.testing.assert_allclose(gaussian.shape_of(p), shape, rtol=1e-12)
    light = gaussian_light(UV, shape, 80.0, (40, 36)) + 3.0
    v, u = np.mgrid[:36, :40].astype(float)
    value, J = gaussian.value_and_jacobian(p, u.ravel(), v.ravel())
    np.testing.assert_allclose(value, light.ravel(), rtol=1e-12)
    for k in range(gaussian.PARAMETERS):
        h = np.zeros(gaussian.PARAMETERS)
        h[k] = 1e-6 * max(abs(p[k]), 1.0)
        above = gaussian.value(p + h, u.ravel(), v.ravel())
        below = gaussian.value(p - h, u.ravel(), v.ravel())
        np.testing.assert_allclose(J[k], (above - below) / (2 * h[k]), atol=1e-5)


def test_fit_of_a_noise_free_spot_is_exact_from_a_poor_start():
    light = (gaussian_light(UV, SHAPE, 100.0, (40, 36)) + 5.0).astype(np.float32)
    start = region_of(UV + np.array([0.8, -0.7]), 1.5 * SHAPE + 0.3 * np.eye(2))
    spot = fit_spot(light, np.full(light.shape, 1e-4, dtype=np.float32), start)
    assert spot.settled
    np.testing.assert_allclose(spot.uv, UV, atol=1e-4)
    np.testing.assert_allclose(spot.shape, SHAPE, rtol=1e-4)
    assert spot.p[6] == pytest.approx(5.0, abs=1e-3)


def test_fit_stays_in_its_trust_region_where_there_is_no_spot():
    rng = np.random.default_rng(2)
    light = rng.normal(0, 1, (60, 60)).astype(np.float32)
    light += np.linspace(0, 50, 60, dtype=np.float32)  # a slope would pull a free fit away
    spot = fit_spot(light, np.ones_like(light), region_of([30.0, 30.0], 4 * np.eye(2)))
    assert np.hypot(*(spot.uv - 30.0)) <= 2.0 + 1e-9
    assert np.linalg.eigvalsh(spot.shape)[1] <= 4 * 2.5**2 * (1 + 1e-9)


def test_covariance_of_white_noise_is_the_cramer_rao_bound():
    # Fisher information of a Gaussian's centre: pi A^2 / (2 n^2) per axis for a circular spot
    amplitude, noise, sigma = 100.0, 10.0, 3.0
    rng = np.random.default_rng(1)
    errors, variances = [], []
    for _ in range(60):
        light = gaussian_light((24.0, 24.0), sigma**2 * np.eye(2), amplitude, (49, 49))
        light = (light + rng.normal(0, noise, light.shape)).astype(np.float32)
        variance = np.full(light.shape, noise**2, dtype=np.float32)
        spot = fit_spot(light, variance, region_of([24.0, 24.0], sigma**2 * np.eye(2)))
        errors.append(spot.uv - 24.0)
        variances.append(np.diag(fit_covariance(spot)))
    bound = noise / amplitude * np.sqrt(2 / np.pi)
    assert np.std(errors) == pytest.approx(bound, rel=0.15)
    # not below the bound, and not far above for want of knowing that there is no speckle
    assert bound < np.sqrt(np.median(variances)) < 1.6 * bound


def test_speckle_is_recognised_by_contrast_and_grain():
    import cv2

    rng = np.random.default_rng(7)
    contrast, spread = 0.3, 1.2  # autocovariance exp(-r^2 / (2 spread^2)): area 2 pi spread^2
    found = []
    for _ in range(30):
        field = cv2.GaussianBlur(rng.normal(size=(81, 81)), (0, 0), spread / np.sqrt(2))
        field *= contrast / field.std()
        light = gaussian_light((40.0, 40.0), 36 * np.eye(2), 100.0, (81, 81)) * (1 + field)
        light = light.astype(np.float32)
        variance = np.full(light.shape, 0.25, dtype=np.float32)
        spot = fit_spot(light, variance, region_of([40.0, 40.0], 36 * np.eye(2)))
        speckle = estimate_speckle(spot)
        found.append((speckle.contrast, speckle.grain))
    mean = np.median(found, axis=0)
    assert mean[0] == pytest.approx(contrast, rel=0.1)
    assert mean[1] == pytest.approx(2 * np.pi * spread**2, rel=0.25)


def test_noise_is_seen_through_slopes_outliers_and_coarse_steps():
    rng = np.random.default_rng(3)
    v, u = np.mgrid[:300, :400].astype(np.float32)
    image = (0.2 * u + 0.1 * v + rng.normal(0, 2.0, u.shape)).astype(np.float32)
    image[100:110, 50:60] += 500
    assert noise_sigma(image) == pytest.approx(2.0, rel=0.02)
    # integers with noise of half a step: a median deviation could only say 0 or 0.74
    coarse = np.rint(rng.normal(0, 0.5, (300, 400))).astype(np.float32)
    assert noise_sigma(coarse, 1.0) == pytest.approx(np.sqrt(0.25 + 1 / 12), rel=0.05)
    assert noise_sigma(np.zeros((50, 50), dtype=np.float32), 1.0) == pytest.approx(1 / np.sqrt(12))


def test_clipped_sigma_of_a_contaminated_sample():
    rng = np.random.default_rng(1)
    sample = rng.normal(0, 3.0, 20_000)
    sample[:400] = 100.0
    assert clipped_sigma(sample.astype(np.float32)) == pytest.approx(3.0, rel=0.03)
    assert clipped_sigma(np.zeros(100, dtype=np.float32)) == 0.0


def test_flicker_and_shift_are_taken_out_of_the_difference_and_the_spot_is_not():
    import cv2

    rng = np.random.default_rng(5)
    scene = 300 + 50 * cv2.GaussianBlur(rng.normal(size=(240, 320)), (0, 0), 3.0) / 0.09
    moved = cv2.warpAffine(
        scene, np.array([[1, 0, 0.15], [0, 1, -0.1]]), (320, 240), flags=cv2.INTER_CUBIC
    )
    spot = gaussian_light((150.0, 120.0), 9 * np.eye(2), 60.0, (320, 240))
    on = (1.02 * scene + spot + rng.normal(0, 0.5, scene.shape)).astype(np.float32)
    off = (moved + rng.normal(0, 0.5, scene.shape)).astype(np.float32)
    raw = (on - off - spot)[5:-5, 5:-5].std()
    left = (pair_difference(on, off, 0.0, 0.1, 0.01).light - spot)[5:-5, 5:-5].std()
    assert raw > 2.0
    assert left < 0.85  # 0.71 is the noise of the two frames


def test_background_ignores_spots_and_follows_the_lamp():
    v, u = np.mgrid[:240, :320].astype(np.float32)
    lamp = 50 + 0.1 * u + 0.05 * v
    spot = gaussian_light((160.0, 100.0), 16 * np.eye(2), 200.0, (320, 240)).astype(np.float32)
    left = smooth_background(lamp + spot) - lamp
    assert np.abs(left[40:-40, 40:-40]).max() < 2.0


def test_candidates_are_ranked_by_height_and_joined_where_they_touch():
    rng = np.random.default_rng(4)
    light = rng.normal(0, 1.0, (200, 300))
    light += gaussian_light((60.0, 50.0), 4 * np.eye(2), 60.0, (300, 200))
    light += gaussian_light((200.0, 120.0), 4 * np.eye(2), 100.0, (300, 200))
    light += gaussian_light((240.0, 40.0), 100 * np.eye(2), 20.0, (300, 200))  # wide: more flux
    difference = Difference(light.astype(np.float32), 1.0, 0.0, None, 1.0)
    ranked = find_candidates(difference, 7.0).ranked
    assert [(c.u // 10, c.v // 10) for c in ranked[:2]] == [(20, 12), (6, 5)]
    assert len(ranked) == 3
    assert abs(ranked[2].u - 240) < 10


def test_no_candidate_in_noise_alone():
    rng = np.random.default_rng(6)
    for _ in range(5):
        light = rng.normal(0, 1.0, (480, 640)).astype(np.float32)
        assert find_candidates(Difference(light, 1.0, 0.0, None, 1.0), 7.0).ranked == ()


def test_region_moments_are_those_of_the_gaussian():
    import cv2

    from lasercal_gtsam.detect.candidates import FINE, Candidate

    light = gaussian_light((100.4, 90.7), 6 * SHAPE, 100.0, (200, 180)).astype(np.float32)
    blurred = cv2.GaussianBlur(light, (0, 0), FINE)
    region = find_region(blurred, Candidate(100, 91, float(blurred.max())))
    np.testing.assert_allclose(region.centroid, (100.4, 90.7), atol=0.05)
    np.testing.assert_allclose(region.shape, 6 * SHAPE, rtol=0.08)
    # pi times the product of the semi-axes sigma sqrt(2 ln 5) of the blurred spot
    grown = 6 * SHAPE + FINE**2 * np.eye(2)
    expected = 2 * np.pi * np.log(5) * np.sqrt(np.linalg.det(grown))
    assert region.area == pytest.approx(expected, rel=0.03)


def test_region_larger_than_the_first_look_is_whole():
    import cv2

    from lasercal_gtsam.detect.candidates import FINE, Candidate

    light = gaussian_light((200.0, 150.0), 60.0**2 * np.eye(2), 100.0, (400, 300))
    blurred = cv2.GaussianBlur(light.astype(np.float32), (0, 0), FINE)
    region = find_region(blurred, Candidate(200, 150, float(blurred.max())))
    assert region.box[2] == pytest.approx(2 * 60 * np.sqrt(2 * np.log(5)), abs=3)


def test_window_holds_the_spot_and_stops_at_the_picture():
    light = np.zeros((40, 50), dtype=np.float32)
    window = cut_window(light, light + 1, np.array([2.0, 20.0]), 4 * np.eye(2))
    assert window.u.min() == 0
    assert window.u.max() <= 2 + 3.5 * np.sqrt(4 + (2 / 3.5) ** 2)
    assert window.light.shape == window.variance.shape == window.u.shape
    assert np.count_nonzero(window.inside) == len(window.u)
