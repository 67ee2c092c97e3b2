"""Robot noise: the same as six more unknowns for every spot, each with a prior."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from core_cases import distance_in_sigmas, rows_of
from lasercal_factors.wrap import custom_factor

import lasercal_gtsam as lc
from lasercal_gtsam.hand_noise import HandNoise, corrected_batch, corrections, linearized
from lasercal_gtsam.rotations import rotation_exp
from lasercal_gtsam.simulate import Noise, simulate

NOISE = Noise(pixel_px=0.3, hand_translation_m=1e-3, hand_rotation_rad=np.radians(0.05))
OPTIONS = {"sigma_px": 0.3, "hand_sigma_m": 1e-3, "hand_sigma_rad": float(np.radians(0.05))}
INTRINSICS = ("fu", "fv", "u0", "v0")


def options(**changes):
    return lc.CalibrationOptions(**({"robust": "none"} | OPTIONS | changes))


@pytest.fixture(scope="module")
def paper():
    return simulate("paper", 1, NOISE)


class ExplicitHands:
    """Every hand pose a variable of its own with a prior; derivatives by differences.

    The cell is one vector: camera rotation vector (about the truth) and position, four intrinsics,
    beam tilts and shifts, plane vectors. GTSAM solves it as it stands.
    """

    def __init__(self, simulation):
        self.seen, self.truth = simulation.observations, simulation.truth
        planes = self.truth.planes.values()
        camera = self.truth.cameras["camera"]
        beam = self.truth.lasers["laser"]
        self.across = np.linalg.svd(beam.direction_hand[None])[2][1:].T
        self.x0 = np.concatenate(
            [np.zeros(3), camera.T_base_camera[:3, 3],
             [getattr(camera.intrinsics, n) for n in INTRINSICS],
             np.zeros(4), *(p.vector for p in planes)]
        )  # fmt: skip

    def cell(self, x):
        return self._cell(tuple(x))

    @cache  # noqa: B019 - the spots of one linearisation ask for the same cells
    def _cell(self, x):
        x = np.array(x)
        camera, beam = self.truth.cameras["camera"], self.truth.lasers["laser"]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation_exp(x[:3]) @ camera.T_base_camera[:3, :3], x[3:6]
        intrinsics = replace(camera.intrinsics, **dict(zip(INTRINSICS, x[6:10], strict=True)))
        moved = lc.Beam(
            beam.direction_hand + self.across @ x[10:12], beam.point_hand + self.across @ x[12:14]
        )
        planes = {
            name: lc.Plane.from_vector(x[14 + 3 * i : 17 + 3 * i])
            for i, name in enumerate(self.truth.planes)
        }
        return lc.Cell(
            {"camera": lc.Camera(intrinsics, T, camera.image_size)}, {"laser": moved}, planes
        )

    def rows(self, x, reference):
        return np.array(list(rows_of(self.cell(x), reference).values()))

    def error(self, k, x, *poses):
        T = np.array([pose.matrix() for pose in poses])
        uv = lc.project(self.cell(x), T, plane=str(self.seen.plane[k]))
        return (uv - self.seen.uv[k]) / OPTIONS["sigma_px"]

    def spot_factor(self, k, cell_key, hand_key):
        steps = 1e-6 * np.maximum(np.abs(self.x0), 1e-1)

        def error(values):
            return self.error(k, values.atVector(cell_key), values.atPose3(hand_key))[0]

        def linearize(values):
            x, pose = values.atVector(cell_key), values.atPose3(hand_key)
            J = [
                (self.error(k, x + h * e, pose) - self.error(k, x - h * e, pose))[0] / (2 * h)
                for h, e in zip(steps, np.eye(len(x)), strict=True)
            ]
            moved = [pose.retract(h * e) for h in (1e-6, -1e-6) for e in np.eye(6)]
            plus, minus = np.split(self.error(k, x, *moved), 2)
            return self.error(k, x, pose)[0], [np.stack(J, axis=1), (plus - minus).T / 2e-6]

        noise = gtsam.noiseModel.Unit.Create(2)
        dims = (len(self.x0), 6)
        return custom_factor("spot", noise, (cell_key, hand_key), dims, error, linearize)

    def solve(self):
        graph, values, key = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.symbol("c", 0)
        values.insert(key, self.x0)
        sigmas = np.repeat([OPTIONS["hand_sigma_rad"], OPTIONS["hand_sigma_m"]], 3)
        prior = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        for k, T in enumerate(self.seen.T_base_hand):
            hand = gtsam.symbol("h", k)
            values.insert(hand, gtsam.Pose3(T))
            graph.add(gtsam.PriorFactorPose3(hand, gtsam.Pose3(T), prior))
            graph.add(self.spot_factor(k, key, hand))
        params = gtsam.LevenbergMarquardtParams.CeresDefaults()
        params.setRelativeErrorTol(1e-12)
        result = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
        x = result.atVector(key)
        covariance = gtsam.Marginals(graph, result).marginalCovariance(key)
        reference = self.cell(x)
        F = np.stack(
            [
                (self.rows(x + h * e, reference) - self.rows(x - h * e, reference)) / (2 * h)
                for h, e in zip(1e-6 * np.maximum(np.abs(x), 0.1), np.eye(len(x)), strict=True)
            ],
            axis=1,
        )
        return reference, 2 * graph.error(result), np.sqrt(np.diag(F @ covariance @ F.T))


def test_as_with_a_variable_for_every_hand_pose():
    simulation = simulate("paper-2", 1, NOISE, groups=3, shots=4)
    result = lc.calibrate(
        simulation.observations, options=options(distortion="none", known={"skew": 0.0})
    )
    cell, cost, sigmas = ExplicitHands(simulation).solve()
    dof = 2 * len(simulation.observations) - 20
    # the explicit graph takes the sigmas as given; ours scales them by what the residuals say
    assert result.fit.sigma0 == pytest.approx(np.sqrt(cost / dof), rel=1e-4)
    assert distance_in_sigmas(result, cell) < 1e-3
    found = np.array([p.sigma for p in result.parameters])
    held = np.array([p.sigma == 0 for p in result.parameters])
    np.testing.assert_allclose(found[~held], result.fit.sigma0 * sigmas[~held], rtol=2e-3)
    assert [p.name for p in result.parameters if p.sigma == 0] == [
        "alpha_c",
        "k1",
        "k2",
        "p1",
        "p2",
    ]


def test_corrections_are_the_likeliest():
    """Minimum of |r + B eta|^2 / pixel + |eta|^2 / hand over eta, by its gradient."""
    simulation = simulate("paper", 2, NOISE)
    seen, cell = simulation.observations, simulation.truth
    noise = HandNoise(OPTIONS["hand_sigma_m"], OPTIONS["hand_sigma_rad"])
    cov = np.broadcast_to(0.3**2 * np.eye(2), (90, 2, 2))
    eta = np.zeros((90, 6))
    for _ in range(4):
        B, r = linearized(seen, cell, eta)
        eta = corrections(B, r, cov, noise)
    gradient = np.einsum("nij,ni->nj", B, r + np.einsum("nij,nj->ni", B, eta)) / 0.09
    gradient += eta / noise.variances
    np.testing.assert_allclose(gradient * np.sqrt(noise.variances), 0, atol=1e-9)
    # with the robot's noise alone the corrections find a good part of what was done to the hands
    done = simulation.T_base_hand_actual[:, :3, 3] - seen.T_base_hand[:, :3, 3]
    assert np.corrcoef(eta[:, :3].ravel(), done.ravel())[0, 1] > 0.5


def test_derivative_by_the_hand_pose():
    simulation = simulate("table2-4", 2)
    seen, cell = simulation.observations, simulation.truth
    rng = np.random.default_rng(0)
    eta = rng.standard_normal((80, 6)) * np.repeat([1e-3, 1e-3], 3)
    B, r = linearized(seen, cell, eta)

    def pixels(step):
        T = seen.T_base_hand.copy()
        T[:, :3, 3] += step[:, :3]
        T[:, :3, :3] = T[:, :3, :3] @ rotation_exp(step[:, 3:])
        return lc.project(cell, T, plane=seen.plane)

    # a step of the rotation is one more turn of the corrected hand
    h = 1e-6
    for j in range(6):
        if j < 3:
            plus, minus = eta.copy(), eta.copy()
            plus[:, j] += h
            minus[:, j] -= h
            numerical = (pixels(plus) - pixels(minus)) / (2 * h)
        else:
            numerical = (turned(pixels, eta, j, h) - turned(pixels, eta, j, -h)) / (2 * h)
        np.testing.assert_allclose(B[:, :, j], numerical, rtol=0, atol=2e-4)
    np.testing.assert_allclose(
        r + np.einsum("nij,nj->ni", B, eta), pixels(eta) - seen.uv, atol=1e-9
    )


def turned(pixels, eta, j, h):
    turn = np.zeros((len(eta), 3))
    turn[:, j - 3] = h
    R = rotation_exp(eta[:, 3:]) @ rotation_exp(turn)
    vectors = np.array([gtsam.Rot3.Logmap(gtsam.Rot3(x)) for x in R])
    return pixels(np.column_stack([eta[:, :3], vectors]))


def test_a_spot_that_cannot_be_is_not_corrected():
    simulation = simulate("paper", 2, NOISE)
    seen, cell = simulation.observations, simulation.truth
    T = seen.T_base_hand.copy()
    T[7, :3, :3] = T[7, :3, :3] @ rotation_exp(np.array([np.pi, 0, 0]))  # the beam points away
    seen = replace(seen, T_base_hand=T)
    noise = HandNoise(1e-3, 1e-3)
    B, r = linearized(seen, cell, np.zeros((90, 6)))
    cov = np.broadcast_to(np.eye(2), (90, 2, 2))
    eta = corrections(B, r, cov, noise)
    assert not eta[7].any()
    assert eta[6].any()
    assert len(corrected_batch(seen, cov, cell, noise, eta)) == 90


def test_no_hand_noise_is_the_plain_fit(paper):
    plain = lc.calibrate(paper.observations, options=options(hand_sigma_m=0.0, hand_sigma_rad=0.0))
    tiny = lc.calibrate(paper.observations, options=options(hand_sigma_m=1e-9, hand_sigma_rad=1e-9))
    assert distance_in_sigmas(plain, tiny) < 1e-5
    assert tiny.fit.sigma0 == pytest.approx(plain.fit.sigma0, rel=1e-5)


def test_sigmas_grow_and_the_scale_is_one(paper):
    plain = lc.calibrate(paper.observations, options=options(hand_sigma_m=0.0, hand_sigma_rad=0.0))
    result = lc.calibrate(paper.observations, options=options())
    assert plain.fit.sigma0 > 3.0  # the robot's noise is in the residuals all the same
    assert result.fit.sigma0 == pytest.approx(1.0, abs=0.2)
    assert result.fit.converged
    # the residuals that are shown are those of the commanded poses
    assert result.fit.rms_px > 1.0


@pytest.mark.parametrize("pixel", [0.3, 1.0, 3.0])
def test_a_missing_pixel_sigma_is_found_beside_the_robots_noise(pixel):
    found = []
    for seed in range(6):
        simulation = simulate("paper", seed, replace(NOISE, pixel_px=pixel))
        result = lc.calibrate(
            simulation.observations, initial=simulation.truth,
            options=options(sigma_px=None, distortion="none"),
        )  # fmt: skip
        assert result.fit.converged
        found.append(result.fit.sigma0)
    # the robot's noise is about 3 px here: what is left for a small pixel sigma is uncertain
    assert np.mean(found) == pytest.approx(pixel, rel=0.15, abs=0.35)
    if pixel == 1.0:
        given = lc.calibrate(
            simulation.observations, initial=simulation.truth,
            options=options(sigma_px=result.fit.sigma0, distortion="none"),
        )  # fmt: skip
        assert distance_in_sigmas(given, result) < 1e-3
        assert given.fit.sigma0 == pytest.approx(1.0, abs=1e-3)
        for a, b in zip(given.parameters, result.parameters, strict=True):
            assert b.sigma == pytest.approx(a.sigma, rel=1e-3)


def test_noise_larger_than_the_data_can_bear_is_said(paper):
    """A metre of robot noise: no number without a word."""
    try:
        result = lc.calibrate(paper.observations, options=options(hand_sigma_m=1.0))
    except lc.LasercalError as error:
        assert "robot" in str(error) or "hand" in str(error) or "undetermined" in str(error)
    else:
        assert not result.fit.converged or result.fit.sigma0 < 0.1
