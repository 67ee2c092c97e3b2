"""Small random samples of the shots of groups of non-rotating motions."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np

from lasercal_gtsam.closed_form.groups import Groups
from lasercal_gtsam.closed_form.spots import IMAGE_DIAGONAL, Index
from lasercal_gtsam.frozen import Array

SEPARATION = 0.01 * IMAGE_DIAGONAL
"""Least distance between the pixels of a sample. A ghost stays where it is, so a sample has one at
most; and shots that are close together fix no map."""
# samples are drawn one by one where a group has more than this many times the number wanted
_LISTED = 20


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of ``size`` shots of every group.

    Attributes
    ----------
    shots : (G, M, size) indices of shots; rows beyond the count are padding
    counts : (G,) number of samples
    """

    shots: Index
    counts: Index

    @classmethod
    def draw(cls, groups: Groups, size: int, most: int, rng: np.random.Generator) -> Samples:
        """All samples with pixels apart where a group has no more than ``most``, or random ones."""
        found = [
            _samples_of(xy[: int(count)], size, most, rng)
            for count, xy in zip(groups.shots, groups.xy, strict=True)
        ]
        counts = np.array([len(rows) for rows in found], dtype=np.int64)
        shots = np.zeros((len(groups), int(counts.max(initial=0)), size), dtype=np.int64)
        for g, rows in enumerate(found):
            shots[g, : len(rows)] = rows
        return cls(shots, counts)


def _samples_of(xy: Array, size: int, most: int, rng: np.random.Generator) -> Index:
    count = len(xy)
    if comb(count, size) <= _LISTED * most:
        rows = np.array(list(combinations(range(count), size)), dtype=np.int64).reshape(-1, size)
    else:
        rows = np.argsort(rng.random((3 * most, count)), axis=1)[:, :size]
    apart = np.linalg.norm(xy[:, None] - xy, axis=-1) > SEPARATION
    first, second = np.triu_indices(size, 1)
    rows = rows[apart[rows[:, first], rows[:, second]].all(axis=1)]
    return rows if len(rows) <= most else np.asarray(rows[rng.permutation(len(rows))[:most]])
