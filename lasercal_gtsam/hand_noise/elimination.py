"""Hand poses eliminated in closed form, each spot or each stop by itself.

The hand pose is an unknown with a prior. Given the cell, its best correction ``eta`` is linear
algebra (Gauss-Helmert): with ``r`` the residuals of all k spots of a stop, ``B`` their derivative
by the hand pose and ``S = cov_uv + B Sigma B^T``, it is ``eta = -Sigma B^T S^-1 (r - B eta)``. The
spots then count with their joint covariance ``S`` (2k x 2k) at the corrected pose. Whitening alone,
at the commanded pose, would be biased.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from lasercal_factors.batch import SpotBatch

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.observations import Index, Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.projection import (
    beam_in_base,
    beam_plane_distance,
    point_jacobian,
    project_points,
)
from lasercal_gtsam.rotations import rotation_exp

Mask = npt.NDArray[np.bool_]


class HandNoise(NamedTuple):
    """Noise of a hand pose, 1 sigma per axis: translation (m), rotation (rad)."""

    sigma_m: float
    sigma_rad: float

    @property
    def variances(self) -> Array:
        """(6,): translation, then rotation."""
        return np.repeat([self.sigma_m**2, self.sigma_rad**2], 3)

    @classmethod
    def of(cls, options: CalibrationOptions) -> HandNoise:
        """What options state."""
        return cls(options.hand_sigma_m, options.hand_sigma_rad)


def linearized(observations: Observations, cell: Cell, eta: Array) -> tuple[Array, Array]:
    """Derivative ``B`` of the pixel by the hand pose and ``r - B eta``, at corrected hand poses.

    Parameters
    ----------
    eta : (N, 6) corrections: translation in base (m), rotation in hand (rad)

    Returns
    -------
    B : (N, 2, 6) px/m, px/rad; zero where no spot can be
    free_residual : (N, 2) px, predicted minus seen pixel at the commanded pose to first order; zero
        where no spot can be
    """
    moved = moved_hands(observations.T_base_hand, eta)
    B, residual = _hand_jacobian(observations, moved, cell)
    free_residual = residual - np.einsum("nij,nj->ni", B, eta)
    impossible = ~np.isfinite(free_residual).all(axis=1)
    B[impossible], free_residual[impossible] = 0.0, 0.0
    return B, free_residual


def corrections(
    B: Array,
    free_residual: Array,
    cov_uv: Array,
    noise: HandNoise,
    stops: Sequence[Index] = (),
    aside: Mask | None = None,
) -> Array:
    """Likeliest corrections of the hand poses, (N, 6): ``-Sigma B^T S^-1 (r - B eta)``.

    Parameters
    ----------
    B, free_residual : from `linearized`
    cov_uv : (N, 2, 2) px^2
    stops : `Observations.shared_stops`, whose spots have one correction together
    aside : (N,) spots left out. No hand pose explains an outlier: its correction is zero, and it
        has no part in that of its stop
    """
    if aside is not None and aside.any():
        B, free_residual = B.copy(), free_residual.copy()
        B[aside], free_residual[aside] = 0.0, 0.0
    S = cov_uv + np.einsum("nij,j,nkj->nik", B, noise.variances, B)
    gain = np.linalg.solve(S, free_residual[..., None])[..., 0]
    eta = np.asarray(-noise.variances * np.einsum("nij,ni->nj", B, gain))
    for members in stops:
        joint, r = joint_derivative(B, members), free_residual[members].reshape(len(members), -1)
        gain = np.linalg.solve(joint_covariance(B, cov_uv, noise, members), r[..., None])[..., 0]
        eta[members] = (-noise.variances * np.einsum("gij,gi->gj", joint, gain))[:, None]
        if aside is not None:
            eta[aside] = 0.0
    return eta


def corrected_batch(
    observations: Observations, cov_uv: Array, cell: Cell, noise: HandNoise, eta: Array
) -> SpotBatch:
    """Spots at corrected hand poses, for the ordinary factors.

    Their residual is ``r - B eta``, their covariance ``S``: pixel and hand together, joint for the
    spots of a stop.
    """
    B, _ = linearized(observations, cell, eta)
    S = cov_uv + np.einsum("nij,j,nkj->nik", B, noise.variances, B)
    batch = SpotBatch.from_arrays(
        observations.uv + np.einsum("nij,nj->ni", B, eta),
        S,
        moved_hands(observations.T_base_hand, eta),
        observations.camera_index,
        observations.laser_index,
        observations.plane_index,
    )
    for members in observations.shared_stops:
        batch = batch.correlated(members, joint_covariance(B, cov_uv, noise, members))
    return batch


def noisy_batch(
    observations: Observations, cov_uv: Array, noise: HandNoise, aside: Mask
) -> SpotBatch:
    """Spots with independent hand poses, eliminated by the factor itself (`hand_kernels`).

    Parameters
    ----------
    cov_uv : (N, 2, 2) px^2 of the pixels alone
    aside : (N,) spots that are judged at the commanded pose
    """
    batch = SpotBatch.from_arrays(
        observations.uv,
        cov_uv,
        observations.T_base_hand,
        observations.camera_index,
        observations.laser_index,
        observations.plane_index,
    )
    return batch.with_noisy_hands(noise.variances, aside)


def joint_derivative(B: Array, members: Index) -> Array:
    """``B`` (G, 2k, 6) of stops (G, k)."""
    return B[members].reshape(len(members), -1, B.shape[-1])


def joint_covariance(B: Array, cov_uv: Array, noise: HandNoise, members: Index) -> Array:
    """``S`` (G, 2k, 2k) of stops (G, k): pixel noise of each spot, the hand's of all."""
    joint = joint_derivative(B, members)
    own = block_diagonal(cov_uv[members])
    return np.asarray(own + np.einsum("gij,j,gkj->gik", joint, noise.variances, joint))


def block_diagonal(blocks: Array) -> Array:
    """(G, k, 2, 2) as block-diagonal matrices (G, 2k, 2k)."""
    count, k = blocks.shape[:2]
    out = np.zeros((count, k, 2, k, 2))
    for i in range(k):
        out[:, i, :, i, :] = blocks[:, i]
    return out.reshape(count, 2 * k, 2 * k)


def stops_by_size(observations: Observations, keep: Mask) -> Iterator[Index]:
    """All spots kept, as stops (G, k) of k spots each, those by themselves first."""
    alone, stops = keep.copy(), dict[int, list[Index]]()
    for members in observations.shared_stops:
        alone[members] = False
        for stop in members:
            left = stop[keep[stop]]
            stops.setdefault(len(left), []).append(left)
    first = np.flatnonzero(alone)
    stops.setdefault(1, [])[:0] = [first[k : k + 1] for k in range(len(first))]
    for k in sorted(stops):
        if k and stops[k]:
            yield np.array(stops[k], dtype=np.int64)


def moved_hands(T_base_hand: Array, eta: Array) -> Array:
    """Hand poses (N, 4, 4) corrected by ``eta`` (N, 6): translation in base, rotation in hand."""
    T = T_base_hand.copy()
    T[:, :3, 3] += eta[:, :3]
    T[:, :3, :3] = T[:, :3, :3] @ rotation_exp(eta[:, 3:])
    return T


def _hand_jacobian(observations: Observations, T: Array, cell: Cell) -> tuple[Array, Array]:
    """Derivative of the pixel by the hand pose (N, 2, 6) and predicted minus seen pixel (N, 2)."""
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
    return B, residual
