"""How the rows of the result table go together: their correlation matrix."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.calibration import Calibration
from lasercal_gtsam.figures.parts import calibrated_cell
from lasercal_gtsam.frozen import Array, FrozenData
from lasercal_gtsam.graph import beam_frames
from lasercal_gtsam.report_map import BeamChart, row_jacobian, row_names

STRONG = 0.9
"""Correlation from which on two rows must not be read one without the other."""


@dataclass(frozen=True, eq=False)
class Correlation(FrozenData):
    """Correlation of all rows that were estimated.

    Attributes
    ----------
    names, units : of the n rows
    matrix : (n, n), from -1 to 1
    covariance : (n, n) in the rows' units
    held : rows that were not estimated
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    matrix: Array
    covariance: Array
    held: tuple[str, ...]

    def strong(self, least: float = STRONG) -> tuple[tuple[str, str, float], ...]:
        """Pairs of rows with at least that correlation, the strongest first."""
        i, j = np.triu_indices(len(self.names), 1)
        size = np.abs(self.matrix[i, j])
        order = [k for k in np.argsort(-size, kind="stable") if size[k] >= least]
        return tuple(
            (self.names[i[k]], self.names[j[k]], float(self.matrix[i[k], j[k]])) for k in order
        )


def correlation(calibration: Calibration) -> Correlation:
    """Correlation of the rows of the table, by the exact change of variables from the state's.

    Rows whose sigma is unknown, as at gimbal lock, are left out with those that were held.
    """
    cell = calibrated_cell(calibration)
    charts = {name: BeamChart.of(beam) for name, beam in cell.lasers.items()}
    F = row_jacobian(cell, charts, beam_frames(cell))
    with np.errstate(invalid="ignore"):
        covariance = F @ calibration.covariance @ F.T
        sigma = np.sqrt(np.diag(covariance))
    names = row_names(cell, charts)
    free = np.flatnonzero(np.isfinite(sigma) & (sigma > 0))
    C = covariance[np.ix_(free, free)]
    matrix = np.clip(C / np.outer(sigma[free], sigma[free]), -1.0, 1.0)
    np.fill_diagonal(matrix, 1.0)
    return Correlation(
        names=tuple(names[k][0] for k in free),
        units=tuple(names[k][1] for k in free),
        matrix=matrix,
        covariance=C,
        held=tuple(name for k, (name, _) in enumerate(names) if k not in set(free.tolist())),
    )
