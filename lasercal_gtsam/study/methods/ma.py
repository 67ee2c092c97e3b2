"""Ma 1996: intrinsics and eye-to-hand from translations along orthogonal directions.

S. D. Ma, "A self-calibration technique for active vision systems", IEEE T-RA 12(1), 1996; there the
camera moves, here the hand moves some points before it. No point need be known. The points of two
shots joined by lines meet in the focus of expansion, the image of the translation's direction.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from lasercal_gtsam.closed_form.linear import null_vector
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.rotations import make_pose, nearest_rotation, skew
from lasercal_gtsam.study.methods.conic import conic_rows, intrinsics_from_conic
from lasercal_gtsam.study.methods.views import EyeToHand, HandViews

_ORTHOGONAL = 1e-6


def calibrate_ma(
    views: HandViews, *, zero_skew: bool = False, orthogonal: float = _ORTHOGONAL
) -> EyeToHand:
    """Solve in closed form: foci of expansion, conic, rotation, then the rest linearly.

    Every shot of an orientation but its first is a translation from the first. Translations of one
    orientation that are orthogonal as commanded give one equation for each pair.

    Parameters
    ----------
    views : two points or more, translations in orthogonal pairs from three orientations or more
    zero_skew : whether the skew is known to be zero
    orthogonal : commanded directions count as orthogonal up to this cosine; larger where the poses
        are rounded

    Returns
    -------
    EyeToHand

    Raises
    ------
    DataError
        Fewer than two points.
    DegenerateError
        Too few orthogonal translations, or no camera explains them.
    """
    views.need("calibrate_ma", 2)
    e, d, group = focus_of_expansion(views)
    rows = [
        conic_rows(e[a], e[b])
        for a, b in combinations(range(len(e)), 2)
        if group[a] == group[b] and abs(float(d[a] @ d[b])) < orthogonal
    ]
    if not rows:
        raise DegenerateError(
            f"no two translations of one orientation are orthogonal (cosine below {orthogonal:g});"
            " move the hand along orthogonal directions without turning it, or, for poses that "
            "are rounded, give a larger 'orthogonal'"
        )
    K_scaled = intrinsics_from_conic(np.array(rows), zero_skew)
    v = np.linalg.solve(K_scaled, e.T).T
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    R_cb = nearest_rotation(v.T @ d)
    rays = views.xy @ np.linalg.inv(K_scaled).T
    points, T_cb = points_and_translation(views, rays, R_cb)
    return EyeToHand(
        K=np.asarray(np.linalg.solve(views.scaling, K_scaled)),
        T_base_camera=make_pose(R_cb.T, -R_cb.T @ T_cb),
        points_hand=points,
    )


def focus_of_expansion(views: HandViews) -> tuple[Array, Array, Array]:
    """Focus of expansion of every translation, its commanded direction, and its orientation.

    The lines through a point's two images are not normalised: the farther it moved in the image,
    the more its line counts. Points that come closer to the focus move away from the camera, so
    the third coordinate is positive; else negative.

    Returns
    -------
    (M, 3), (M, 3), (M,) arrays
        Foci in scaled pixels, unit directions in base axes, number of the orientation.
    """
    e, d, group = [], [], []
    for g, shots in enumerate(views.orientations()):
        start = views.xy[shots[0]]
        for k in shots[1:]:
            end = views.xy[k]
            move = views.t[k] - views.t[shots[0]]
            if not np.linalg.norm(move) > 0:
                continue
            focus = null_vector(np.cross(start, end))
            # the sign of the depth change, with the focus's third coordinate taken out of both
            gap0 = start[:, :2] * focus[2] - focus[:2]
            gap1 = end[:, :2] * focus[2] - focus[:2]
            away = float(np.linalg.norm(gap0) - np.linalg.norm(gap1))
            e.append(focus * np.sign(focus[2] or 1.0) * (1.0 if away >= 0 else -1.0))
            d.append(move / np.linalg.norm(move))
            group.append(g)
    if not e:
        raise DegenerateError("the hand never moves without turning: no focus of expansion")
    return np.array(e), np.array(d), np.array(group)


def points_and_translation(views: HandViews, rays: Array, R_cb: Array) -> tuple[Array, Array]:
    """Points in the hand (J, 3) and ``T_cb`` (3,), metres, for a known camera rotation.

    Linear: ``[x] (R_cb (R_i P_j + t_i) + T_cb) = 0`` with the unit rays ``x`` of (S, J, 3).

    Raises
    ------
    DegenerateError
        The hand does not turn enough to tell the points from the camera.
    """
    shots, count = rays.shape[:2]
    x = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    cross = skew(x)
    A = np.zeros((shots, count, 3, 3 * count + 3))
    turned = cross @ (R_cb @ views.R)[:, None]
    for j in range(count):
        A[:, j, :, 3 * j : 3 * j + 3] = turned[:, j]
    A[..., -3:] = cross
    b = -(cross @ (views.t @ R_cb.T)[:, None, :, None])[..., 0]
    unknowns = A.shape[-1]
    found, _, rank, _ = np.linalg.lstsq(A.reshape(-1, unknowns), b.reshape(-1), rcond=1e-10)
    if rank < unknowns:
        raise DegenerateError(
            "points and camera position cannot be told apart; turn the hand about two axes or more"
        )
    return np.asarray(found[:-3].reshape(count, 3)), np.asarray(found[-3:])
