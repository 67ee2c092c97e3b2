"""A start that outliers do not spoil, be they one or nearly half of the spots.

One reflection taken for the spot, 100 px away among 90, puts the closed form off by 15 %, and a
fifth of them leaves nothing of it. So, once some spots stand out:

1. the groups of non-rotating motions tell which of their shots agree (`agreement`);
2. the pair is solved on those. One wrong spot among them still spoils it, so that parts of them are
   tried as well, and the solution that most spots of all fit is taken;
3. spots far off are set aside, those near are taken back, and the pair is solved again, until
   nothing changes.

Only the start leaves spots out; the refinement gets all of them, and the names of those that were
set aside.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lasercal_gtsam.closed_form.agreement import agreements
from lasercal_gtsam.closed_form.camera import KnownIntrinsics
from lasercal_gtsam.closed_form.groups import Groups, find_groups
from lasercal_gtsam.closed_form.lost_planes import with_lost_planes
from lasercal_gtsam.closed_form.pair import PairCandidate, plausible, solve_pair
from lasercal_gtsam.closed_form.requirements import check_spots
from lasercal_gtsam.closed_form.solution import Solution, spot_distances
from lasercal_gtsam.closed_form.spots import Index, Spots
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.frozen import Array

Mask = npt.NDArray[np.bool_]

SUSPICIOUS = 4.5
"""Multiple of the median distance beyond which a spot starts the rounds (Gaussian: 5.3 sigma)."""
ASIDE = 3.0
"""Multiple of the median distance beyond which spots are then left out (Gaussian: 3.5 sigma)."""
SMALLEST_LIMIT_PX = 1.0
MOST_ASIDE = 0.5
FITS = 0.0125
"""Share of the image diagonal within which a spot counts for a solution of a part of them."""
_ROUNDS = 10
# how many agreements are tried, and parts of each; the share of its spots that must fit a solution
# for it to be good, and for it to be better than nothing
_AGREEMENTS, _PARTS, _GOOD, _USABLE = 3, 12, 0.8, 0.4
# share of them from which on the distances tell the outliers, and not what was solved
_TELLING = 0.6
# share of the fit that another round must keep
_NO_WORSE = 0.5
# solutions of a part that are judged by all spots
_JUDGED = 6


class _Start(NamedTuple):
    """Solutions of some spots, the best for all spots first.

    ``distances`` (N,): of all spots from the best, pixels; ``rows``: the spots that were solved;
    ``fit``: how many of all fit the best.
    """

    found: list[PairCandidate]
    distances: Array
    rows: Index
    fit: float


def solve_pair_without_outliers(
    spots: Spots, known: KnownIntrinsics, group_tolerance_rad: float
) -> tuple[list[PairCandidate], Mask]:
    """`pair.solve_pair`, again without the spots that lie far off, until nothing changes.

    Returns
    -------
    solutions, the best first, and (N,) which spots none of them was made from

    Raises
    ------
    DegenerateError
        As `pair.solve_pair` on all spots.
    """
    check_spots(spots)
    everything = np.arange(len(spots))
    groups = find_groups(spots, group_tolerance_rad)
    solver = _Solver(spots, known, group_tolerance_rad)
    nothing = np.zeros(len(spots), dtype=np.bool_)
    start = solver.solve(everything, search=False)
    if start is not None and not plausible(start.found[0], spots):
        start = None
    if start is not None and within(start.distances, SUSPICIOUS).all():
        return start.found, nothing
    agreed = solver.from_agreement(groups)
    if start is None and (agreed is None or agreed.fit <= _USABLE * len(agreed.rows)):
        try:
            start = solver.judged(solve_pair(spots, groups, known), everything)
        except DegenerateError:
            if agreed is None:
                raise
        if start is not None and within(start.distances, SUSPICIOUS).all():
            return start.found, nothing
    if start is None or (agreed is not None and agreed.fit > start.fit):
        start = agreed
    assert start is not None
    start = solver.rounds(start)
    if len(start.rows) == len(spots):
        return start.found, _far(start.distances)
    if start.fit > _TELLING * len(start.rows):
        near = within(start.distances, ASIDE, start.distances[start.rows])
        return start.found, ~near | np.isnan(start.distances)
    return start.found, ~np.isin(everything, start.rows)


def set_aside(solution: Solution, spots: Spots) -> Mask:
    """(N,) True for spots too far from a solution; none where no spot is `SUSPICIOUS`."""
    return _far(spot_distances(solution, spots))


def _far(distances: Array) -> Mask:
    aside = ~within(distances, ASIDE)
    if within(distances, SUSPICIOUS).all() or aside.mean() > MOST_ASIDE:
        return np.zeros(len(distances), dtype=np.bool_)
    return aside


def within(distances: Array, factor: float, of: Array | None = None) -> Mask:
    """Spots nearer than a multiple of the median; NaN (spots on unsolved planes) counts as near.

    The median of all, or of the distances in ``of``.
    """
    limit = max(factor * _median(distances if of is None else of), SMALLEST_LIMIT_PX)
    return np.asarray(np.isnan(distances) | (distances <= limit))


def _median(distances: Array) -> float:
    return float(np.nanmedian(distances))


@dataclass(frozen=True, eq=False)
class _Solver:
    """Solves parts of the spots of one pair, and judges the solutions by all of them."""

    spots: Spots
    known: KnownIntrinsics
    group_tolerance_rad: float

    def solve(self, rows: Index, *, search: bool) -> _Start | None:
        """Solutions of some spots; None where these do not determine the cell."""
        some = self.spots.subset(rows)
        groups = find_groups(some, self.group_tolerance_rad)
        try:
            return self.judged(solve_pair(some, groups, self.known, search=search), rows)
        except DegenerateError:
            return None

    def judged(self, found: list[PairCandidate], rows: Index) -> _Start:
        """Solutions of some spots, which of them most of all spots fit, and how far they are."""
        if len(rows) < len(self.spots):
            found = [self.completed(one) for one in found[:_JUDGED]] + found[_JUDGED:]
        distances = [spot_distances(one.solution, self.spots) for one in found[:_JUDGED]]
        fits = [self.fit(one) for one in distances]
        if len(rows) < len(self.spots):
            best = int(np.argmax(fits))
            found = [found[best], *found[:best], *found[best + 1 :]]
        else:
            best = 0
        return _Start(found, distances[best], rows, fits[best])

    def completed(self, candidate: PairCandidate) -> PairCandidate:
        """The candidate with the planes that its spots did not give."""
        solution = with_lost_planes(candidate.solution, self.spots, self.limit_px)
        return replace(candidate, solution=solution)

    @property
    def limit_px(self) -> float:
        """Distance up to which a spot counts for a solution."""
        return FITS * float(np.hypot(*self.spots.image_size))

    def fit(self, distances: Array) -> float:
        """How many spots are near, those near the limit counting less."""
        return float(np.nansum(np.maximum(0.0, 1.0 - (distances / self.limit_px) ** 2)))

    def from_agreement(self, groups: Groups) -> _Start | None:
        """The solution of shots that agree which most spots fit; None if none can be solved."""
        best: _Start | None = None
        for agreement in agreements(groups)[:_AGREEMENTS]:
            count = len(agreement.rows)
            for part in islice(agreement.parts(), _PARTS):
                one = self.solve(part, search=False)
                if one is not None and (best is None or one.fit > best.fit):
                    best = one
                if best is not None and best.fit > _GOOD * count:
                    return best
            if best is not None and best.fit > _USABLE * count:
                return best
        return best

    def rounds(self, start: _Start) -> _Start:
        """Set aside and take back spots until nothing changes."""
        for _ in range(_ROUNDS):
            kept = within(start.distances, ASIDE, start.distances[start.rows])
            rows = np.flatnonzero(kept)
            if np.array_equal(rows, start.rows) or kept.mean() < 1.0 - MOST_ASIDE:
                break
            again = self.solve(rows, search=True)
            if again is None or _median(again.distances) > 1.02 * _median(start.distances):
                break
            if again.fit < _NO_WORSE * start.fit:
                break
            start = again
        return start
