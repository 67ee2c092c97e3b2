"""A laser spot with the hand pose as one more variable, for graphs that want the poses themselves.

The textbook form of robot noise: a `gtsam.Pose3` for every standing of the hand, a prior on it at
the commanded pose, and a factor for each spot that was seen from there. It costs GTSAM six more
unknowns a stop and, from Python, a copy of all values for every factor; the application eliminates
the poses in closed form instead, with the same result.
"""

from __future__ import annotations

import math
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from lasercal_factors import kernels
from lasercal_factors.arrays import Array, Spots
from lasercal_factors.batch import IMPOSSIBLE, SpotBatch
from lasercal_factors.beam import BeamFrame
from lasercal_factors.errors import FactorError
from lasercal_factors.hand_kernels import by_hand
from lasercal_factors.spot import CellKeys
from lasercal_factors.wrap import custom_factor

_HAND_DIM = 6


def LaserSpotHandFactor(
    camera_key: int,
    intrinsics_key: int,
    laser_key: int,
    plane_key: int,
    hand_key: int,
    uv: npt.ArrayLike,
    frame: BeamFrame,
    cov_uv: npt.ArrayLike,
    held: npt.ArrayLike | None = None,
) -> gtsam.CustomFactor:
    """One laser spot on camera pose, intrinsics, beam, plane and hand pose (eq. 1-9, 55).

    Parameters
    ----------
    camera_key, intrinsics_key, laser_key, plane_key : as for `LaserSpotFactor`
    hand_key : of a `Pose3`, ``T_base_hand`` (metres). Its tangent is GTSAM's: rotation, then
        translation, both in the hand
    uv : (2,) seen pixel
    frame : constant `BeamFrame` about which the beam's 4-vector is meant
    cov_uv : (2, 2) px^2, of the pixel alone
    held : (22,) booleans: tangent coordinates of camera pose, intrinsics, beam and plane that must
        not move; their columns are zero, so that something else has to pin them

    Returns
    -------
    gtsam.CustomFactor
        Error: whitened predicted minus seen pixel, (2,). Infinite where the beam misses the plane
        or the spot lies behind the camera.

    Raises
    ------
    FactorError
        Wrong shapes; or, from inside a solver, linearised at a state where no spot can be.
    """
    cell = CellKeys(((camera_key, intrinsics_key),), (laser_key,), (plane_key,), (frame,))
    batch = SpotBatch.from_arrays(
        np.asarray(uv)[None], np.asarray(cov_uv)[None], np.eye(4)[None], [0], [0], [0]
    )
    pixels, blocks = batch.spots.pixels, batch.spots.blocks
    w00, w01, w11 = pixels[2:, 0]
    W = np.array([[w00, w01], [0.0, w11]])
    free = np.ones(cell.n) if held is None else 1.0 - np.asarray(held, dtype=np.float64)
    if free.shape != (cell.n,):
        raise FactorError(f"held: expected ({cell.n},) booleans, got {free.shape}")

    def spots(values: Any) -> Spots:
        pose = values.atPose3(hand_key)
        hand = np.append(pose.rotation().matrix().ravel(), pose.translation())
        return Spots(pixels, hand[:, None], blocks)

    def error(values: Any) -> Array:
        du, dv = kernels.residuals(spots(values), cell.read(values))[0]
        if math.isnan(du):
            return np.full(2, np.inf)
        return np.array([w00 * du + w01 * dv, w11 * dv])

    def linearize(values: Any) -> tuple[Array, list[Array]]:
        state, seen = cell.read(values), spots(values)
        if math.isnan(kernels.residuals(seen, state)[0, 0]):
            raise FactorError("LaserSpotHandFactor: " + IMPOSSIBLE)
        row = kernels.rows(seen, state)[0]
        J = row[:, :-1] * free
        hand = seen.hands[:, 0].copy()
        _, B = by_hand(hand, blocks[0], state)
        # B: translation in base, rotation in hand
        by_pose = np.concatenate([B[:, 3:], B[:, :3] @ hand[:9].reshape(3, 3)], axis=1)
        return row[:, -1], [*(J[:, c] for c in cell.columns), W @ by_pose]

    noise = gtsam.noiseModel.Unit.Create(2)
    keys, dims = (*cell.keys, hand_key), (*cell.dims, _HAND_DIM)
    return custom_factor("LaserSpotHandFactor", noise, keys, dims, error, linearize)
