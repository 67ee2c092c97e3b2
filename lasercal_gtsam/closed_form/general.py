"""Stages 2-6 for groups of any non-rotating translations (the stronger form of the paper's chain).

With the direction ``u`` each group is a homography ``m ~ H_g (s, 1)`` of ``s = B_g' (t - o_g)``,
``B_g = R_g E_u``. All homographies of a plane share its vanishing line, which puts them on one
scale (in place of 18) and makes them linear least squares. Since ``B_g' P_g B_g = I`` for the
oblique projector ``P_g``, ``B_g' G^-1 H_g[:, :2] = nu_p I`` is linear in ``G^-1`` (in place of 24
and 27).

Two planes or more that are not parallel. Noise costs three times as much as in the triangulation
form, but one hand orientation a plane is enough here (with three planes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.closed_form.camera import upper_triangular_times_rotation
from lasercal_gtsam.closed_form.groups import Groups
from lasercal_gtsam.closed_form.linear import dlt, homogeneous, scaled_solve
from lasercal_gtsam.closed_form.solution import Solution
from lasercal_gtsam.closed_form.spots import Index, Spots
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.rotations import basis_of

SMALLEST_GAP = 1e-9
"""Singular values closer than this (relative) mean that a system has several solutions."""
_LINE_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class PlaneGroups:
    """Groups as homographies on one scale per plane.

    Attributes
    ----------
    H : (G, 3, 3) with ``m = H (s, 1)`` up to the spot's depth; the same scale within a plane
    B : (G, 3, 2) ``R_g E_u``
    o : (G, 3) centre of the hand positions, metres
    s : (G, K, 2) ``B' (t - o)``, metres
    present : (G, K)
    plane : (G,) plane index
    lines : (P, 3) vanishing lines, unit vectors; NaN for planes without groups
    u : (3,) beam direction in the hand frame
    """

    H: Array
    B: Array
    o: Array
    s: Array
    present: Array
    plane: Index
    lines: Array
    u: Array

    @property
    def beams(self) -> Array:
        """(G, 3) beam directions in the base."""
        return np.cross(self.B[:, :, 0], self.B[:, :, 1])

    @property
    def images(self) -> Array:
        """(G, K, 3) ``H (s, 1)`` for every shot."""
        return np.asarray(homogeneous(self.s) @ np.swapaxes(self.H, 1, 2))


def plane_groups(groups: Groups, u: Array, plane_count: int) -> PlaneGroups:
    """Homographies of all groups, with a shared vanishing line and scale for each plane.

    Raises
    ------
    DegenerateError
        No group has translations in two directions across the beam.
    """
    groups = groups.subset(_across_two(groups, u))
    if len(groups) == 0:
        raise DegenerateError(
            "no group of non-rotating motions spans two directions across the beam"
        )
    B = groups.R @ basis_of(u)
    o = (groups.t * groups.present[..., None]).sum(1) / groups.present.sum(1)[:, None]
    s = ((groups.t - o[:, None]) @ B) * groups.present[..., None]
    H = dlt(s, groups.xy, groups.present)
    lines = np.full((plane_count, 3), np.nan)
    for p in np.unique(groups.plane):
        rows = np.flatnonzero(groups.plane == p)
        lines[p] = vanishing_line(H[rows], s[rows], groups.present[rows])
        for g in rows:
            shots = groups.present[g] > 0
            H[g] = affine_homography(lines[p], s[g][shots], groups.xy[g][shots])
    return PlaneGroups(H, B, o, s, groups.present, groups.plane, lines, u)


def _across_two(groups: Groups, u: Array) -> Index:
    total = groups.present.sum(1)[:, None]
    centre = (groups.t * groups.present[..., None]).sum(1) / total
    moves = ((groups.t - centre[:, None]) @ (groups.R @ basis_of(u))) * groups.present[..., None]
    spread = np.linalg.svd(moves, compute_uv=False)
    return np.flatnonzero(spread[:, 1] > 1e-3 * np.maximum(spread[:, 0], 1e-300))


def vanishing_line(H: Array, s: Array, present: Array) -> Array:
    """Line ``l`` with ``l' H_g[:, :2] = 0`` for all groups of a plane: unit vector (3,).

    Replaces (18): the scale of each group follows from ``l' H_g[:, 2] = 1``. Iterated, because the
    scales weight the groups.
    """
    spread = np.sqrt((s**2).sum((1, 2)) / present.sum(1))
    H = H / H[:, 2:, 2:]
    line = np.zeros(3)
    for _ in range(_LINE_ROUNDS):
        columns = H[:, :, :2] * spread[:, None, None]
        line = np.linalg.svd(columns.transpose(1, 0, 2).reshape(3, -1))[0][:, -1]
        scale = H[:, :, 2] @ line
        if scale.sum() < 0:
            line, scale = -line, -scale
        H = H / np.where(np.abs(scale) > 1e-12, scale, 1e-12)[:, None, None]
    return np.asarray(line)


def affine_homography(line: Array, s: Array, xy: Array) -> Array:
    """Homography (3, 3) with a given vanishing line: an affine map in ``s`` (n, 2), 6 unknowns.

    Pixels are taken to ``y = N' m / (l' m)`` with ``N`` a basis across ``l``; weights ``l' m`` make
    the residuals pixels again.
    """
    N = basis_of(line)
    m = homogeneous(xy)
    weight = m @ line
    A = homogeneous(s) * weight[:, None]
    C = np.linalg.lstsq(A, m @ N, rcond=None)[0].T
    return np.asarray(N @ C + np.outer(line, [0.0, 0.0, 1.0]))


def inverse_projection(groups: PlaneGroups) -> tuple[Array, float]:
    """``G^-1`` (3, 3) with ``G = K R_cb``, in place of (24), and its gap.

    Four rows a group of ``B' G^-1 H[:, :2] = nu_p I``, 9 + P unknowns. The gap (last but one to
    first singular value) is small for nearly parallel planes.

    Raises
    ------
    DegenerateError
        More than one solution (one plane, parallel planes, too few groups) or none with all
        ``nu_p`` and ``det G`` positive.
    """
    used = np.unique(groups.plane)
    rows = np.zeros((len(groups.plane), 2, 2, 9 + len(used)))
    kron = groups.B[:, :, None, :, None] * groups.H[:, None, :, None, :2]
    rows[..., :9] = kron.transpose(0, 3, 4, 1, 2).reshape(-1, 2, 2, 9)
    at = np.searchsorted(used, groups.plane)
    for i in (0, 1):
        rows[np.arange(len(at)), i, i, 9 + at] = -1.0
    A = rows.reshape(-1, 9 + len(used))
    scale = np.linalg.norm(A, axis=0)
    _, sv, Vt = np.linalg.svd(A / scale, full_matrices=True)
    gap = float(sv[8 + len(used) - 1] / sv[0]) if len(sv) >= 8 + len(used) else 0.0
    x = Vt[-1] / scale
    if x[9:].sum() < 0:
        x = -x
    G_inv = x[:9].reshape(3, 3)
    if gap < SMALLEST_GAP:
        raise DegenerateError(
            "the groups do not determine the camera: needed are three groups on three planes or "
            "two each on two planes that are not parallel, with different hand orientations"
        )
    if x[9:].min() <= 0 or np.linalg.det(G_inv) <= 0:
        raise DegenerateError(
            "the groups contradict each other (they give a mirrored camera): two or three hand "
            "orientations on each plane and longer translations make them firmer"
        )
    return G_inv, gap


def translations(groups: PlaneGroups, G_inv: Array) -> tuple[Array, Array, Array]:
    """Beam point ``tau`` (2,), camera position ``T`` (3,), ``lambda`` (P,), in place of (30)-(32).

    ``B' (lambda_p G^-1 H (s, 1) + T - t) = tau``: two rows a shot, 5 + P unknowns, no special case
    for any beam direction.

    Raises
    ------
    DegenerateError
        Rank below 5 + P, or a ``lambda`` that is not positive.
    """
    used = np.unique(groups.plane)
    at = np.searchsorted(used, groups.plane)
    local = np.einsum("gai,ab,gkb->gki", groups.B, G_inv, groups.images)
    tau, T, scales = solve_translations(groups, local[..., None], at, len(used))
    everywhere = np.full(len(groups.lines), np.nan)
    everywhere[used] = scales[:, 0]
    if scales.min() <= 0:
        raise DegenerateError("a plane comes out behind the camera")
    return tau, T, everywhere


def solve_translations(
    groups: PlaneGroups, columns: Array, at: Index, count: int
) -> tuple[Array, Array, Array]:
    """Solve ``sum_j columns_j x_pj + B' T - tau = B' t`` for ``tau``, ``T`` and ``x``.

    Parameters
    ----------
    columns : (G, K, 2, J) coefficients of the J unknown scales of each plane
    at : (G,) plane number 0 .. ``count`` - 1

    Returns
    -------
    tau (2,), T (3,), x (count, J)
    """
    n_groups, n_shots, _, per_plane = columns.shape
    origin = groups.o.mean(axis=0)
    A = np.zeros((n_groups, n_shots, 2, 5 + per_plane * count))
    A[..., :2] = -np.eye(2)
    A[..., 2:5] = np.swapaxes(groups.B, 1, 2)[:, None]
    for g, p in enumerate(at):
        A[g, :, :, 5 + per_plane * p : 5 + per_plane * (p + 1)] = columns[g]
    b = groups.s + ((groups.o - origin)[:, None, :] @ groups.B)
    shots = groups.present > 0
    x, gap = scaled_solve(A[shots].reshape(-1, A.shape[-1]), b[shots].ravel())
    if gap < SMALLEST_GAP:
        raise DegenerateError(
            "the poses do not determine beam point and camera position: three hand orientations or "
            "more are needed, not about one axis and not only about the beam"
        )
    # T was found relative to the origin, and tau does not move with it
    return x[:2], x[2:5] + origin, x[5:].reshape(count, per_plane)


def planes_of_groups(
    groups: PlaneGroups, G_inv: Array, T: Array, scales: Array
) -> tuple[Array, Array]:
    """Normals and points of the planes, in place of (33)-(35): (P, 3), (P, 3).

    The normal is the vanishing line seen from the camera; the point is the mean of the spots.
    """
    normals = np.full((len(groups.lines), 3), np.nan)
    points = np.full_like(normals, np.nan)
    for p in np.unique(groups.plane):
        n = np.linalg.solve(G_inv.T, groups.lines[p])
        normals[p] = n / np.linalg.norm(n)
        rows = groups.plane == p
        seen = groups.images[rows][groups.present[rows] > 0]
        points[p] = scales[p] * (G_inv @ seen.mean(axis=0)) + T
    return normals, points


def solve_general(groups: Groups, spots: Spots, u: Array) -> Solution:
    """The general form on groups of two planes or more: camera, beam and the planes with groups.

    Raises
    ------
    DegenerateError
        As the steps.
    """
    at = plane_groups(groups, u, spots.plane_count)
    G_inv, _ = inverse_projection(at)
    K, R_cb = upper_triangular_times_rotation(np.asarray(np.linalg.inv(G_inv)))
    tau, T, scales = translations(at, G_inv)
    normals, points = planes_of_groups(at, G_inv, T, scales)
    K = np.asarray(np.linalg.solve(spots.scaling, K))
    return Solution(K, R_cb.T, T, u, basis_of(u) @ tau, normals, points)
