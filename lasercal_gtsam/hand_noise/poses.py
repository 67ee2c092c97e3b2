"""Where the hand really was: the likeliest pose of every spot's hand, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from lasercal_factors.batch import SpotBatch

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DataError
from lasercal_gtsam.frozen import Array, FrozenData
from lasercal_gtsam.graph import pixel_covariances, spread_columns, state_from_cell
from lasercal_gtsam.hand_noise.elimination import (
    HandNoise,
    Mask,
    corrections,
    joint_covariance,
    joint_derivative,
    linearized,
    moved_hands,
    stops_by_size,
)
from lasercal_gtsam.observations import Observations

# corrections settle by a factor of 30 to 100 a round
_ROUNDS = 8


@dataclass(frozen=True, eq=False)
class HandPoses(FrozenData):
    """Hand poses of N spots as the calibration has them; the same for all spots of a stop.

    Attributes
    ----------
    T_base_hand : (N, 4, 4), metres
    correction : (N, 6) from the commanded pose: translation in base (m), rotation vector in the
        hand (rad); zero for a spot that was left out
    covariance : (N, 6, 6) in the tangent space of `gtsam.Pose3`: rotation (rad), then translation
        (m), both in the hand. As the calibration's own covariance it is scaled by the residuals,
        and holds what is not known of the cell
    """

    T_base_hand: Array
    correction: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Noisy:
    """What a calibration with robot noise was made of.

    ``kept`` (N,): spots that count. ``cov_uv`` (N, 2, 2) px^2 of the pixels alone. ``unit``: factor
    on all sigmas that the residuals gave.
    """

    observations: Observations
    cell: Cell
    noise: HandNoise
    cov_uv: Array
    kept: Mask
    unit: float

    @classmethod
    def of(cls, calibration: Calibration) -> Noisy:
        """Noise levels, stated or found, and the spots that count.

        Raises
        ------
        DataError
            No robot noise was stated or found; the calibration states no sigmas or does not hold
            its spots; a robust loss weighs its spots.
        """
        seen, options = calibration.inputs.observations, calibration.options_used
        fit, weight = calibration.fit, calibration.spots.weight
        noise = HandNoise.of(options)
        if not max(noise) > 0:
            raise DataError(
                "hand poses: the calibration takes them as exact; state hand_sigma_m and "
                "hand_sigma_rad, or have them estimated (estimate_noise)"
            )
        if not np.isfinite(fit.sigma0) or not (weight > 0).any():
            raise DataError("hand poses: the calibration states no sigmas, or holds no spots")
        if ((weight > 0) & (weight < 1)).any():
            raise DataError(
                f"hand poses: the {options.robust} loss weighs the spots; calibrate with "
                "robust='auto' or 'none'"
            )
        found = options.sigma_px is None and bool(np.isnan(seen.cov_uv).any())
        return cls(
            seen,
            calibration.cell.restricted(seen),
            noise,
            pixel_covariances(seen, fit.sigma0 if found else options.sigma_px),
            weight > 0,
            1.0 if found else fit.sigma0,
        )

    def corrections(self) -> Array:
        """(N, 6) likeliest corrections."""
        seen, eta = self.observations, np.zeros((len(self.observations), 6))
        for _ in range(_ROUNDS):
            B, r = linearized(seen, self.cell, eta)
            eta = corrections(B, r, self.cov_uv, self.noise, seen.shared_stops, ~self.kept)
        return eta


def adjusted_hand_poses(calibration: Calibration) -> HandPoses:
    """Likeliest hand poses, given all spots, by the elimination's own equations.

    With ``eta = -Sigma B^T S^-1 (r + J z)`` the covariance of a pose is that of the pose given the
    cell, ``Sigma - Sigma B^T S^-1 B Sigma``, and that of the cell, carried over by
    ``Sigma B^T S^-1 J``. It equals what `gtsam.Marginals` gives for `explicit.hand_pose_graph`, at
    a small part of the cost.

    Raises
    ------
    DataError
        As in `Noisy.of`.
    """
    told = Noisy.of(calibration)
    seen, variances = told.observations, told.noise.variances
    eta = told.corrections()
    B, _ = linearized(seen, told.cell, eta)
    T = moved_hands(seen.T_base_hand, eta)
    J = _by_cell(told, T)
    covariance = np.tile(np.diag(told.unit**2 * variances), (len(seen), 1, 1))
    for members in stops_by_size(seen, told.kept):
        joint = joint_derivative(B, members)
        S = joint_covariance(B, told.cov_uv, told.noise, members)
        gain = np.linalg.solve(S, joint * variances)  # (G, 2k, 6): S^-1 B Sigma
        given_cell = np.diag(variances) - np.swapaxes(joint * variances, 1, 2) @ gain
        carried = np.swapaxes(gain, 1, 2) @ J[members].reshape(len(members), S.shape[1], -1)
        of_cell = carried @ calibration.covariance @ np.swapaxes(carried, 1, 2)
        covariance[members] = (told.unit**2 * given_cell + of_cell)[:, None]
    # translation in base, rotation in hand -> rotation and translation in hand
    to_tangent = np.zeros((len(seen), 6, 6))
    to_tangent[:, :3, 3:] = np.eye(3)
    to_tangent[:, 3:, :3] = np.swapaxes(T[:, :3, :3], 1, 2)
    covariance = to_tangent @ covariance @ np.swapaxes(to_tangent, 1, 2)
    return HandPoses(T, eta, covariance)


def _by_cell(told: Noisy, T_base_hand: Array) -> Array:
    """(N, 2, n) derivative of the pixels by the cell's coordinates, at these hand poses."""
    seen = told.observations
    index = seen.camera_index, seen.laser_index, seen.plane_index
    identity = np.broadcast_to(np.eye(2), (len(seen), 2, 2))
    batch = SpotBatch.from_arrays(seen.uv, identity, T_base_hand, *index)
    rows = batch.rows(state_from_cell(told.cell))[..., :-1]
    rows[~told.kept] = 0.0  # maybe impossible
    return spread_columns(rows, told.cell, seen)
