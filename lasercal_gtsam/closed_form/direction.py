"""Stage 1: the laser direction from groups of non-rotating motions.

While the hand translates by ``w``, the spot moves on the plane by ``P w`` with the oblique
projector ``P = I - u n'/(n.u)``; a motion along the beam does not move it. So pixels are a
projective function of the translation (16), (17) whose linear part has the beam as its kernel
(20)-(22), the same in the hand frame for all groups (23). One kernel is poor; two steps make it ten
times better: pool all groups, then minimise the error of homographies over the two degrees of
freedom of the direction.
"""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.closed_form.groups import Groups
from lasercal_gtsam.closed_form.linear import dlt, hartley, homogeneous, transformed
from lasercal_gtsam.closed_form.spots import Index
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.units import RAD_PER_DEG

SHOTS_FOR_KERNEL = 6
"""Shots which the 12 unknowns of (16) need."""
SHOTS_FOR_POLISH = 5
"""One shot more than a homography needs: only then has it an error to minimise."""
_HEMISPHERE_POINTS = 80
_DISTINCT_RAD = 5.0 * RAD_PER_DEG
_MERGED_RAD = 0.5 * RAD_PER_DEG
_CONVERGED_RAD = 1e-6
_DIFFERENCE = 1e-5
_LARGEST_STEP_RAD = 0.3


def informative_groups(groups: Groups, shots: int = SHOTS_FOR_POLISH) -> Index:
    """Groups that tell something of the direction: enough shots, translations of rank 3.

    Translations within one plane do not: each direction across it fits them equally well.
    """
    return np.flatnonzero((groups.shots >= shots) & (groups.translation_ranks() == 3))


def translation_map(groups: Groups) -> Array:
    """Map ``(xy, 1) ~ A (t, 1)`` of each group, corrected (16), (17): (G, 3, 4).

    The paper stacks star-shaped motions, 3 (N + 1) = 12 unknowns for N = 3 directions (corrected);
    with the translations in base coordinates any motions of rank 3 do. Needs 6 shots a group.
    """
    return dlt(groups.t, groups.xy, groups.present)


def group_kernels(groups: Groups) -> Array:
    """Beam direction from each group alone, kernel of the linear part of (17), (20)-(22): (G, 3).

    Unit vectors in the hand frame, ``R_g' u_g`` of (23); their sign is free.
    """
    linear = translation_map(groups)[..., :3]
    kernel = np.linalg.svd(linear)[2][..., -1, :]
    return np.asarray((kernel[:, None, :] @ groups.R)[:, 0])


def pooled_direction(kernels: Array) -> Array:
    """Mean of directions without sign (23, with the missing signs): unit vector (3,).

    The top eigenvector of the sum of ``v v'`` is the mean after the best choice of signs.
    """
    return np.asarray(np.linalg.eigh(kernels.T @ kernels)[1][:, -1])


def across_beam(groups: Groups, u: Array) -> Array:
    """Translations across the beam, ``s = (R_g E_u)' t``, for directions (D, 3): (D, G, K, 2)."""
    B = groups.R @ tangent_bases(u)[:, None]
    return np.asarray(groups.t @ B)


def homography_residuals(groups: Groups, u: Array) -> Array:
    """Reprojection residuals of the best homography of each group for trial directions.

    If ``u`` is right, the pixels of a group are a homography of ``(R_g E_u)' t``.

    Parameters
    ----------
    u : (D, 3) unit vectors, hand frame

    Returns
    -------
    (D, 2GK) array in scaled pixels; zero for padding
    """
    w = groups.present
    s = across_beam(groups, u)
    s = transformed(hartley(s, np.broadcast_to(w, s.shape[:-1])), s)
    Sm = hartley(groups.xy, w)
    xy = transformed(Sm, groups.xy)
    x = homogeneous(s) * w[..., None]
    image = x @ np.swapaxes(_regressed_homographies(x, xy), -1, -2)
    third = image[..., 2:]
    third = np.where(np.abs(third) > 1e-12, third, 1e-12)
    residual = (image[..., :2] / third - xy) * (w / Sm[:, :1, 0])[..., None]
    return np.asarray(residual.reshape(len(u), -1))


def _regressed_homographies(x: Array, xy: Array) -> Array:
    """Homographies ``(xy, 1) ~ H x`` by elimination, many at once: (..., 3, 3).

    For a given third row ``h`` the first two rows are linear regressions of ``xy (h.x)`` on ``x``;
    what is left is a 3x3 eigenvalue problem for ``h``. Seven times faster than the null vector of
    the 2K x 9 system, and good to 1e-10 on centred points; `linear.dlt` is the exact one.
    """
    xt = np.swapaxes(x, -1, -2)
    S = xt @ x
    S += 1e-14 * np.trace(S, axis1=-2, axis2=-1)[..., None, None] * np.eye(3)
    moments = np.stack([xt @ (xy[..., i, None] * x) for i in (0, 1)], axis=-3)
    regression = np.linalg.solve(S[..., None, :, :], moments)
    M = xt @ ((xy**2).sum(-1)[..., None] * x) - (moments @ regression).sum(-3)
    h = np.linalg.eigh(0.5 * (M + np.swapaxes(M, -1, -2)))[1][..., 0]
    rows = (regression @ h[..., None, :, None])[..., 0]
    return np.concatenate([rows, h[..., None, :]], axis=-2)


