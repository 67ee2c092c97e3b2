"""Sigmas: joint covariance, a-posteriori scale, Table 2's own parameters.

The covariance comes from one singular value decomposition of the graph's square-root information,
which also names the weak directions. It equals `gtsam.Marginals` (tested), better conditioned.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from lasercal_factors.batch import Loss, SpotBatch

from lasercal_gtsam.calibration import Parameter, WeakDirection, measured
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import CellGraph, beam_frames, expansion, state_from_cell
from lasercal_gtsam.losses import loss_weights, sensitivity_and_spread
from lasercal_gtsam.observability import RangeSvd
from lasercal_gtsam.report_map import (
    BEAM_TANGENT,
    CAMERA_TANGENT,
    PLANE_TANGENT,
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
    leverage : (N,) of each spot, see `SpotResult`; None where nobody asked
    """

    covariance: Array
    labels: tuple[str, ...]
    sigma0: float
    dof: float
    weak: tuple[WeakDirection, ...]
    leverage: Array | None = None


def estimate_uncertainty(solution: Solution) -> Uncertainty:
    """Covariance at a solution, scaled by the residuals (method 5: ``s0^2 = SSE / dof``).

    With a loss the spots must be whitened to a scale of one; ``sigma0`` is then one, and the
    covariance is Huber's (`losses.sensitivity_and_spread`). Held coordinates have zero rows; tied
    focal lengths move together.

    Raises
    ------
    DegenerateError
        The information is singular; the message names the undetermined directions.
    """
    problem = solution.problem.anchored(solution.cell)
    values = problem.start_values()
    svd = refuse_if_singular(problem, values)
    dof = degrees_of_freedom(problem, values)
    E = expansion(problem.chart.aspects, problem.free)
    if problem.loss.name == "none":
        sigma0 = float(np.sqrt(solution.cost / dof)) if dof >= 1 else float("nan")
        unit = sigma0 / problem.scale
        free, weak_of = unit**2 * svd.covariance(), svd
    else:
        sigma0 = 1.0 if dof >= 1 else float("nan")
        free, unit, weak_of = _robust_covariance(problem, sigma0)
    covariance = E @ free @ E.T
    covariance[~E.any(axis=1)] = 0.0  # what is held has none, even where the scale is unknown
    covariance[:, ~E.any(axis=1)] = 0.0
    # of exact data the strength is that with the stated sigmas, whatever scale was settled on
    exact = not sigma0 > _EXACT
    weak = weak_of.weak_directions(sigma=1.0 / problem.scale if exact else unit)
    leverage = spot_leverages(problem, E @ svd.root())
    return Uncertainty(covariance, tangent_labels(solution.cell), sigma0, dof, weak, leverage)


def _robust_covariance(problem: CellGraph, sigma0: float) -> tuple[Array, float, RangeSvd]:
    """Covariance of the free coordinates, its scale, and the unweighted information.

    With ``D`` the rows of the spots and ``P`` the information of the priors it is
    ``A^-1 (b D^T D + P) A^-1`` with ``A = a D^T D + P``.
    """
    residuals = problem.batch.rows(state_from_cell(problem.start))[problem.batch.used, :, -1]
    unknowns = float(problem.free.sum())
    a, b = sensitivity_and_spread(problem.loss, residuals, unknowns)
    plain = replace(problem, loss=Loss())
    R = plain.rows(plain.start_values())
    labels = tangent_labels(problem.start)
    unit = float(np.sqrt(b)) / a * sigma0
    svd = RangeSvd.of(R, labels, problem.free)
    if not problem.holds.priors:
        return unit**2 * svd.covariance(), unit, svd
    data = len(R) - len(problem.holds.priors)
    weights = np.where(np.arange(len(R)) < data, np.sqrt(a), 1.0)
    inverse = RangeSvd.of(weights[:, None] * R, labels, problem.free).covariance()
    D = R[:data, problem.free]
    # A^-1 (A + (b - a) D^T D) A^-1
    return sigma0**2 * (inverse + (b - a) * (inverse @ D.T) @ (D @ inverse)), unit, svd


def spot_leverages(problem: CellGraph, root: Array) -> Array:
    """Leverage of every spot, (N,): its rows of the hat matrix's diagonal, summed; 0 if left out.

    Parameters
    ----------
    problem : its chart about the solution
    root : (n, m) square root of the covariance of all coordinates, spots at their stated sigmas
    """
    rows = problem.batch.rows(state_from_cell(problem.start)) / problem.scale
    if problem.loss.name != "none":
        m = np.einsum("ni,ni->n", rows[..., -1], rows[..., -1])
        rows *= np.sqrt(loss_weights(problem.loss, m))[:, None, None]
    return hat_diagonal(problem.batch, rows, root, problem.start)


def hat_diagonal(batch: SpotBatch, rows: Array, root: Array, cell: Cell) -> Array:
    """Diagonal of the hat matrix, summed over the two rows of each spot, (N,).

    Parameters
    ----------
    batch : spots, whose indices are those of the cell's parts
    rows : (N, 2, 23) as `SpotBatch.rows` gives them at the cell, weighted as the spots count
    root : (n, m) square root of the covariance of all tangent coordinates, in the rows' units
    cell : where it is linearised
    """
    sizes = (len(CAMERA_TANGENT), len(BEAM_TANGENT), len(PLANE_TANGENT))
    lasers = sizes[0] * len(cell.cameras)
    planes = lasers + sizes[1] * len(cell.lasers)
    root = root.copy()
    root[planes + 2 :: sizes[2]] *= -1.0  # the kernels' offset of a plane is minus its distance
    parts = np.zeros((len(batch), 2, root.shape[1]))
    for c, l, p, first, last in batch.spots.blocks:  # noqa: E741
        at = np.concatenate(
            [
                begin + size * index + np.arange(size)
                for begin, size, index in zip((0, lasers, planes), sizes, (c, l, p), strict=True)
            ]
        )
        members = batch.order[first:last]
        parts[members] = rows[members, :, :-1] @ root[at]
    return np.asarray(np.square(batch.decorrelated(parts)).sum(axis=(1, 2)))


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
                f"plane {name!r} passes the base origin at "
                f"{measured(MM_PER_M * plane.distance, MM_PER_M * sigma)} mm: do not read the "
                f"sigmas of a_{name} one by one, use its normal and distance"
            )
    return notes
