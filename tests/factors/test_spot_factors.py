"""Both factors: equal to each other, to the reference, and to what GTSAM expects of a factor."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from lasercal_factors import (
    BeamFrame,
    CellKeys,
    FactorError,
    LaserSpotBatchFactor,
    LaserSpotFactor,
    Loss,
    SpotBatch,
    check_jacobians,
    custom_factor,
    keys_for,
)
from lasercal_factors.kernels import loss_value, loss_weight, tangent_basis

from lasercal_gtsam import Beam, Camera, Cell, Intrinsics, Plane, project
from lasercal_gtsam.rotations import make_pose, rotation_exp

BEAMS = {"oblique": [0.2, 0.1, 1.0], "tool z": [0.0, 0.0, 1.0], "tool y": [0.0, 1.0, 0.1]}
COVARIANCE = np.array([[0.9, 0.3], [0.3, 0.5]])


class Scene:
    """Two planes (one a horizontal table), a camera 0.6 m away, beams that hit the planes."""

    def __init__(self, beam: str = "oblique", count: int = 30) -> None:
        rng = np.random.default_rng(3)
        direction = np.array(BEAMS[beam]) / np.linalg.norm(BEAMS[beam])
        planes = {
            "table": Plane.from_point(np.array([0, 0, 1.0]), np.array([0.5, 0, 0.1])),
            "wall": Plane.from_point(np.array([0.3, -0.4, 1.0]), np.array([0.5, 0, 0.1])),
        }
        camera = Camera(
            Intrinsics(550, 540, 2.0, 320, 240, -0.2, 0.1, 2e-3, -1e-3),
            make_pose(rotation_exp(np.array([np.pi - 0.2, 0, 0.1])), np.array([0.5, 0.05, 0.7])),
            (640, 480),
        )
        self.cell = Cell(
            {"camera": camera}, {"laser": Beam(direction, np.array([0.01, -0.02, 0.03]))}, planes
        )
        down = rotation_exp(np.array([np.pi, 0, 0])) @ _turn(direction, np.array([0, 0, 1.0]))
        self.T = np.array(
            [
                make_pose(
                    rotation_exp(0.2 * rng.standard_normal(3)) @ down,
                    np.array([0.5, 0, 0.4]) + 0.04 * rng.standard_normal(3),
                )
                for _ in range(count)
            ]
        )
        self.plane = np.arange(count) % 2
        names = [list(planes)[i] for i in self.plane]
        self.uv = project(self.cell, self.T, plane=names) + rng.standard_normal((count, 2))
        assert np.isfinite(self.uv).all()
        self.frame = BeamFrame.from_line(
            direction + np.array([0.02, -0.01, 0.015]), [0.0, 0.0, 0.02]
        )
        self.keys = keys_for(1, 1, 2, [self.frame])
        self.batch = SpotBatch.from_arrays(
            self.uv, np.broadcast_to(COVARIANCE, (count, 2, 2)), self.T,
            np.zeros(count, int), np.zeros(count, int), self.plane,
        )  # fmt: skip
        self.values = self.values_of(self.cell)

    def values_of(self, cell: Cell, keys: CellKeys | None = None) -> gtsam.Values:
        keys = keys or self.keys
        values = gtsam.Values()
        (x, k), camera = keys.cameras[0], cell.cameras["camera"]
        values.insert(x, gtsam.Pose3(camera.T_base_camera))
        values.insert(k, camera.intrinsics.to_gtsam())
        beam = cell.lasers["laser"]
        line = keys.frames[0].coordinates(beam.direction_hand, beam.point_hand)
        values.insert(keys.lasers[0], line)
        for key, plane in zip(keys.planes, cell.planes.values(), strict=True):
            values.insert(key, gtsam.OrientedPlane3(np.append(plane.normal_base, -plane.distance)))
        return values

    def single(self, k: int) -> gtsam.CustomFactor:
        (x, i), plane = self.keys.cameras[0], self.keys.planes[self.plane[k]]
        return LaserSpotFactor(
            x, i, self.keys.lasers[0], plane, self.uv[k], self.T[k], self.frame, COVARIANCE
        )

    def graph_of_singles(self) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        for k in range(len(self.uv)):
            graph.add(self.single(k))
        return graph

    def graph_of_batch(self, **options: object) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        graph.add(LaserSpotBatchFactor(self.keys, self.batch, **options))  # type: ignore[arg-type]
        return graph

    def ordering(self) -> gtsam.Ordering:
        ordering = gtsam.Ordering()
        for key in self.keys.keys:
            ordering.push_back(key)
        return ordering


def _turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A rotation that takes direction a to b."""
    axis = np.cross(a, b)
    sine, cosine = np.linalg.norm(axis), a @ b
    return np.eye(3) if sine < 1e-12 else rotation_exp(axis / sine * np.arctan2(sine, cosine))


