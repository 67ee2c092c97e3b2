"""Starts from random parts of the spots, a few of which have hardly any outliers.

For hand poses in no groups: in groups the closed form itself tells which shots agree.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lasercal_gtsam.cell import Cell
from lasercal_gtsam.robust.consensus import Consensus, best_of, consensus, credible, settles_it
from lasercal_gtsam.robust.scale import lengths_of
from lasercal_gtsam.start import Search

Parts = Iterator[tuple[Cell, int] | None]

# how many random parts at least, and the probability that one without outliers is among them
_FEWEST, _CONFIDENCE = 15, 0.99
# how many at least while no fit is credible: its residuals say nothing about the share of outliers
_FEWEST_LOST = 30
# where a part has this share of the spots or more, only a lonely outlier can be outside of it: then
# as many parts as leave out every spot so many times
_LARGE, _TIMES_LEFT_OUT = 2 / 3, 2
# parts that lead to the same end, so that fewer are enough
_AGREED = 2
# parts refused one after the other after which the data are at fault, not their outliers
_MOST_REFUSED = 4


def best_of_parts(search: Search, parts: Parts, best: Consensus | None) -> Consensus | None:
    """Best consensus over random parts, as many as the share of outliers asks for."""
    lowest, refused, agreed = np.inf, 0, 0
    for trial, part in enumerate(parts, start=1):
        if part is None:
            refused += 1
            if refused == trial >= _MOST_REFUSED:
                break
            continue
        cell, size = part
        start, found = search.holds.apply(cell), None
        middle = float(np.median(lengths_of(search, start)))
        if np.isfinite(middle) and middle <= 2.0 * lowest:
            lowest = min(lowest, middle)
            found = consensus(search, start, start)
            before, best = best, best_of([best, found])
            if found is not None and best is not None and found.scale < 1.01 * best.scale:
                agreed = agreed + 1 if before and before.scale < 1.01 * best.scale else 1
        if best is None:
            continue
        if agreed >= _AGREED and credible(search, best.scale):
            break
        if found is best and settles_it(search, best):
            break
        clean = float(np.clip(best.share**size, 1e-12, 1.0 - 1e-12))
        least = _FEWEST if credible(search, best.scale) else _FEWEST_LOST
        enough = max(least, np.log(1.0 - _CONFIDENCE) / np.log1p(-clean))
        if trial >= min(enough, _most(len(search.batch), size)):
            break
    return best


def _most(count: int, size: int) -> float:
    """How many parts of ``size`` of ``count`` spots are worth trying at most."""
    if size < _LARGE * count:
        return np.inf
    return _TIMES_LEFT_OUT * count / max(count - size, 1)
