"""Robot noise, eliminated in closed form for each spot (one independent hand pose a spot).

The hand pose is an unknown with a prior. Given the cell, its best correction ``eta`` is linear
algebra of size two (Gauss-Helmert): with ``B`` the derivative of the pixel by the hand pose,
``S = cov_uv + B Sigma B^T`` and ``eta = -Sigma B^T S^-1 (r - B eta)``. The spot then counts with
covariance ``S`` at the corrected pose. Whitening alone, at the commanded pose, would be biased.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from lasercal_factors.batch import SpotBatch

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import state_from_cell
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.projection import (
    beam_in_base,
    beam_plane_distance,
    point_jacobian,
    project_points,
)
from lasercal_gtsam.rotations import rotation_exp
from lasercal_gtsam.solve import CONVERGED_SIGMAS, Solution
from lasercal_gtsam.start import Search

_MAX_ROUNDS = 12
# rounds end when the estimate moves by less than this many sigmas
_SETTLED_SIGMAS = 1e-5
_EXACT_PX = 1e-3
# range in which a pixel sigma is looked for (px), and its relative precision
_SIGMA_RANGE_PX = (1e-3, 1e3)
_SIGMA_STEPS = 40


class HandNoise(NamedTuple):
    """Noise of a hand pose, 1 sigma per axis: translation (m), rotation (rad)."""

    sigma_m: float
    sigma_rad: float

    @property
    def variances(self) -> Array:
        """(6,): translation, then rotation."""
        return np.repeat([self.sigma_m**2, self.sigma_rad**2], 3)


def refine_with_hand_noise(
    search: Search, solution: Solution, rejected: npt.NDArray[np.bool_]
) -> tuple[Solution, Array, float | None]:
    """Refit with the robot's noise: rounds of corrected hand poses until nothing moves.

    Where spots have no pixel sigma (neither their own nor ``options.sigma_px``), it is found along
    with the rest: the one with which the residuals are as long as they should be.

    Parameters
    ----------
    search : as for the fit without robot noise
    solution : that fit
    rejected : (N,) booleans: spots left out

    Returns
    -------
    Solution
    lengths : (N,) residual length of each spot in sigmas of pixel and hand together; infinite where
        no spot can be
    sigma_px : pixel sigma found; None where none was missing

    Raises
    ------
    SolveError
        The refit fails.
    """
    observations, options = search.observations, search.options
    noise = HandNoise(options.hand_sigma_m, options.hand_sigma_rad)
    unknown = np.isnan(observations.cov_uv[:, 0, 0])
    own = np.where(unknown[:, None, None], 0.0, observations.cov_uv)
    missing = np.where(unknown, 1.0, 0.0)[:, None, None] * np.eye(2)
    sigma_px = options.sigma_px or 1.0
    find_sigma = options.sigma_px is None and bool(unknown.any())
    eta = np.zeros((len(observations), 6))
    for _ in range(_MAX_ROUNDS):
        B, r = linearized(observations, solution.cell, eta)
        if find_sigma:
            dof = 2 * int((~rejected).sum()) - int(solution.problem.free.sum())
            fixed = own + np.einsum("nij,j,nkj->nik", B, noise.variances, B)
            sigma_px = _missing_sigma(r[~rejected], fixed[~rejected], missing[~rejected], dof)
        cov = own + sigma_px**2 * missing
        eta = corrections(B, r, cov, noise)
        # no hand pose explains an outlier: judge it at the commanded one
        eta[rejected] = 0.0
        everyone = corrected_batch(observations, cov, solution.cell, noise, eta)
        batch = everyone.weighted(~rejected) if rejected.any() else everyone
        before = batch.total_loss(state_from_cell(solution.cell), solution.problem.loss)
        better = replace(search, batch=batch).attempt(solution.cell, solution.problem.holds)
        if not isinstance(better, Solution):
            raise SolveError(f"the fit fails with the robot's noise: {better}") from better
        moved = np.sqrt(max(before - better.cost, 0.0))
        solution = replace(better, iterations=solution.iterations + better.iterations)
        unit = max(float(np.sqrt(better.cost / (2 * len(batch.order)))), _EXACT_PX)
        # where the solver itself comes near its optimum slowly, the rounds cannot do better
        near = max(_SETTLED_SIGMAS * unit, min(2.0 * better.decrement, CONVERGED_SIGMAS * unit))
        if moved < near:
            break
    else:
        trouble = (
            f"the corrections of the hand poses do not settle: the last round moved {moved:.2g} "
            "sigma; check hand_sigma_m and hand_sigma_rad"
        )
        solution = replace(solution, troubles=(*solution.troubles, trouble))
    lengths = everyone.whitened_lengths(state_from_cell(solution.cell))
    lengths = np.where(np.isnan(lengths), np.inf, lengths)
    return solution, lengths, sigma_px if find_sigma else None


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
    B, residual = _hand_jacobian(observations, _moved(observations.T_base_hand, eta), cell)
    free_residual = residual - np.einsum("nij,nj->ni", B, eta)
    impossible = ~np.isfinite(free_residual).all(axis=1)
    B[impossible], free_residual[impossible] = 0.0, 0.0
    return B, free_residual


def corrections(B: Array, free_residual: Array, cov_uv: Array, noise: HandNoise) -> Array:
    """Likeliest corrections of the hand poses, (N, 6): ``-Sigma B^T S^-1 (r - B eta)``."""
    S = cov_uv + np.einsum("nij,j,nkj->nik", B, noise.variances, B)
    gain = np.linalg.solve(S, free_residual[..., None])[..., 0]
    return np.asarray(-noise.variances * np.einsum("nij,ni->nj", B, gain))


def corrected_batch(
    observations: Observations, cov_uv: Array, cell: Cell, noise: HandNoise, eta: Array
) -> SpotBatch:
    """Spots at corrected hand poses, for the ordinary factors.

    Their residual is ``r - B eta``, their covariance ``S``: pixel and hand together.
    """
    T = _moved(observations.T_base_hand, eta)
    B, _ = linearized(observations, cell, eta)
    S = cov_uv + np.einsum("nij,j,nkj->nik", B, noise.variances, B)
    return SpotBatch.from_arrays(
        observations.uv + np.einsum("nij,nj->ni", B, eta),
        S,
        T,
        observations.camera_index,
        observations.laser_index,
        observations.plane_index,
    )


def _missing_sigma(r: Array, fixed: Array, missing: Array, dof: int) -> float:
    """Sigma with which ``sum r^T (fixed + sigma^2 missing)^-1 r = dof``, by bisection (px)."""
    low, high = np.log(_SIGMA_RANGE_PX)
    for _ in range(_SIGMA_STEPS):
        middle = 0.5 * (low + high)
        S = fixed + np.exp(2.0 * middle) * missing
        chi2 = float(np.einsum("ni,ni->", r, np.linalg.solve(S, r[..., None])[..., 0]))
        low, high = (middle, high) if chi2 > dof else (low, middle)
    return float(np.exp(0.5 * (low + high)))


def _moved(T_base_hand: Array, eta: Array) -> Array:
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
