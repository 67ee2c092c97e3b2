"""Reprojection refinement of what the comparison methods find."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from lasercal_gtsam.errors import DataError, SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.rotations import make_pose, nearest_rotation, rotation_exp
from lasercal_gtsam.study.methods.views import EyeToHand, HandViews

_CAMERA = 10  # f_u, f_v, u0, v0, rotation, position
_MAX_EVALUATIONS = 200


def refine_views(views: HandViews, start: EyeToHand, pattern: Array | None = None) -> EyeToHand:
    """Least squares of the pixels over intrinsics without skew, camera pose and hand points.

    Parameters
    ----------
    views : what was seen
    start : from a closed form
    pattern : (J, 3) metres; with it the points move as one rigid body of this shape (a plane
        pattern has z = 0), without it each by itself

    Returns
    -------
    EyeToHand

    Raises
    ------
    DataError
        ``pattern`` does not match the views.
    SolveError
        The minimum was not reached, or the points left the front of the camera.
    """
    if pattern is not None and pattern.shape != (views.uv.shape[1], 3):
        raise DataError(
            f"refine_views: pattern: expected shape ({views.uv.shape[1]}, 3), one row for each "
            f"point, got {pattern.shape}"
        )
    R0, T0 = start.T_base_camera[:3, :3], start.T_base_camera[:3, 3]
    if pattern is not None:
        P0, centre = _rigid(pattern, start.points_hand), start.points_hand.mean(axis=0)

    def cell(x: Array) -> EyeToHand:
        K = np.array([[x[0], 0.0, x[2]], [0.0, x[1], x[3]], [0.0, 0.0, 1.0]])
        pose = make_pose(R0 @ rotation_exp(x[4:7]), T0 + x[7:10])
        if pattern is None:
            points = start.points_hand + x[_CAMERA:].reshape(-1, 3)
        else:
            points = (P0 - centre) @ rotation_exp(x[10:13]).T + centre + x[13:16]
        return EyeToHand(K, pose, points)

    def residuals(x: Array) -> Array:
        return np.asarray((cell(x).predicted(views.T_base_hand) - views.uv).reshape(-1))

    K0 = start.K
    x0 = np.zeros(_CAMERA + (6 if pattern is not None else start.points_hand.size))
    x0[:4] = K0[0, 0], K0[1, 1], K0[0, 2], K0[1, 2]
    if len(x0) > views.uv.size:
        raise SolveError(f"{len(x0)} unknowns for {views.uv.size} pixel coordinates")
    # pixels, radians and metres each move the image by some pixels
    scale = np.concatenate([np.full(4, 10.0), np.full(3, 0.01), np.full(len(x0) - 7, 0.01)])
    found = least_squares(
        residuals,
        x0,
        jac="3-point",
        method="lm",
        x_scale=scale,
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
        max_nfev=_MAX_EVALUATIONS,
    )
    result = cell(found.x)
    in_front = _depths(result, views) > 0
    if not found.success or not in_front.all() or not (found.x[:2] > 0).all():
        raise SolveError(
            "the refinement did not end at a camera that sees the points: start closer, or look "
            "for a wrong pose or point"
        )
    return result


def _rigid(pattern: Array, points: Array) -> Array:
    """Closest rigid copy of ``pattern`` (J, 3) to ``points`` (J, 3)."""
    a, b = pattern - pattern.mean(axis=0), points - points.mean(axis=0)
    return np.asarray(a @ nearest_rotation(b.T @ a).T + points.mean(axis=0))


def _depths(cell: EyeToHand, views: HandViews) -> Array:
    base = cell.points_hand @ np.swapaxes(views.R, 1, 2) + views.t[:, None]
    return np.asarray((base - cell.T_base_camera[:3, 3]) @ cell.T_base_camera[:3, 2])
