"""Least squares over one part of a cell, everything else held: a few unknowns, a few spots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from lasercal_factors import kernels
from lasercal_factors.arrays import State
from lasercal_factors.batch import LOSSES, Loss, SpotBatch
from lasercal_factors.chart import CellChart

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import cell_from_state, make_batch, state_from_cell
from lasercal_gtsam.incremental.belief import Part, part_offset
from lasercal_gtsam.observations import Observations

Index = npt.NDArray[np.int64]

# where a part's columns begin in the kernels' rows
_ROW_OFFSET: dict[Part, int] = {"camera": 0, "laser": 15, "plane": 19}
# squared length (sigmas) that stands for a spot that cannot be
_IMPOSSIBLE = 1e12
_MAX_ITERATIONS = 60
_LARGEST_DAMPING = 1e8
# a step this short, in sigmas, ends the iteration: the next one would be its square
_SMALLEST_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class PartFit:
    """A part fitted to its spots.

    Attributes
    ----------
    cell : with the part as fitted
    cost : sum of the losses; those that cannot be count as very far; infinite if none can be
    rows : (2n, k) derivative of the whitened pixels by the part's tangent coordinates, weighted by
        the loss, spots in the observations' order
    """

    cell: Cell
    cost: float
    rows: Array


def fit_part(
    cell: Cell,
    observations: Observations,
    kind: Part,
    name: str,
    loss: Loss,
    coordinates: Sequence[int],
) -> PartFit:
    """Levenberg-Marquardt on the pixels over some tangent coordinates of one part.

    Spots that cannot be at the start (behind the camera, beam off its plane) are left out: they are
    outliers, or the start is a bad one, as its cost then shows.

    Parameters
    ----------
    cell : the start, with every part that the spots involve
    observations : spots, all of this part; those without a covariance count with 1 px
    loss : robust loss
    coordinates : which of the part's tangent coordinates move (`report_map`)
    """
    seen = Cell(
        {x: cell.cameras[x] for x in observations.cameras},
        {x: cell.lasers[x] for x in observations.lasers},
        {x: cell.planes[x] for x in observations.planes},
    )
    state, batch = state_from_cell(seen), make_batch(observations, None)
    possible = np.isfinite(batch.residuals(state)[:, 0])
    move = np.asarray(coordinates, dtype=np.int64)
    if not possible.any():
        return PartFit(cell, np.inf, np.zeros((0, len(move))))
    if not possible.all():
        batch = batch.weighted(possible)
    columns = part_offset(seen, kind, name) + move
    row_columns = _ROW_OFFSET[kind] + move
    # the rows' offset of a plane is GTSAM's, -d
    sign = np.where(row_columns == 21, -1.0, 1.0)
    cost, damping = batch.total_loss(state, loss), 1e-4
    J, r = _rows(batch, state, loss, row_columns, sign)
    for _ in range(_MAX_ITERATIONS):
        scale = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        A, b = J / scale, np.concatenate([-r, np.zeros(len(move))])
        damped = np.concatenate([A, np.sqrt(damping) * np.eye(len(move))])
        step = np.linalg.lstsq(damped, b, rcond=None)[0]
        chart = CellChart(state)
        z = np.zeros(chart.n)
        z[columns] = step / scale
        moved = chart.state(z)
        new_cost, short = (
            batch.total_loss(moved, loss),
            float(np.linalg.norm(step)) < _SMALLEST_STEP,
        )
        if new_cost < cost:
            state, cost, damping = moved, new_cost, max(0.1 * damping, 1e-12)
            J, r = _rows(batch, state, loss, row_columns, sign)
        else:
            damping *= 10.0
        if short or damping > _LARGEST_DAMPING:
            break
    fitted = cell_from_state(state, seen)
    everything = Cell(
        {**cell.cameras, **fitted.cameras},
        {**cell.lasers, **fitted.lasers},
        {**cell.planes, **fitted.planes},
    )
    lost = float(kernels.loss_value(LOSSES[loss.name], loss.threshold, _IMPOSSIBLE))
    return PartFit(everything, cost + lost * int((~possible).sum()), J)


def _rows(
    batch: SpotBatch, state: State, loss: Loss, columns: Index, sign: Array
) -> tuple[Array, Array]:
    """Weighted derivative (2n, k) and residual (2n,) of the spots that are used."""
    rows = batch.rows(state)[batch.used]
    r = rows[:, :, -1]
    weight = np.array(
        [
            kernels.loss_weight(LOSSES[loss.name], loss.threshold, m)
            for m in (r * r).sum(axis=1).tolist()
        ]
    )
    root = np.sqrt(weight)[:, None]
    J = rows[:, :, columns] * sign * root[:, :, None]
    return J.reshape(-1, len(sign)), (r * root).ravel()
