"""Values and prior for a graph of one's own: GTSAM's charts, its marginals, its estimates."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from format_cases import CAMERA, calibrated, poses, random_covariance, two_cameras, with_pose
from hypothesis import given, settings
from hypothesis import strategies as st
from lasercal_factors import LaserSpotBatchFactor, check_jacobians

import lasercal_gtsam as lc
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.formats.gtsam_graph import HELD_SIGMA, TIED_SHARE, load_gtsam, to_gtsam
from lasercal_gtsam.graph import cell_from_state, make_batch

# differences of errors whose rows cancel (strong correlations) lose digits to rounding
TOLERANCE = 1e-5


def signs_of(prior) -> np.ndarray:
    """GTSAM's offset of a plane is minus the distance."""
    signs = np.ones(prior.keys.n)
    for key, columns in zip(prior.keys.keys, prior.keys.columns, strict=True):
        if gtsam.Symbol(key).chr() == ord("p"):
            signs[columns.stop - 1] = -1
    return signs


def free_of(prior) -> np.ndarray:
    return np.diag(prior.covariance) > 0


def moved(prior, size: float, seed: int) -> gtsam.Values:
    """Values a few sigmas away from the mean, in GTSAM's charts; held ones at the mean."""
    rng = np.random.default_rng(seed)
    step = size * np.sqrt(np.diag(prior.covariance)) * rng.normal(size=prior.keys.n)
    steps = gtsam.VectorValues()
    for key, columns in zip(prior.keys.keys, prior.keys.columns, strict=True):
        steps.insert(key, step[columns])
    return prior.values.retract(steps)


def test_the_values_are_the_cell():
    calibration = calibrated()
    prior = to_gtsam(calibration)
    values, cell = prior.values, calibration.cell
    (pose_key, lens_key), camera = prior.keys.cameras[0], cell.cameras[CAMERA]
    np.testing.assert_allclose(
        values.atPose3(pose_key).matrix(), camera.T_base_camera, rtol=0, atol=1e-12
    )
    np.testing.assert_array_equal(values.atCal3DS2(lens_key).vector(), camera.intrinsics.vector)
    for key, plane in zip(prior.keys.planes, cell.planes.values(), strict=True):
        a, b, c, d = values.atOrientedPlane3(key).planeCoefficients()
        np.testing.assert_allclose([a, b, c, -d], [*plane.normal_base, plane.distance], atol=1e-15)
    (beam,) = cell.lasers.values()
    direction, point = prior.keys.frames[0].line(values.atVector(prior.keys.lasers[0]))
    np.testing.assert_allclose(direction, beam.direction_hand, atol=1e-15)
    np.testing.assert_allclose(point, beam.point_hand, atol=1e-15)


def test_gtsams_marginals_are_the_joint_covariance():
    calibration = calibrated()
    prior = to_gtsam(calibration)
    free = free_of(prior)
    assert (~free).sum() == 1  # the skew
    graph = prior.graph
    order = gtsam.Ordering()
    for key in prior.keys.keys:
        order.push_back(key)
    A = graph.linearize(prior.values).jacobian(order)[0]
    found = np.linalg.inv(A.T @ A)
    signs = signs_of(prior)
    wanted = calibration.covariance * np.outer(signs, signs)
    sigma = np.sqrt(np.diag(wanted))[free]
    difference = found[np.ix_(free, free)] - wanted[np.ix_(free, free)]
    assert np.abs(difference / np.outer(sigma, sigma)).max() < 1e-9
    assert np.sqrt(np.diag(found)[~free]) == pytest.approx(HELD_SIGMA)
    marginals = gtsam.Marginals(graph, prior.values)
    key = prior.keys.cameras[0][0]
    pose = marginals.marginalCovariance(key)
    np.testing.assert_allclose(pose, prior.covariance_of(key), rtol=1e-6)
    np.testing.assert_array_equal(prior.covariance_of(key), calibration.covariance[:6, :6])


