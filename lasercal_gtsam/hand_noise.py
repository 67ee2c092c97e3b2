"""Robot noise, eliminated in closed form for each spot (one independent hand pose a spot).

The hand pose is an unknown with a prior. Given the cell, its best correction ``eta`` is linear
algebra of size two (Gauss-Helmert): with ``B`` the derivative of the pixel by the hand pose,
``S = cov_uv + B Sigma B^T`` and ``eta = -Sigma B^T S^-1 (r - B eta)``. The spot then counts with
covariance ``S`` at the corrected pose. Whitening alone, at the commanded pose, would be biased.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from lasercal_factors.batch import SpotBatch

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import pixel_covariances
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.projection import (
    beam_in_base,
    beam_plane_distance,
    point_jacobian,
    project_points,
)
from lasercal_gtsam.rotations import rotation_exp
from lasercal_gtsam.solve import Solution
from lasercal_gtsam.start import Search

_ROUNDS = 4


def with_hand_noise(search: Search, solution: Solution) -> tuple[Search, Solution]:
    """Refit with the robot's noise: a few rounds of corrected hand poses.

    Spots that ``search`` leaves out stay out of the fit; the search returned holds all spots with
    their corrected poses and full covariance.
    """
    observations, options, used = search.observations, search.options, search.batch.used
    cov = pixel_covariances(observations, options.sigma_px)
    eta = np.zeros((len(observations), 6))
    for _ in range(_ROUNDS):
        batch, eta = adjusted_batch(
            observations, cov, solution.cell, options.hand_sigma_m, options.hand_sigma_rad, eta
        )
        search = replace(search, batch=batch)
        better = search.without(~used).solve_from(solution.cell)
        if better is None:
            break
        solution = replace(better, iterations=solution.iterations + better.iterations)
    return search, solution


def adjusted_batch(
    observations: Observations,
    cov_uv: Array,
    cell: Cell,
    sigma_m: float,
    sigma_rad: float,
    eta: Array,
) -> tuple[SpotBatch, Array]:
    """Spots with corrected hand poses and the covariance that includes the robot's.

    Parameters
    ----------
    observations : spots with the commanded hand poses
    cov_uv : (N, 2, 2) px^2, of the pixels alone
    cell : current estimate
    sigma_m, sigma_rad : hand noise, 1 sigma per axis
    eta : (N, 6) corrections so far: translation in base (m), rotation in hand (rad)

    Returns
    -------
    SpotBatch
        For the ordinary factors; its residual is ``r - B eta`` with covariance ``S``.
    Array
        The next corrections, (N, 6); zero for a spot that cannot be where it was seen at all.
    """
    variances = np.r_[np.full(3, sigma_m**2), np.full(3, sigma_rad**2)]
    T = _moved(observations.T_base_hand, eta)
    B, residual = _hand_jacobian(observations, T, cell)
    S = cov_uv + np.einsum("nij,j,nkj->nik", B, variances, B)
    free_residual = residual - np.einsum("nij,nj->ni", B, eta)
    gain = np.linalg.solve(S, free_residual[..., None])[..., 0]
    next_eta = -variances * np.einsum("nij,ni->nj", B, gain)
    T = _moved(observations.T_base_hand, next_eta)
    B, _ = _hand_jacobian(observations, T, cell)
    S = cov_uv + np.einsum("nij,j,nkj->nik", B, variances, B)
    shift = np.einsum("nij,nj->ni", B, next_eta)
    batch = SpotBatch.from_arrays(
        observations.uv + shift,
        S,
        T,
        observations.camera_index,
        observations.laser_index,
        observations.plane_index,
    )
    return batch, next_eta


def _moved(T_base_hand: Array, eta: Array) -> Array:
    T = T_base_hand.copy()
    T[:, :3, 3] += eta[:, :3]
    T[:, :3, :3] = T[:, :3, :3] @ np.array([rotation_exp(w) for w in eta[:, 3:]])
    return T


def _hand_jacobian(observations: Observations, T: Array, cell: Cell) -> tuple[Array, Array]:
    """Derivative of the pixel by the hand pose (N, 2, 6) and predicted minus seen pixel (N, 2).

    Zero where no spot can be.
    """
    B, residual = np.empty((len(T), 2, 6)), np.empty((len(T), 2))
    index = np.column_stack(
        [observations.camera_index, observations.laser_index, observations.plane_index]
    )
    for c, l, p in np.unique(index, axis=0):  # noqa: E741
        rows = np.flatnonzero((index == (c, l, p)).all(axis=1))
        camera = cell.cameras[observations.cameras[c]]
        beam = cell.lasers[observations.lasers[l]]
        plane = cell.planes[observations.planes[p]]
        u, q = beam_in_base(T[rows], beam)
        length = beam_plane_distance(u, q, plane.normal_base, plane.distance)
        X = q + length[:, None] * u
        Pi = np.eye(3) - u[:, :, None] * plane.normal_base / (u @ plane.normal_base)[:, None, None]
        J = point_jacobian(X, camera) @ Pi
        spot_hand = beam.point_hand + length[:, None] * beam.direction_hand
        B[rows, :, :3] = J
        JR = J @ T[rows, :3, :3]
        # d/dw of R exp(w) s = -R [s]x w, row by row: (a R) . (w x s) = (s x (a R)) . w
        B[rows, :, 3:] = np.cross(spot_hand[:, None, :], JR)
        residual[rows] = project_points(X, camera) - observations.uv[rows]
    impossible = ~(np.isfinite(residual).all(axis=1) & np.isfinite(B).all(axis=(1, 2)))
    B[impossible], residual[impossible] = 0.0, 0.0
    return B, residual
