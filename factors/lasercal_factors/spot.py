"""Factors for laser spots: one spot at a time, or all spots of a cell in one factor.

Both say the same: predicted minus seen pixel (paper, eq. 55) of the chain beam -> plane -> camera.
`LaserSpotFactor` is the textbook custom factor for a graph of your own. `LaserSpotBatchFactor`
holds any number of spots; it hands GTSAM the square root of their information, not their rows, so
that GTSAM's part of a linearisation does not depend on the number of spots.

Variables
---------
camera pose `gtsam.Pose3` (``T_base_camera``), intrinsics `gtsam.Cal3DS2`, beam 4-vector about a
`BeamFrame` (hand coordinates), plane `gtsam.OrientedPlane3` (base; GTSAM's ``n.x + d = 0``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from lasercal_factors import kernels
from lasercal_factors.arrays import Array, Index, State
from lasercal_factors.batch import IMPOSSIBLE, LOSSES, Loss, SpotBatch, refuse_loss
from lasercal_factors.beam import BeamFrame
from lasercal_factors.errors import FactorError
from lasercal_factors.wrap import custom_factor


@dataclass(frozen=True)
class CellKeys:
    """Keys of a cell's variables, in the column order of the batch factor.

    ``cameras`` holds (pose key, intrinsics key) pairs; ``frames`` one `BeamFrame` for each laser.
    """

    cameras: tuple[tuple[int, int], ...]
    lasers: tuple[int, ...]
    planes: tuple[int, ...]
    frames: tuple[BeamFrame, ...]

    def __post_init__(self) -> None:
        if len(self.frames) != len(self.lasers):
            raise FactorError(f"{len(self.lasers)} lasers but {len(self.frames)} beam frames")

    @cached_property
    def keys(self) -> tuple[int, ...]:
        """All keys: every camera's pose and intrinsics, then lasers, then planes."""
        return (*(k for pair in self.cameras for k in pair), *self.lasers, *self.planes)

    @cached_property
    def dims(self) -> tuple[int, ...]:
        """Tangent dimension of each key."""
        return (*(6, 9) * len(self.cameras), *(4,) * len(self.lasers), *(3,) * len(self.planes))

    @cached_property
    def columns(self) -> tuple[slice, ...]:
        """Columns of each key."""
        ends = np.cumsum(self.dims)
        return tuple(slice(int(e) - d, int(e)) for e, d in zip(ends, self.dims, strict=True))

    @cached_property
    def n(self) -> int:
        """Number of columns."""
        return sum(self.dims)

    @cached_property
    def _frame_arrays(self) -> tuple[Array, Array]:
        return np.array([f.R for f in self.frames]), np.array([f.t for f in self.frames])

    def read(self, values: gtsam.Values) -> State:
        """Arrays of the variables in ``values``."""
        n_cameras, n_planes = len(self.cameras), len(self.planes)
        cam_R, cam_t = np.empty((n_cameras, 3, 3)), np.empty((n_cameras, 3))
        cam_K = np.empty((n_cameras, 9))
        for c, (x, k) in enumerate(self.cameras):
            pose = values.atPose3(x)
            cam_R[c] = pose.rotation().matrix()
            cam_t[c] = pose.translation()
            cam_K[c] = values.atCal3DS2(k).vector()
        beam_l = np.empty((len(self.lasers), 4))
        for i, key in enumerate(self.lasers):
            beam_l[i] = values.atVector(key)
        planes = np.empty((n_planes, 4))
        for i, key in enumerate(self.planes):
            planes[i] = values.atOrientedPlane3(key).planeCoefficients()
        plane_n = planes[:, :3].copy()
        return State(cam_R, cam_t, cam_K, *self._frame_arrays, beam_l, plane_n, -planes[:, 3])

    def offsets(self, batch: SpotBatch) -> Index:
        """(M, 4) first columns of camera pose, intrinsics, beam and plane for each block."""
        first = np.array([c.start for c in self.columns], dtype=np.int64)
        c, l, p = batch.spots.blocks[:, :3].T  # noqa: E741
        laser = 2 * len(self.cameras) + l
        plane = 2 * len(self.cameras) + len(self.lasers) + p
        which: Index = np.column_stack([2 * c, 2 * c + 1, laser, plane])
        return np.asarray(first[which])


