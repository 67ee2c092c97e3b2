"""Spots with errors in common, and spots with noisy hands, against dense linear algebra."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from lasercal_factors import (
    CellChart,
    FactorError,
    LaserCellFactor,
    LaserSpotBatchFactor,
    LaserSpotHandFactor,
    Loss,
    check_jacobians,
    custom_factor,
)
from test_spot_factors import COVARIANCE, Scene

from lasercal_gtsam.graph import state_from_cell

VARIANCES = np.repeat([1e-3**2, 2e-3**2], 3)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(count=24)


def joint(rng: np.random.Generator, groups: int, k: int) -> np.ndarray:
    """Covariances (G, 2k, 2k) with `COVARIANCE` for every spot, and something in common."""
    common = 0.4 * rng.standard_normal((groups, 2 * k, 6))
    S = common @ np.swapaxes(common, 1, 2) + np.kron(np.eye(k), COVARIANCE)
    L, own = np.linalg.cholesky(COVARIANCE), np.zeros_like(S)
    for i in range(k):
        at = slice(2 * i, 2 * i + 2)
        own[:, at, at] = L @ np.linalg.inv(np.linalg.cholesky(S[:, at, at]))
    return own @ S @ np.swapaxes(own, 1, 2)


@pytest.fixture(scope="module")
def groups() -> list[tuple[np.ndarray, np.ndarray]]:
    """Three pairs over both planes, two triples; the rest by themselves."""
    rng = np.random.default_rng(5)
    pairs, triples = np.array([[0, 7], [2, 4], [9, 1]]), np.array([[3, 10, 12], [20, 6, 15]])
    return [(pairs, joint(rng, 3, 2)), (triples, joint(rng, 2, 3))]


def dense(count: int, groups: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    V = np.kron(np.eye(count), COVARIANCE)
    for members, S in groups:
        for spots, block in zip(members, S, strict=True):
            at = (2 * spots[:, None] + np.arange(2)).ravel()
            V[np.ix_(at, at)] = block
    return V


def residuals_and_derivative(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Unwhitened, (2N,) and (2N, 28), in the variables' tangent spaces, by one factor a spot."""
    L = np.linalg.cholesky(COVARIANCE)
    rows, r = np.zeros((2 * len(scene.uv), scene.keys.n)), []
    columns = dict(zip(scene.keys.keys, scene.keys.columns, strict=True))
    whitening = scene.batch.spots.pixels[2:, 0]
    W = np.array([[whitening[0], whitening[1]], [0.0, whitening[2]]])
    for k in range(len(scene.uv)):
        factor = scene.single(k)
        A, b = factor.linearize(scene.values).jacobian()
        at = 0
        for key in list(factor.keys()):
            width = columns[key].stop - columns[key].start
            rows[2 * k : 2 * k + 2, columns[key]] = np.linalg.solve(W, A[:, at : at + width])
            at += width
        r.append(np.linalg.solve(W, -b))
    assert np.allclose(L @ L.T, np.linalg.inv(W.T @ W))
    return np.concatenate(r), rows


def test_correlated_spots_are_generalised_least_squares(scene, groups) -> None:
    batch = scene.batch
    for members, S in groups:
        batch = batch.correlated(members, S)
    r, J = residuals_and_derivative(scene)
    V = dense(len(scene.uv), groups)
    factor = LaserSpotBatchFactor(scene.keys, batch)
    assert 2 * factor.error(scene.values) == pytest.approx(r @ np.linalg.solve(V, r), rel=1e-11)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    H, g = graph.linearize(scene.values).hessian(scene.ordering())
    expected = J.T @ np.linalg.solve(V, J)
    scale = np.sqrt(np.diag(expected))
    # GTSAM's g is minus the gradient
    outer = np.outer(scale, scale)
    np.testing.assert_allclose(H / outer, expected / outer, atol=1e-11)
    np.testing.assert_allclose(g / scale, -J.T @ np.linalg.solve(V, r) / scale, atol=1e-9)


