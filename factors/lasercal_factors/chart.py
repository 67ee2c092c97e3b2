"""A whole cell as one minimal vector about a reference, and the factor of all spots on it.

For a solve that stands alone, one vector variable is the leanest graph: GTSAM moves one block, and
a callback reads one array. The natural variables (`spot.LaserSpotBatchFactor`) are for graphs that
hold other factors too. Both have the same error, gradient and Gauss-Newton Hessian in their own
coordinates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from lasercal_factors import chart_kernels, hand_kernels, kernels
from lasercal_factors.arrays import Array, Index, State
from lasercal_factors.batch import IMPOSSIBLE, LOSSES, Loss, SpotBatch, refuse_loss
from lasercal_factors.errors import FactorError
from lasercal_factors.wrap import Error, Linearize, custom_factor

CAMERA_DIM, BEAM_DIM, PLANE_DIM = 15, 4, 3


@dataclass(frozen=True, eq=False)
class CellChart:
    """Coordinates ``z`` (n,) of a cell about a reference state; ``z = 0`` is the reference.

    Order and meaning (SI): each camera's rotation 3 and translation 3, both in the camera frame of
    the reference, then its nine intrinsics; each beam's ``a, b, x, y``; each plane's normal 2 along
    `kernels.tangent_basis` and distance (``n . x = d``).

    Attributes
    ----------
    reference : the state at ``z = 0``
    aspects : for each camera a fixed ``fu / fv``, or None; ``fu`` then follows ``fv``
    """

    reference: State
    aspects: tuple[float | None, ...] = ()

    @cached_property
    def n(self) -> int:
        """Number of coordinates."""
        r = self.reference
        return CAMERA_DIM * len(r.cam_R) + BEAM_DIM * len(r.beam_l) + PLANE_DIM * len(r.plane_d)

    @cached_property
    def aspect_array(self) -> Array:
        """Aspects (C,), NaN where free."""
        given = self.aspects or (None,) * len(self.reference.cam_R)
        return np.array([np.nan if a is None else a for a in given], dtype=np.float64)

    def state(self, z: Array) -> State:
        """The state at ``z``."""
        state: State = chart_kernels.move(z, self.aspect_array, self.reference)
        return state

    def intrinsics(self, z: Array) -> Array:
        """``cam_K`` (C, 9) of `state`, without the rest of it."""
        coordinates = z[: CAMERA_DIM * len(self.reference.cam_R)].reshape(-1, CAMERA_DIM)
        K: Array = self.reference.cam_K + coordinates[:, CAMERA_DIM - 9 :]
        tied = ~np.isnan(self.aspect_array)
        K[tied, 0] = self.aspect_array[tied] * K[tied, 1]
        return K

    def tangent_map(self, z: Array) -> Array:
        """(n, n): a step in ``z`` to the step in the tangent coordinates of the state at ``z``.

        Those are the same coordinates about the moved state; the identity at ``z = 0``.
        """
        cameras, lasers = len(self.reference.cam_R), len(self.reference.beam_l)
        M = np.eye(self.n)
        for c in range(cameras):
            at = CAMERA_DIM * c
            turn, right = chart_kernels.rotation(z[at : at + 3])
            M[at : at + 3, at : at + 3] = right
            M[at + 3 : at + 6, at + 3 : at + 6] = turn.T
        at = CAMERA_DIM * cameras + BEAM_DIM * lasers
        moved = self.state(z).plane_n
        for n, moved_n in zip(self.reference.plane_n, moved, strict=True):
            M[at : at + 2, at : at + 2] = chart_kernels.normal_map(n, moved_n, z[at : at + 2])
            at += PLANE_DIM
        return M


def LaserCellFactor(
    key: int,
    chart: CellChart,
    batch: SpotBatch,
    loss: Loss | None = None,
    held: npt.ArrayLike | None = None,
) -> gtsam.CustomFactor:
    """All spots of a cell as one factor on one vector variable, by square-root information.

    Parameters
    ----------
    key : of the (n,) vector
    chart : what the vector means
    batch : the spots; their indices refer to the chart's cameras, beams and planes
    loss : robust loss for each spot
    held : (n,) booleans: coordinates that must not move; they get a unit pin (their own marginal
        covariance is then 1 and without meaning, the rest is as if they were constants)

    Raises
    ------
    FactorError
        An index without a part; or, from inside a solver, linearised where no spot can be.
    """
    loss = loss or Loss()
    reference, n = chart.reference, chart.n
    parts = np.array([len(reference.cam_R), len(reference.beam_l), len(reference.plane_d)])
    most = batch.spots.blocks[:, :3].max(axis=0)
    if np.any(most >= parts):
        raise FactorError(f"batch: indices up to {most}, the chart has {parts} parts")
    mask = np.zeros(n, np.bool_) if held is None else np.array(held, np.bool_)
    if mask.shape != (n,):
        raise FactorError(f"held: expected ({n},) booleans, got {mask.shape}")
    tied = np.flatnonzero(~np.isnan(chart.aspect_array))
    tie_from = CAMERA_DIM * tied + 6
    mask[tie_from] = True
    c, l, p = batch.spots.blocks[:, :3].T  # noqa: E741
    laser = CAMERA_DIM * parts[0] + BEAM_DIM * l
    plane = CAMERA_DIM * parts[0] + BEAM_DIM * parts[1] + PLANE_DIM * p
    offsets = np.column_stack([CAMERA_DIM * c, CAMERA_DIM * c + 6, laser, plane])
    about = (chart.aspect_array, reference, batch.spots)
    robust = (LOSSES[loss.name], loss.threshold)
    constraints = (mask, tie_from, tie_from + 1, chart.aspect_array[tied])
    noise = gtsam.noiseModel.Unit.Create(n + 1)
    if batch.correlations or batch.hand is not None:
        refuse_loss(loss)
        pose = _correlated if batch.correlations else _noisy
        functions = pose(key, chart, batch, offsets, constraints)
        return custom_factor("LaserCellFactor", noise, [key], [n], *functions)

    def error(values: Any) -> Array:
        e = np.zeros(n + 1)
        e[0] = math.sqrt(chart_kernels.loss_at(values.atVector(key), *about, *robust))
        return e

    def linearize(values: Any) -> tuple[Array, list[Array]]:
        z = values.atVector(key)
        R = chart_kernels.square_root_information_at(z, *about, offsets, *robust, constraints)
        if not math.isfinite(R[0, 0]):
            raise FactorError("LaserCellFactor: " + IMPOSSIBLE)
        return R[:, n], [R[:, :n]]

    return custom_factor("LaserCellFactor", noise, [key], [n], error, linearize)


def _noisy(
    key: int, chart: CellChart, batch: SpotBatch, offsets: Index, constraints: tuple[Any, ...]
) -> tuple[Error, Linearize]:
    """Error and derivative of `LaserCellFactor` with the hand poses eliminated at every state."""
    n = chart.n
    variances, fixed = batch.hand or (np.zeros(6), np.ones(len(batch.order), np.bool_))
    # corrections of the state before, where those of the next one are looked for
    eta = np.zeros((len(batch.order), 6))
    about = (chart.aspect_array, chart.reference, batch.spots, variances, fixed, eta)

    def error(values: Any) -> Array:
        e = np.zeros(n + 1)
        e[0] = math.sqrt(hand_kernels.loss_with_hands(values.atVector(key), *about))
        return e

    def linearize(values: Any) -> tuple[Array, list[Array]]:
        z = values.atVector(key)
        R = hand_kernels.root_with_hands(z, *about, offsets, constraints)
        if not math.isfinite(R[0, 0]):
            raise FactorError("LaserCellFactor: " + IMPOSSIBLE)
        return R[:, n], [R[:, :n]]

    return error, linearize


def _correlated(
    key: int, chart: CellChart, batch: SpotBatch, offsets: Index, constraints: tuple[Any, ...]
) -> tuple[Error, Linearize]:
    """Error and derivative of `LaserCellFactor` where some spots have errors in common."""
    division, reference, n = batch.division, chart.reference, chart.n

    def error(values: Any) -> Array:
        e = np.zeros(n + 1)
        e[0] = math.sqrt(division.total_loss(chart.state(values.atVector(key))))
        return e

    def linearize(values: Any) -> tuple[Array, list[Array]]:
        z = values.atVector(key)
        state = chart.state(z)
        H = division.information(offsets, n, state)
        if not math.isfinite(H[0, 0]):
            raise FactorError("LaserCellFactor: " + IMPOSSIBLE)
        parts = len(state.cam_R), len(state.beam_l)
        chart_kernels.transport(H, z, reference.plane_n, state.plane_n, *parts)
        kernels.constrain(H, *constraints)
        R = kernels.cholesky(H)
        return R[:, n], [R[:, :n]]

    return error, linearize