@pytest.mark.parametrize("size", [0.0, 1.0, 30.0])
def test_the_jacobians_are_gtsams_own(size):
    prior = to_gtsam(calibrated())
    check_jacobians(prior.factor, moved(prior, size, 1), tolerance=TOLERANCE)


def test_the_error_is_the_mahalanobis_length_and_the_mean_is_found_again():
    prior = to_gtsam(calibrated())
    graph = prior.graph
    assert graph.error(prior.values) < 1e-20
    # along one coordinate: half its square over the conditional variance
    free = np.flatnonzero(free_of(prior))
    information = np.linalg.inv(prior.covariance[np.ix_(free, free)])
    start = prior.keys.columns[0].start
    step = np.zeros(6)
    step[3] = 1e-4
    values = prior.values
    key = prior.keys.cameras[0][0]
    values.update(key, values.atPose3(key).retract(step))
    i = list(free).index(start + 3)
    assert graph.error(values) == pytest.approx(0.5 * information[i, i] * 1e-8, rel=1e-6)
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-15)
    found = gtsam.LevenbergMarquardtOptimizer(graph, moved(prior, 3.0, 2), params).optimize()
    assert graph.error(found) < 1e-12


def test_a_plane_turned_round_is_impossible_not_near():
    prior = to_gtsam(calibrated())
    values, key = prior.values, prior.keys.planes[0]
    n = values.atOrientedPlane3(key).normal().point3()
    values.update(key, gtsam.OrientedPlane3(gtsam.Unit3(-n), 0.1))
    assert prior.graph.error(values) == np.inf


def test_half_the_spots_as_prior_and_half_as_factor_are_all_spots():
    """The use it is made for: a calibration goes into a graph with newer spots."""
    known = lc.CalibrationOptions(known={"skew": 0.0}, robust="none")
    spots = calibrated().inputs.observations
    order = np.random.default_rng(0).permutation(len(spots))
    first, rest = spots[np.sort(order[:45])], spots[np.sort(order[45:])]
    whole = lc.calibrate(spots, options=known)
    early = lc.calibrate(first, options=known)
    # one noise scale for both halves, as the calibration of all spots has
    sigma = whole.fit.sigma0
    scaled = replace(early, covariance=early.covariance * (sigma / early.fit.sigma0) ** 2)
    prior = to_gtsam(scaled)
    graph = prior.graph
    graph.add(LaserSpotBatchFactor(prior.keys, make_batch(rest, sigma)))
    found = gtsam.LevenbergMarquardtOptimizer(graph, prior.values).optimize()
    cell = cell_from_state(prior.keys.read(found), early.cell)
    camera, wanted = cell.cameras[CAMERA], whole.cell.cameras[CAMERA]
    sigmas = np.sqrt(np.diag(whole.covariance))
    lens = (camera.intrinsics.vector - wanted.intrinsics.vector)[[0, 1, 3, 4, 5, 6, 7, 8]]
    assert np.abs(lens / sigmas[[6, 7, 9, 10, 11, 12, 13, 14]]).max() < 0.2
    t = (camera.T_base_camera - wanted.T_base_camera)[:3, 3]
    assert np.abs(t / sigmas[3:6]).max() < 0.2
    marginal = gtsam.Marginals(graph, found).marginalCovariance(prior.keys.cameras[0][0])
    np.testing.assert_allclose(np.sqrt(np.diag(marginal)), sigmas[:6], rtol=0.1)


def test_tied_focal_lengths_stay_tied():
    seen = calibrated().inputs.observations
    options = lc.CalibrationOptions(known={"skew": 0.0, "aspect": 1.0})
    prior = to_gtsam(lc.calibrate(seen, options=options))
    key = prior.keys.cameras[0][1]
    found = gtsam.Marginals(prior.graph, prior.values).marginalCovariance(key)
    ratio = found[0, 0] + found[1, 1] - 2 * found[0, 1]
    assert 0 < ratio < (2 * TIED_SHARE) ** 2 * found[0, 0]
    stated = prior.covariance_of(key)
    free = np.delete(np.arange(9), 2)
    sigma = np.sqrt(np.diag(stated))[free]
    difference = (found - stated)[np.ix_(free, free)] / np.outer(sigma, sigma)
    assert np.abs(difference).max() < 3 * TIED_SHARE**2


