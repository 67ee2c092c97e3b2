"""Horaud and Dornaika: hand-eye calibration from a known spatial object.

R. Horaud, F. Dornaika, "Hand-eye calibration", IJRR 14(3), 1995: ``AX = XB`` written with the
camera matrices themselves, ``M Y = M' Y B``, so that the intrinsics are not needed for it. Here the
camera is fixed and the object is on the hand: Y is the hand in the object's frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from lasercal_gtsam.closed_form.camera import upper_triangular_times_rotation
from lasercal_gtsam.closed_form.linear import dlt
from lasercal_gtsam.errors import DataError, DegenerateError
from lasercal_gtsam.frozen import Array, FrozenData, set_array
from lasercal_gtsam.rotations import (
    make_pose,
    nearest_rotation,
    rotation_exp,
    rotation_log,
)
from lasercal_gtsam.study.methods.views import EyeToHand, HandViews

# translation equations against axis differences, metres (the paper's refinement in both at once)
_LENGTH_SCALE_M = 0.1
# motions that turn less than this say nothing about the rotation
_LEAST_TURN_RAD = 1e-6
# close to half a turn an axis and its opposite are one, so that noise may swap them
_MOST_TURN_RAD = np.pi - 0.1


@dataclass(frozen=True, eq=False)
class ObjectInHand(FrozenData):
    """The object's pose in the hand, and the camera that follows from it.

    Attributes
    ----------
    camera : intrinsics, camera in base, the object's points in the hand
    T_hand_object : (4, 4), metres; refined
    T_hand_object_closed : (4, 4), the closed form
    """

    camera: EyeToHand
    T_hand_object: Array
    T_hand_object_closed: Array

    def __post_init__(self) -> None:
        set_array(self, "T_hand_object", self.T_hand_object, (4, 4))
        set_array(self, "T_hand_object_closed", self.T_hand_object_closed, (4, 4))


def calibrate_horaud_dornaika(views: HandViews, points: Array) -> ObjectInHand:
    """Camera matrix of every shot, intrinsics as their mean, hand-eye by ``M Y = M' Y B``.

    Parameters
    ----------
    views : three shots or more, turned about two axes or more
    points : (J, 3) the object's points in its own frame, metres; six or more, not in one plane

    Returns
    -------
    ObjectInHand

    Raises
    ------
    DataError
        ``points`` does not match the views, or too few.
    DegenerateError
        A shot gives no camera, or the hand turns about one axis only.
    """
    views.need("calibrate_horaud_dornaika", 6)
    if points.shape != (views.uv.shape[1], 3):
        raise DataError(
            f"calibrate_horaud_dornaika: points: expected shape ({views.uv.shape[1]}, 3), one row "
            f"for each point, got {points.shape}"
        )
    if len(views.uv) < 3:
        raise DataError(f"calibrate_horaud_dornaika: needs 3 shots or more, got {len(views.uv)}")
    M = camera_matrices(views, points)
    found = [upper_triangular_times_rotation(m[:, :3]) for m in M]
    K_scaled = np.mean([K for K, _ in found], axis=0)
    Y_closed, Y = hand_in_object(M, views.T_base_hand)
    closed, T_hand_object = np.asarray(np.linalg.inv(Y_closed)), np.asarray(np.linalg.inv(Y))
    K = np.asarray(np.linalg.solve(views.scaling, K_scaled))
    camera = EyeToHand(
        K=K,
        T_base_camera=_camera_in_base(M, K_scaled, views.T_base_hand @ T_hand_object),
        points_hand=points @ T_hand_object[:3, :3].T + T_hand_object[:3, 3],
    )
    return ObjectInHand(camera, T_hand_object, closed)


def camera_matrices(views: HandViews, points: Array) -> Array:
    """3x4 DLT of every shot, (S, 3, 4), in scaled pixels: the third row of unit length."""
    M = dlt(np.broadcast_to(points, (len(views.uv), *points.shape)), views.xy[..., :2])
    return np.asarray(M / np.linalg.norm(M[:, 2, :3], axis=1)[:, None, None])


def hand_in_object(M: Array, T_base_hand: Array) -> tuple[Array, Array]:
    """Y = T_object_hand by ``N_i Y = Y B_i``: closed form, and refined in both parts together.

    With ``M_i = [S_i s_i]`` and the first shot as reference: ``N_i = S_i^-1 S_1`` is the object's
    rotation from there, ``nu_i = S_i^-1 (s_1 - s_i)`` its translation, and
    ``B_i = T_base_hand_i^-1 T_base_hand_1`` the hand's. None of them needs intrinsics.

    Parameters
    ----------
    M : (S, 3, 4), any common image coordinates
    T_base_hand : (S, 4, 4), metres

    Raises
    ------
    DegenerateError
        The hand turns about one axis only.
    """
    S, s = M[:, :, :3], M[:, :, 3]
    N = nearest_rotation(np.asarray(np.linalg.solve(S[1:], np.broadcast_to(S[0], S[1:].shape))))
    nu = np.linalg.solve(S[1:], (s[0] - s[1:])[..., None])[..., 0]
    B = np.linalg.solve(T_base_hand[1:], np.broadcast_to(T_base_hand[0], T_base_hand[1:].shape))
    n, b = np.array([rotation_log(r) for r in N]), np.array([rotation_log(r[:3, :3]) for r in B])
    angle = np.linalg.norm(b, axis=1)
    turned = (angle > _LEAST_TURN_RAD) & (angle < _MOST_TURN_RAD)
    n, b = _unit(n[turned]), _unit(b[turned])
    if len(b) < 2 or np.linalg.svd(b, compute_uv=False)[1] < 1e-6:
        raise DegenerateError(
            "from the first shot the hand turns about one axis only, or by half a turn, which has "
            "no sign; turn it about another axis too"
        )
    R = nearest_rotation(n.T @ b)
    A = (N - np.eye(3)).reshape(-1, 3)

    def translation_gap(R: Array, t: Array) -> Array:
        return np.asarray(A @ t - (B[:, :3, 3] @ R.T - nu).reshape(-1))

    t = np.asarray(np.linalg.lstsq(A, -translation_gap(R, np.zeros(3)), rcond=None)[0])

    def residuals(x: Array) -> Array:
        turn = rotation_exp(x[:3]) @ R
        axes = (n - b @ turn.T).reshape(-1)
        return np.concatenate([axes, translation_gap(turn, t + x[3:]) / _LENGTH_SCALE_M])

    x = least_squares(
        residuals, np.zeros(6), jac="3-point", method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14
    ).x
    return make_pose(R, t), make_pose(rotation_exp(x[:3]) @ R, t + x[3:])


def _camera_in_base(M: Array, K: Array, T_base_object: Array) -> Array:
    """Mean over the shots of the camera's pose in the base."""
    turned = nearest_rotation(np.asarray(np.linalg.solve(K, M[:, :, :3])))
    place = np.linalg.solve(K, M[:, :, 3:])[..., 0]
    R = T_base_object[:, :3, :3] @ np.swapaxes(turned, 1, 2)
    t = T_base_object[:, :3, 3] - (R @ place[..., None])[..., 0]
    return make_pose(nearest_rotation(R.sum(axis=0)), t.mean(axis=0))


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))
