"""A running estimate as the same `Calibration` that a batch solution gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lasercal_gtsam.calibration import (
    Calibration,
    Fit,
    Inputs,
    Observability,
    Parameter,
    SpotResults,
    rms_px,
)
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import make_batch, pixel_covariances, state_from_cell
from lasercal_gtsam.hand_noise import HandNoise, corrected_batch, corrections, linearized
from lasercal_gtsam.incremental.beginning import determined
from lasercal_gtsam.incremental.estimate import Estimate
from lasercal_gtsam.observability import SINGULAR, RangeSvd
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.projection import project
from lasercal_gtsam.report_map import tangent_labels
from lasercal_gtsam.solve import fold_warnings
from lasercal_gtsam.uncertainty import Uncertainty, report_notes, table_parameters

_HAND_ROUNDS = 3


@dataclass(frozen=True)
class Account:
    """What a result says beside the estimate.

    Attributes
    ----------
    initial : the start, all parts
    options : what was asked for
    sigma_px : pixel sigma that spots without one of their own count with
    limit : residual length (a-priori sigmas) from which on a spot is an outlier
    waiting : number of every spot that waits
    older : spots that live on in the prior only
    words : what is held
    troubles : sentences
    """

    initial: Cell
    options: CalibrationOptions
    sigma_px: float
    limit: float
    waiting: tuple[int, ...]
    older: int
    words: tuple[str, ...]
    troubles: tuple[str, ...]


def uncertainty_of(estimate: Estimate, unit: float = 1.0) -> Uncertainty:
    """Covariance of the estimate; ``unit``: pixel sigma that the scale multiplies."""
    labels = tangent_labels(estimate.template)
    return Uncertainty(estimate.covariance(), labels, unit * estimate.sigma0, estimate.dof, ())


def parameters_of(estimate: Estimate, initial: Cell) -> tuple[Parameter, ...]:
    """Rows of the table."""
    cell = estimate.cell
    return table_parameters(cell, initial.restricted(cell), uncertainty_of(estimate))


def calibration_of(
    estimate: Estimate, observations: Observations, first: int, account: Account, unit: float
) -> Calibration:
    """The whole result.

    Parameters
    ----------
    estimate : as it stood
    observations : the spots that were stored then
    first : number of the first of them
    account : the rest
    unit : pixel sigma that the a-posteriori scale multiplies
    """
    cell = estimate.cell
    uncertainty = uncertainty_of(estimate, unit)
    residuals, lengths = _residuals(cell, observations, account)
    rejected = np.array(
        [
            _reason(length / estimate.sigma0, account.limit / estimate.sigma0)
            # the limit of few spots may be infinite, as is the length of what cannot be
            if not (length <= account.limit and length < np.inf)
            else None
            for length in lengths
        ],
        dtype=object,
    )
    for k in account.waiting:
        if k < first:  # given up since
            continue
        rejected[k - first] = "held back: it waits for more spots, or for the end of an alarm"
    used = np.array([reason is None for reason in rejected], dtype=np.bool_)
    svd = RangeSvd.of(estimate.R[:-1, :-1], uncertainty.labels, ~(estimate.fixed | estimate.open))
    undetermined = [
        f"the spots do not determine this combination: {w.words}"
        for w in svd.weak_directions(SINGULAR, sigma=estimate.sigma0)
    ]
    troubles = [*account.troubles, *undetermined]
    fit = _fit(estimate, account, troubles, residuals[used], int((~used).sum()), unit)
    notes = [*fold_warnings(cell), *report_notes(cell, uncertainty)]
    if account.older:
        notes.append(f"{account.older} older spots live on as prior knowledge only")
    return Calibration(
        cell=cell,
        initial=account.initial,
        parameters=table_parameters(cell, account.initial.restricted(cell), uncertainty),
        covariance=uncertainty.covariance,
        labels=uncertainty.labels,
        fit=fit,
        spots=SpotResults(
            observations.id,
            observations.plane,
            observations.camera,
            observations.laser,
            residuals,
            used.astype(np.float64),
            tuple(rejected.tolist()),
        ),
        observability=Observability(
            svd.weak_directions(sigma=estimate.sigma0), account.words, tuple(notes)
        ),
        inputs=Inputs(observations, account.options),
    )


def _residuals(cell: Cell, seen: Observations, account: Account) -> tuple[Array, Array]:
    """Pixels (N, 2) and whitened lengths (N,) of spots whose parts are all known; else NaN."""
    residuals, lengths = np.full((len(seen), 2), np.nan), np.full(len(seen), np.inf)
    rows = np.flatnonzero(determined(seen, cell))
    if not len(rows):
        return residuals, lengths
    spots, options = seen[rows], account.options
    names = {k: getattr(spots, k).tolist() for k in ("plane", "camera", "laser")}
    residuals[rows] = project(cell, spots.T_base_hand, **names) - spots.uv
    cov = pixel_covariances(spots, account.sigma_px)
    noise = HandNoise.of(options)
    part = cell.restricted(spots)
    if max(noise) > 0:
        eta = np.zeros((len(spots), 6))
        for _ in range(_HAND_ROUNDS):
            eta = corrections(*linearized(spots, part, eta), cov, noise)
        batch = corrected_batch(spots, cov, part, noise, eta)
    else:
        batch = make_batch(spots, account.sigma_px)
    found = batch.whitened_lengths(state_from_cell(part))
    lengths[rows] = np.where(np.isnan(found), np.inf, found)
    return residuals, lengths


def _reason(length: float, limit: float) -> str:
    if not np.isfinite(length):
        return "no spot can be there"
    return f"residual {length:.1f} sigma, limit {limit:.1f}"


def _fit(
    estimate: Estimate,
    account: Account,
    troubles: Sequence[str],
    residuals: Array,
    n_rejected: int,
    unit: float,
) -> Fit:
    rms = estimate.rms_px if account.older else rms_px(residuals)
    if troubles:
        status = "not to be trusted: " + "; ".join(troubles)
    else:
        status = f"running: {len(residuals) + account.older} spots, RMS {rms:.3g} px"
        if n_rejected:
            status += f", {n_rejected} rejected as outliers or held back"
        if warnings := fold_warnings(estimate.cell):
            status += "; but " + "; ".join(warnings)
    return Fit(
        rms_px=rms,
        sigma0=unit * estimate.sigma0,
        dof=estimate.dof,
        iterations=1,
        converged=not troubles,
        status=status,
        n_spots=len(residuals) + account.older,
        n_rejected=n_rejected,
    )
