"""Numbers out of the trials: spreads, biases, coverages and the normalised squared error."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import bdtr, bdtrc, gammainc, gammaincc, gammaincinv, ndtr

from lasercal_gtsam.frozen import Array
from lasercal_gtsam.sigma_check.result import Coverage, NeesCheck, RowCheck

Z95 = 1.959963984540054
P68, P95 = 0.6826894921370859, 0.95


@dataclass(frozen=True, eq=False)
class Trials:
    """Raw outcome.

    ``sigma`` (rows,) is stated; ``errors`` and ``own_sigma`` are (solved, rows); ``whitened``
    (solved, d) are errors of the whole vector with unit covariance if the stated one is right.
    ``combinations`` (d, n): what each whitened coordinate is made of, in sigmas of the tangent
    coordinates ``labels`` (n,). ``expected_sigma`` (rows,): what the calibration's own spots give
    when they are solved at once from its estimate; ``volume``: their joint covariance in units of
    the stated one (variance per coordinate, geometric mean).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    sigma: Array
    expected_sigma: Array
    errors: Array
    own_sigma: Array
    whitened: Array
    combinations: Array
    labels: tuple[str, ...]
    volume: float
    failures: dict[int, str]
    trials: int
    seed: int
    from_data: bool
    spots: int
    dof: float
    left_out: int
    rejected: int
    redrawn: int
    noise_px: float
    priors: tuple[str, ...]
    outliers: int


def coverage(inside: int, trials: int, nominal: float) -> Coverage:
    """Share of intervals that held the truth, against what they promise."""
    share = inside / trials
    middle = (share + 0.5 / trials) / (1.0 + 1.0 / trials)
    half = math.sqrt(share * (1.0 - share) / trials + 0.25 / trials**2) / (1.0 + 1.0 / trials)
    at_most = float(bdtr(inside, trials, nominal))
    at_least = float(bdtrc(inside - 1, trials, nominal)) if inside else 1.0
    p = min(1.0, 2.0 * min(at_most, at_least))
    return Coverage(nominal, share, max(middle - half, 0.0), min(middle + half, 1.0), p)


def nees_check(nees: Array, dimension: int) -> NeesCheck:
    """Mean of the normalised squared errors with the 99 % band of chi-square."""
    n = len(nees)
    low, high = (chi2_quantile(p, n * dimension) / n for p in (0.005, 0.995))
    return NeesCheck(float(nees.mean()), dimension, low, high, float(nees.max()))


def chi2_quantile(p: float, dof: float) -> float:
    """Quantile of chi-square."""
    return float(2.0 * gammaincinv(dof / 2.0, p))


def row_check(run: Trials, i: int) -> RowCheck:
    """Statistics of one row of the table."""
    e, sigma, own = run.errors[:, i], float(run.sigma[i]), run.own_sigma[:, i]
    n = len(e)
    scatter = float(e.std(ddof=1))
    ratio, freedom = scatter / sigma, n - 1
    below = float(gammainc(freedom / 2.0, freedom * ratio**2 / 2.0))
    above = float(gammaincc(freedom / 2.0, freedom * ratio**2 / 2.0))
    low, high = (ratio / math.sqrt(chi2_quantile(p, freedom) / freedom) for p in (0.975, 0.025))
    bias = float(e.mean()) / sigma
    error_of_bias = ratio / math.sqrt(n)
    return RowCheck(
        name=run.names[i],
        unit=run.units[i],
        sigma=sigma,
        expected_sigma=float(run.expected_sigma[i]),
        scatter=scatter,
        ratio=ratio,
        ratio_low=low,
        ratio_high=high,
        ratio_p=min(1.0, 2.0 * min(below, above)),
        bias=bias,
        bias_p=float(2.0 * ndtr(-abs(bias) / error_of_bias)) if error_of_bias > 0 else 1.0,
        coverage_68=coverage(int((np.abs(e) <= sigma).sum()), n, P68),
        coverage_95=coverage(int((np.abs(e) <= Z95 * sigma).sum()), n, P95),
        own_sigma=float(np.median(own)),
        own_coverage_95=coverage(int((np.abs(e) <= Z95 * own).sum()), n, P95),
    )