def LaserSpotFactor(
    camera_key: int,
    intrinsics_key: int,
    laser_key: int,
    plane_key: int,
    uv: npt.ArrayLike,
    T_base_hand: npt.ArrayLike,
    frame: BeamFrame,
    cov_uv: npt.ArrayLike,
) -> gtsam.CustomFactor:
    """One laser spot as a factor on camera pose, intrinsics, beam and plane (eq. 1-9, 55).

    Parameters
    ----------
    camera_key, intrinsics_key, laser_key, plane_key : keys of a `Pose3`, a `Cal3DS2`, a 4-vector
        (see ``frame``) and an `OrientedPlane3`
    uv : (2,) seen pixel
    T_base_hand : (4, 4) hand pose, metres
    frame : constant `BeamFrame` about which the 4-vector is meant
    cov_uv : (2, 2) px^2

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
    keys = CellKeys(((camera_key, intrinsics_key),), (laser_key,), (plane_key,), (frame,))
    batch = SpotBatch.from_arrays(
        np.asarray(uv)[None], np.asarray(cov_uv)[None], np.asarray(T_base_hand)[None], [0], [0], [0]
    )
    w00, w01, w11 = batch.spots.pixels[2:, 0]

    def error(values: Any) -> Array:
        du, dv = batch.residuals(keys.read(values))[0]
        if math.isnan(du):
            return np.full(2, np.inf)
        return np.array([w00 * du + w01 * dv, w11 * dv])

    def linearize(values: Any) -> tuple[Array, list[Array]]:
        state = keys.read(values)
        if math.isnan(batch.residuals(state)[0, 0]):
            raise FactorError("LaserSpotFactor: " + IMPOSSIBLE)
        row = batch.rows(state)[0]
        return row[:, 22], [row[:, c] for c in keys.columns]

    noise = gtsam.noiseModel.Unit.Create(2)
    return custom_factor("LaserSpotFactor", noise, keys.keys, keys.dims, error, linearize)


def LaserSpotBatchFactor(
    keys: CellKeys,
    batch: SpotBatch,
    loss: Loss | None = None,
    held: npt.ArrayLike | None = None,
) -> gtsam.CustomFactor:
    """All spots of a cell as one factor by square-root information.

    Same error, gradient and Gauss-Newton Hessian as one `LaserSpotFactor` for each spot. The
    Jacobian is the Cholesky factor of ``[J r]^T [J r]``, n+1 rows whatever the number of spots.

    Parameters
    ----------
    keys : the variables; the batch's indices refer to them
    batch : the spots
    loss : robust loss for each spot (its derivative weights the spot)
    held : (n,) booleans: tangent coordinates that must not move. They get a unit pin, so that the
        rest is solved, and its covariance is, as if they were constants; their own marginal
        covariance is then 1 and without meaning.

    Raises
    ------
    FactorError
        An index without a key; or, from inside a solver, linearised where no spot can be.
    """
    loss = loss or Loss()
    limits = (len(keys.cameras), len(keys.lasers), len(keys.planes))
    if np.any(batch.spots.blocks[:, :3].max(axis=0) >= limits):
        raise FactorError(
            f"batch: indices up to {batch.spots.blocks[:, :3].max(axis=0)}, keys {limits}"
        )
    n = keys.n
    mask = np.zeros(n, np.bool_) if held is None else np.array(held, np.bool_)
    if mask.shape != (n,):
        raise FactorError(f"held: expected ({n},) booleans, got {mask.shape}")
    if batch.hand is not None:
        raise FactorError("LaserSpotBatchFactor: noisy hands are for `LaserCellFactor`")
    if batch.correlations:
        refuse_loss(loss)
    none = np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    spots, offsets = batch.spots, keys.offsets(batch)
    rest = (LOSSES[loss.name], loss.threshold, (mask, *none))
    noise = gtsam.noiseModel.Unit.Create(n + 1)
    columns = keys.columns

    def error(values: Any) -> Array:
        e = np.zeros(n + 1)
        e[0] = math.sqrt(batch.total_loss(keys.read(values), loss))
        return e

    def root(state: State) -> Array:
        if not batch.correlations:
            return kernels.square_root_information(spots, offsets, n, state, *rest)  # type: ignore[no-any-return]
        H = batch.division.information(offsets, n, state)
        if not math.isfinite(H[0, 0]):
            return H
        kernels.constrain(H, *rest[2])
        return kernels.cholesky(H)  # type: ignore[no-any-return]

    def linearize(values: Any) -> tuple[Array, list[Array]]:
        R = root(keys.read(values))
        if not math.isfinite(R[0, 0]):
            raise FactorError("LaserSpotBatchFactor: " + IMPOSSIBLE)
        return R[:, n], [R[:, c] for c in columns]

    return custom_factor("LaserSpotBatchFactor", noise, keys.keys, keys.dims, error, linearize)


def keys_for(cameras: int, lasers: int, planes: int, frames: Sequence[BeamFrame]) -> CellKeys:
    """Conventional keys: ``x`` camera pose, ``k`` intrinsics, ``l`` beam, ``p`` plane."""
    return CellKeys(
        tuple((gtsam.symbol("x", c), gtsam.symbol("k", c)) for c in range(cameras)),
        tuple(gtsam.symbol("l", i) for i in range(lasers)),
        tuple(gtsam.symbol("p", i) for i in range(planes)),
        tuple(frames),
    )
