"""A running estimate as the same `Calibration` that a batch solution gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from lasercal_factors.batch import SpotBatch

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
from lasercal_gtsam.observability import SINGULAR, RangeSvd, undetermined
from lasercal_gtsam.observations import Observations
from lasercal_gtsam.options import CalibrationOptions
from lasercal_gtsam.projection import project
from lasercal_gtsam.report_map import tangent_labels
from lasercal_gtsam.solve import fold_warnings
from lasercal_gtsam.uncertainty import (
    Uncertainty,
    hat_diagonal,
    report_notes,
    table_parameters,
)

_HAND_ROUNDS = 3
# spots that are looked at together, so that memory stays small however many there are
_TOGETHER = 1 << 15


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
    fade : factor on a spot's information for each spot that came after it
    """

    initial: Cell
    options: CalibrationOptions
    sigma_px: float
    limit: float
    waiting: tuple[int, ...]
    older: int
    words: tuple[str, ...]
    troubles: tuple[str, ...]
    fade: float = 1.0


class _Compared(NamedTuple):
    """Stored spots against the estimate.

    Attributes
    ----------
    residual_px : (N, 2) predicted minus seen, NaN where a part is not known
    length : (N,) whitened (a-priori sigmas), infinite where no spot can be
    leverage : (N,) of each, as if it was used (`SpotResult`)
    """

    residual_px: Array
    length: Array
    leverage: Array


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
    residuals, lengths, leverage = _compared(estimate, observations, account)
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
    troubles = [*account.troubles, *_impossible(residuals[used])]
    if singular := svd.weak_directions(SINGULAR, sigma=estimate.sigma0):
        troubles.append(undetermined(singular))
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
            np.where(used, leverage, 0.0),
        ),
        observability=Observability(
            svd.weak_directions(sigma=estimate.sigma0), account.words, tuple(notes)
        ),
        inputs=Inputs(observations, account.options),
    )


def _compared(estimate: Estimate, seen: Observations, account: Account) -> _Compared:
    """Residuals and leverages of the spots whose parts are all known.

    Leverages are those of the batch solution, with the running covariance. What older spots and
    priors say is in that, so that stored spots have the less leverage beside them: their sum is
    what of the unknowns they determine themselves. A spot that has faded has its share only.
    """
    cell, root = estimate.cell, estimate.root()
    coordinates = {label: k for k, label in enumerate(tangent_labels(cell))}
    count = len(seen)
    out = _Compared(np.full((count, 2), np.nan), np.full(count, np.inf), np.full(count, np.nan))
    known = np.flatnonzero(determined(seen, cell))
    for begin in range(0, len(known), _TOGETHER):
        rows = known[begin : begin + _TOGETHER]
        spots = seen[rows]
        names = {k: getattr(spots, k).tolist() for k in ("plane", "camera", "laser")}
        out.residual_px[rows] = project(cell, spots.T_base_hand, **names) - spots.uv
        part = cell.restricted(spots)
        batch, state = _batch(spots, part, account), state_from_cell(part)
        found = batch.whitened_lengths(state)
        out.length[rows] = np.where(np.isnan(found), np.inf, found)
        at = [coordinates[label] for label in tangent_labels(part)]
        linear = batch.rows(state)
        linear[~np.isfinite(found)] = 0.0
        weights = account.fade ** (count - 1 - rows)
        out.leverage[rows] = weights * hat_diagonal(batch, linear, root[at], part)
    return out


def _batch(spots: Observations, cell: Cell, account: Account) -> SpotBatch:
    """Spots as they count: with the hand poses that are likeliest, where the hand is noisy."""
    noise = HandNoise.of(account.options)
    if not max(noise) > 0:
        return make_batch(spots, account.sigma_px)
    cov = pixel_covariances(spots, account.sigma_px)
    eta = np.zeros((len(spots), 6))
    for _ in range(_HAND_ROUNDS):
        eta = corrections(*linearized(spots, cell, eta), cov, noise)
    return corrected_batch(spots, cov, cell, noise, eta)


def _impossible(residuals: Array) -> list[str]:
    """A sentence if used spots cannot be, as the hand was commanded; noise may have moved it."""
    count = int((~np.isfinite(residuals).all(axis=1)).sum())
    if not count:
        return []
    return [
        f"{count} of {len(residuals)} spots that count cannot be where the hand was (beam away "
        "from its plane, behind the camera, or in the fold of the distortion)"
    ]


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
    seen = np.isfinite(residuals).all(axis=1)
    rms = estimate.rms_px if account.older else rms_px(residuals[seen])
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
