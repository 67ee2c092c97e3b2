"""Starts from random parts of the spots, a few of which have hardly any outliers."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.observations import Index, Observations

# share of each plane's spots in a part and the least number of them; how many parts at most
_PART_SHARE, _PART_SPOTS = 1 / 3, 10
_MAX_PARTS = 60


def parts_of(
    observations: Observations, closed_form: Callable[[Observations], Cell], seed: int
) -> Iterator[tuple[Cell, int] | None]:
    """Closed forms of random parts of the spots: a third of each plane's, at least ten.

    Of few spots a part leaves out hardly any. So what the parts of one shuffle leave out differs
    until every spot was left out once, and a single outlier is never in all of them.

    Yields (cell, number of spots), or None where the closed form refused the part.
    """
    rng = np.random.default_rng(seed)
    index = np.column_stack(
        [observations.camera_index, observations.laser_index, observations.plane_index]
    )
    members = [np.flatnonzero((index == block).all(axis=1)) for block in np.unique(index, axis=0)]
    taken = [_taken(rng, m) for m in members]
    for _ in range(_MAX_PARTS):
        rows = np.sort(np.concatenate([next(part) for part in taken]))
        try:
            yield closed_form(observations[rows]), len(rows)
        except DegenerateError:
            yield None


def _taken(rng: np.random.Generator, members: Index) -> Iterator[Index]:
    """Parts of some spots, without end; each leaves out the next ones of a shuffled circle."""
    size = min(max(_PART_SPOTS, int(np.ceil(_PART_SHARE * len(members)))), len(members))
    while True:
        shuffled = rng.permutation(members)
        step = max(len(members) - size, 1)
        for first in range(0, len(members), step):
            yield np.roll(shuffled, -first)[:size]
