"""The right cause is named, and the part is given back: a few seeds of `bump_study`."""

from __future__ import annotations

import numpy as np
import pytest
from bump_study import NAMES, SIZES, study

SEEDS = range(20)
MOVES = ("camera", "laser", "plane")
LARGE = ("2 deg/10 mm", "20 deg/100 mm")


@pytest.mark.slow
@pytest.mark.parametrize("kind", MOVES)
@pytest.mark.parametrize("size", LARGE)
@pytest.mark.parametrize("pixel_px", [0.3, 1.0])
def test_large_bumps_are_named_within_ten_spots(kind: str, size: str, pixel_px: float) -> None:
    tally = study(kind, SIZES[size], SEEDS, pixel_px=pixel_px, after=(10,), give_back=True)
    assert tally.rate(10) >= 0.95
    assert not any(tally.wrong_sure[10])
    assert np.mean(np.array(tally.far) < 3.0) >= 0.9
    unknowns = {"camera": 6, "laser": 4, "plane": 3}[kind]
    # mean of 20 chi-squares: three sigmas
    assert np.mean(tally.score) < unknowns + 3 * np.sqrt(2 * unknowns / len(SEEDS))


@pytest.mark.slow
@pytest.mark.parametrize("kind", MOVES)
def test_small_bumps_are_named_where_they_can_be_noticed(kind: str) -> None:
    tally = study(kind, SIZES["0.2 deg/1 mm"], SEEDS, pixel_px=0.3, after=(10, 20))
    assert tally.rate(20) >= 0.9
    rate, count = tally.rate_of_noticeable(10)
    assert count == 0 or rate >= 0.9
    assert not any(tally.wrong_sure[10])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["robot", "none"])
def test_the_robot_and_nothing_are_named(kind: str) -> None:
    tally = study(kind, (0.0, 0.0), SEEDS, pixel_px=0.3, after=(10,))
    assert NAMES[kind] == ""
    assert tally.rate(10) >= 0.85
    assert not any(tally.wrong_sure[10])