@pytest.fixture(scope="module", params=BEAMS)
def scene(request: pytest.FixtureRequest) -> Scene:
    return Scene(request.param)


def test_error_is_the_whitened_distance_between_seen_and_predicted_pixel(scene: Scene) -> None:
    names = [list(scene.cell.planes)[i] for i in scene.plane]
    r = project(scene.cell, scene.T, plane=names) - scene.uv
    expected = 0.5 * np.einsum("ni,ij,nj->n", r, np.linalg.inv(COVARIANCE), r)
    found = [scene.single(k).error(scene.values) for k in range(len(r))]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_batch_and_single_factors_agree_in_error_gradient_and_hessian(scene: Scene) -> None:
    batch, singles = scene.graph_of_batch(), scene.graph_of_singles()
    assert batch.error(scene.values) == pytest.approx(singles.error(scene.values), rel=1e-12)
    H, g = batch.linearize(scene.values).hessian(scene.ordering())
    H1, g1 = singles.linearize(scene.values).hessian(scene.ordering())
    scale = np.sqrt(np.diag(H1))
    np.testing.assert_allclose(H / np.outer(scale, scale), H1 / np.outer(scale, scale), atol=1e-12)
    np.testing.assert_allclose(g / scale, g1 / scale, atol=1e-10)


def test_jacobians_against_central_differences_under_gtsams_retraction(scene: Scene) -> None:
    assert check_jacobians(scene.single(0), scene.values) < 1e-6
    assert check_jacobians(scene.single(1), scene.values) < 1e-6
    assert check_jacobians(LaserSpotBatchFactor(scene.keys, scene.batch), scene.values) < 1e-6


def test_check_jacobians_notices_a_wrong_derivative() -> None:
    key = gtsam.symbol("l", 0)
    factor = custom_factor(
        "wrong", gtsam.noiseModel.Unit.Create(4), [key], [4],
        lambda v: 2.0 * v.atVector(key), lambda v: (2.0 * v.atVector(key), [np.eye(4)]),
    )  # fmt: skip
    values = gtsam.Values()
    values.insert(key, np.array([1.0, 2.0, 3.0, 4.0]))
    with pytest.raises(FactorError, match="differ at l0"):
        check_jacobians(factor, values)


def test_both_graphs_reach_the_same_optimum() -> None:
    scene = Scene(count=60)
    rng = np.random.default_rng(0)
    step = gtsam.VectorValues()
    for key, dim in zip(scene.keys.keys, scene.keys.dims, strict=True):
        size = np.array([5, 5, 0, 5, 5, 0, 0, 0, 0]) if dim == 9 else 5e-3
        step.insert(key, size * rng.standard_normal(dim))
    held = np.zeros(scene.keys.n, bool)
    held[6 + np.array([2, 6, 7, 8])] = True
    start = scene.values.retract(step)
    prior = gtsam.noiseModel.Diagonal.Sigmas(
        np.where(np.isin(range(9), [2, 6, 7, 8]), 1e-6, 1e6).astype(float)
    )
    singles = scene.graph_of_singles()
    k = scene.keys.cameras[0][1]
    singles.add(gtsam.PriorFactorCal3DS2(k, start.atCal3DS2(k), prior))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    a = gtsam.LevenbergMarquardtOptimizer(singles, start, params).optimize()
    b = gtsam.LevenbergMarquardtOptimizer(scene.graph_of_batch(held=held), start, params).optimize()
    np.testing.assert_allclose(
        a.atCal3DS2(k).vector(), b.atCal3DS2(k).vector(), rtol=1e-5, atol=1e-5
    )
    # held coordinates do not move, not even by rounding
    before, after = start.atCal3DS2(k).vector(), b.atCal3DS2(k).vector()
    assert np.array_equal(before[[2, 6, 7, 8]], after[[2, 6, 7, 8]])


