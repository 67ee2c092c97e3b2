"""The whole cell as one vector: same problem as the natural variables, in other coordinates."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from lasercal_factors import (
    CellChart,
    FactorError,
    LaserCellFactor,
    LaserSpotBatchFactor,
    Loss,
    SpotBatch,
    State,
    check_jacobians,
)
from test_spot_factors import BEAMS, Scene

KEY = gtsam.symbol("z", 0)


def chart_of(scene: Scene, aspect: float | None = None) -> CellChart:
    """Chart about the scene's cell; the beam written about the scene's frame."""
    return CellChart(scene.keys.read(scene.values), (aspect,))


def vector_values(z: np.ndarray) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(KEY, z)
    return values


def natural_values(scene: Scene, state: State) -> gtsam.Values:
    values = gtsam.Values()
    pose = gtsam.Pose3(gtsam.Rot3(state.cam_R[0]), state.cam_t[0])
    (x, k), keys = scene.keys.cameras[0], scene.keys
    values.insert(x, pose)
    values.insert(k, gtsam.Cal3DS2(*state.cam_K[0]))
    values.insert(keys.lasers[0], state.beam_l[0])
    for key, n, d in zip(keys.planes, state.plane_n, state.plane_d, strict=True):
        values.insert(key, gtsam.OrientedPlane3(*n, -d))
    return values


def random_step(rng: np.random.Generator, size: float) -> np.ndarray:
    camera = np.r_[np.full(6, 0.05), 20, 20, 3, 10, 10, 0.05, 0.05, 5e-3, 5e-3]
    beam, plane = np.r_[0.02, 0.02, 0.004, 0.004], np.r_[0.05, 0.05, 0.01]
    return size * np.r_[camera, beam, plane, plane] * rng.standard_normal(25)


@pytest.fixture(scope="module", params=BEAMS)
def scene(request: pytest.FixtureRequest) -> Scene:
    return Scene(request.param)


def test_same_error_as_the_natural_variables_anywhere(scene: Scene) -> None:
    chart, rng = chart_of(scene), np.random.default_rng(2)
    cell_factor = LaserCellFactor(KEY, chart, scene.batch)
    batch_factor = LaserSpotBatchFactor(scene.keys, scene.batch)
    for size in (0.0, 0.3, 1.0):
        z = random_step(rng, size)
        natural = natural_values(scene, chart.state(z))
        expected = batch_factor.error(natural)
        assert np.isfinite(expected)
        assert cell_factor.error(vector_values(z)) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("aspect", [None, 1.01])
def test_intrinsics_alone_are_those_of_the_state(scene: Scene, aspect: float | None) -> None:
    chart, z = chart_of(scene, aspect), random_step(np.random.default_rng(3), 1.0)
    np.testing.assert_array_equal(chart.intrinsics(z), chart.state(z).cam_K)


def test_jacobian_far_from_the_reference(scene: Scene) -> None:
    chart = chart_of(scene)
    z = random_step(np.random.default_rng(4), 1.0)
    for loss in (Loss(), Loss("cauchy", 2.0)):
        factor = LaserCellFactor(KEY, chart, scene.batch, loss)
        assert check_jacobians(factor, vector_values(z)) < 1e-6


def test_at_the_reference_the_chart_is_the_natural_tangent_space(scene: Scene) -> None:
    """Same Hessian at z = 0, but for the sign of GTSAM's plane offset."""
    chart = chart_of(scene)
    A, b = (
        LaserCellFactor(KEY, chart, scene.batch).linearize(vector_values(np.zeros(25))).jacobian()
    )
    natural = LaserSpotBatchFactor(scene.keys, scene.batch).linearize(scene.values)
    graph = gtsam.GaussianFactorGraph()
    graph.add(natural)
    H, g = graph.hessian(scene.ordering())
    sign = np.ones(25)
    sign[[21, 24]] = -1
    scale = np.sqrt(np.diag(H))
    np.testing.assert_allclose(
        (A.T @ A) / np.outer(scale, scale),
        H * np.outer(sign, sign) / np.outer(scale, scale),
        atol=1e-11,
    )
    np.testing.assert_allclose(A.T @ b / scale, sign * g / scale, atol=1e-9)
    np.testing.assert_allclose(chart.tangent_map(np.zeros(25)), np.eye(25), atol=1e-15)


