"""The paper's own chain for several planes (section 3.2), equation by equation, corrected.

Star-shaped motions: from a start pose the hand moves along N directions ``j_n`` (base frame), with
several positions along each; ``w`` are the coordinates of the motion along them. Exact without
noise. With noise it is a poor start (it takes one kernel of a poorly determined matrix per group
and single points for the scale), so `pair` does not use it; it is kept for comparison, and as the
place where to find the paper's equations.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lasercal_gtsam.closed_form.camera import upper_triangular_times_rotation
from lasercal_gtsam.closed_form.groups import Groups
from lasercal_gtsam.closed_form.linear import (
    dlt_rows,
    homogeneous,
    null_vector_and_gap,
    scaled_solve,
)
from lasercal_gtsam.closed_form.solution import Solution
from lasercal_gtsam.closed_form.spots import Spots
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.rotations import skew
from lasercal_gtsam.units import RAD_PER_DEG

SMALLEST_GAP = 1e-9
_SAME_DIRECTION = np.cos(0.5 * RAD_PER_DEG)


@dataclass(frozen=True, eq=False)
class Star:
    """One group as star-shaped motions.

    Attributes
    ----------
    R : (3, 3) hand rotation
    start : (3,) hand position where ``w`` = 0, metres
    J : (3, N) directions ``j_n`` in the base, unit columns
    w : (K, N) coordinates of the motions, metres
    xy : (K, 2) pixels (any affine ones)
    plane : plane index
    """

    R: Array
    start: Array
    J: Array
    w: Array
    xy: Array
    plane: int


def stars(groups: Groups) -> list[Star]:
    """Groups of rank-3 translations as stars; others are left out (see `as_star`)."""
    found = []
    for g in np.flatnonzero((groups.translation_ranks() == 3) & (groups.shots >= 6)):
        shots = groups.present[g] > 0
        start, J = as_star(groups.t[g][shots])
        w = (groups.t[g][shots] - start) @ np.linalg.pinv(J).T
        found.append(Star(groups.R[g], start, J, w, groups.xy[g][shots], int(groups.plane[g])))
    return found


def as_star(t: Array) -> tuple[Array, Array]:
    """Start (3,) and three directions (3, 3) of star-shaped motions ``t`` (K, 3).

    The start is the position from which the others lie in three directions. Where there is none,
    the mean and the principal axes serve: the equations hold for any basis.
    """
    for start in t:
        moves = t - start
        length = np.linalg.norm(moves, axis=1)
        units = moves[length > 1e-9] / length[length > 1e-9, None]
        J: list[Array] = []
        for unit in units:
            if not J or np.abs(np.array(J) @ unit).max() < _SAME_DIRECTION:
                J.append(unit)
            if len(J) > 3:
                break
        if len(J) == 3 and abs(np.linalg.det(np.array(J))) > 1e-3:
            return start, np.array(J).T
    centre = t.mean(axis=0)
    return centre, np.linalg.svd(t - centre, full_matrices=False)[2].T


def motion_map(star: Star) -> Array:
    """``H^ = [i_1 .. i_N T^]`` (3, N+1) with ``m ~ H^ (w, 1)``, corrected (16), (17).

    The row for a spot holds ``(w', 1)`` with N + 1 entries, so the system is 2K x 3(N+1) (printed
    2K x 9 is right for N = 2 only). The third row is made positive on the data.

    Raises
    ------
    DegenerateError
        More than one solution.
    """
    scale = np.abs(star.w).max()
    x = homogeneous(star.w / scale)
    h, gap = null_vector_and_gap(dlt_rows(x, star.xy))
    if gap < SMALLEST_GAP:
        raise DegenerateError(
            "a group does not determine its map from motions to pixels: 6 positions or more in "
            "three directions are needed"
        )
    H = h.reshape(3, -1)
    if (x @ H[2]).sum() < 0:
        H = -H
    H[:, :-1] /= scale
    return np.asarray(H)


def common_scale(maps: list[Array]) -> list[Array]:
    """Bring the maps of one plane to the scale of the first, corrected (18).

    ``T^`` of the first group lies in the plane of another: ``a i_a + b i_b + c T^ = T^_1`` gives
    the ratio ``lambda_m = c_m lambda_1`` (printed the other way round), so ``H^_m`` times ``c_m``
    is on the first one's scale. Of the pairs of directions the best conditioned is taken.

    Raises
    ------
    DegenerateError
        A scale is not positive.
    """
    scaled = [maps[0]]
    for H in maps[1:]:
        best, c = np.inf, 0.0
        for a, b in combinations(range(H.shape[1] - 1), 2):
            A = H[:, [a, b, -1]]
            condition = float(np.linalg.cond(A / np.linalg.norm(A, axis=0)))
            if condition < best:
                best, c = condition, float(np.linalg.solve(A, maps[0][:, -1])[2])
        if c <= 0:
            raise DegenerateError("two groups of one plane contradict each other")
        scaled.append(c * H)
    return scaled


def beam_in_base(H: Array, J: Array) -> Array:
    """Beam direction (3,) of a group in the base (20)-(22): kernel of ``P^ = [i_1 .. i_N] J^+``."""
    return np.asarray(np.linalg.svd(H[:, :-1] @ np.linalg.pinv(J))[2][-1])


def beam_in_hand(R: Array, beams: Array) -> Array:
    """Mean of ``R_m' u_m`` (23), unit vector (3,); the signs are aligned first (not in the paper).

    Parameters
    ----------
    R : (M, 3, 3) hand rotations; beams : (M, 3) in the base
    """
    v = (beams[:, None, :] @ R)[:, 0]
    v = v * np.where(v @ v[0] < 0, -1.0, 1.0)[:, None]
    mean = v.sum(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def inverse_projection_paper(maps: list[Array], found: list[Star], u: Array) -> tuple[Array, Array]:
    """``G = K R_cb`` by (24), stacked into (27): returns ``K`` (3, 3) and ``R_cb`` (3, 3).

    ``(u_m x j_n)' G^-1 i_n = 0``: one row of 9 a direction. The sign is that of a positive
    determinant; ``K`` and ``R_cb`` by RQ. At most three rows of a hand orientation are independent,
    so the eight that are needed take 2 + 2 groups on two planes or 1 + 1 + 1 on three (the paper's
    count after (27) is corrected).

    Parameters
    ----------
    u : (3,) beam in the hand frame

    Raises
    ------
    DegenerateError
        More than one solution, as for one plane or parallel planes.
    """
    rows = [
        np.kron(np.cross(star.R @ u, star.J[:, n]), H[:, n] / np.linalg.norm(H[:, n]))
        for H, star in zip(maps, found, strict=True)
        for n in range(star.J.shape[1])
    ]
    g, gap = null_vector_and_gap(np.array(rows))
    if gap < SMALLEST_GAP:
        raise DegenerateError(
            "the groups do not determine the camera: needed are three groups on three planes or "
            "two each on two planes that are not parallel, with different hand orientations"
        )
    G = np.asarray(np.linalg.inv(g.reshape(3, 3)))
    return upper_triangular_times_rotation(-G if np.linalg.det(G) < 0 else G)


def beam_point_and_camera(
    maps: list[Array], found: list[Star], u: Array, K: Array, R_cb: Array
) -> tuple[Array, Array, Array]:
    """Beam point, camera position and plane scales by (30)-(32).

    ``[u_c]x (lambda_p K^-1 H^ (w, 1) - R_cb (R_m q + t) - T_cb) = 0`` with ``u_c = R_cb R_m u`` and
    the camera-frame translation ``T_cb = -R_cb T`` (the paper's transform of the base into the
    camera). One entry of ``q`` is 0: the paper's x, or the one along which the beam runs most,
    because a beam parallel to the y-z plane never meets x = 0. Columns are scaled to unit length.

    Returns
    -------
    q (3,) hand frame, T (3,) base, metres; lambda (P,), one for each plane that occurs, in order

    Raises
    ------
    DegenerateError
        Rank below 5 + P, or a scale that is not positive.
    """
    planes = sorted({star.plane for star in found})
    free = np.delete(np.arange(3), np.argmax(np.abs(u)))
    rows, rhs = [], []
    for H, star in zip(maps, found, strict=True):
        cross = skew(R_cb @ star.R @ u)
        rays = np.linalg.solve(K, H @ homogeneous(star.w).T).T
        t = star.start + star.w @ star.J.T
        block = np.zeros((len(t), 3, 5 + len(planes)))
        block[:, :, :2] = -cross @ R_cb @ star.R[:, free]
        block[:, :, 2:5] = -cross
        block[:, :, 5 + planes.index(star.plane)] = rays @ cross.T
        rows.append(block.reshape(-1, block.shape[-1]))
        rhs.append((t @ (cross @ R_cb).T).ravel())
    x, gap = scaled_solve(np.concatenate(rows), np.concatenate(rhs))
    if gap < SMALLEST_GAP:
        raise DegenerateError(
            "the poses do not determine beam point and camera position: three hand orientations or "
            "more are needed, not about one axis and not only about the beam"
        )
    if x[5:].min() <= 0:
        raise DegenerateError("a plane comes out behind the camera")
    q = np.zeros(3)
    q[free] = x[:2]
    return q, -R_cb.T @ x[2:5], x[5:]


def plane_in_camera(maps: list[Array], K: Array, scale: float) -> tuple[Array, Array]:
    """Normal (3,) and point (3,) of one plane in the camera frame, (33)-(35).

    The normal is the null vector of the stacked rows ``(lambda K^-1 i)'`` (row vectors: the
    paper's stack is to be read so); the point is the mean of the starts ``lambda K^-1 T^``.
    """
    images = np.linalg.solve(K, np.concatenate([H[:, :-1] for H in maps], axis=1))
    normal = np.linalg.svd(images.T / np.linalg.norm(images, axis=0)[:, None])[2][-1]
    starts = np.linalg.solve(K, np.stack([H[:, -1] for H in maps], axis=1))
    return normal, scale * starts.mean(axis=1)


def solve_paper(groups: Groups, spots: Spots) -> Solution:
    """The paper's chain from groups to the cell (section 3.2).

    Raises
    ------
    DegenerateError
        As the steps.
    """
    found = stars(groups)
    if not found:
        raise DegenerateError(
            "no group has 6 positions or more with translations in three directions"
        )
    maps = [motion_map(star) for star in found]
    planes = sorted({star.plane for star in found})
    for p in planes:
        at = [i for i, star in enumerate(found) if star.plane == p]
        for i, H in zip(at, common_scale([maps[i] for i in at]), strict=True):
            maps[i] = H
    beams = np.array([beam_in_base(H, star.J) for H, star in zip(maps, found, strict=True)])
    u = beam_in_hand(np.array([star.R for star in found]), beams)
    K, R_cb = inverse_projection_paper(maps, found, u)
    q, T, scales = beam_point_and_camera(maps, found, u, K, R_cb)
    normals = np.full((spots.plane_count, 3), np.nan)
    points = np.full((spots.plane_count, 3), np.nan)
    for p, scale in zip(planes, scales, strict=True):
        members = [H for H, star in zip(maps, found, strict=True) if star.plane == p]
        normal, point = plane_in_camera(members, K, float(scale))
        normals[p], points[p] = R_cb.T @ normal, R_cb.T @ point + T
    K = np.asarray(np.linalg.solve(spots.scaling, K))
    return Solution(K, R_cb.T, T, u, q, normals, points)
