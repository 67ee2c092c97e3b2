"""Priors on rows of the table, linearised wherever the running estimate is."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import gtsam
import numpy as np
from lasercal_factors.chart import CellChart

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import CELL_KEY, prior_factor
from lasercal_gtsam.holds import Holds
from lasercal_gtsam.incremental.belief import Mask

Priors = Mapping[str, tuple[float, float]]


def soft_priors(
    chart: CellChart, cell: Cell, held: Mask, priors: Priors
) -> Callable[[Array], Array] | None:
    """Augmented information of the priors as a function of the chart's coordinates.

    None where there are no priors. The function gives ``[J r]^T [J r]``, (n+1, n+1), at ``z`` (n,),
    in the priors' own sigmas.
    """
    if not priors:
        return None
    holds = Holds(held, {}, {}, frozenset(), dict(priors), ())
    factor = prior_factor(chart, holds, cell)

    def information(z: Array) -> Array:
        values = gtsam.Values()
        values.insert(CELL_KEY, z)
        A, b = factor.linearize(values).jacobian()
        rows = np.column_stack([A, -b])
        return np.asarray(rows.T @ rows)

    return information