def test_tangent_map_is_the_change_of_coordinates(scene: Scene) -> None:
    """Steps in z about z0 equal steps in the chart about the moved state, to first order."""
    chart, z0 = chart_of(scene), random_step(np.random.default_rng(6), 1.0)
    moved = CellChart(chart.state(z0))
    M = chart.tangent_map(z0)
    h = 1e-6
    for i in range(25):
        dz = np.zeros(25)
        dz[i] = h
        direct = chart.state(z0 + dz)
        mapped = moved.state(M @ dz)
        for name in State._fields:
            a, b = getattr(direct, name), getattr(mapped, name)
            np.testing.assert_allclose(a, b, rtol=0, atol=50 * h * h, err_msg=f"{name} {i}")


def test_state_is_gtsams_retraction_of_pose_and_plane_normal() -> None:
    scene = Scene()
    chart, z = chart_of(scene), random_step(np.random.default_rng(8), 1.0)
    state, reference = chart.state(z), chart.reference
    R0 = gtsam.Rot3(reference.cam_R[0])
    np.testing.assert_allclose(
        state.cam_R[0], R0.compose(gtsam.Rot3.Expmap(z[:3])).matrix(), atol=1e-14
    )
    np.testing.assert_allclose(
        state.cam_t[0], reference.cam_t[0] + reference.cam_R[0] @ z[3:6], atol=1e-15
    )
    np.testing.assert_allclose(np.linalg.norm(state.plane_n, axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(state.plane_d, reference.plane_d + z[[21, 24]], atol=1e-15)


def test_tied_focal_lengths_move_together_and_held_ones_not_at_all() -> None:
    scene = Scene(count=60)
    chart = chart_of(scene, aspect=1.02)
    held = np.zeros(25, bool)
    held[8] = True
    factor = LaserCellFactor(KEY, chart, scene.batch, held=held)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    result = gtsam.LevenbergMarquardtOptimizer(graph, vector_values(np.zeros(25))).optimize()
    z = result.atVector(KEY)
    assert z[6] == 0
    assert z[8] == 0
    state = chart.state(z)
    assert state.cam_K[0, 0] == pytest.approx(1.02 * state.cam_K[0, 1], rel=1e-15)
    assert graph.error(result) < graph.error(vector_values(np.zeros(25)))
    # the derivative by fv holds the way through fu too
    check_jacobians(LaserCellFactor(KEY, chart, scene.batch), vector_values(0.5 * z))


def test_several_cameras_and_lasers_in_one_vector() -> None:
    """Error and derivatives with two cameras and two lasers."""
    one, two = Scene("oblique", 24), Scene("tool z", 24)
    parts = zip(one.keys.read(one.values), two.keys.read(two.values), strict=True)
    chart = CellChart(State(*(np.concatenate(pair) for pair in parts)))
    batch = SpotBatch.from_arrays(
        np.concatenate([one.uv, two.uv]), np.broadcast_to(np.eye(2), (48, 2, 2)),
        np.concatenate([one.T, two.T]), np.repeat([0, 1], 24), np.repeat([0, 1], 24),
        np.concatenate([one.plane, 2 + two.plane]),
    )  # fmt: skip
    factor = LaserCellFactor(KEY, chart, batch)
    rng = np.random.default_rng(1)
    a, b = random_step(rng, 0.5), random_step(rng, 0.5)
    z = np.r_[a[:15], b[:15], a[15:19], b[15:19], a[19:], b[19:]]
    assert check_jacobians(factor, vector_values(z)) < 1e-6


def test_wrong_use_is_a_factor_error() -> None:
    scene = Scene(count=10)
    chart = chart_of(scene)
    with pytest.raises(FactorError, match="held"):
        LaserCellFactor(KEY, chart, scene.batch, held=[True])
    short = CellChart(chart.reference._replace(plane_n=np.eye(3)[:1], plane_d=np.ones(1)))
    with pytest.raises(FactorError, match="indices up to"):
        LaserCellFactor(KEY, short, scene.batch)
    behind = np.zeros(25)
    behind[0] = np.pi
    factor = LaserCellFactor(KEY, chart, scene.batch)
    assert factor.error(vector_values(behind)) == np.inf
    with pytest.raises(FactorError, match="behind its camera"):
        factor.linearize(vector_values(behind))