def test_a_spot_left_out_leaves_its_group_as_if_it_had_not_been_there(scene, groups) -> None:
    (pairs, S2), (triples, S3) = groups
    batch = scene.batch.correlated(pairs, S2).correlated(triples, S3)
    weights = np.ones(24)
    weights[[7, 10]] = 0.0
    r, _ = residuals_and_derivative(scene)
    at = np.repeat(weights > 0, 2)
    V = dense(24, groups)[np.ix_(at, at)]
    state = state_from_cell(scene.cell)
    found = batch.weighted(weights).total_loss(state, Loss())
    assert found == pytest.approx(r[at] @ np.linalg.solve(V, r[at]), rel=1e-9)
    # half a weight is twice the variance, the rest of it noise of the spot's own
    weights = np.where(np.arange(24) == 3, 0.5, 1.0)
    V = dense(24, groups)
    V[6:8, 6:8] += COVARIANCE
    found = batch.weighted(weights).total_loss(state, Loss())
    assert found == pytest.approx(r @ np.linalg.solve(V, r), rel=1e-9)


def test_the_vector_factor_agrees_and_has_right_derivatives(scene, groups) -> None:
    (members, S), _ = groups
    batch = scene.batch.correlated(members, S)
    chart = CellChart(state_from_cell(scene.cell))
    factor = LaserCellFactor(0, chart, batch)
    values = gtsam.Values()
    values.insert(0, np.zeros(chart.n))
    natural = LaserSpotBatchFactor(scene.keys, batch)
    assert factor.error(values) == pytest.approx(natural.error(scene.values), rel=1e-12)
    moved = gtsam.Values()
    moved.insert(0, 1e-3 * np.random.default_rng(0).standard_normal(chart.n))
    assert check_jacobians(factor, moved) < 1e-6


def test_correlated_spots_are_refused_where_they_make_no_sense(scene, groups) -> None:
    (pairs, S), _ = groups
    with pytest.raises(FactorError, match="in two groups"):
        scene.batch.correlated(pairs, S).correlated(pairs[:1], S[:1])
    with pytest.raises(FactorError, match=r"\(G, k\) and \(G, 2k, 2k\)"):
        scene.batch.correlated(pairs, S[:, :2])
    batch = scene.batch.correlated(pairs, S)
    with pytest.raises(FactorError, match="cauchy loss"):
        LaserSpotBatchFactor(scene.keys, batch, Loss("cauchy", 2.0))
    with pytest.raises(FactorError, match="cauchy loss"):
        batch.total_loss(state_from_cell(scene.cell), Loss("cauchy", 2.0))
    impossible = S.copy()
    impossible[0] = 1e3
    with pytest.raises(FactorError, match="not positive definite"):
        scene.batch.correlated(pairs, impossible).total_loss(state_from_cell(scene.cell), Loss())


# --- the hand pose as a variable, and eliminated ------------------------------------------------


def hand_factor(scene: Scene, k: int) -> gtsam.CustomFactor:
    (x, i), plane = scene.keys.cameras[0], scene.keys.planes[scene.plane[k]]
    hand = gtsam.symbol("h", k)
    return LaserSpotHandFactor(
        x, i, scene.keys.lasers[0], plane, hand, scene.uv[k], scene.frame, COVARIANCE
    )


def test_the_hand_pose_as_a_variable(scene) -> None:
    values = gtsam.Values(scene.values)
    for k in (0, 1):
        values.insert(gtsam.symbol("h", k), gtsam.Pose3(scene.T[k]))
        factor = hand_factor(scene, k)
        assert factor.error(values) == pytest.approx(scene.single(k).error(values), rel=1e-12)
        assert check_jacobians(factor, values) < 1e-6


def test_held_columns_are_zero(scene) -> None:
    (x, i), plane = scene.keys.cameras[0], scene.keys.planes[0]
    held = np.zeros(22, np.bool_)
    held[[8, 20]] = True
    values = gtsam.Values(scene.values)
    values.insert(5, gtsam.Pose3(scene.T[0]))
    parts = (x, i, scene.keys.lasers[0], plane, 5, scene.uv[0], scene.frame, COVARIANCE)
    free = LaserSpotHandFactor(*parts).linearize(values).jacobian()[0]
    some = LaserSpotHandFactor(*parts, held).linearize(values).jacobian()[0]
    changed = np.abs(free - some).max(axis=0) > 0
    assert changed.sum() == 2 and not some[:, changed].any()
    with pytest.raises(FactorError, match="held"):
        LaserSpotHandFactor(*parts, held[:20])