def test_covariance_beside_held_parameters_is_that_of_the_smaller_problem() -> None:
    scene = Scene(count=60)
    held = np.zeros(scene.keys.n, bool)
    held[[8, 9, 12]] = True
    marginals = gtsam.Marginals(scene.graph_of_batch(held=held), scene.values)
    joint = marginals.jointMarginalCovariance(list(scene.keys.keys)).fullMatrix()
    H, _ = scene.graph_of_singles().linearize(scene.values).hessian(scene.ordering())
    expected = np.linalg.inv(H[np.ix_(~held, ~held)])
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        joint[np.ix_(~held, ~held)] / np.outer(sigma, sigma),
        expected / np.outer(sigma, sigma), atol=1e-7,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["huber", "cauchy", "geman-mcclure"])
def test_robust_batch_equals_gtsams_robust_single_factors(name: str) -> None:
    scene = Scene(count=40)
    uv = scene.uv.copy()
    uv[::7] += [15.0, -9.0]
    batch = SpotBatch.from_arrays(
        uv, np.broadcast_to(np.eye(2), (40, 2, 2)), scene.T, np.zeros(40, int), np.zeros(40, int),
        scene.plane,
    )  # fmt: skip
    kind = {"huber": 1, "cauchy": 2, "geman-mcclure": 3}[name]
    c = 1.7
    factor = LaserSpotBatchFactor(scene.keys, batch, Loss(name, c))  # type: ignore[arg-type]
    r = batch.residuals(scene.keys.read(scene.values))
    m = (r**2).sum(axis=1)
    assert 2 * factor.error(scene.values) == pytest.approx(
        sum(loss_value(kind, c, x) for x in m), rel=1e-12
    )
    # the weight is the derivative of the loss
    for x in (0.3, 2.5, 40.0):
        slope = (loss_value(kind, c, x + 1e-5) - loss_value(kind, c, x - 1e-5)) / 2e-5
        assert loss_weight(kind, c, x) == pytest.approx(slope, rel=1e-6)
    assert check_jacobians(factor, scene.values) < 1e-6


def test_a_spot_of_weight_zero_is_not_there() -> None:
    scene = Scene(count=40)
    keep = np.arange(40) % 5 != 0
    part = SpotBatch.from_arrays(
        scene.uv[keep], np.broadcast_to(COVARIANCE, (keep.sum(), 2, 2)), scene.T[keep],
        np.zeros(keep.sum(), int), np.zeros(keep.sum(), int), scene.plane[keep],
    )  # fmt: skip
    weighted = scene.batch.weighted(keep)
    assert np.array_equal(weighted.used, keep)
    a = LaserSpotBatchFactor(scene.keys, weighted).error(scene.values)
    b = LaserSpotBatchFactor(scene.keys, part).error(scene.values)
    assert a == pytest.approx(b, rel=1e-12)


def test_the_order_of_the_spots_matters_by_rounding_only() -> None:
    scene = Scene(count=40)
    order = np.random.default_rng(1).permutation(40)
    shuffled = SpotBatch.from_arrays(
        scene.uv[order], np.broadcast_to(COVARIANCE, (40, 2, 2)), scene.T[order],
        np.zeros(40, int), np.zeros(40, int), scene.plane[order],
    )  # fmt: skip
    a = LaserSpotBatchFactor(scene.keys, scene.batch).error(scene.values)
    b = LaserSpotBatchFactor(scene.keys, shuffled).error(scene.values)
    assert a == pytest.approx(b, rel=1e-13)
    state = scene.keys.read(scene.values)
    np.testing.assert_array_equal(scene.batch.residuals(state)[order], shuffled.residuals(state))


def test_impossible_spots_cost_infinity_and_cannot_be_linearised(scene: Scene) -> None:
    (x, _), values = scene.keys.cameras[0], gtsam.Values(scene.values)
    behind = values.atPose3(x).compose(gtsam.Pose3(gtsam.Rot3.Rx(np.pi), np.zeros(3)))
    values.update(x, behind)
    factor = LaserSpotBatchFactor(scene.keys, scene.batch)
    assert factor.error(values) == np.inf
    assert scene.single(0).error(values) == np.inf
    with pytest.raises(FactorError, match="behind its camera"):
        factor.linearize(values)
    with pytest.raises(FactorError, match="behind its camera"):
        scene.single(0).linearize(values)


