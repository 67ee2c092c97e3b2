"""Malm and Heyden: intrinsics and eye-to-hand from a planar pattern that translates.

H. Malm, A. Heyden, "A new approach to hand-eye calibration" (ICPR 2000) and "Simplified intrinsic
camera calibration and hand-eye calibration for robot vision" (IROS 2003), with the pattern on the
hand. The images of the pattern's axes and of the known translations share one scale, so that each
orientation with two translations gives five equations for the conic. Four of them are independent
(the plane of the pattern and that of the translations share a line): one orientation is enough for
``K`` without skew, two for ``K`` with it.
"""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.closed_form.linear import null_vector
from lasercal_gtsam.errors import DataError, DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Index
from lasercal_gtsam.rotations import make_pose, nearest_rotation
from lasercal_gtsam.study.methods.conic import conic_rows, intrinsics_from_conic
from lasercal_gtsam.study.methods.views import EyeToHand, HandViews


def calibrate_malm_heyden(
    views: HandViews, pattern: Array, *, zero_skew: bool = False
) -> EyeToHand:
    """Solve in closed form: one linear map for each orientation, conic, poses, positions.

    Parameters
    ----------
    views : four points or more; per orientation a start and translations out of the pattern's
        plane; three orientations or more, not about one axis
    pattern : (J, 2) coordinates of the points in the pattern's plane, metres
    zero_skew : whether the skew is known to be zero

    Returns
    -------
    EyeToHand
        With the pattern's points in the hand.

    Raises
    ------
    DataError
        ``pattern`` does not match the views, or two shots of one orientation have one position.
    DegenerateError
        Too few orientations or translations, or no camera explains them.
    """
    views.need("calibrate_malm_heyden", 4)
    if pattern.shape != (views.uv.shape[1], 2):
        raise DataError(
            f"calibrate_malm_heyden: pattern: expected shape ({views.uv.shape[1]}, 2), one row for "
            f"each point, got {pattern.shape}"
        )
    groups = [shots for shots in views.orientations() if len(shots) > 1]
    if not groups:
        raise DegenerateError("the hand never translates: no scale for the pattern's images")
    for shots in groups:
        moves = np.linalg.norm(views.t[shots[1:]] - views.t[shots[0]], axis=1)
        if not (moves > 0).all():
            again = shots[1:][~(moves > 0)][0]
            raise DataError(
                f"calibrate_malm_heyden: shots {shots[0]} and {again} have the same hand pose; "
                "leave one out"
            )
    maps = [_pattern_map(views, shots, pattern) for shots in groups]
    rows = [_conic_equations(views, shots, H) for shots, H in zip(groups, maps, strict=True)]
    K_scaled = intrinsics_from_conic(np.concatenate(rows), zero_skew)
    turns, places, seen, moved = [], [], [], []
    for shots, H in zip(groups, maps, strict=True):
        C = np.linalg.solve(K_scaled, H)
        C = C / np.mean(np.linalg.norm(C[:, :2], axis=0))
        turns.append(nearest_rotation(np.column_stack([C[:, :2], np.cross(C[:, 0], C[:, 1])])))
        places.append(C[:, 2])
        directions = (C[:, 3:] - C[:, 2:3]).T
        seen.append(directions / np.linalg.norm(directions, axis=1, keepdims=True))
        tau = views.t[shots[1:]] - views.t[shots[0]]
        moved.append(tau / np.linalg.norm(tau, axis=1, keepdims=True))
    R_cb = nearest_rotation(np.concatenate(seen).T @ np.concatenate(moved))
    first = np.array([shots[0] for shots in groups])
    R_pattern = nearest_rotation(
        sum((R_cb @ views.R[k]).T @ turn for k, turn in zip(first, turns, strict=True))
    )
    T_pattern, T_cb = _positions(R_cb @ views.R[first], np.array(places) - views.t[first] @ R_cb.T)
    return EyeToHand(
        K=np.asarray(np.linalg.solve(views.scaling, K_scaled)),
        T_base_camera=make_pose(R_cb.T, -R_cb.T @ T_cb),
        points_hand=pattern @ R_pattern[:, :2].T + T_pattern,
    )


def _pattern_map(views: HandViews, shots: Index, pattern: Array) -> Array:
    """``[h1 h2 h3^(0) h3^(1) ...]`` (3, 2 + shots): ``m ~ h1 x + h2 y + h3^(shot)``.

    One DLT over all shots of an orientation, with the pattern scaled by its rms; positive depth in
    the first shot.
    """
    scale = float(np.sqrt(np.mean(pattern**2)))
    count, points = len(shots), len(pattern)
    x = np.zeros((count, points, 2 + count))
    x[:, :, :2] = pattern / scale
    x[np.arange(count), :, 2 + np.arange(count)] = 1.0
    m = views.xy[shots]
    rows = np.zeros((count, points, 2, 3, 2 + count))
    rows[:, :, 0, 0] = x
    rows[:, :, 1, 1] = x
    rows[:, :, :, 2] = -m[..., :2, None] * x[:, :, None]
    H = null_vector(rows.reshape(-1, 3 * (2 + count))).reshape(3, 2 + count)
    H = H if np.sum(x[0] @ H[2]) > 0 else -H
    H[:, :2] /= scale
    return np.asarray(H)


def _conic_equations(views: HandViews, shots: Index, H: Array) -> Array:
    """Axes orthonormal, translations as long as commanded and at the commanded angles.

    All divided by the square of the first axis' image, and by the lengths of the translations, so
    that every equation counts alike.
    """
    h1, h2 = H[:, 0], H[:, 1]
    unit = float(h1 @ h1)
    tau = views.t[shots[1:]] - views.t[shots[0]]
    length = np.linalg.norm(tau, axis=1)
    q = (H[:, 3:] - H[:, 2:3]).T / length[:, None]
    d = tau / length[:, None]
    one = 0.5 * (conic_rows(h1, h1) + conic_rows(h2, h2))
    j, k = np.triu_indices(len(q))
    lengths = conic_rows(q[j], q[k]) - np.sum(d[j] * d[k], axis=1)[:, None] * one
    axes = [conic_rows(h1, h2), conic_rows(h1, h1) - conic_rows(h2, h2)]
    return np.concatenate([np.array(axes), lengths]) / unit


def _positions(turned: Array, b: Array) -> tuple[Array, Array]:
    """``T_o`` and ``T_cb`` from ``turned_i T_o + T_cb = b_i`` (G, 3, 3), (G, 3)."""
    A = np.concatenate([turned, np.tile(np.eye(3), (len(turned), 1, 1))], axis=2).reshape(-1, 6)
    found, _, rank, _ = np.linalg.lstsq(A, b.reshape(-1), rcond=1e-10)
    if rank < 6:
        raise DegenerateError(
            "pattern and camera position cannot be told apart; turn the hand about two axes or more"
        )
    return found[:3], found[3:]