def test_elimination_is_the_minimum_over_the_hand_poses(scene) -> None:
    """The noisy factor's error, against GTSAM moving each hand alone; and its derivative."""
    chart = CellChart(state_from_cell(scene.cell))
    batch = scene.batch.with_noisy_hands(VARIANCES)
    values = gtsam.Values()
    values.insert(0, np.zeros(chart.n))
    found = 2 * LaserCellFactor(0, chart, batch).error(values)
    prior = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(VARIANCES[[3, 4, 5, 0, 1, 2]]))
    expected = 0.0
    for k in range(len(scene.uv)):
        graph, hand = gtsam.NonlinearFactorGraph(), gtsam.symbol("h", k)
        start = gtsam.Values(scene.values)
        start.insert(hand, gtsam.Pose3(scene.T[k]))
        graph.add(hand_factor(scene, k))
        graph.add(gtsam.PriorFactorPose3(hand, gtsam.Pose3(scene.T[k]), prior))
        for key, dim in zip(scene.keys.keys, scene.keys.dims, strict=True):
            if key in list(hand_factor(scene, k).keys()):
                graph.add(_pinned(key, dim))
        params = gtsam.LevenbergMarquardtParams.CeresDefaults()
        params.setRelativeErrorTol(1e-14)
        best = gtsam.LevenbergMarquardtOptimizer(graph, start, params).optimize()
        expected += 2 * graph.error(best)
    assert found == pytest.approx(expected, rel=1e-6)
    moved = gtsam.Values()
    moved.insert(0, 1e-3 * np.random.default_rng(1).standard_normal(chart.n))
    assert _gradient_error(LaserCellFactor(0, chart, batch), moved) < 1e-6


def _pinned(key: int, dim: int) -> gtsam.CustomFactor:
    noise = gtsam.noiseModel.Isotropic.Sigma(dim, 1e-9)
    return custom_factor(
        "pin",
        noise,
        [key],
        [dim],
        lambda _: np.zeros(dim),
        lambda _: (np.zeros(dim), [np.eye(dim)]),
    )


def _gradient_error(factor: gtsam.CustomFactor, values: gtsam.Values) -> float:
    """Gradient against central differences, in units of each column's scale."""
    A, b = factor.linearize(values).jacobian()
    scale, gradient, z = np.linalg.norm(A, axis=0), -A.T @ b, values.atVector(0)
    worst = 0.0
    for i in np.flatnonzero(scale):
        errors = []
        for sign in (1, -1):
            moved = gtsam.Values()
            moved.insert(0, z + sign * 1e-4 / scale[i] * np.eye(len(z))[i])
            errors.append(factor.error(moved))
        numeric = (errors[0] - errors[1]) / 2e-4
        worst = max(worst, abs(numeric - gradient[i] / scale[i]) / np.linalg.norm(b))
    return worst


def test_noisy_hands_are_refused_where_they_make_no_sense(scene, groups) -> None:
    noisy = scene.batch.with_noisy_hands(VARIANCES)
    with pytest.raises(FactorError, match="6 variances"):
        scene.batch.with_noisy_hands(-VARIANCES)
    with pytest.raises(FactorError, match="correlated already"):
        scene.batch.correlated(*groups[0]).with_noisy_hands(VARIANCES)
    with pytest.raises(FactorError, match="other than 0 and 1"):
        noisy.weighted(np.full(24, 0.5))
    with pytest.raises(FactorError, match="LaserCellFactor"):
        LaserSpotBatchFactor(scene.keys, noisy)
    with pytest.raises(FactorError, match="cauchy loss"):
        LaserCellFactor(0, CellChart(state_from_cell(scene.cell)), noisy, Loss("cauchy", 2.0))


def test_a_fixed_hand_is_judged_where_it_was_commanded(scene) -> None:
    fixed = np.zeros(24, np.bool_)
    fixed[3] = True
    state = state_from_cell(scene.cell)
    noisy = scene.batch.with_noisy_hands(VARIANCES, fixed).at(state)
    at = int(np.flatnonzero(noisy.order == 3)[0])
    np.testing.assert_array_equal(noisy.spots.hands[:, at], scene.batch.spots.hands[:, at])
    assert (noisy.spots.hands != scene.batch.spots.hands).any(axis=0).sum() == 23
