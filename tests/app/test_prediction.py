"""`calibration.predict` and `.locate`: derivatives, and honest covariances by Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from lasercal_factors.beam import BeamFrame

import lasercal_gtsam as lc
from lasercal_gtsam.cell import Camera, Cell, Intrinsics, Plane
from lasercal_gtsam.prediction import CellUncertainty, locate, predict
from lasercal_gtsam.report_map import tangent_labels
from lasercal_gtsam.rotations import basis_of, make_pose, rotation_exp
from lasercal_gtsam.simulate import Noise, simulate


def moved(cell: Cell, d: np.ndarray) -> Cell:
    """A cell of one camera and one laser moved by tangent coordinates, step by step."""
    (camera,), (beam,) = cell.cameras.values(), cell.lasers.values()
    R, t = camera.T_base_camera[:3, :3], camera.T_base_camera[:3, 3]
    pose = make_pose(R @ rotation_exp(d[:3]), t + R @ d[3:6])
    intrinsics = Intrinsics.from_vector(camera.intrinsics.vector + d[6:15])
    frame = BeamFrame.from_line(beam.direction_hand, beam.point_hand)
    planes = {}
    for i, (name, plane) in enumerate(cell.planes.items()):
        e = d[19 + 3 * i : 22 + 3 * i]
        normal = plane.normal_base + basis_of(plane.normal_base) @ e[:2]
        planes[name] = Plane(normal, plane.distance + e[2])
    return Cell(
        {"camera": Camera(intrinsics, pose, camera.image_size)},
        {"laser": lc.Beam(*frame.line(d[15:19]))},
        planes,
    )


@pytest.fixture(scope="module")
def setting() -> tuple[Cell, lc.Observations]:
    made = simulate("paper-distorted", seed=3)
    (camera,) = made.truth.cameras.values()
    i = camera.intrinsics
    bent = Intrinsics(i.fu, i.fv, 2.0, i.u0, i.v0, i.k1, i.k2, 2e-3, -1e-3)
    cell = Cell(
        {"camera": Camera(bent, camera.T_base_camera, camera.image_size)},
        made.truth.lasers, made.truth.planes,
    )  # fmt: skip
    return cell, made.observations


def test_covariances_are_those_of_numerical_derivatives(setting) -> None:
    cell, observations = setting
    n = 19 + 3 * len(cell.planes)
    rng = np.random.default_rng(0)
    scale = np.r_[np.full(6, 1e-3), 2, 2, 0.5, 2, 2, 0.02, 0.02, 1e-3, 1e-3, np.full(n - 15, 1e-3)]
    root = scale[:, None] * rng.standard_normal((n, n)) / np.sqrt(n)
    known = CellUncertainty(cell, root @ root.T, tangent_labels(cell))
    T, uv = observations.T_base_hand[:5], observations.uv[:5]

    pixels, cov_px = predict(known, T, "1", "camera", "laser")
    points, cov_m = locate(known, uv, "1", "camera", 0.7)
    np.testing.assert_allclose(pixels, lc.project(cell, T, plane="1"), rtol=0, atol=1e-12)
    np.testing.assert_allclose(points, lc.spot_on_ray(cell, uv, plane="1"), rtol=0, atol=1e-15)

    J_px, J_m = np.empty((5, 2, n)), np.empty((5, 3, n))
    for k in range(n):
        h = np.zeros(n)
        h[k] = 1e-4 * scale[k]
        forward, backward = moved(cell, h), moved(cell, -h)
        difference = lc.project(forward, T, plane="1") - lc.project(backward, T, plane="1")
        J_px[:, :, k] = difference / (2 * h[k])
        difference = lc.spot_on_ray(forward, uv, plane="1") - lc.spot_on_ray(
            backward, uv, plane="1"
        )
        J_m[:, :, k] = difference / (2 * h[k])
    by_pixel = np.empty((5, 3, 2))
    for k in range(2):
        h = 1e-4 * np.eye(2)[k]
        difference = lc.spot_on_ray(cell, uv + h, plane="1") - lc.spot_on_ray(
            cell, uv - h, plane="1"
        )
        by_pixel[:, :, k] = difference / 2e-4
    expected = J_px @ known.covariance @ np.swapaxes(J_px, 1, 2)
    np.testing.assert_allclose(cov_px, expected, rtol=1e-5, atol=1e-5 * expected.max())
    expected = J_m @ known.covariance @ np.swapaxes(J_m, 1, 2)
    expected += 0.49 * by_pixel @ np.swapaxes(by_pixel, 1, 2)
    np.testing.assert_allclose(cov_m, expected, rtol=1e-5, atol=1e-5 * expected.max())


def test_honest_by_monte_carlo() -> None:
    """NEES of a predicted pixel and of a located point over 200 calibrations, 1 px, 90 spots."""
    options = lc.CalibrationOptions(distortion="none")
    nees_px, nees_m = [], []
    truth_run = simulate("paper", seed=1)
    T, uv = truth_run.observations.T_base_hand[7], truth_run.observations.uv[3]
    goal_px = lc.project(truth_run.truth, T[None], plane="1")[0]
    goal_m = lc.spot_on_ray(truth_run.truth, uv, plane="1")[0]
    exact = truth_run.observations
    for seed in range(200):
        rng = np.random.default_rng(seed)
        noisy = lc.Observations.from_arrays(
            exact.uv + rng.standard_normal(exact.uv.shape), exact.T_base_hand,
            plane=exact.plane.tolist(), image_size=(640, 480),
        )  # fmt: skip
        calibration = lc.calibrate(noisy, initial=truth_run.truth, options=options)
        pixel, cov = calibration.predict(T, plane="1")
        e = pixel[0] - goal_px
        nees_px.append(e @ np.linalg.solve(cov[0], e))
        # the pixel that is located has noise of its own
        point, cov = calibration.locate(uv + rng.standard_normal(2), plane="1", sigma_px=1.0)
        e = point[0] - goal_m
        nees_m.append(e @ np.linalg.solve(cov[0], e))
    # mean of 200 chi-square values: 2 +- 0.14 and 3 +- 0.17 (one sigma)
    assert np.mean(nees_px) == pytest.approx(2.0, abs=0.45)
    assert np.mean(nees_m) == pytest.approx(3.0, abs=0.55)


def test_names_are_checked_and_impossible_spots_are_nan(setting) -> None:
    made = simulate("paper", seed=0, noise=Noise(pixel_px=0.3))
    calibration = lc.calibrate(made.observations, initial=made.truth)
    T = made.observations.T_base_hand[0]
    with pytest.raises(lc.DataError, match="plane: the cell has 1, 2, 3; none was named"):
        calibration.predict(T)
    with pytest.raises(lc.DataError, match="'left' is not among them"):
        calibration.locate([1, 2], plane="1", camera="left")
    away = T.copy()
    away[:3, :3] = T[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    uv, cov = calibration.predict(away, plane="1")
    assert np.isnan(uv).all()
    assert np.isnan(cov).all()
