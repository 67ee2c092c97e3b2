"""A cell that most spots agree on: the Cauchy loss minimised from a start, and what it is worth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from lasercal_factors.batch import Loss

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import LasercalError
from lasercal_gtsam.frozen import Array
from lasercal_gtsam.graph import make_graph
from lasercal_gtsam.holds import Holds
from lasercal_gtsam.robust.scale import (
    MEDIAN_ERROR,
    Mask,
    lengths_of,
    outliers,
    rejection_length,
    robust_scale,
    unknowns_of,
)
from lasercal_gtsam.solve import solve
from lasercal_gtsam.start import Search, fits_distortion, typical_sigma

# threshold of the Cauchy loss while outliers are looked for; the usual one, 94 % efficient here
CAUCHY_THRESHOLD = 2.385
MOST_OUTLIERS = 0.5
"""Share of outliers beyond which nothing says which spots are right."""
_ROUNDS = 10
# residual scale, as a share of the image diagonal, above which a fit explains nothing
_CREDIBLE_SCALE = 0.01
# probability that so many spots fit some cell by chance
_CHANCE = 1e-6


@dataclass(frozen=True)
class Consensus:
    """Where the Cauchy loss ended: the cell, the scale of its residuals and their lengths."""

    start: Cell
    cell: Cell
    scale: float
    lengths: Array
    iterations: int

    @property
    def share(self) -> float:
        """Share of the spots that fit."""
        return float(np.mean(self.lengths <= rejection_length(len(self.lengths)) * self.scale))


def consensus(
    search: Search, start: Cell, cell: Cell, among: Mask | None = None
) -> Consensus | None:
    """Minimise the Cauchy loss from ``cell``, which came from ``start``.

    The threshold follows the scale of the residuals downwards. The distortion stays where it is
    until the rest fits, then comes in as in a staged start. Where it is known which spots agree,
    ``among`` them first: many outliers that agree as well could draw a start away that is good.
    """
    if among is not None and not among.all():
        first = _minimised(search, start, cell, among)
        cell = cell if first is None else first.cell
    return _minimised(search, start, cell, np.ones(len(search.batch), np.bool_))


def _minimised(search: Search, start: Cell, cell: Cell, among: Mask) -> Consensus | None:
    stages: list[Holds] = [search.holds]
    if fits_distortion(search.holds, len(search.observations.cameras)):
        held = search.holds.without_distortion
        stages = [held(), held(("k1",)), search.holds]
    cell = make_graph(search.observations, search.batch, search.holds, cell).start
    unknowns = unknowns_of(search)
    lengths = lengths_of(search, cell)
    loss = Loss("cauchy", CAUCHY_THRESHOLD)
    iterations = 0
    for holds in stages:
        for _ in range(_ROUNDS):
            possible = np.isfinite(lengths) & among
            if possible.sum() < MOST_OUTLIERS * among.sum():
                return None
            scale = robust_scale(lengths[among], unknowns)
            batch = search.batch if possible.all() else search.batch.weighted(possible)
            problem = make_graph(search.observations, batch, holds, cell, loss).rescaled(scale)
            try:
                found = solve(problem, search.options.max_iterations, find_scale=False)
            except LasercalError:
                return None
            cell, lengths = found.cell, lengths_of(search, found.cell)
            iterations += found.iterations
            if abs(robust_scale(lengths[among], unknowns) - scale) < 0.01 * scale:
                break
    return Consensus(start, cell, robust_scale(lengths, unknowns), lengths, iterations)


def best_of(found: Sequence[Consensus | None]) -> Consensus | None:
    """The consensus with the smallest Cauchy loss at the smallest scale of all."""
    candidates = [c for c in found if c is not None]
    if not candidates:
        return None
    threshold = CAUCHY_THRESHOLD * min(c.scale for c in candidates)
    return min(candidates, key=lambda c: float(np.log1p((c.lengths / threshold) ** 2).sum()))


def credible(search: Search, scale: float, share: float = _CREDIBLE_SCALE) -> bool:
    """Whether the residuals are as short as detected spots can make them."""
    diagonal = max(np.hypot(*size) for size in search.observations.image_size.values())
    return bool(scale * typical_sigma(search) < share * diagonal)


def looks_clean(search: Search, lengths: Array) -> bool:
    """No residual too long, no heavy tail, and a scale that detected spots can have.

    A tail shows where many outliers agree: none stands out, but the root mean square exceeds the
    scale that the median gives by more than chance (four standard errors).
    """
    count, unknowns = len(lengths), unknowns_of(search)
    scale = robust_scale(lengths, unknowns)
    if not lengths.max() <= rejection_length(count) * scale:
        return False
    tail = float(np.sqrt(lengths @ lengths / max(2 * count - unknowns, 1))) / scale
    return tail < 1.0 + 4.0 * MEDIAN_ERROR / np.sqrt(count) and credible(search, scale)


def settles_it(search: Search, found: Consensus | None) -> bool:
    """Whether half of the spots fit or more, with residuals as noise alone makes them.

    Then there is nothing better to find. In a wrong minimum the residuals of those that fit are not
    so: many small, some large.
    """
    if found is None:
        return False
    far = np.asarray(~(found.lengths <= rejection_length(len(found.lengths)) * found.scale))
    if far.mean() > MOST_OUTLIERS:
        return False
    out = outliers(found.lengths, unknowns_of(search), far)
    return not_by_chance(search, found.lengths, out) and looks_clean(search, found.lengths[~out])


def not_by_chance(search: Search, lengths: Array, out: Mask) -> bool:
    """Whether so many spots as are left would hardly fit a cell if they were anywhere.

    As many spots as fix the unknowns fit always. Of the others each is within the limit with the
    share of the picture that this takes (Moisan & Stival 2004).
    """
    count, unknowns = len(out), unknowns_of(search)
    left = int((~out).sum())
    if left < (1.0 - MOST_OUTLIERS) * count or 2 * left <= unknowns:
        return False
    scale = robust_scale(lengths[~out], unknowns)
    limit_px = rejection_length(count) * scale * typical_sigma(search)
    area = max(width * height for width, height in search.observations.image_size.values())
    chance = min(math.pi * limit_px**2 / area, 1.0)
    choices = math.lgamma(count + 1) - math.lgamma(left + 1) - math.lgamma(count - left + 1)
    return choices + (left - 0.5 * unknowns) * math.log(chance) < math.log(_CHANCE)
