"""Rotations as the paper writes them, and small helpers on poses (4x4 arrays)."""

from __future__ import annotations

import numpy as np
from lasercal_factors.beam import basis_across

from lasercal_gtsam.frozen import Array


def rotation_from_zyx(theta: float, phi: float, psi: float) -> Array:
    """``R = Rz(theta) Ry(phi) Rx(psi)``, angles in radians (method note 1.1)."""
    (ct, cp, cs), (st, sp, ss) = np.cos([theta, phi, psi]), np.sin([theta, phi, psi])
    return np.array(
        [
            [ct * cp, ct * sp * ss - st * cs, ct * sp * cs + st * ss],
            [st * cp, st * sp * ss + ct * cs, st * sp * cs - ct * ss],
            [-sp, cp * ss, cp * cs],
        ]
    )


def zyx_from_rotation(R: Array) -> Array:
    """``(theta, phi, psi)`` in radians with ``R = Rz(theta) Ry(phi) Rx(psi)``; phi in +-90 deg."""
    return np.array(
        [
            np.arctan2(R[1, 0], R[0, 0]),
            np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0])),
            np.arctan2(R[2, 1], R[2, 2]),
        ]
    )


def skew(v: Array) -> Array:
    """``[v]x`` with ``skew(a) @ b = a x b`` (stacks allowed, shape (..., 3))."""
    v = np.asarray(v)
    W = np.zeros((*v.shape[:-1], 3, 3))
    W[..., 2, 1], W[..., 0, 2], W[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return W - np.swapaxes(W, -1, -2)


def rotation_exp(w: Array) -> Array:
    """Rotation matrix of the rotation vector ``w`` (radians; stacks allowed, shape (..., 3)).

    Rodrigues' formula in terms of sinc, which needs no special case for small angles.
    """
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    W = skew(w)
    half = np.sinc(angle / (2 * np.pi))
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * W + 0.5 * half**2 * (W @ W))


def rotation_log(R: Array) -> Array:
    """Rotation vector (3,) of a rotation matrix, radians, at most pi long."""
    sine = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    s, c = float(np.linalg.norm(sine)), 0.5 * (float(np.trace(R)) - 1.0)
    angle = float(np.arctan2(s, c))
    if c > -0.99:
        return sine * (angle / s if s > 1e-9 else 1.0)
    # near half a turn the sine is lost: the axis spans the symmetric part's largest column
    axis = (R + R.T + (1.0 - float(np.trace(R))) * np.eye(3))[:, int(np.argmax(np.diag(R)))]
    axis = axis / np.linalg.norm(axis)
    return np.asarray(angle * (axis if axis @ sine >= 0 else -axis))


def nearest_rotation(M: Array) -> Array:
    """Closest rotation matrix in the Frobenius norm (stacks allowed, shape (..., 3, 3))."""
    U, _, Vt = np.linalg.svd(M)
    sign = np.ones((*M.shape[:-2], 3))
    sign[..., 2] = np.sign(np.linalg.det(U @ Vt))
    return np.asarray((U * sign[..., None, :]) @ Vt)


def make_pose(R: Array, t: Array) -> Array:
    """Assemble the 4x4 transform of rotation ``R`` and translation ``t``."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def basis_of(v: Array) -> Array:
    """``E_v``: 3x2 orthonormal basis of the plane across ``v`` with ``e1 x e2 = v/|v|``.

    Deterministic and built from the coordinate axis least aligned with ``v``.
    """
    return basis_across(v / np.linalg.norm(v))
