"""Starts from random parts of the spots, a few of which have hardly any outliers."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.errors import DegenerateError
from lasercal_gtsam.observations import Observations

# share of each plane's spots in a part and the least number of them; how many parts at most
_PART_SHARE, _PART_SPOTS = 1 / 3, 10
_MAX_PARTS = 60


def parts_of(
    observations: Observations, closed_form: Callable[[Observations], Cell], seed: int
) -> Iterator[tuple[Cell, int] | None]:
    """Closed forms of random parts of the spots: a third of each plane's, at least ten.

    Yields (cell, number of spots), or None where the closed form refused the part.
    """
    rng = np.random.default_rng(seed)
    index = np.column_stack(
        [observations.camera_index, observations.laser_index, observations.plane_index]
    )
    members = [np.flatnonzero((index == block).all(axis=1)) for block in np.unique(index, axis=0)]
    for _ in range(_MAX_PARTS):
        chosen = [
            rng.permutation(m)[: max(_PART_SPOTS, int(np.ceil(_PART_SHARE * len(m))))]
            for m in members
        ]
        rows = np.sort(np.concatenate(chosen))
        try:
            yield closed_form(observations[rows]), len(rows)
        except DegenerateError:
            yield None
