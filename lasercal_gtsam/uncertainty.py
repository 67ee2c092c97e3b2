"""Sigmas: joint covariance, a-posteriori scale, Table 2's own parameters.

The covariance comes from one singular value decomposition of the graph's square-root information,
which also names the weak directions. It equals `gtsam.Marginals` (tested), better conditioned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.calibration import Parameter, WeakDirection
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import CellGraph, beam_frames
from lasercal_gtsam.report_map import (
    CAMERA_TANGENT,
    BeamChart,
    row_jacobian,
    row_names,
    row_values,
    tangent_labels,
)
from lasercal_gtsam.solve import (
    Solution,
    degrees_of_freedom,
    refuse_if_singular,
)
from lasercal_gtsam.units import MM_PER_M

# a plane closer to the base origin than this bends the paper's vector a
_NEAR_ORIGIN_SIGMAS = 5.0
# residual scale below which data are exact and say nothing about their noise
_EXACT = 1e-6


@dataclass(frozen=True)
class Uncertainty:
    """Joint covariance of a solution.

    Attributes
    ----------
    covariance : (n, n) in tangent coordinates at the solution (`report_map`), SI units; NaN where
        there are no degrees of freedom to estimate the scale from
    labels : names of the coordinates
    sigma0 : a-posteriori scale of the pixel sigmas
    dof : degrees of freedom behind ``sigma0``
    weak : directions which the data hardly determine
    """

    covariance: Array
    labels: tuple[str, ...]
    sigma0: float
    dof: float
    weak: tuple[WeakDirection, ...]


def estimate_uncertainty(solution: Solution) -> Uncertainty:
    """Covariance at a solution, scaled by the residuals (method 5: ``s0^2 = SSE / dof``).

    Held coordinates have zero rows; tied focal lengths move together.

    Raises
    ------
    DegenerateError
        The information is singular; the message names the undetermined directions.
    """
    problem = solution.problem.anchored(solution.cell)
    values = problem.start_values()
    svd = refuse_if_singular(problem, values)
    dof = degrees_of_freedom(problem, values)
    sigma0 = float(np.sqrt(solution.cost / dof)) if dof >= 1 else float("nan")
    unit = sigma0 / problem.scale
    E = _expansion(problem)
    covariance = E @ (unit**2 * svd.covariance()) @ E.T
    covariance[~E.any(axis=1)] = 0.0  # what is held has none, even where the scale is unknown
    covariance[:, ~E.any(axis=1)] = 0.0
    weak = svd.weak_directions(sigma=unit if unit > _EXACT else 1.0)
    return Uncertainty(covariance, tangent_labels(solution.cell), sigma0, dof, weak)


def table_parameters(cell: Cell, initial: Cell, uncertainty: Uncertainty) -> tuple[Parameter, ...]:
    """Rows of the paper's Table 2 with sigmas by exact change of variables."""
    charts = {name: BeamChart.of(beam) for name, beam in cell.lasers.items()}
    F = row_jacobian(cell, charts, beam_frames(cell))
    covariance = uncertainty.covariance
    unknown = np.isnan(np.diag(covariance))
    variances = np.einsum("ij,jk,ik->i", F, np.nan_to_num(covariance), F, optimize=True)
    if unknown.any():
        variances[F[:, unknown].any(axis=1)] = np.nan
    sigmas = np.sqrt(np.maximum(variances, 0.0))
    rows = zip(
        row_names(cell, charts),
        row_values(initial, charts),
        row_values(cell, charts),
        sigmas,
        strict=True,
    )
    return tuple(
        Parameter(name, float(before), float(after), float(sigma), unit)
        for (name, unit), before, after, sigma in rows
    )


def report_notes(cell: Cell, uncertainty: Uncertainty) -> list[str]:
    """Rows of the table whose sigmas do not tell the whole: planes that may pass the base origin.

    Their vector ``a = d n`` bends within a sigma of ``d``; normal and distance stay good.
    """
    where = {label: i for i, label in enumerate(uncertainty.labels)}
    notes: list[str] = []
    for name, plane in cell.planes.items():
        i = where[f"plane {name}.distance"]
        sigma = float(np.sqrt(max(uncertainty.covariance[i, i], 0.0)))
        if plane.distance < _NEAR_ORIGIN_SIGMAS * sigma:
            notes.append(
                f"plane {name!r} passes the base origin at {MM_PER_M * plane.distance:.2g} +- "
                f"{MM_PER_M * sigma:.2g} mm: do not read the sigmas of a_{name} one by one, use "
                "its normal and distance"
            )
    return notes


def _expansion(problem: CellGraph) -> Array:
    """(n, n_free): free coordinates to all of them; tied focal lengths move together."""
    E = np.eye(problem.chart.n)
    for c, aspect in enumerate(problem.chart.aspects):
        if aspect is not None:
            fu = c * len(CAMERA_TANGENT) + CAMERA_TANGENT.index("fu")
            E[fu, fu + 1] = aspect
    return E[:, problem.free]
