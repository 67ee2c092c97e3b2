"""Independent reference of the chain beam -> plane -> camera -> pixel and of its derivatives.

Plain numpy, written from the geometry in another form than the package: the hit by Pluecker
coordinates of the beam, the tangential distortion in vector form. Everything accepts complex
arrays, so that a complex step gives derivatives free of cancellation (to about 1e-15 relative).

Arrays may have leading dimensions that broadcast: one camera, beam or plane for all spots, or one
each. Metres, radians, pixels; frames as in the package.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64] | npt.NDArray[np.complex128]

STEP = 1e-30


class Spots(NamedTuple):
    """What is known of each spot: hand pose in base and the seen pixel."""

    R_base_hand: Array  # (N, 3, 3)
    t_base_hand: Array  # (N, 3)
    uv: Array  # (N, 2)


class State(NamedTuple):
    """What is estimated, and the constant frame of the beam."""

    R_base_camera: Array  # (3, 3)
    t_base_camera: Array  # (3,)
    intrinsics: Array  # (9,): fu fv skew u0 v0 k1 k2 p1 p2
    R_hand_beam: Array  # (3, 3), constant
    t_hand_beam: Array  # (3,), constant
    beam: Array  # (4,): a b x y; along R (a, b, 1) through t + R (x, y, 0)
    normal: Array  # (3,) or (N, 3): n . x = d
    distance: Array  # () or (N,)


def spot_in_base(spots: Spots, state: State) -> Array:
    """Hit of the beam on the plane, (N, 3): ``(d u + n x (q x u)) / (n . u)``."""
    a, b, x, y = np.moveaxis(np.asarray(state.beam), -1, 0)
    one, zero = np.ones_like(a), np.zeros_like(a)
    direction = _apply(state.R_hand_beam, np.stack([a, b, one], axis=-1))
    point = _apply(state.R_hand_beam, np.stack([x, y, zero], axis=-1)) + state.t_hand_beam
    u = _apply(spots.R_base_hand, direction)
    q = _apply(spots.R_base_hand, point) + spots.t_base_hand
    moment = np.cross(q, u)
    weight = np.sum(state.normal * u, axis=-1)[..., None]
    return (np.asarray(state.distance)[..., None] * u + np.cross(state.normal, moment)) / weight


def residual(spots: Spots, state: State) -> Array:
    """Predicted minus seen pixel, (N, 2); no test of cheirality."""
    R = np.swapaxes(state.R_base_camera, -1, -2)
    p = _apply(R, spot_in_base(spots, state) - state.t_base_camera)
    xy = p[..., :2] / p[..., 2:]
    fu, fv, skew, u0, v0, k1, k2, p1, p2 = np.moveaxis(np.asarray(state.intrinsics), -1, 0)
    r2 = np.sum(xy * xy, axis=-1)[..., None]
    decentring = np.stack([p2, p1], axis=-1)
    radial = 1 + k1[..., None] * r2 + k2[..., None] * r2**2
    tangential = 2 * np.sum(decentring * xy, axis=-1)[..., None] * xy + r2 * decentring
    xd, yd = np.moveaxis(radial * xy + tangential, -1, 0)
    return np.stack([fu * xd + skew * yd + u0, fv * yd + v0], axis=-1) - spots.uv


def step(state: State, delta: Array, basis: Array) -> State:
    """State moved by a small tangent vector, (22,), to first order.

    Camera ``R exp([w]x)``, ``T + R v`` (rotation first, both in the camera frame, as
    `gtsam.Pose3`); normal ``n + basis a`` with ``basis`` (3, 2) or (N, 3, 2); the rest is additive.
    """
    w, v = delta[0:3], delta[3:6]
    R = np.asarray(state.R_base_camera)
    turn = np.cross(np.eye(3), w)  # rows e_i x w: the matrix [w]x
    return state._replace(
        R_base_camera=R + R @ turn,
        t_base_camera=state.t_base_camera + R @ v,
        intrinsics=state.intrinsics + delta[6:15],
        beam=state.beam + delta[15:19],
        normal=state.normal + basis @ delta[19:21],
        distance=state.distance + delta[21],
    )


def jacobian_complex_step(spots: Spots, state: State, basis: Array) -> npt.NDArray[np.float64]:
    """Derivative of `residual`, (N, 2, 22): pose 6 | intrinsics 9 | beam 4 | normal 2, distance."""
    columns = []
    for j in range(22):
        delta = np.zeros(22, dtype=np.complex128)
        delta[j] = 1j * STEP
        columns.append(np.imag(residual(spots, step(state, delta, basis))) / STEP)
    return np.stack(columns, axis=-1)


def _apply(R: Array, v: Array) -> Array:
    return np.sum(R * np.asarray(v)[..., None, :], axis=-1)
