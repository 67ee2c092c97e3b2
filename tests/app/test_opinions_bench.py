"""The calibration laid out: derivatives, whitening, and what is left of the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from opinion_cases import PIXELS, calibrated, capture

from lasercal_gtsam.api import calibrate
from lasercal_gtsam.cell import Plane
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.opinions.bench import lay_out
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.projection import project
from lasercal_gtsam.simulate.noise import Noise


def test_columns_are_the_derivative_of_the_prediction():
    bench = lay_out(calibrated("paper", 1))
    seen, cell, step = bench.observations, bench.cell, 1e-6

    def predicted(cell, T):
        return project(cell, T, plane=seen.plane.tolist())

    def whitened(pixels):
        return np.einsum("nij,nj->ni", bench.whitening, pixels)

    on = seen.plane == "2"
    plane = cell.planes["2"]
    far = cell.with_planes({**cell.planes, "2": Plane(plane.normal_base, plane.distance + step)})
    by_distance = (predicted(far, seen.T_base_hand) - predicted(cell, seen.T_base_hand)) / step
    np.testing.assert_allclose(
        bench.parts[on, :, 21], whitened(by_distance)[on], rtol=1e-3, atol=1.0
    )
    moved = np.array(seen.T_base_hand)
    moved[:, 1, 3] += step
    by_hand = (predicted(cell, moved) - predicted(cell, seen.T_base_hand)) / step
    np.testing.assert_allclose(bench.hand[:, :, 1], whitened(by_hand), rtol=1e-3, atol=1.0)


def test_residuals_are_predicted_minus_seen_at_the_optimum():
    calibration = calibrated("paper", 1)
    bench = lay_out(calibration)
    used = calibration.spots.weight > 0
    expected = calibration.spots.residual_px[used] / calibration.fit.sigma0
    np.testing.assert_allclose(bench.r.reshape(-1, 2), expected, atol=1e-9)
    lengths = np.linalg.norm(bench.A, axis=0)
    assert np.abs(bench.A.T @ bench.r / lengths).max() < 1e-3
    # in units of the estimated scale the residuals are as long as they must be
    assert bench.sse == pytest.approx(calibration.fit.dof, rel=1e-6)
    assert bench.dof == calibration.fit.dof


def test_stated_robot_noise_is_part_of_every_residual():
    noise = Noise(0.5, 0.001, np.deg2rad(0.05))
    seen, made = capture("paper", 2, noise=noise)
    options = CalibrationOptions(sigma_px=0.5, hand_sigma_m=0.001, hand_sigma_rad=np.deg2rad(0.05))
    bench = lay_out(calibrate(seen, initial=made.truth, options=options))
    assert bench.stated
    assert 0.8 < bench.unit < 1.25
    assert bench.sse == pytest.approx(bench.dof, rel=0.02)
    # nobody states the pixels: their sigma is found beside the hand's
    found = lay_out(calibrate(seen, initial=made.truth, options=replace(options, sigma_px=None)))
    assert found.sse == pytest.approx(found.dof, rel=0.02)


def test_priors_of_one_plane_count():
    bench = lay_out(calibrated("paper-1", 3))
    assert len(bench.r) == 2 * len(bench) + 5
    assert bench.sse == pytest.approx(bench.dof, rel=0.1)


def test_spots_that_were_left_out_are_left_out():
    calibration = calibrated("table2-3", 1)
    spots = calibration.spots
    weight = np.array(spots.weight)
    weight[:5] = 0.0
    bench = lay_out(replace(calibration, spots=replace(spots, weight=weight)))
    assert bench.observations.id.tolist() == spots.id[5:].tolist()


def test_refuses_what_nothing_checks():
    calibration = calibrated("paper", 1)
    fit = replace(calibration.fit, sigma0=float("nan"), dof=0.0)
    with pytest.raises(DataError, match="degrees of freedom"):
        lay_out(replace(calibration, fit=fit))
    assert PIXELS.pixel_px == pytest.approx(calibration.fit.sigma0, rel=0.25)