@settings(max_examples=25, deadline=None, derandomize=True)
@given(T=poses, seed=st.integers(0, 10**6))
def test_a_file_gives_the_same_prior_back(tmp_path_factory, T, seed):
    calibration = with_pose(T)
    n = len(calibration.labels)
    joint = random_covariance(seed, np.full(n, 1e-3))
    calibration = replace(calibration, covariance=joint)
    path = tmp_path_factory.getbasetemp() / "prior.gtsam.npz"
    lc.export(calibration, "gtsam", path)
    direct, loaded = to_gtsam(calibration), load_gtsam(path)
    np.testing.assert_array_equal(loaded.covariance, direct.covariance)
    for a, b in zip(loaded.state, direct.state, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * max(1.0, np.abs(T[:3, 3]).max()))
    assert loaded.keys.keys == direct.keys.keys
    assert (loaded.cameras, loaded.planes) == (direct.cameras, direct.planes)
    away = moved(direct, 0.01, 1)
    assert loaded.graph.error(away) == pytest.approx(direct.graph.error(away), rel=1e-9)


def test_parts_are_chosen_and_the_rest_is_marginalised():
    calibration = two_cameras()
    prior = to_gtsam(calibration, ["camera:right", "plane:2"])
    assert (prior.cameras, prior.lasers, prior.planes) == (("right",), (), ("2",))
    wanted = [i for i, x in enumerate(calibration.labels) if x.startswith(("right.", "plane 2."))]
    signs = signs_of(prior)
    np.testing.assert_array_equal(
        prior.covariance, calibration.covariance[np.ix_(wanted, wanted)] * np.outer(signs, signs)
    )
    check_jacobians(prior.factor, moved(prior, 0.1, 3), tolerance=TOLERANCE)
    with pytest.raises(DataError, match="there are camera:left, camera:right"):
        to_gtsam(calibration, ["camera:middle"])
    with pytest.raises(DataError, match="one at least"):
        to_gtsam(calibration, [])


def test_a_graph_may_have_other_keys():
    prior = to_gtsam(calibrated())
    keys = [gtsam.symbol("c", i) for i in range(len(prior.keys.keys))]
    other = prior.rekeyed(keys)
    assert list(other.values.keys()) == keys
    assert other.keys.cameras == ((keys[0], keys[1]),)
    np.testing.assert_array_equal(other.covariance_of(keys[0]), prior.covariance[:6, :6])
    check_jacobians(other.factor, moved(other, 1.0, 4), tolerance=TOLERANCE)
    for wrong in (keys[:-1], [*keys[:-1], keys[0]]):
        with pytest.raises(DataError, match="expected 6 different ones"):
            prior.rekeyed(wrong)


def test_what_is_no_covariance_is_refused():
    prior = to_gtsam(calibrated())
    bad = prior.covariance.copy()
    bad[0, 1] = bad[1, 0] = 2 * np.sqrt(bad[0, 0] * bad[1, 1])
    with pytest.raises(DataError, match="negative eigenvalue"):
        _ = replace(prior, covariance=bad).factor


def test_files_that_are_none_are_refused(tmp_path):
    path = tmp_path / "x.npz"
    with pytest.raises(DataError, match="no such file"):
        load_gtsam(path)
    path.write_bytes(b"PK not really")
    with pytest.raises(DataError, match="not a file of the format gtsam"):
        load_gtsam(path)
    lc.export(calibrated(), "npz", path)
    with pytest.raises(DataError, match="expected format"):
        load_gtsam(path)
