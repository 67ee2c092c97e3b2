"""Outliers: found with a redescending loss, named, and left out of the final estimate.

A spot is an outlier if its whitened residual is longer than chance allows. The Cauchy loss keeps
outliers from hiding each other; the final estimate is plain least squares on the accepted spots, so
that its sigmas mean what they say. On clean data nothing changes, not even a digit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from lasercal_factors.batch import Loss

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import state_from_cell
from lasercal_gtsam.holds import Holds
from lasercal_gtsam.solve import Solution
from lasercal_gtsam.start import Search, refine_candidates

# threshold at which the Cauchy loss is 95 % efficient for two-dimensional Gaussian residuals
CAUCHY_THRESHOLD = 2.385
# probability that any spot of a clean capture is rejected
FALSE_ALARM = 1e-3
_MEDIAN_RAYLEIGH = float(np.sqrt(2 * np.log(2)))
_MIN_SCALE = 1e-6
_ROUNDS = 10
_MAX_SHARE = 0.5


def rejection_length(count: int) -> float:
    """Length (sigmas) that the longest of ``count`` good residuals rarely exceeds (`FALSE_ALARM`).

    A quantile of the Rayleigh distribution, ``sqrt(-2 ln p)``.
    """
    return float(np.sqrt(-2.0 * np.log(FALSE_ALARM / max(count, 1))))


def robust_scale(lengths: Array, unknowns: int) -> float:
    """Scale of whitened residual lengths (N,) by their median, corrected for the unknowns."""
    rows = 2 * len(lengths)
    correction = float(np.sqrt(rows / max(rows - unknowns, 1)))
    return max(float(np.median(lengths)) / _MEDIAN_RAYLEIGH * correction, _MIN_SCALE)


def reject_outliers(
    search: Search, solution: Solution
) -> tuple[Search, Solution, tuple[str | None, ...]]:
    """Leave out the spots that do not fit, if there are any.

    Returns
    -------
    Search, Solution
        With the outliers' weights at zero; the ones given if there are none.
    tuple
        For each spot None, or why it was rejected.
    """
    count = len(search.batch)
    unknowns = int((~search.holds.held).sum())
    limit = rejection_length(count)
    lengths, scale = _lengths(search, solution, unknowns)
    if not np.any(lengths > limit * scale):
        if solution.problem.batch.used.sum() < search.batch.used.sum():
            everything = search.solve_from(solution.cell)
            solution = solution if everything is None else _after(solution, everything)
        return search, solution, (None,) * count

    current = solution
    for _ in range(_ROUNDS):
        loss = Loss("cauchy", CAUCHY_THRESHOLD * scale)
        robust = replace(search, loss=loss).solve_from(current.cell)
        if robust is None:
            break
        before, current = scale, _after(current, robust)
        lengths, scale = _lengths(search, current, unknowns)
        if abs(scale - before) < 0.01 * before:
            break

    rejected = np.zeros(count, dtype=np.bool_)
    for _ in range(_ROUNDS):
        found = ~(lengths <= limit * scale)
        if found.mean() > _MAX_SHARE:
            trouble = f"{found.sum()} of {count} spots do not fit the cell that the others agree on"
            troubled = replace(solution, troubles=(*solution.troubles, trouble))
            return search, troubled, (None,) * count
        if np.array_equal(found, rejected):
            break
        rejected = found
        kept = replace(search, batch=search.batch.weighted(~rejected))
        refit = kept.solve_from(current.cell)
        if refit is None:
            break
        current = _after(current, refit)
        lengths, scale = _lengths(search, current, unknowns)
    if not rejected.any():
        return search, solution, (None,) * count
    reasons = tuple(
        f"residual {lengths[k] / scale:.1f} sigma, limit {limit:.1f}" if rejected[k] else None
        for k in range(count)
    )
    return replace(search, batch=search.batch.weighted(~rejected)), current, reasons


def without_outliers(
    search: Search, solution: Solution, wanted: Holds
) -> tuple[Search, Solution, tuple[str | None, ...]]:
    """`reject_outliers`; distortion terms that had to be held because of them are freed again."""
    kept, refit, reasons = reject_outliers(search, solution)
    if not any(reasons) or np.array_equal(search.holds.held, wanted.held):
        return kept, refit, reasons
    again = refine_candidates(replace(kept, holds=wanted), [refit.cell])
    return reject_outliers(replace(search, holds=again.problem.holds), _after(refit, again))


def _after(before: Solution, solution: Solution) -> Solution:
    """The solution with the iterations spent before it counted in."""
    return replace(solution, iterations=before.iterations + solution.iterations)


def _lengths(search: Search, solution: Solution, unknowns: int) -> tuple[Array, float]:
    lengths = search.batch.whitened_lengths(state_from_cell(solution.cell))
    lengths = np.where(np.isnan(lengths), np.inf, lengths)
    return lengths, robust_scale(lengths, unknowns)
