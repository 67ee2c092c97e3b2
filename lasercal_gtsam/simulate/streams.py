"""Independent streams of random numbers out of one seed."""

from __future__ import annotations

import numpy as np

from lasercal_gtsam.errors import DataError

CELL, MOTIONS, NOISE, PICTURES = range(4)


def stream(seed: int, *key: int) -> np.random.Generator:
    """Generator that depends on the seed and the key only.

    What one use draws does not shift another: pixels do not change when a motion takes one more
    try, and picture 7 is the same whether picture 6 was rendered or not.

    Parameters
    ----------
    seed : integer >= 0
    key : what it is for: one of `CELL`, `MOTIONS`, `NOISE`, `PICTURES`, then any counters

    Raises
    ------
    DataError
        The seed is not an integer >= 0.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise DataError(f"simulate: seed must be an integer >= 0, got {seed!r}")
    return np.random.default_rng(np.random.SeedSequence(int(seed), spawn_key=key))
