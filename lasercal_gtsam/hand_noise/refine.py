"""The fit with a noisy robot: rounds of corrected hand poses, noise levels found on the way."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lasercal_gtsam.errors import SolveError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import state_from_cell
from lasercal_gtsam.hand_noise.elimination import (
    HandNoise,
    Mask,
    corrected_batch,
    corrections,
    linearized,
    noisy_batch,
)
from lasercal_gtsam.hand_noise.levels import (
    Levels,
    PixelNoise,
    Residuals,
    estimated_levels,
    missing_sigma,
)
from lasercal_gtsam.solve import CONVERGED_SIGMAS, Solution
from lasercal_gtsam.start import Search

_MAX_ROUNDS = 12
# with noise levels to be found along with the rest
_MAX_ROUNDS_OF_LEVELS = 40
# rounds end when the estimate moves by less than this many sigmas, and noise levels by less than
# this many of their standard errors
_SETTLED_SIGMAS = 1e-5
_SETTLED_LEVELS = 1e-4
_EXACT_PX = 1e-3


class Refined(NamedTuple):
    """A fit with robot noise.

    ``lengths`` (N,): residual length of each spot in sigmas of pixel and hand together; infinite
    where no spot can be. ``sigma_px``: pixel sigma found; None where none was missing. ``levels``:
    all levels in use.
    """

    solution: Solution
    lengths: Array
    sigma_px: float | None
    levels: Levels


def refine_with_hand_noise(search: Search, solution: Solution, rejected: Mask) -> Refined:
    """Refit with the robot's noise.

    Independent hand poses are eliminated inside the factor, at every state that the solver tries;
    for shared ones there are rounds of corrected poses until nothing moves. Where spots have no
    pixel sigma (neither their own nor ``options.sigma_px``), it is found along with the rest: the
    one with which the residuals are as long as they should be. Where ``options.estimate_noise``
    names levels of the hand, these and a missing pixel sigma are estimated together, by restricted
    maximum likelihood (`components`).

    Parameters
    ----------
    search : as for the fit without robot noise
    solution : that fit
    rejected : (N,) booleans: spots left out

    Raises
    ------
    SolveError
        The refit fails.
    DataError
        Too few spots for the levels that were to be estimated.
    """
    observations, options = search.observations, search.options
    stops, pixels = observations.shared_stops, PixelNoise.of(observations, options)
    lacking = bool(pixels.missing.any())
    levels, change = Levels(1.0, HandNoise.of(options)), 0.0
    in_rounds = bool(options.estimate_noise) or lacking or bool(stops)
    eta = np.zeros((len(observations), 6))
    for number in range(_MAX_ROUNDS_OF_LEVELS if options.estimate_noise else _MAX_ROUNDS):
        if in_rounds:
            B, r = linearized(observations, solution.cell, eta)
            spots = Residuals(observations, eta, B, r, ~rejected)
        if options.estimate_noise:
            before, last = levels, levels if number else None
            levels = estimated_levels(spots, pixels, solution, options, last)
            change = levels.differ(before)
        elif lacking:
            dof = 2 * int((~rejected).sum()) - int(solution.problem.free.sum())
            levels = Levels(missing_sigma(spots, pixels, levels.hand, dof), levels.hand)
        cov = pixels.covariance(levels.sigma_px)
        if in_rounds:
            eta = corrections(B, r, cov, levels.hand, stops, rejected)
        if stops:
            everyone = corrected_batch(observations, cov, solution.cell, levels.hand, eta)
        else:
            everyone = noisy_batch(observations, cov, levels.hand, rejected)
        batch = everyone.weighted(~rejected) if rejected.any() else everyone
        cost = batch.total_loss(state_from_cell(solution.cell), solution.problem.loss)
        better = replace(search, batch=batch).attempt(solution.cell, solution.problem.holds)
        if not isinstance(better, Solution):
            raise SolveError(f"the fit fails with the robot's noise: {better}") from better
        moved = np.sqrt(max(cost - better.cost, 0.0))
        solution = replace(better, iterations=solution.iterations + better.iterations)
        unit = max(float(np.sqrt(better.cost / (2 * len(batch.order)))), _EXACT_PX)
        # where the solver itself comes near its optimum slowly, the rounds cannot do better
        near = max(_SETTLED_SIGMAS * unit, min(2.0 * better.decrement, CONVERGED_SIGMAS * unit))
        if not in_rounds or (moved < near and change < _SETTLED_LEVELS):
            break
    else:
        what = "noise levels" if options.estimate_noise else "hand_sigma_m and hand_sigma_rad"
        trouble = (
            f"the corrections of the hand poses do not settle: the last round moved {moved:.2g} "
            f"sigma; check {what}"
        )
        solution = replace(solution, troubles=(*solution.troubles, trouble))
    state = state_from_cell(solution.cell)
    # from here on the spots are those at the likeliest hand poses
    settled = replace(solution.problem, batch=batch.at(state))
    solution = replace(solution, problem=settled)
    lengths = everyone.whitened_lengths(state)
    lengths = np.where(np.isnan(lengths), np.inf, lengths)
    return Refined(solution, lengths, levels.sigma_px if lacking else None, levels)