def test_several_cameras_lasers_and_planes_by_key() -> None:
    """Two cameras and two lasers: the batch equals the sum over the cells taken one by one."""
    one, two = Scene("oblique", 24), Scene("tool z", 24)
    keys = CellKeys(
        (one.keys.cameras[0], (gtsam.symbol("x", 1), gtsam.symbol("k", 1))),
        (one.keys.lasers[0], gtsam.symbol("l", 1)),
        (*one.keys.planes, gtsam.symbol("p", 2), gtsam.symbol("p", 3)),
        (one.frame, two.frame),
    )
    batch = SpotBatch.from_arrays(
        np.concatenate([one.uv, two.uv]), np.broadcast_to(COVARIANCE, (48, 2, 2)),
        np.concatenate([one.T, two.T]), np.repeat([0, 1], 24), np.repeat([0, 1], 24),
        np.concatenate([one.plane, 2 + two.plane]),
    )  # fmt: skip
    other = CellKeys((keys.cameras[1],), (keys.lasers[1],), keys.planes[2:], (two.frame,))
    values = gtsam.Values(one.values)
    values.insert(two.values_of(two.cell, other))
    total = LaserSpotBatchFactor(keys, batch)
    expected = LaserSpotBatchFactor(one.keys, one.batch).error(one.values)
    expected += LaserSpotBatchFactor(two.keys, two.batch).error(two.values)
    assert total.error(values) == pytest.approx(expected, rel=1e-12)
    assert check_jacobians(total, values) < 1e-6


def test_tangent_basis_is_that_of_unit3() -> None:
    rng = np.random.default_rng(5)
    normals = rng.standard_normal((200, 3))
    normals = np.concatenate([normals, np.eye(3), -np.eye(3), [[1.0, 1.0, 0.1]]])
    for n in normals / np.linalg.norm(normals, axis=1, keepdims=True):
        np.testing.assert_allclose(tangent_basis(n), gtsam.Unit3(n).basis(), atol=4e-16)


def test_wrong_use_is_a_factor_error_not_a_crash() -> None:
    scene = Scene(count=10)
    with pytest.raises(FactorError, match="indices up to"):
        LaserSpotBatchFactor(keys_for(1, 1, 1, [scene.frame]), scene.batch)
    with pytest.raises(FactorError, match="held"):
        LaserSpotBatchFactor(scene.keys, scene.batch, held=[True])
    with pytest.raises(FactorError, match="positive definite"):
        SpotBatch.from_arrays([[0, 0]], [-np.eye(2)], [np.eye(4)], [0], [0], [0])
    with pytest.raises(FactorError, match="expected"):
        SpotBatch.from_arrays([[0, 0, 0]], [np.eye(2)], [np.eye(4)], [0], [0], [0])
    with pytest.raises(FactorError, match="beam frames"):
        keys_for(1, 2, 1, [scene.frame])
    with pytest.raises(FactorError, match="loss"):
        Loss("tukey")  # type: ignore[arg-type]
    with pytest.raises(FactorError, match="zero"):
        BeamFrame.from_line([0, 0, 0], [0, 0, 0])
    with pytest.raises(FactorError, match="90 deg"):
        scene.frame.coordinates(-scene.frame.R[:, 2], np.zeros(3))


@pytest.mark.parametrize(
    ("jacobian", "message"),
    [(np.eye(3), "expected"), (np.zeros((2, 4)), "expected"), (np.full((4, 4), 0.0), None)],
)
def test_custom_factor_checks_shapes(jacobian: np.ndarray, message: str | None) -> None:
    key = gtsam.symbol("l", 0)
    factor = custom_factor(
        "toy", gtsam.noiseModel.Unit.Create(4), [key], [4],
        lambda v: v.atVector(key), lambda v: (v.atVector(key), [jacobian]),
    )  # fmt: skip
    values = gtsam.Values()
    values.insert(key, np.zeros(4))
    if message is None:
        factor.linearize(values)
    else:
        with pytest.raises(FactorError, match=message):
            factor.linearize(values)


@pytest.mark.parametrize("direction", [*BEAMS.values(), [1e-9, 0.0, -1.0]])
def test_beam_frame_round_trip(direction: list[float]) -> None:
    frame = BeamFrame.from_line(direction, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(frame.R.T @ frame.R, np.eye(3), atol=1e-15)
    assert np.linalg.det(frame.R) == pytest.approx(1)
    np.testing.assert_allclose(frame.coordinates(direction, [0.1, 0.2, 0.3]), 0, atol=1e-15)
    coordinates = np.array([0.1, -0.2, 0.01, 0.02])
    u, q = frame.line(coordinates)
    np.testing.assert_allclose(frame.coordinates(3 * u, q + 0.7 * u), coordinates, atol=1e-15)