def homography_costs(groups: Groups, u: Array) -> Array:
    """Mean squared residual of `homography_residuals` for each direction: (D,), scaled px^2."""
    return np.asarray((homography_residuals(groups, u) ** 2).sum(axis=1) / groups.present.sum())


def polish_directions(groups: Groups, u: Array, rounds: int = 15) -> tuple[Array, Array]:
    """Minimise `homography_costs` over the 2 degrees of freedom of each direction.

    Damped Gauss-Newton with central differences, all starts side by side; the most valuable single
    step of the closed form.

    Parameters
    ----------
    u : (D, 3) starts, unit vectors in the hand frame

    Returns
    -------
    directions (D, 3) and their costs (D,)
    """
    u, cost = np.array(u), homography_costs(groups, u)
    damping, active = np.full(len(u), 1e-3), np.ones(len(u), dtype=bool)
    for _ in range(rounds):
        rows = np.flatnonzero(active)
        if not len(rows):
            break
        E = tangent_bases(u[rows])
        trials = np.concatenate(
            [u[rows]]
            + [u[rows] + sign * _DIFFERENCE * E[..., i] for i in (0, 1) for sign in (1, -1)]
        )
        r = homography_residuals(groups, trials).reshape(5, len(rows), -1)
        J = np.stack([r[1] - r[2], r[3] - r[4]], axis=-1) / (2 * _DIFFERENCE)
        normal = np.swapaxes(J, -1, -2) @ J
        gradient = (r[0][:, None, :] @ J)[:, 0]
        trace = np.trace(normal, axis1=-2, axis2=-1)
        normal += (damping[rows] * trace + 1e-300)[:, None, None] * np.eye(2)
        step = -np.linalg.solve(normal, gradient[..., None])[..., 0]
        length = np.linalg.norm(step, axis=1)
        step *= np.minimum(1.0, _LARGEST_STEP_RAD / np.maximum(length, 1e-300))[:, None]
        moved = _unit(u[rows] + (E @ step[..., None])[..., 0])
        moved_cost = homography_costs(groups, moved)
        better = moved_cost < cost[rows]
        u[rows[better]], cost[rows[better]] = moved[better], moved_cost[better]
        damping[rows] *= np.where(better, 0.1, 10.0)
        active[rows] = (length > _CONVERGED_RAD) & (damping[rows] < 1e3)
        active[np.setdiff1d(rows, best_distinct_index(u, cost, len(u), _MERGED_RAD))] = False
    return u, cost


def robust_directions(groups: Groups, keep: int = 4) -> tuple[Array, Array]:
    """Laser directions from all groups, best first: pool, search the hemisphere, polish.

    Trials are the pooled kernel, each group's kernel and points on the hemisphere (the sign does
    not matter); the best few that differ by more than 5 deg are polished.

    Returns
    -------
    directions (D, 3) in the hand frame and their costs (D,), D <= ``keep``; D = 0 if no group tells
    anything of the direction
    """
    groups = groups.subset(informative_groups(groups))
    if len(groups) == 0:
        return np.empty((0, 3)), np.empty(0)
    trials = hemisphere(_HEMISPHERE_POINTS)
    rich = groups.subset(informative_groups(groups, SHOTS_FOR_KERNEL))
    if len(rich):
        kernels = group_kernels(rich)
        trials = np.concatenate([pooled_direction(kernels)[None], kernels, trials])
    starts = best_distinct(trials, homography_costs(groups, trials), keep, _DISTINCT_RAD)
    u, cost = polish_directions(groups, starts)
    order = best_distinct_index(u, cost, keep, _MERGED_RAD)
    return u[order], cost[order]


def best_distinct(u: Array, cost: Array, keep: int, angle_rad: float) -> Array:
    """The ``keep`` directions of lowest cost that differ by more than an angle (sign ignored)."""
    return np.asarray(u[best_distinct_index(u, cost, keep, angle_rad)])


def best_distinct_index(u: Array, cost: Array, keep: int, angle_rad: float) -> Index:
    """Indices of `best_distinct`, best first."""
    chosen: list[int] = []
    near = np.cos(angle_rad)
    for i in np.argsort(cost, kind="stable"):
        if len(chosen) == keep:
            break
        if not chosen or np.abs(u[chosen] @ u[i]).max() < near:
            chosen.append(int(i))
    return np.array(chosen, dtype=np.int64)


def hemisphere(count: int) -> Array:
    """``count`` directions spread evenly over the half sphere z > 0 (Fibonacci): (count, 3)."""
    i = np.arange(count) + 0.5
    z = 1.0 - i / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * i
    r = np.sqrt(1.0 - z * z)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), z])


def tangent_bases(u: Array) -> Array:
    """``E_u`` for each of (D, 3) unit vectors: (D, 3, 2), as `rotations.basis_of`."""
    axis = np.zeros_like(u)
    axis[np.arange(len(u)), np.argmin(np.abs(u), axis=1)] = 1.0
    e1 = _unit(np.cross(u, axis))
    return np.stack([e1, np.cross(u, e1)], axis=-1)


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))
