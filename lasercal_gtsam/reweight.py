"""A robust loss of the user's choice: M-estimates, and graduated truncated least squares.

Both begin where `robust.refine_without_outliers` ends, so that no start has to be good. What that
search left out counts again: an M-estimate weighs every spot by its loss, and the truncated loss
opens the question anew and closes it by degrees.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import cast

import numpy as np
from lasercal_factors.batch import LossName, SpotBatch

from lasercal_gtsam.calibration import with_levels
from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import LasercalError, SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import make_graph, pixel_covariances, state_from_cell
from lasercal_gtsam.hand_noise import HandNoise, corrected_batch, corrections, linearized
from lasercal_gtsam.losses import efficient_loss, loss_weights, truncated_weights
from lasercal_gtsam.robust import (
    Accepted,
    Consensus,
    Finish,
    Finished,
    Mask,
    Refine,
    lengths_in,
    outlier_reasons,
    refit,
    rejection_length,
    robust_scale,
)
from lasercal_gtsam.solve import Solution, solve
from lasercal_gtsam.start import Search

# spots whitened at a cell, hand poses corrected there
SpotsAt = Callable[[Cell], SpotBatch]

_MAX_ROUNDS = 40
# an M-estimate is settled when the scale and (in sigmas) the estimate move by less than this
_SETTLED = 1e-6
_SETTLED_SIGMAS = 1e-4
# where the scale still moves by more after all rounds, the answer says so
_UNSETTLED = 1e-3
# Yang et al. 2020, remark 5: growth of mu from one round to the next
_GROWTH = 1.4
# residual, in limits, up to which a spot counts in the first round. Their start, plain least
# squares, has to be left where outliers agree with each other; a start is at hand that is better.
_REOPENED = 10.0
# rounds after which mu is a million and the cut sharp, should a spot lie on it
_MAX_DEGREES = 60
# weights this close to 0 or 1 are decided
_DECIDED = 1e-6


def refine_with_loss(search: Search, accepted: Accepted, name: str) -> Accepted:
    """M-estimate of all spots that are possible, from an answer without outliers.

    The scale is the corrected median of the lengths of the spots which that answer kept; it is
    found along with the estimate, and the threshold of the loss follows it. (A median over all
    spots would grow by half where 40 % are outliers, and with it what they may do.)

    Parameters
    ----------
    search : observations, whitening, holds and options
    accepted : the answer without outliers; returned as it is where it is not to be trusted
    name : "huber", "cauchy" or "geman-mcclure"

    Raises
    ------
    SolveError
        Minimising the loss left the possible.
    """
    finished = accepted.finished
    if not finished.solution.plausible:
        return accepted
    kept = _kept(accepted)
    loss = efficient_loss(cast(LossName, name))
    spots_at = _spots_at(search, finished, ~kept)
    cell, holds = finished.solution.cell, finished.solution.problem.holds
    unknowns = int(finished.solution.problem.free.sum())
    iterations, change = finished.solution.iterations, np.inf
    batch = spots_at(cell)
    lengths = lengths_in(batch, cell)
    scale = robust_scale(lengths[kept], unknowns)
    for _ in range(_MAX_ROUNDS):
        possible = np.isfinite(lengths)
        used = (batch if possible.all() else batch.weighted(possible)).scaled(scale)
        problem = make_graph(search.observations, used, holds, cell, loss)
        before = used.total_loss(state_from_cell(problem.start), loss)
        try:
            solution = solve(problem, search.options.max_iterations, find_scale=False)
        except LasercalError as error:
            raise SolveError(f"the {name} loss cannot be minimised: {error}") from error
        moved = np.sqrt(max(before - solution.cost, 0.0))
        iterations += solution.iterations
        cell = solution.cell
        answer, at_scale, judged = solution, scale, lengths_in(batch, cell)
        batch = spots_at(cell)
        lengths = lengths_in(batch, cell)
        scale = robust_scale(lengths[kept], unknowns)
        change = abs(np.log(scale / at_scale))
        if change < _SETTLED and moved < _SETTLED_SIGMAS:
            break
    answer = replace(answer, iterations=iterations)
    if change > _UNSETTLED:
        trouble = f"the scale of the residuals does not settle: it still moved by {change:.1%}"
        answer = replace(answer, troubles=(*answer.troubles, trouble))
    judged = judged / at_scale
    weights = np.where(possible, loss_weights(loss, np.where(possible, judged, 0.0) ** 2), 0.0)
    reasons = tuple(None if can else "no spot can be there" for can in possible)
    sigma_px = at_scale * (finished.sigma_px or 1.0)
    weighed = finished._replace(solution=answer, lengths=judged, sigma_px=sigma_px)
    return Accepted(weighed, reasons, accepted.start, weights)


def refine_truncated(
    search: Search, accepted: Accepted, refine: Refine, finish: Finish
) -> Accepted:
    """Graduated truncated least squares (Yang, Antonante, Tzoumas, Carlone 2020), outliers named.

    The truncated loss ``min(r^2, c^2)`` is reached through surrogates that begin nearly convex. The
    truncation ``c`` is `rejection_length` times the scale, which follows the spots that count, so
    that clean data lose no spot. The final estimate is least squares on the accepted spots.

    Parameters
    ----------
    search : observations, whitening, holds and options
    accepted : the answer to begin from; stays the answer if its truncated loss is the smaller one
    refine, finish : plain least squares from some cells, and what follows
    """
    finished = accepted.finished
    if not finished.solution.plausible:
        return accepted
    found = _graduated(search, accepted)
    if found is None:
        return accepted
    answer = refit(search, found, refine, finish)
    if answer is None:
        return accepted
    new, rejected = answer
    kept = _kept(accepted)
    if np.array_equal(~rejected, kept):
        return accepted
    unknowns = int(finished.solution.problem.free.sum())
    scales = [robust_scale(new.lengths[~rejected], unknowns)]
    scales.append(robust_scale(finished.lengths[kept], unknowns))
    limit = rejection_length(len(kept)) * min(scales)
    if _truncated_loss(new.lengths, limit) >= _truncated_loss(finished.lengths, limit):
        return accepted
    reasons = outlier_reasons(search, new.lengths, rejected)
    return Accepted(new, reasons, accepted.start)


def _graduated(search: Search, accepted: Accepted) -> Consensus | None:
    """Rounds of weighted least squares while the cut sharpens; None where they fail."""
    finished = accepted.finished
    problem = finished.solution.problem
    kept, unknowns = _kept(accepted), int(problem.free.sum())
    spots_at = _spots_at(search, finished, ~kept)
    cell, iterations = finished.solution.cell, finished.solution.iterations
    quantile = rejection_length(len(kept))
    mu = 0.0
    for _ in range(_MAX_DEGREES):
        batch = spots_at(cell)
        lengths = lengths_in(batch, cell)
        scale = robust_scale(lengths[kept], unknowns)
        limit = quantile * scale
        mu = _GROWTH * mu if mu else _first_mu(lengths, limit)
        weights = truncated_weights(lengths, limit, mu)
        kept = lengths <= limit  # not by the weights: while these are soft, few are near one
        if np.all((weights < _DECIDED) | (weights > 1.0 - _DECIDED)):
            break
        step = make_graph(search.observations, batch.weighted(weights), problem.holds, cell)
        try:
            solution: Solution = solve(step, search.options.max_iterations)
        except LasercalError:
            return None
        cell, iterations = solution.cell, iterations + solution.iterations
    return Consensus(accepted.start, cell, scale, lengths, iterations)


def _first_mu(lengths: Array, limit: float) -> float:
    """``mu`` with which the longest residual, or one of ten limits, is where weights end."""
    longest = float(lengths[np.isfinite(lengths)].max()) / limit
    end = float(np.clip(np.sqrt(2.0) * longest, np.sqrt(2.0), _REOPENED))
    return 1.0 / (end**2 - 1.0)


def _truncated_loss(lengths: Array, limit: float) -> float:
    return float(np.square(np.minimum(lengths, limit)).sum())


def _kept(accepted: Accepted) -> Mask:
    return np.array([reason is None for reason in accepted.reasons], dtype=np.bool_)


def _spots_at(search: Search, finished: Finished, rejected: Mask) -> SpotsAt:
    """Spots at a cell: as they were seen or, with a noisy robot, at corrected hand poses."""
    options, observations = with_levels(search.options, finished.noise), search.observations
    if not options.noisy_hand:
        return lambda cell: search.batch
    noise = HandNoise.of(options)
    cov = pixel_covariances(observations, finished.sigma_px or options.sigma_px)
    eta = np.zeros((len(observations), 6))

    def spots_at(cell: Cell) -> SpotBatch:
        nonlocal eta
        B, free_residual = linearized(observations, cell, eta)
        eta = corrections(B, free_residual, cov, noise, observations.shared_stops, rejected)
        return corrected_batch(observations, cov, cell, noise, eta)

    return spots_at
