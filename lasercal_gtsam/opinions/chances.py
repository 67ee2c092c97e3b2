"""Tail probabilities and the correction for looking many times, without `scipy.stats`.

(`scipy.stats` takes most of a second to import; its functions here are one call of
`scipy.special` each.)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtrc, fdtrc, ndtr

from lasercal_gtsam.frozen import Array


def f_above(value: float, k: float, dof: float) -> float:
    """P(F > value) with k and dof degrees of freedom."""
    return float(fdtrc(k, dof, value))


def chi2_above(value: float, k: float) -> float:
    """P(chi2 > value) with k degrees of freedom."""
    return float(chdtrc(k, value))


def normal_above(value: float) -> float:
    """P(Z > value)."""
    return float(ndtr(-value))


def holm(chances: Sequence[float]) -> list[float]:
    """Holm's step-down correction: chances that hold for all tests together."""
    order = np.argsort(chances, kind="stable")
    out, worst = [1.0] * len(chances), 0.0
    for rank, i in enumerate(order):
        worst = max(worst, min(1.0, (len(chances) - rank) * chances[i]))
        out[int(i)] = worst
    return out


def anderson_darling(z: Array) -> tuple[float, float]:
    """Anderson-Darling statistic of normality, mean and variance estimated, and its chance.

    With the correction for small samples and the formula for the chance of D'Agostino and Stephens,
    "Goodness-of-fit techniques" (1986), table 4.9.
    """
    n = len(z)
    x = np.sort((z - z.mean()) / z.std(ddof=1))
    i = np.arange(1, n + 1)
    below = np.clip(ndtr(x), 1e-300, 1.0)
    above = np.clip(ndtr(-x[::-1]), 1e-300, 1.0)
    a = float(-n - np.mean((2 * i - 1) * (np.log(below) + np.log(above))))
    a *= 1 + 0.75 / n + 2.25 / n**2
    if a >= 0.6:
        p = np.exp(1.2937 - 5.709 * a + 0.0186 * a * a)
    elif a >= 0.34:
        p = np.exp(0.9177 - 4.279 * a - 1.38 * a * a)
    elif a >= 0.2:
        p = 1 - np.exp(-8.318 + 42.796 * a - 59.938 * a * a)
    else:
        p = 1 - np.exp(-13.436 + 101.14 * a - 223.73 * a * a)
    # the formula turns upwards beyond its range
    return a, float(min(p, 1.0)) if a < 10 else 0.0
