"""The compiled chain and its analytic derivatives against the independent reference."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
import reference
from lasercal_factors.spot import SpotBatch, State
from scipy.spatial.transform import Rotation

from lasercal_gtsam import Beam, Camera, Cell, Intrinsics, Plane, project
from lasercal_gtsam.rotations import basis_of, make_pose

CENTRE = np.array([0.1, -0.05, 0.6])  # about where the spots lie, in base
BEAMS = {"tool z": [0, 0, 1.0], "tool y": [0, 1.0, 0], "oblique": [0.74, 0.3, 0.6]}
NORMALS = {"table": [0, 0, 1.0], "tilted": [0.2, -0.5, 0.8]}


def scene(beam: str, normal: str) -> tuple[reference.Spots, reference.State, np.ndarray]:
    rng = np.random.default_rng(7)
    count = 40
    u0, n = (np.array(v) / np.linalg.norm(v) for v in (BEAMS[beam], NORMALS[normal]))
    R_hand_beam = np.column_stack([basis_of(u0), u0])
    line = np.array([0.03, -0.02, 0.004, 0.007])
    u = R_hand_beam @ [line[0], line[1], 1.0]
    origin = R_hand_beam @ [line[2], line[3], 0.0] + [0.01, -0.02, 0.05]
    # beams from above, towards points of the plane about CENTRE
    targets = CENTRE + rng.uniform(-0.08, 0.08, (count, 2)) @ basis_of(n).T
    down = -n + 0.3 * rng.standard_normal((count, 3))
    R = np.array([Rotation.align_vectors(a, u)[0].as_matrix() for a in down])
    R = R @ Rotation.from_rotvec(rng.uniform(-1, 1, (count, 1)) * u / np.linalg.norm(u)).as_matrix()
    length = rng.uniform(0.08, 0.16, (count, 1)) / np.linalg.norm(u)
    t = targets - np.einsum("nij,nj->ni", R, origin + length * u)
    forward = np.array([0.3, 0.1, -1.0])
    R_base_camera = Rotation.align_vectors(forward, [0, 0, 1.0])[0].as_matrix()
    state = reference.State(
        R_base_camera,
        CENTRE - 0.4 * forward / np.linalg.norm(forward),
        np.array([550, 560, 3.0, 320, 240, -0.3, 0.2, 2e-3, -1e-3]),
        R_hand_beam,
        np.array([0.01, -0.02, 0.05]),
        line,
        n,
        np.array(n @ CENTRE),
    )
    uv = rng.uniform([0, 0], [640, 480], (count, 2))
    return reference.Spots(R, t, uv), state, basis_of(n)


def hand_poses(spots: reference.Spots) -> np.ndarray:
    pairs = zip(spots.R_base_hand, spots.t_base_hand, strict=True)
    return np.array([make_pose(R, t) for R, t in pairs])


@pytest.mark.parametrize("normal", NORMALS)
@pytest.mark.parametrize("beam", BEAMS)
def test_reference_predicts_what_the_readable_projection_predicts(beam: str, normal: str) -> None:
    spots, state, _ = scene(beam, normal)
    R0 = state.R_hand_beam
    line = Beam(R0 @ [*state.beam[:2], 1], R0 @ [*state.beam[2:], 0] + state.t_hand_beam)
    pose = make_pose(state.R_base_camera, state.t_base_camera)
    camera = Camera(Intrinsics.from_vector(state.intrinsics), pose, (640, 480))
    cell = Cell({"c": camera}, {"l": line}, {"p": Plane(state.normal, float(state.distance))})
    expected = project(cell, hand_poses(spots)) - spots.uv
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(reference.residual(spots, state), expected, rtol=0, atol=1e-10)


def test_reference_derivative_is_that_of_finite_steps() -> None:
    spots, state, basis = scene("oblique", "tilted")
    J = reference.jacobian_complex_step(spots, state, basis)
    scale = np.array([1e-6] * 6 + [1e-3] * 5 + [1e-6] * 11)
    for j, h in enumerate(scale):
        delta = np.zeros(22)
        delta[j] = h
        forward, backward = (reference.step(state, s * delta, basis) for s in (1, -1))
        turn = Rotation.from_rotvec(delta[:3]).as_matrix()  # the true exponential, not its start
        forward = forward._replace(R_base_camera=state.R_base_camera @ turn)
        backward = backward._replace(R_base_camera=state.R_base_camera @ turn.T)
        slope = (reference.residual(spots, forward) - reference.residual(spots, backward)) / (2 * h)
        np.testing.assert_allclose(
            J[:, :, j], slope, rtol=1e-6, atol=1e-5 * np.abs(J[..., j]).max()
        )


@pytest.mark.parametrize("normal", NORMALS)
@pytest.mark.parametrize("beam", BEAMS)
def test_kernel_rows_are_the_reference_derivative(beam: str, normal: str) -> None:
    spots, state, _ = scene(beam, normal)
    count = len(spots.uv)
    W = np.array([[1.3, -0.4], [0.0, 0.7]])
    batch = SpotBatch.from_arrays(
        spots.uv,
        np.tile(np.linalg.inv(W.T @ W), (count, 1, 1)),
        hand_poses(spots),
        *np.zeros((3, count), dtype=int),
    )
    rows = batch.rows(State(*(np.array(x)[None] for x in state)))
    basis = gtsam.Unit3(state.normal).basis()
    expected = W @ reference.jacobian_complex_step(spots, state, basis)
    expected[..., 21] *= -1  # the kernel's offset is GTSAM's: n . x + d = 0
    error = np.abs(rows[..., :22] - expected).max(axis=(0, 1)) / np.abs(expected).max(axis=(0, 1))
    assert error.max() < 1e-13
    residual = reference.residual(spots, state) @ W.T
    np.testing.assert_allclose(rows[..., 22], residual, rtol=0, atol=1e-10)
