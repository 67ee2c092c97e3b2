"""Are the sigmas right with robot noise, stated and estimated. `noise_study` prints the numbers."""

from __future__ import annotations

import numpy as np
import pytest
from noise_study import BOTH, CASES, ESTIMATED, nees_study, stated

from lasercal_gtsam.sigma_check.statistics import nees_check


def options(told, **changes):
    return {"distortion": "none", **stated(told), **changes}


def test_a_few_captures():
    found = nees_study(BOTH, options(BOTH), range(6), "paper")
    assert found.dimension == 24 and found.dof == 156 and not found.skipped
    assert found.scaled.shape == found.ratio.shape == (6,)
    assert 10 < found.ratio.mean() < 45
    levels = nees_study(BOTH, options(BOTH, sigma_px=None, **ESTIMATED), range(3), "paper")
    assert levels.levels.shape == levels.reach.shape == (3, 3)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_stated_noise_gives_right_sigmas(case):
    """306 spots: the cell is nearly linear within its errors.

    With 90 the same robot noise bends it: the likelihood ratio, which no bend of the unknowns can
    touch, is as it should be, while their quadratic form is 4 to 5 % too large.
    """
    noise, told = CASES[case]
    found = nees_study(noise, options(told), range(500), "paper", groups=6, shots=17)
    check = nees_check(found.stated, found.dimension)
    assert check.low < check.mean < check.high
    few = nees_study(noise, options(told), range(500), "paper")
    check = nees_check(few.ratio, few.dimension)
    assert check.low < check.mean < check.high
    for scores in (found.scores, few.scores):
        cover = (np.abs(scores) < 1.96).mean(axis=0)
        assert cover.min() > 0.92 and 0.94 < cover.mean() < 0.96


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_estimated_noise_gives_right_sigmas(case):
    noise, told = CASES[case]
    asked = options(told, sigma_px=None, **ESTIMATED)
    found = nees_study(noise, asked, range(300), "paper")
    cover = (np.abs(found.scores) < 1.96).mean(axis=0)
    assert cover.min() > 0.91 and 0.935 < cover.mean() < 0.965
    assert found.reach.mean(axis=0).min() > 0.92
