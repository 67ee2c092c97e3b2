"""A start that gross outliers do not spoil: solve, set aside what lies far off, solve again.

One reflection taken for the spot, 100 px away among 90, puts the closed form off by 15 %. Its
residual still stands out, so it is found in a few rounds. Only the start leaves these spots out;
the refinement gets all of them, and the names of those that were set aside.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.closed_form.camera import KnownIntrinsics
from lasercal_gtsam.closed_form.groups import find_groups
from lasercal_gtsam.closed_form.pair import PairCandidate, solve_pair
from lasercal_gtsam.closed_form.solution import Solution, spot_distances
from lasercal_gtsam.closed_form.spots import Spots
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array

SUSPICIOUS = 4.5
"""Multiple of the median distance beyond which a spot starts the rounds (Gaussian: 5.3 sigma)."""
ASIDE = 3.0
"""Multiple of the median distance beyond which spots are then left out (Gaussian: 3.5 sigma)."""
SMALLEST_LIMIT_PX = 1.0
MOST_ASIDE = 0.3
_ROUNDS = 10


def solve_pair_without_outliers(
    spots: Spots, known: KnownIntrinsics, group_tolerance_rad: float
) -> list[PairCandidate]:
    """`pair.solve_pair`, again without the spots that lie far off, until nothing changes.

    Raises
    ------
    DegenerateError
        As `pair.solve_pair` on all spots.
    """
    found = solve_pair(spots, find_groups(spots, group_tolerance_rad), known)
    distances = spot_distances(found[0].solution, spots)
    kept = within(distances, SUSPICIOUS)
    if kept.all():
        return found
    previous = np.ones(len(spots), dtype=bool)
    for _ in range(_ROUNDS):
        kept = within(distances, ASIDE)
        if np.array_equal(kept, previous) or kept.mean() < 1.0 - MOST_ASIDE:
            break
        previous = kept
        subset = spots.subset(np.flatnonzero(kept))
        try:
            again = solve_pair(subset, find_groups(subset, group_tolerance_rad), known)
        except DegenerateError:
            break
        new = spot_distances(again[0].solution, spots)
        if _median(new) > 1.02 * _median(distances):
            break
        found, distances = again, new
    return found


def set_aside(solution: Solution, spots: Spots) -> npt.NDArray[np.bool_]:
    """(N,) True for spots too far from a solution; none where no spot is `SUSPICIOUS`."""
    distances = spot_distances(solution, spots)
    if within(distances, SUSPICIOUS).all():
        return np.zeros(len(spots), dtype=bool)
    aside = ~within(distances, ASIDE)
    return aside if aside.mean() <= MOST_ASIDE else np.zeros(len(spots), dtype=bool)


def within(distances: Array, factor: float) -> npt.NDArray[np.bool_]:
    """Spots nearer than a multiple of the median; NaN (spots on unsolved planes) counts as near."""
    limit = max(factor * _median(distances), SMALLEST_LIMIT_PX)
    return np.asarray(np.isnan(distances) | (distances <= limit))


def _median(distances: Array) -> float:
    return float(np.nanmedian(distances))
